"""The command line on bad input: one message, exit code 2, and nothing left behind."""

from __future__ import annotations

import gzip
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gyrostab.errors import OutputError
from gyrostab.ingest.columns.pieces import Buffers
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.opening import open_log, open_product
from gyrostab.jobs.run import load_log
from tests.support.command_line import RATE, WINDOW, call, write_log


def _without_stamps(*options: object):
    def make(folder: Path) -> list[object]:
        (folder / "bad.csv").write_text(
            "gyro_x [deg/h]\n" + "\n".join(str(n % 7) for n in range(100))
        )
        return [folder / "bad.csv", "-o", folder / "out.nc", *options, "--window", "4samples"]

    return make


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "tool.csv")


def _bad_text(text: bytes, name: str = "bad.csv"):
    def make(folder: Path) -> list[object]:
        path = folder / name
        path.write_bytes(text)
        return [path, "-o", folder / "out.nc", *WINDOW]

    return make


def _bad_log(*options: object, **spoil):
    def make(folder: Path) -> list[object]:
        return [
            write_log(folder / "bad.csv", **spoil),
            "-o",
            folder / "out.nc",
            *(options or WINDOW),
        ]

    return make


def _truncated_gzip(folder: Path) -> list[object]:
    whole = gzip.compress(write_log(folder / "bad.csv").read_bytes())
    (folder / "bad.csv").unlink()
    (folder / "bad.csv.gz").write_bytes(whole[: len(whole) // 2])
    return [folder / "bad.csv.gz", "-o", folder / "out.nc", *WINDOW]


def _truncated_netcdf(folder: Path) -> list[object]:
    values = xr.DataArray(
        np.random.default_rng(1).standard_normal((1, 5000)),
        dims=("axis", "time"),
        attrs={"units": "degree hour-1"},
    )
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
    "time going backwards": (_bad_log(change=lambda rows: rows[::-1]), "time"),
    "all NaN": (_bad_log(change=_no_gyro), "unreadable"),
    "one sample": (_bad_log(seconds=0.01), "."),
    "rate declared wrongly by 10 %": (_bad_log("--rate", "110", *WINDOW), "110"),
    "duplicate columns": (_bad_log(header="time [s],gyro_x [deg/h],gyro_x [deg/h]"), "gyro_x"),
    "binary junk named csv": (
        _bad_text(bytes(np.random.default_rng(3).integers(0, 256, 5000, dtype=np.uint8))),
        "text|binary",
    ),
    "truncated gzip": (_truncated_gzip, "bad.csv.gz"),
    "truncated NetCDF": (_truncated_netcdf, "bad.nc"),
    "window longer than the record": (_bad_log("--window", "2min", "--step", "10s"), "window"),
    "step longer than the window": (_bad_log("--window", "10s", "--step", "20s"), "step"),
    "tau longer than the window": (
        _bad_log("--window", "20s", "--step", "5s", "--taus", "1s,30s"),
        "tau|30",
    ),
    "all averaging times too long": (
        _bad_log("--window", "20s", "--tau-max", "15s"),
        "15s.*half of the window of 20s",
    ),
    "output is a directory": (
        lambda folder: [
            write_log(folder / "good.csv"),
            "-o",
            _folder(folder / "out.nc"),
            "--overwrite",
        ],
        "out.nc' is a directory",
    ),
    "damaged log of ours": (_damaged_log, r"bad\.nc: .*is damaged"),
    "window without a unit": (_bad_log("--window", "20", "--step", "5s"), "window|20"),
    "window that is not a duration": (_bad_log("--window", "long"), "long"),
    **{
        f"negative {option}": (_bad_log(f"--{option}", "-5min"), "'-5min' must be longer than zero")
        for option in ("window", "step", "max-gap", "tau-max", "fit-from")
    },
    "two samples": (
        _bad_text(b"time [s],gyro_x [deg/h]\n0,1\n1,2\n"),
        "record has 2 samples, .* at least 4; no window .--window. helps: give a longer log",
    ),
    "axis that is not there": (_bad_log("--axis", "w", *WINDOW), "axis|'w'"),
    "more than half unreadable": (_bad_log(change=_words), "unreadable"),
    "no such file": (lambda folder: [folder / "none.csv", "-o", folder / "out.nc"], "none.csv"),
    "output exists": (_existing_output, "--overwrite"),
    "output is the input": (
        lambda folder: [write_log(folder / "out.nc"), "-o", folder / "out.nc", "--overwrite"],
        "input",
    ),
    "output of the wrong kind": (
        lambda folder: [write_log(folder / "good.csv"), "-o", folder / "out.csv"],
        r"must end in \.nc",
    ),
    "folder that cannot be written to": (_unwritable_folder, "out.nc"),
    "folder that is not there": (
        lambda folder: [write_log(folder / "good.csv"), "-o", folder / "no" / "out.nc"],
        "no/out.nc': there is no directory",
    ),
    "map without a name": (_bad_log("--map", "wx"), "--map"),
    "config that is not there": (_bad_log("--config", "/nonexistent/run.toml"), "run.toml"),
    "option that is not there": (_bad_log("--begin-again"), "--begin-again"),
    "value that is not a number": (_bad_log("--rate", "fast"), "--rate"),
    "rate above a stamp per nanosecond": (
        _without_stamps("--rate", "1e308"),
        r"--rate 1e\+308: .* from 1e-09 to 1e\+09",
    ),
    "rate of which one sample takes ages": (
        _without_stamps("--rate", "1e-300"),
        r"--rate 1e-300: .* from 1e-09 to 1e\+09",
    ),
    "start near the end of time": (
        _without_stamps("--rate", "1", "--start", "2262-04-11T23:47:10"),
        "years 1678 to 2262",
    ),
    "duration in two words": (
        _bad_log("--window", "2", "min"),
        "write --window 2min, without a blank",
    ),
    "no worker": (_bad_log("--workers", "0"), "--workers"),
    "no log": (lambda folder: ["-o", folder / "out.nc"], r"LOG is missing\. See gyrostab run"),
    "log taken by an option": (
        lambda folder: ["--map", write_log(folder / "good.csv"), "-o", folder / "out.nc"],
        r"LOG is missing: \S*good\.csv is the value of --map\. See gyrostab run",
    ),
    "no output": (lambda folder: [write_log(folder / "good.csv")], "--output is missing"),
    "option without its value": (_bad_log("--window"), "--window requires an argument"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_one_message_and_nothing_left_behind(case, tmp_path, capfd):
    make, expected = BAD_INPUT[case]
    arguments = make(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert call("run", *arguments, "--quiet-progress") == 2
    shown = capfd.readouterr()
    assert shown.out == ""
    messages = [
        line for line in shown.err.splitlines() if not line.startswith(("note: ", "zstd: "))
    ]  # zstd speaks for itself
    assert len(messages) == 1, shown.err
    assert messages[0].startswith("gyrostab: ")
    assert re.search(expected, messages[0]), messages[0]
    assert "Traceback" not in shown.err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("option", ["--overwrite", "--workers=1", "--debug", "-o"])
def test_an_option_before_the_command_is_said_to_come_after_it(option, log, capfd):
    assert call(option, "run", log) == 2
    (message,) = capfd.readouterr().err.splitlines()
    assert message.startswith("gyrostab: Options come after the command: ")
    assert f"gyrostab run {option} ..." in message


@pytest.mark.parametrize("make", [
    lambda log, name: ["scan", f"{name}.csv"],
    lambda log, name: ["ingest", log, "-o", "log.nc", "--channel", f"{name}.csv"],
    lambda log, name: ["run", log, "-o", f"{name}.nc", *WINDOW],
    lambda log, name: ["report", f"{name}.nc", "-o", "report.html"],
])  # fmt: skip
def test_a_name_that_is_too_long_is_bad_input(make, log, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    name = 300 * "n"
    assert call(*make(log, name)) == 2
    *_, message = capfd.readouterr().err.splitlines()
    assert re.fullmatch(rf"gyrostab: .*{name}\S*: File name too long.*", message), message


def test_a_product_may_have_a_name_of_the_greatest_length(log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    product = 252 * "n" + ".nc"
    assert call("run", log, "-o", product, *WINDOW) == 0
    assert os.listdir() == [product]


@pytest.mark.parametrize("options", [
    "--taus banana", "--taus 0", "--tau-max banana", "--step 0s", "--terms XYZ",
    "--fit-from banana", "--fit-to 0s", "--exclude 1min", "--exclude 1min/banana", "--from banana",
])  # fmt: skip
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_wrong_options_are_refused_before_the_log_is_read(options, dry, log, tmp_path, capfd):
    assert call("run", log, "-o", tmp_path / "out.nc", *options.split(), *dry) == 2
    (message,) = [
        line for line in capfd.readouterr().err.splitlines() if not line.startswith("reading")
    ]
    assert message.startswith("gyrostab: ")
    unread = tmp_path / "unread.csv"
    unread.write_text("time [s],gyro_x\n0,1\n")  # would be refused for its missing unit
    assert call("run", unread, "-o", tmp_path / "out.nc", *options.split(), *dry) == 2
    assert message in capfd.readouterr().err


def test_record_without_a_whole_window_gets_no_advice_on_the_window(tmp_path, capfd):
    path = tmp_path / "three.csv"
    path.write_text("time [s],gyro_x [deg/h]\n0,1\n1,2\n2,0\n")
    assert call("run", path, "-o", tmp_path / "out.nc") == 2
    shown = capfd.readouterr().err
    assert "the record has 3 samples" in shown
    assert "give a shorter window" not in shown
    assert "the window is" not in shown


@pytest.mark.slow
def test_full_standard_output_is_explained(log):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gyrostab", "scan", str(log)],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 2
    assert "the standard output: cannot be written" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_no_room_for_the_columns_of_a_long_log(monkeypatch):
    full = Path("/dev/full").open("wb")  # noqa: SIM115
    monkeypatch.setattr(
        "gyrostab.ingest.columns.pieces.tempfile.TemporaryFile", lambda **options: full
    )
    monkeypatch.setattr("gyrostab.ingest.columns.pieces.SPILL_BYTES", 100)
    with pytest.raises(OutputError, match=r"cannot be written.*TMPDIR"):
        Buffers({0: np.float64}).add({0: np.zeros(1000)})


def test_the_reading_options_stand_in_the_history(log, tmp_path):
    assert (
        call("ingest", log, "-o", tmp_path / "log.nc", "--epoch", "2026-03-01", "--map", "gyro_y=-")
        == 0
    )
    with open_log(tmp_path / "log.nc") as stored:
        assert "(read with epoch: 2026-03-01; map: gyro_y=-)" in stored.attrs["history"]


def test_options_that_do_not_fit_a_regular_log(log, tmp_path, capfd):
    regular = tmp_path / "log.nc"
    distant = tmp_path / "far.csv"
    distant.write_text("time,temperature [degC]\n2026-01-01T00:00:00,20\n2026-01-01T00:00:10,21\n")
    assert call("ingest", log, "-o", regular) == 0
    assert call("run", regular, "-o", tmp_path / "a.nc", *WINDOW, "--rate", RATE / 2) == 2
    assert "regular log of 100 Hz, not of 50 Hz" in capfd.readouterr().err
    assert (
        call(
            "run", regular, "-o", tmp_path / "a.nc", *WINDOW, "--rate", RATE, "--unit", "gyro=deg/s"
        )
        == 0
    )
    assert "--unit is not used" in capfd.readouterr().err
    assert call("run", regular, "-o", tmp_path / "b.nc", *WINDOW, "--channel", distant) == 0
    assert "none of its 2 values" in capfd.readouterr().err


def test_constant_signal_runs_with_a_note(tmp_path, capfd):
    path = write_log(
        tmp_path / "flat.csv", change=lambda rows: [f"{row.split(',')[0]},5.0,5.0" for row in rows]
    )
    assert call("run", path, "-o", tmp_path / "out.nc", *WINDOW) == 0
    notes = [line for line in capfd.readouterr().err.splitlines() if "note: " in line]
    for axis in "xy":
        assert sum(f"axis {axis} " in note for note in notes) == 1
    assert float(open_product(tmp_path / "out.nc")["avar"].max()) == pytest.approx(0.0, abs=1e-12)


def test_stages_refuse_what_is_not_theirs(log, tmp_path, capfd):
    assert call("fit", log, "-o", tmp_path / "product.nc") == 2
    assert "not a DAVAR surface; if it is a log, make one with 'gyrostab davar'" in (
        capfd.readouterr().err
    )
    for command, name in (("report", "report.html"), ("correlate", "out.nc"), ("plot", "figures")):
        assert call(command, log, "-o", tmp_path / name) == 2
        shown = capfd.readouterr().err
        assert (
            "is a text file, not a product; if it is a log, make one with 'gyrostab run'" in shown
        )
        assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []
