"""The command line: what it prints, its exit codes, and what it leaves behind."""

from __future__ import annotations

import io
import os
import pty
import re
import shutil
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyrostab.__main__ import main as start
from gyrostab.cli import app
from gyrostab.ingest.make_log import make_log
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_log, open_product, open_surface
from gyrostab.progress import show_progress
from gyrostab.time.durations import format_duration
from tests.support.command_line import N_TRUE, WINDOW, call, stopped, write_log

COMMANDS = (
    "demo",
    "scan",
    "ingest",
    "run",
    "watch",
    "davar",
    "fit",
    "report",
    "plot",
    "export",
    "simulate",
    "diagnose",
    "doctor",
)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "tool.csv")


# ------------------------------------------------------------------------------
# good input


@pytest.fixture(scope="module")
def product(log, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "product.nc"
    assert call("run", log, "-o", path, *WINDOW, "--quiet-progress") == 0
    return path


def test_run_finds_the_noise_that_was_put_in(product):
    dataset = open_product(product)
    assert list(dataset["axis"].values) == ["x", "y"]
    size, error = (dataset[name].isel(time=[0, -1]).values for name in ("N", "N_stderr"))
    assert np.all(np.abs(size - N_TRUE) < 5.0 * error)
    assert np.all(error < 0.1 * N_TRUE)


def test_davar_takes_any_log_and_no_product(log, product, tmp_path, capfd):
    assert call("davar", log, "-o", tmp_path / "davar.nc", *WINDOW) == 0
    np.testing.assert_array_equal(
        open_surface(tmp_path / "davar.nc")["avar"], open_product(product)["avar"]
    )
    capfd.readouterr()
    for none, kind in ((product, "a product"), (tmp_path / "davar.nc", "a dynamic Allan variance")):
        assert call("davar", none, "-o", tmp_path / "again.nc", *WINDOW) == 2
        assert (
            f"{none.name}: is {kind} that gyrostab wrote, not a log; give the log"
            in capfd.readouterr().err
        )


def test_the_fit_can_start_at_a_longer_averaging_time(log, tmp_path):
    assert (
        call("run", log, "-o", tmp_path / "late.nc", *WINDOW, "--fit-from", "0.1s", "--terms", "N")
        == 0
    )
    late = open_product(tmp_path / "late.nc")
    assert (late["observable"].sel(term="Q") == 0).all()
    assert float(late["N"][0, 0]) == pytest.approx(N_TRUE, rel=0.2)


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
def test_the_stages_one_by_one_give_the_same_product(log, product, tmp_path, suffix):
    stored, surface, fitted = (tmp_path / f"{name}.{suffix}" for name in ("log", "davar", "fitted"))
    assert call("ingest", log, "-o", stored) == 0
    assert call("davar", stored, "-o", surface, *WINDOW) == 0
    assert call("fit", surface, "-o", fitted) == 0
    assert open_surface(surface).sizes["axis"] == 2
    whole, staged = open_product(product), open_product(fitted)
    for name in ("avar", "count", "window_mean", "Q", "N", "B", "K", "R", "N_stderr", "K_upper"):
        xr.testing.assert_allclose(staged[name], whole[name], rtol=1e-9)


def test_scan_suggests_windows_for_the_noise_it_finds(tmp_path, capsys):
    """The estimate of N is within 10 % of the simulated noise, also below quantization noise."""
    from gyrostab.simulate import simulate

    long = simulate({"noise": {"N": 0.01, "Q": 0.5}}, duration="30min", rate=50.0)
    path = to_netcdf(long, tmp_path / "long.nc")
    assert call("scan", path) == 0
    shown = capsys.readouterr()
    match = re.search(r"N is about ([\d.]+) deg/sqrt\(h\)", shown.err)
    assert match is not None
    assert float(match[1]) == pytest.approx(0.01, rel=0.1)
    assert "--window 5min: B from 0.2" in shown.err
    assert "N is about" not in shown.out


def test_a_dry_run_describes_the_product_and_writes_nothing(log, product, tmp_path, capsys):
    assert call("run", log, "-o", tmp_path / "product.nc", *WINDOW, "--dry-run") == 0
    assert not list(tmp_path.iterdir())
    shown = capsys.readouterr().out
    made = open_product(product)
    window, tau = (format_duration(time, " ") for time in (made.window_s, float(made.tau[-1])))
    assert re.search(rf"^windows +{made.sizes['time']} of {window}, one every", shown, re.M)
    assert re.search(rf"^averaging +{made.sizes['tau']} times from \S+ m?s to {tau}$", shown, re.M)
    (size,) = re.findall(r"^output +about (\S+) MB$", shown, re.M)
    assert float(size) * 1e6 == pytest.approx(product.stat().st_size, rel=0.2)


def test_a_dry_run_prints_the_windows_before_it_computes(log, tmp_path, monkeypatch, capsys):
    """The first computation compiles, which takes longer than all the rest."""
    monkeypatch.setattr("gyrostab.jobs.estimate.compute_part", lambda *_: 1 / 0)
    assert call("run", log, "-o", tmp_path / "product.nc", *WINDOW, "--dry-run") == 1
    assert "averaging" in capsys.readouterr().out


@pytest.mark.parametrize("form", ["nc", "zarr"])
@pytest.mark.parametrize(("option", "stored"), [((), True), (("--no-stamps",), False)])
def test_ingest_stores_the_time_of_every_sample(log, tmp_path, form, option, stored):
    assert call("ingest", log, "-o", tmp_path / f"log.{form}", *option) == 0
    engine = "zarr" if form == "zarr" else "netcdf4"
    with xr.open_dataset(tmp_path / f"log.{form}", engine=engine) as plain:
        assert ("time" in plain.coords) is stored
        with open_log(tmp_path / f"log.{form}") as own:
            np.testing.assert_array_equal(plain.rate.values, own.rate.values)
            if stored:
                np.testing.assert_array_equal(plain.time.values, own.time.values)


def test_one_axis_only(log, product, tmp_path):
    assert call("run", log, "-o", tmp_path / "y.nc", *WINDOW, "--axis", "y") == 0
    product_y = open_product(tmp_path / "y.nc")
    assert list(product_y["axis"].values) == ["y"]
    np.testing.assert_allclose(
        product_y["avar"].values[0], open_product(product)["avar"].sel(axis="y").values
    )


def test_window_in_samples_is_the_window_in_seconds(log, product, tmp_path):
    assert (
        call(
            "run", log, "-o", tmp_path / "out.nc", "--window", "2000samples", "--step", "500samples"
        )
        == 0
    )
    np.testing.assert_array_equal(
        open_product(tmp_path / "out.nc")["avar"].values, open_product(product)["avar"].values
    )


def test_map_and_unit_make_a_strange_log_readable(log, product, tmp_path):
    strange = tmp_path / "strange.csv"
    strange.write_text(
        log.read_text().replace("gyro_x [deg/h]", "wx").replace("gyro_y [deg/h]", "wy")
    )
    options = ("--map", "wx=gyro_x", "--map", "wy=gyro_y", "--unit", "gyro=0.5 deg/h")
    assert call("run", strange, "-o", tmp_path / "out.nc", *WINDOW, *options) == 0
    np.testing.assert_allclose(
        open_product(tmp_path / "out.nc")["avar"].values,
        open_product(product)["avar"].values / 4.0,
        rtol=1e-6,
    )


def test_map_from_a_file(log, tmp_path):
    strange = tmp_path / "strange.csv"
    strange.write_text(log.read_text().replace("gyro_x", "wx").replace("gyro_y", "wy"))
    (tmp_path / "map.toml").write_text('wx = "gyro_x"\nwy = "gyro_y"\n')
    assert call("ingest", strange, "-o", tmp_path / "log.nc", "--map", tmp_path / "map.toml") == 0
    assert list(open_log(tmp_path / "log.nc")["axis"].values) == ["x", "y"]


def test_config_gives_defaults_and_the_command_line_wins(log, tmp_path):
    config = tmp_path / "run.toml"
    config.write_text(
        'quiet-progress = true\n[run]\nwindow = "20s"\nstep = "10s"\naxis = ["x"]\n'
        '[run.unit]\ngyro = "2 deg/h"\n[fit]\nterms = "N"\n'
    )
    assert call("run", log, "-o", tmp_path / "a.nc", "--config", config) == 0
    assert call("run", log, "-o", tmp_path / "b.nc", f"--config={config}", "--step", "5s") == 0
    first, second = open_product(tmp_path / "a.nc"), open_product(tmp_path / "b.nc")
    assert list(first["axis"].values) == ["x"]
    steps = [
        np.diff(dataset["time"].values)[0] / np.timedelta64(1, "s") for dataset in (first, second)
    ]
    assert steps == [10.0, 5.0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[run]\nwindw = "20s"\n', "windw"),
        ("[rum]\n", r"\[rum\]"),
        ("[run\n", "not a TOML file"),
        ("[run]\nrate = 'x'\n", "rate"),
        ("run = 5\n", r"run is a command; give its options in a table \[run\]"),
        ("workers = 1.5\n", r"workers\]: 1\.5 .give a whole number.\. See"),
    ],
)
def test_config_with_a_slip_of_the_pen(text, expected, log, tmp_path, capfd):
    (tmp_path / "run.toml").write_text(text)
    assert call("run", log, "-o", tmp_path / "out.nc", "--config", tmp_path / "run.toml") == 2
    assert re.search(expected, capfd.readouterr().err)


