"""The command line: what it prints, its exit codes, and what it leaves behind."""

from __future__ import annotations

import gzip
import os
import pty
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gyrostab.__main__ import main as start
from gyrostab.cli import app, main
from gyrostab.errors import OutputError
from gyrostab.export import open_log, open_product, open_surface, to_netcdf
from gyrostab.read.buffers import Buffers
from gyrostab.run import load_log

COMMANDS = ("demo", "scan", "ingest", "run", "davar", "fit", "report", "plot", "export", "simulate")
RATE = 100
N_TRUE = 0.02  # deg/sqrt(h)


def write_log(
    path: Path, seconds: float = 60.0, *, header: str = "time [s],gyro_x [deg/h],gyro_y [deg/h]", change: Callable | None = None
) -> Path:
    """A log of white rate noise of `N_TRUE`; `change` may spoil its list of rows."""
    noise = 60.0 * N_TRUE * np.sqrt(RATE) * np.random.default_rng(5).standard_normal((round(seconds * RATE), 2))
    rows = [f"{index / RATE:.2f},{x:.4f},{y:.4f}" for index, (x, y) in enumerate(noise)]
    path.write_text("\n".join([header, *(change(rows) if change else rows)]) + "\n")
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "tool.csv")


def call(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


WINDOW = ("--window", "20s", "--step", "5s")

# ------------------------------------------------------------------------------------------------------------ bad input


def _bad_text(text: bytes, name: str = "bad.csv"):
    def make(folder: Path) -> list[object]:
        path = folder / name
        path.write_bytes(text)
        return [path, "-o", folder / "out.nc", *WINDOW]

    return make


def _bad_log(*options: object, **spoil):
    def make(folder: Path) -> list[object]:
        return [write_log(folder / "bad.csv", **spoil), "-o", folder / "out.nc", *(options or WINDOW)]

    return make


def _truncated_gzip(folder: Path) -> list[object]:
    whole = gzip.compress(write_log(folder / "bad.csv").read_bytes())
    (folder / "bad.csv").unlink()
    (folder / "bad.csv.gz").write_bytes(whole[: len(whole) // 2])
    return [folder / "bad.csv.gz", "-o", folder / "out.nc", *WINDOW]


def _truncated_netcdf(folder: Path) -> list[object]:
    values = xr.DataArray(np.random.default_rng(1).standard_normal((1, 5000)), dims=("axis", "time"), attrs={"units": "degree hour-1"})
    xr.Dataset({"rate": values}).to_netcdf(folder / "bad.nc")
    whole = (folder / "bad.nc").read_bytes()
    (folder / "bad.nc").write_bytes(whole[: len(whole) // 2])
    return [folder / "bad.nc", "-o", folder / "out.nc", *WINDOW]


def _existing_output(folder: Path) -> list[object]:
    (folder / "out.nc").write_text("precious")
    return [write_log(folder / "good.csv"), "-o", folder / "out.nc", *WINDOW]


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


def _damaged_log(folder: Path) -> list[object]:
    to_netcdf(load_log([write_log(folder / "good.csv")], epoch="2026-03-01"), folder / "bad.nc")
    whole = bytearray((folder / "bad.nc").read_bytes())
    whole[len(whole) // 2 : len(whole) // 2 + 200] = b"\xff" * 200
    (folder / "bad.nc").write_bytes(bytes(whole))
    return [folder / "bad.nc", "-o", folder / "out.nc", "--strict", *WINDOW]


def _unwritable_folder(folder: Path) -> list[object]:
    if os.geteuid() == 0:  # nothing is forbidden to root but what the kernel itself refuses
        return [write_log(folder / "good.csv"), "-o", "/proc/out.nc", *WINDOW]
    (folder / "locked").mkdir(mode=0o555)
    return [write_log(folder / "good.csv"), "-o", folder / "locked" / "out.nc", *WINDOW]


def _no_gyro(rows: list[str]) -> list[str]:
    return [f"{row.split(',')[0]},nan,nan" for row in rows]


def _words(rows: list[str]) -> list[str]:
    return [row if index % 5 < 2 else "**** telemetry ****" for index, row in enumerate(rows)]


BAD_INPUT = {
    "empty file": (_bad_text(b""), "empty"),
    "header only": (_bad_text(b"time [s],gyro_x [deg/h]\n"), "no data row"),
    "no unit": (_bad_log(header="time [s],gyro_x,gyro_y"), "--unit"),
    "unknown unit": (_bad_log(header="time [s],gyro_x [furlong/h],gyro_y [deg/h]"), "furlong/h"),
    "two time columns": (_bad_log(header="time [s],time [ms],gyro_y [deg/h]"), "time"),
    "time going backwards": (_bad_log(change=lambda rows: rows[::-1]), "time"),
    "all NaN": (_bad_log(change=_no_gyro), "unreadable"),
    "one sample": (_bad_log(seconds=0.01), "."),
    "rate declared wrongly by 10 %": (_bad_log("--rate", "110", *WINDOW), "110"),
    "duplicate columns": (_bad_log(header="time [s],gyro_x [deg/h],gyro_x [deg/h]"), "gyro_x"),
    "binary junk named csv": (_bad_text(bytes(np.random.default_rng(3).integers(0, 256, 5000, dtype=np.uint8))), "text|binary"),
    "truncated gzip": (_truncated_gzip, "bad.csv.gz"),
    "truncated NetCDF": (_truncated_netcdf, "bad.nc"),
    "window longer than the record": (_bad_log("--window", "2min", "--step", "10s"), "window"),
    "step longer than the window": (_bad_log("--window", "10s", "--step", "20s"), "step"),
    "tau longer than the window": (_bad_log("--window", "20s", "--step", "5s", "--taus", "1s,30s"), "tau|30"),
    "all averaging times too long": (_bad_log("--window", "20s", "--tau-max", "15s"), "15s.*half of the window of 20s"),
    "output is a directory": (
        lambda folder: [write_log(folder / "good.csv"), "-o", _folder(folder / "out.nc"), "--overwrite"],
        "out.nc' is a directory",
    ),
    "damaged log of ours": (_damaged_log, r"bad\.nc: .*is damaged"),
    "window without a unit": (_bad_log("--window", "20", "--step", "5s"), "window|20"),
    "window that is no duration": (_bad_log("--window", "long"), "long"),
    "axis that is not there": (_bad_log("--axis", "w", *WINDOW), "axis|'w'"),
    "more than half unreadable": (_bad_log(change=_words), "unreadable"),
    "no such file": (lambda folder: [folder / "none.csv", "-o", folder / "out.nc"], "none.csv"),
    "output exists": (_existing_output, "--overwrite"),
    "output is the input": (lambda folder: [write_log(folder / "out.nc"), "-o", folder / "out.nc", "--overwrite"], "input"),
    "output of the wrong kind": (lambda folder: [write_log(folder / "good.csv"), "-o", folder / "out.csv"], r"must end in \.nc"),
    "folder that cannot be written to": (_unwritable_folder, "out.nc"),
    "folder that is not there": (lambda folder: [write_log(folder / "good.csv"), "-o", folder / "no" / "out.nc"], "out.nc"),
    "map without a name": (_bad_log("--map", "wx"), "--map"),
    "config that is not there": (_bad_log("--config", "/nonexistent/run.toml"), "run.toml"),
    "option that is not there": (_bad_log("--begin-again"), "--begin-again"),
    "value that is no number": (_bad_log("--rate", "fast"), "--rate"),
    "no worker": (_bad_log("--workers", "0"), "--workers"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_one_message_and_nothing_left_behind(case, tmp_path, capfd):
    make, expected = BAD_INPUT[case]
    arguments = make(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert call("run", *arguments, "--quiet-progress") == 2
    shown = capfd.readouterr()
    assert shown.out == ""
    messages = [line for line in shown.err.splitlines() if not line.startswith(("note: ", "zstd: "))]  # zstd speaks for itself
    assert len(messages) == 1, shown.err
    assert messages[0].startswith("gyrostab: ")
    assert re.search(expected, messages[0]), messages[0]
    assert "Traceback" not in shown.err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_disk_full_while_writing(tmp_path):
    path = write_log(tmp_path / "tool.csv", 900.0)
    code = (
        "import resource, sys; from gyrostab.cli import main; import gyrostab; gyrostab.regularise; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2**19, 2**19)); "
        f"sys.exit(main(['ingest', {str(path)!r}, '-o', {str(tmp_path / 'log.nc')!r}, '--quiet-progress']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert "log.nc" in done.stderr
    assert "Traceback" not in done.stderr
    assert [entry.name for entry in tmp_path.iterdir()] == ["tool.csv"]


def test_full_standard_output_is_explained(log):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([sys.executable, "-m", "gyrostab", "scan", str(log)], stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert "the standard output: cannot be written" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_no_room_for_the_columns_of_a_long_log(monkeypatch):
    full = Path("/dev/full").open("wb")  # noqa: SIM115
    monkeypatch.setattr("gyrostab.read.buffers.tempfile.TemporaryFile", lambda **options: full)
    with pytest.raises(OutputError, match=r"cannot be written.*TMPDIR"):
        Buffers({0: np.float64}, limit=100).add({0: np.zeros(1000)})


def test_the_reading_options_stand_in_the_history(log, tmp_path):
    assert call("ingest", log, "-o", tmp_path / "log.nc", "--epoch", "2026-03-01", "--map", "gyro_y=-") == 0
    with open_log(tmp_path / "log.nc") as stored:
        assert "(read with epoch: 2026-03-01; map: gyro_y=-)" in stored.attrs["history"]


def test_options_that_do_not_fit_a_regular_log(log, tmp_path, capfd):
    regular = tmp_path / "log.nc"
    far = tmp_path / "far.csv"
    far.write_text("time,temperature [degC]\n2026-01-01T00:00:00,20\n2026-01-01T00:00:10,21\n")
    assert call("ingest", log, "-o", regular) == 0
    assert call("run", regular, "-o", tmp_path / "a.nc", *WINDOW, "--rate", RATE / 2) == 2
    assert "regular log of 100 Hz, not of 50 Hz" in capfd.readouterr().err
    assert call("run", regular, "-o", tmp_path / "a.nc", *WINDOW, "--rate", RATE, "--unit", "gyro=deg/s") == 0
    assert "--unit is not used" in capfd.readouterr().err
    assert call("run", regular, "-o", tmp_path / "b.nc", *WINDOW, "--channel", far) == 0
    assert "none of its 2 values" in capfd.readouterr().err


def test_constant_signal_runs_with_a_note(tmp_path, capfd):
    path = write_log(tmp_path / "flat.csv", change=lambda rows: [f"{row.split(',')[0]},5.0,5.0" for row in rows])
    assert call("run", path, "-o", tmp_path / "out.nc", *WINDOW) == 0
    assert re.search("note: .*constant", capfd.readouterr().err)
    assert float(open_product(tmp_path / "out.nc")["avar"].max()) == pytest.approx(0.0, abs=1e-12)


def test_stages_refuse_what_is_not_theirs(log, tmp_path, capfd):
    assert call("fit", log, "-o", tmp_path / "product.nc") == 2
    assert call("report", log, "-o", tmp_path / "report.html") == 2
    assert "Traceback" not in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------------------------ good input


@pytest.fixture(scope="module")
def product(log, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "product.nc"
    assert call("run", log, "-o", path, *WINDOW, "--quiet-progress") == 0
    return path


def test_run_finds_the_noise_that_was_put_in(product):
    dataset = open_product(product)
    assert list(dataset["axis"].values) == ["x", "y"]
    found, error = (dataset[name].isel(time=[0, -1]).values for name in ("N", "N_stderr"))
    assert np.all(np.abs(found - N_TRUE) < 5.0 * error)
    assert np.all(error < 0.1 * N_TRUE)


def test_davar_takes_any_log_and_no_product(log, product, tmp_path, capfd):
    assert call("davar", log, "-o", tmp_path / "davar.nc", *WINDOW) == 0
    np.testing.assert_array_equal(open_surface(tmp_path / "davar.nc")["avar"], open_product(product)["avar"])
    capfd.readouterr()
    assert call("davar", product, "-o", tmp_path / "again.nc", *WINDOW) == 2
    assert "Traceback" not in capfd.readouterr().err


def test_the_fit_can_start_at_a_longer_averaging_time(log, tmp_path):
    assert call("run", log, "-o", tmp_path / "late.nc", *WINDOW, "--fit-from", "0.1s", "--terms", "N") == 0
    late = open_product(tmp_path / "late.nc")
    assert (late["observable"].sel(term="Q") == 0).all()
    assert float(late["N"][0, 0]) == pytest.approx(N_TRUE, rel=0.2)


def test_the_stages_one_by_one_give_the_same_product(log, product, tmp_path):
    assert call("ingest", log, "-o", tmp_path / "log.nc") == 0
    assert call("davar", tmp_path / "log.nc", "-o", tmp_path / "davar.nc", *WINDOW) == 0
    assert call("fit", tmp_path / "davar.nc", "-o", tmp_path / "product.nc") == 0
    assert open_surface(tmp_path / "davar.nc").sizes["axis"] == 2
    whole, staged = open_product(product), open_product(tmp_path / "product.nc")
    for name in ("avar", "count", "window_mean", "Q", "N", "B", "K", "R", "N_stderr", "K_upper"):
        xr.testing.assert_allclose(staged[name], whole[name], rtol=1e-9)


def test_ingest_to_zarr_holds_the_same_log(log, tmp_path):
    assert call("ingest", log, "-o", tmp_path / "log.nc") == 0
    assert call("ingest", log, "-o", tmp_path / "log.zarr") == 0
    xr.testing.assert_equal(open_log(tmp_path / "log.zarr")["rate"], open_log(tmp_path / "log.nc")["rate"])


def test_one_axis_only(log, product, tmp_path):
    assert call("run", log, "-o", tmp_path / "y.nc", *WINDOW, "--axis", "y") == 0
    one = open_product(tmp_path / "y.nc")
    assert list(one["axis"].values) == ["y"]
    np.testing.assert_allclose(one["avar"].values[0], open_product(product)["avar"].sel(axis="y").values)


def test_window_in_samples_is_the_window_in_seconds(log, product, tmp_path):
    assert call("run", log, "-o", tmp_path / "out.nc", "--window", "2000samples", "--step", "500samples") == 0
    np.testing.assert_array_equal(open_product(tmp_path / "out.nc")["avar"].values, open_product(product)["avar"].values)


def test_map_and_unit_make_a_strange_log_readable(log, product, tmp_path):
    strange = tmp_path / "strange.csv"
    strange.write_text(log.read_text().replace("gyro_x [deg/h]", "wx").replace("gyro_y [deg/h]", "wy"))
    options = ("--map", "wx=gyro_x", "--map", "wy=gyro_y", "--unit", "gyro=0.5 deg/h")
    assert call("run", strange, "-o", tmp_path / "out.nc", *WINDOW, *options) == 0
    np.testing.assert_allclose(open_product(tmp_path / "out.nc")["avar"].values, open_product(product)["avar"].values / 4.0, rtol=1e-6)


def test_map_from_a_file(log, tmp_path):
    strange = tmp_path / "strange.csv"
    strange.write_text(log.read_text().replace("gyro_x", "wx").replace("gyro_y", "wy"))
    (tmp_path / "map.toml").write_text('wx = "gyro_x"\nwy = "gyro_y"\n')
    assert call("ingest", strange, "-o", tmp_path / "log.nc", "--map", tmp_path / "map.toml") == 0
    assert list(open_log(tmp_path / "log.nc")["axis"].values) == ["x", "y"]


def test_config_gives_defaults_and_the_command_line_wins(log, tmp_path):
    config = tmp_path / "run.toml"
    config.write_text(
        'quiet-progress = true\n[run]\nwindow = "20s"\nstep = "10s"\naxis = ["x"]\n[run.unit]\ngyro = "2 deg/h"\n[fit]\nterms = "N"\n'
    )
    assert call("run", log, "-o", tmp_path / "a.nc", "--config", config) == 0
    assert call("run", log, "-o", tmp_path / "b.nc", f"--config={config}", "--step", "5s") == 0
    first, second = open_product(tmp_path / "a.nc"), open_product(tmp_path / "b.nc")
    assert list(first["axis"].values) == ["x"]
    steps = [np.diff(dataset["time"].values)[0] / np.timedelta64(1, "s") for dataset in (first, second)]
    assert steps == [10.0, 5.0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [('[run]\nwindw = "20s"\n', "windw"), ("[rum]\n", r"\[rum\]"), ("[run\n", "not a TOML file"), ("[run]\nrate = 'x'\n", "rate")],
)
def test_config_with_a_slip_of_the_pen(text, expected, log, tmp_path, capfd):
    (tmp_path / "run.toml").write_text(text)
    assert call("run", log, "-o", tmp_path / "out.nc", "--config", tmp_path / "run.toml") == 2
    assert re.search(expected, capfd.readouterr().err)


def test_overwrite_replaces(log, tmp_path):
    (tmp_path / "log.nc").write_text("old")
    assert call("ingest", log, "-o", tmp_path / "log.nc", "--overwrite") == 0
    assert open_log(tmp_path / "log.nc").sizes["time"] == 6000


def test_report_is_one_page(product, tmp_path):
    assert call("report", product, "-o", tmp_path / "report.html") == 0
    page = (tmp_path / "report.html").read_text()
    assert "<html" in page
    assert not re.search(r"""(src|href)=["']https?://""", page)


# ------------------------------------------------------------------------------------------------------ help, exit codes


def test_help_names_every_command(capsys):
    assert call("--help") == 0
    shown = capsys.readouterr().out
    assert all(re.search(rf"^\W*{command}\b", shown, re.M) for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_has_an_example_that_parses(command, capsys):
    assert call(command, "--help") == 0
    text = re.sub(r"\s+", " ", capsys.readouterr().out)
    example = re.search(rf"gyrostab {command} (?!-)[^╭]*?(?=╭)|gyrostab {command} -o \S+", text.split("Example", 1)[1])
    assert example, text
    app[command].parse_args(example.group().split()[2:], exit_on_error=False, print_error=False)


def test_version(capsys):
    assert call("--version") == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


def test_no_command_shows_the_help(capsys):
    assert call() == 0
    assert "demo" in capsys.readouterr().out


def test_interrupt_is_exit_code_3(log, tmp_path, monkeypatch, capsys):
    def interrupted(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gyrostab.run.core.load_log", interrupted)
    assert call("run", log, "-o", tmp_path / "out.nc", *WINDOW) == 3
    assert "interrupted" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_while_the_program_loads_is_exit_code_3(monkeypatch, capsys):
    def interrupted() -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("gyrostab.cli.main", interrupted)
    assert start() == 3
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_real_interrupt_leaves_nothing_behind(tmp_path, name):
    path = write_log(tmp_path / "long.csv")
    code = (
        "import os, signal, sys, xarray\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background starts with it ignored\n"
        "from gyrostab.cli import main\n"
        "write = xarray.Dataset.to_netcdf\n"
        "def slow(dataset, target, **options):\n"
        "    written = write(dataset, target, **options)\n"
        f"    os.kill(os.getpid(), signal.{name})\n"
        "    return written\n"
        "xarray.Dataset.to_netcdf = slow\n"
        f"sys.exit(main(['ingest', {str(path)!r}, '-o', {str(tmp_path / 'log.nc')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 3, done.stderr
    assert "interrupted" in done.stderr
    assert "Traceback" not in done.stderr
    assert [entry.name for entry in tmp_path.iterdir()] == ["long.csv"]


def test_a_fault_of_ours_is_exit_code_1_without_traceback(log, tmp_path, monkeypatch, capsys):
    def broken(*args: object, **options: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr("gyrostab.run.core.load_log", broken)
    assert call("run", log, "-o", tmp_path / "out.nc", *WINDOW) == 1
    shown = capsys.readouterr().err
    assert "of all things" in shown
    assert "Traceback" not in shown
    with pytest.raises(ZeroDivisionError):
        call("run", log, "-o", tmp_path / "out.nc", *WINDOW, "--debug")


def test_progress_is_one_plain_line_away_from_a_terminal(log, tmp_path, capfd):
    assert call("run", log, "-o", tmp_path / "a.nc", *WINDOW) == 0
    plain = [line for line in capfd.readouterr().err.splitlines() if not line.startswith("note: ")]
    assert len(plain) == 1
    assert re.search(r"computing: 12,000 samples in \d+\.\d s, \d+\.\d\d Msamples/s", plain[0])
    assert call("run", log, "-o", tmp_path / "b.nc", *WINDOW, "--quiet-progress") == 0
    assert "done in" not in capfd.readouterr().err


def test_progress_is_a_bar_on_a_terminal(log, tmp_path):
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "gyrostab", "run", str(log), "-o", str(tmp_path / "out.nc"), *WINDOW]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=follower, env={**os.environ, "COLUMNS": "120"}) as running:
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


# ------------------------------------------------------------------------------------------------------------------ scan


def test_scan_in_a_pipe_is_a_plain_table(log, capsys):
    assert call("scan", log) == 0
    head, row = (line.split("\t") for line in capsys.readouterr().out.splitlines())
    table = dict(zip(head, row, strict=True))
    assert table["file"] == str(log)
    assert (float(table["rate_hz"]), table["axes"], int(table["rows"]), int(table["gaps"])) == (100.0, "x y", 6000, 0)
    assert float(table["span_s"]) == pytest.approx(59.99)


def test_scan_goes_on_after_a_file_that_cannot_be_read(log, tmp_path, capsys):
    (tmp_path / "junk.csv").write_text("")
    assert call("scan", tmp_path / "junk.csv", log) == 2
    shown = capsys.readouterr()
    assert "empty" in shown.out
    assert str(log) in shown.out
    assert "1 of 2" in shown.err