def test_report_is_one_page(product, tmp_path):
    assert call("report", product, "-o", tmp_path / "report.html") == 0
    page = (tmp_path / "report.html").read_text()
    assert "<html" in page
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.S)
    assert not re.search(r"""(src|href)=["']https?://""", markup)
    assert not re.search(r"<script[^>]* src", page)


# ------------------------------------------------------------------------------
# help, exit codes


def test_help_names_every_command(capsys):
    assert call("--help") == 0
    shown = capsys.readouterr().out
    assert all(re.search(rf"^\W*{command}\b", shown, re.M) for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_has_an_example_that_parses(command, capsys):
    assert call(command, "--help") == 0
    text = re.sub(r"\s+", " ", capsys.readouterr().out)
    example = re.search(
        rf"gyrostab {command} (?!-)[^╭]*?(?=╭)|gyrostab {command} -o \S+",
        text.split("Example", 1)[1],
    )
    assert example, text
    app[command].parse_args(example.group().split()[2:], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_calls_an_output_a_folder_if_it_is_one(command, capsys):
    assert call(command, "--help") == 0
    text = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    for kind, meaning in re.findall(r"--output -o (\S+) (\w+)", text):
        assert (kind == "DIR") == (meaning == "Folder")


def test_doctor_describes_the_installation(capsys, monkeypatch):
    assert call("doctor") == 0
    shown = capsys.readouterr().out
    assert f"numpy {np.__version__}" in shown
    assert not re.search(r"extra (las|ulog|miniseed): .*pip install", shown)
    assert re.search(r"compiled kernels: (\d+ files of|none yet)", shown)
    true = metadata.version

    def version(name: str) -> str:
        if name == "pyulog":
            raise metadata.PackageNotFoundError(name)
        return "1.26.4" if name == "numpy" else true(name)

    monkeypatch.setattr(metadata, "version", version)
    assert call("doctor") == 2
    shown = capsys.readouterr()
    assert "extra ulog: pyulog missing; pip install 'gyrostab[ulog]'" in shown.out
    assert re.search(r"numpy 1\.26\.4 \(needs >=2[\d.]*\): install gyrostab again", shown.err)


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is absent")
def test_completion_is_installed_in_the_shell_of_the_user(tmp_path):
    home = {**os.environ, "HOME": str(tmp_path), "SHELL": "/bin/bash"}
    command = [sys.executable, "-m", "gyrostab", "--install-completion"]
    subprocess.run(command, env=home, check=True, capture_output=True)
    (script,) = (path for path in tmp_path.rglob("gyrostab") if path.is_file())
    shown = subprocess.run(
        ["bash", "-c", f"source {script} && complete -p gyrostab"], capture_output=True, text=True
    )
    assert shown.stdout.startswith("complete -F")
    assert all(command in script.read_text(encoding="utf-8") for command in COMMANDS)


def test_version(capsys):
    assert call("--version") == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


@pytest.mark.parametrize("command", [["--version"], ["run", "--help"]])
def test_a_reader_that_has_ended_is_no_error(command):
    reader, writer = os.pipe()
    os.close(reader)
    code = "import sys; from gyrostab.__main__ import main; sys.exit(main())"
    ended = subprocess.run(
        [sys.executable, "-c", code, *command], stdout=writer, stderr=subprocess.PIPE
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_closed_standard_streams_are_no_error(log, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    monkeypatch.setattr(sys, "stdout", None)
    assert call("ingest", log, "-o", tmp_path / "log.nc") == 0
    assert call("scan", tmp_path / "nothing.csv") == 2


def test_no_command_shows_the_help(capsys):
    assert call() == 0
    assert "demo" in capsys.readouterr().out


def test_interrupt_is_exit_code_3(log, tmp_path, monkeypatch, capsys):
    def interrupted(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gyrostab.jobs.run.load_log", interrupted)
    assert call("run", log, "-o", tmp_path / "out.nc", *WINDOW) == 3
    assert "interrupted" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_while_the_program_loads_is_exit_code_3(monkeypatch, capsys):
    def interrupted() -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("gyrostab.cli.main", interrupted)
    assert start() == 3
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "SIGTERM",
        # without a signal in `test_interrupt_is_exit_code_3`
        pytest.param("SIGINT", marks=pytest.mark.slow),
        pytest.param("SIGHUP", marks=pytest.mark.full),
    ],
)
def test_a_real_interrupt_leaves_nothing_behind(tmp_path, name):
    path = write_log(tmp_path / "long.csv")
    code = (
        "import os, signal, sys, xarray\n"
        # a job in the background starts with the signal ignored
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from gyrostab.cli import main\n"
        "write = xarray.Dataset.dump_to_store\n"
        "def slow(dataset, target, **options):\n"
        "    written = write(dataset, target, **options)\n"
        f"    os.kill(os.getpid(), signal.{name})\n"
        "    return written\n"
        "xarray.Dataset.dump_to_store = slow\n"
        f"sys.exit(main(['ingest', {str(path)!r}, '-o', {str(tmp_path / 'log.nc')!r}]))"
    )
    stopped(code, exit_code=3, says="interrupted")
    assert [entry.name for entry in tmp_path.iterdir()] == ["long.csv"]


def test_a_fault_of_ours_is_exit_code_1_without_traceback(log, tmp_path, monkeypatch, capsys):
    def broken(*args: object, **options: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr("gyrostab.jobs.run.load_log", broken)
    assert call("run", log, "-o", tmp_path / "out.nc", *WINDOW) == 1
    shown = capsys.readouterr().err
    assert "of all things" in shown
    assert "Traceback" not in shown
    with pytest.raises(ZeroDivisionError):
        call("run", log, "-o", tmp_path / "out.nc", *WINDOW, "--debug")
    (tmp_path / "run.toml").write_text("[run]\ndebug = true\n")
    with pytest.raises(ZeroDivisionError):
        call("run", log, "-o", tmp_path / "out.nc", *WINDOW, "--config", tmp_path / "run.toml")


def test_progress_is_a_plain_line_per_stage_away_from_a_terminal(log, tmp_path, capfd):
    assert call("run", log, "-o", tmp_path / "a.nc", *WINDOW) == 0
    *stages, last = [
        line
        for line in capfd.readouterr().err.splitlines()
        if not line.startswith(("note: ", "next: "))
    ]
    assert stages[0] == "reading ..."
    assert "computing ..." in stages
    assert re.search(r"computing: 12,000 samples in \d+\.\d s, \d+\.\d\d Msamples/s", last)
    assert call("run", log, "-o", tmp_path / "b.nc", *WINDOW, "--quiet-progress") == 0
    assert "done in" not in capfd.readouterr().err


def test_a_long_stage_has_lines_of_progress(monkeypatch, capsys):
    clock = iter(float(second) for second in range(0, 1000, 50))
    monkeypatch.setattr("gyrostab.progress.time.perf_counter", lambda: next(clock))
    with show_progress() as stage:
        for done in range(1, 5):
            stage("diagnosing", 40, done, "cases")
    assert capsys.readouterr().err.splitlines()[:-1] == [
        "diagnosing ...",
        "diagnosing 3 of 40 cases, 30.83 min left",
    ]


@pytest.mark.slow
def test_progress_is_a_bar_on_a_terminal(log, tmp_path):
    leader, follower = pty.openpty()
    arguments = ["run", str(log), "-o", str(tmp_path / "out.nc"), *WINDOW]
    command = [sys.executable, "-m", "gyrostab", *arguments]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=follower, env={**os.environ, "COLUMNS": "120"}
    ) as running:
        os.close(follower)
        shown = b""
        deadline = time.monotonic() + 100.0
        while time.monotonic() < deadline:
            try:
                part = os.read(leader, 4096)
            except OSError:  # the other end has closed
                break
            if not part:
                break
            shown += part
    os.close(leader)
    assert running.returncode == 0, shown
    assert b"computing" in shown
    assert b"Msamples/s" in shown


# ------------------------------------------------------------------------------
# scan


def test_scan_in_a_pipe_is_a_plain_table(log, capsys):
    assert call("scan", log) == 0
    head, row = (line.split("\t") for line in capsys.readouterr().out.splitlines())
    table = dict(zip(head, row, strict=True))
    assert table["file"] == str(log)
    assert (float(table["rate_hz"]), table["axes"], int(table["rows"]), int(table["gaps"])) == (
        100.0,
        "x y",
        6000,
        0,
    )
    assert float(table["span_s"]) == pytest.approx(59.99)


def test_scan_goes_on_after_a_file_that_cannot_be_read(log, tmp_path, capsys):
    (tmp_path / "junk.csv").write_text("")
    assert call("scan", tmp_path / "junk.csv", log) == 2
    shown = capsys.readouterr()
    assert "empty" in shown.out
    assert str(log) in shown.out
    assert "1 of 2" in shown.err


def test_scan_counts_the_gaps_of_a_log_without_a_table(tmp_path, capsys):
    """`make_log` makes no table of gaps, and `run` needs none."""
    values = np.arange(100.0)
    values[10:20] = values[50] = np.nan
    to_netcdf(make_log(values, rate=10.0, unit="deg/h"), tmp_path / "log.nc")
    assert call("scan", tmp_path / "log.nc") == 0
    row = pd.read_csv(io.StringIO(capsys.readouterr().out), sep="\t").iloc[0]
    assert (row.gaps, row.missing_share, row.rows) == (2, pytest.approx(0.11), 100)


def test_a_cell_of_digits_without_end_is_no_stamp(tmp_path, capsys):
    """Python refuses to convert such a text to an integer, and the log is read all the same."""
    path = write_log(tmp_path / "log.csv", change=lambda rows: [*rows[:-1], "9" * 5000 + ",1,1"])
    assert call("scan", path) == 0
    table = pd.read_csv(io.StringIO(capsys.readouterr().out), sep="\t", comment="#")
    assert "1 of 6000 rows are unreadable: line 6001 (" in table.loc[0, "odd"]
