"""Formats of optional libraries, and binary: real files and small files written for the tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyrostab.errors import FormatError, GyrostabError, OptionError
from gyrostab.ingest import ReadOptions, read_log, scan_file
from gyrostab.ingest.formats.tables import (
    Table,
    TableColumn,
    read_tables,
    scan_tables,
)
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from tests.ingest.field_files import las_text, write_trace

Find = Callable[[str], Path]
ROWS = 500
RATE = 50.0
START = np.datetime64("2026-03-01T12:00:00", "ns")
STAMPS = START + (np.arange(ROWS) * 20_000_000).astype("timedelta64[ns]")
VALUES = np.random.default_rng(5).integers(-20000, 20000, (2, ROWS))
DEG_H = 3600.0 * np.rad2deg(1e-9)  # of a nanoradian per second


def test_blueseis_matches_its_text_export(recordings: Find) -> None:
    path, ramp = (
        recordings("fog-blueseis-ramp/FOG.mseed"),
        recordings("fog-blueseis-ramp/RAMP.mseed"),
    )
    text = pd.read_csv(recordings("fog-blueseis-ramp/fog_ramp.csv.gz"))
    log = read_log(
        path, map={"HJ3": "gyro_z", "YR3": "ramp"}, unit={"gyro": "1 nrad/s"}, channel=ramp
    )
    assert np.allclose(log.rate.values[0], text.rate_counts * DEG_H, rtol=1e-7)
    assert np.array_equal(log.ramp.values, text.ramp_counts)
    assert np.array_equal(log.time.values, log.time_ramp.values)
    assert log.time.values[0] == np.datetime64("2017-10-14T01:59:59.999800")
    whole = regularise(log)
    assert whole.attrs["sampling_rate_hz"] == 200.0
    assert whole.sizes["time"] == 72001
    summary = scan_file(path, ReadOptions(map={"HJ3": "gyro_z"}, unit={"gyro": "1 nrad/s"}))
    assert (summary.format, summary.axes, summary.n_rows) == ("miniseed", ("z",), 72001)
    assert (summary.first, summary.last) == (log.time.values[0], log.time.values[-1])


def test_rotation_and_ground_motion_keep_separate_stamps(recordings: Find) -> None:
    path = recordings("fog-rotation-earthquake/bspf_M5.2_6c.mseed")
    text = pd.read_csv(recordings("fog-rotation-earthquake/bspf_M5.2_6c.csv.gz"))
    axes = {"HJE": "gyro_x", "HJN": "gyro_y", "HJZ": "gyro_z", "HHZ": "ground [m/s]"}
    log = read_log(path, map=axes, unit={"gyro": "rad/s"})
    expected = np.rad2deg(text[["HJE", "HJN", "HJZ"]].to_numpy().T) * 3600.0
    assert np.allclose(log.rate.values, expected, rtol=1e-6, atol=1e-9)
    assert np.allclose(log.ground.values, text.HHZ, rtol=1e-6)
    assert log.time.values[0] - log.time_ground.values[0] == np.timedelta64(3_700_000, "ns")


def test_ring_laser_matches_its_netcdf_export(recordings: Find) -> None:
    path = recordings("ringlaser-g-3h/romy_eventM7.0.mseed")
    log = read_log(path, map={"BJZ": "gyro_z"}, unit={"gyro": "1 rad/s"})
    with xr.open_dataset(recordings("ringlaser-g-3h/ringlaser_g_3h.nc")) as other:
        counts = other[
            next(name for name in other.data_vars if "BJZ" in str(name) or "gyro" in str(name))
        ].values.ravel()
    ours = log.rate.values[0]
    assert np.corrcoef(ours, counts)[0, 1] > 1 - 1e-9
    assert regularise(log).attrs["sampling_rate_hz"] == 20.0


def test_px4_log_matches_its_text_export(recordings: Find) -> None:
    axes = {f"gyro_rad[{place}]": f"gyro_{axis}" for place, axis in enumerate("xyz")}
    path = recordings("px4-bench-dropouts/sample.ulg")
    log = read_log(path, map={**axes, "load": "cpu [1]"}, unit={"gyro": "rad/s"})
    text = read_log(
        recordings("px4-bench-dropouts/sensor_combined.csv.gz"),
        map=axes,
        unit={"gyro": "rad/s", "time": "us"},
    )
    assert np.allclose(log.rate.values, text.rate.values, rtol=1e-6)
    assert np.array_equal(log.time.values, text.time.values)
    assert log.cpu.dims == ("time_cpu",)
    assert log.cpu.size == 69
    assert any("lost data 4 times" in note for note in log.attrs["notes"])
    summary = scan_file(path, ReadOptions(map=axes, unit={"gyro": "rad/s"}))
    assert (summary.axes, summary.n_rows, summary.first) == (
        ("x", "y", "z"),
        17070,
        log.time.values[0],
    )


def write_miniseed(path: Path, *, gap: int = 0) -> None:
    from pymseed import DataEncoding

    half = ROWS // 2
    with path.open("wb") as file:
        for first in (0, half):
            begin = STAMPS[first] + np.timedelta64(20_000_000 * gap * (first > 0), "ns")
            for code, values in zip(("H_J_1", "H_J_2"), VALUES.astype(np.int32), strict=True):
                part = values[first : first + half]
                write_trace(file, code, part, RATE, begin, encoding=DataEncoding.STEIM2)
        slow = np.arange(10, dtype=np.float64)
        write_trace(file, "L_K_O", slow, 1.0, STAMPS[0], encoding=DataEncoding.FLOAT64)


MINISEED = {
    "map": {"HJ1": "gyro_x", "HJ2": "gyro_y", "LKO": "temperature"},
    "unit": {"gyro": "0.5 deg/h", "temperature": "degC"},
}


def test_time_between_miniseed_segments_is_a_gap(tmp_path: Path) -> None:
    write_miniseed(tmp_path / "a.mseed", gap=7)
    log = read_log(tmp_path / "a.mseed", **MINISEED)
    assert np.array_equal(log.rate.values, VALUES * 0.5)
    assert np.array_equal(log.temperature.values, np.arange(10.0))
    whole = regularise(log)
    assert gap_table(whole)[["samples", "cause"]].values.tolist() == [[7, "missing"]]
    assert "temperature" in whole


def test_several_files_with_slow_channels_are_one_log(tmp_path: Path) -> None:
    write_miniseed(tmp_path / "a.mseed")
    data = (tmp_path / "a.mseed").read_bytes()
    (tmp_path / "b.mseed").write_bytes(data)
    twice = read_log([tmp_path / "a.mseed", tmp_path / "b.mseed"], **MINISEED)
    assert np.array_equal(twice.rate.values, VALUES * 0.5)
    assert twice.temperature.dims == ("time_temperature",)


@pytest.fixture
def las(tmp_path: Path) -> Path:
    rows = (
        f"{k / RATE:.2f} {x} {-999.25 if k == 3 else y} 21.5" for k, (x, y) in enumerate(VALUES.T)
    )
    path = tmp_path / "run.las"
    path.write_text(las_text("TIME.S GYRO_X.deg/h GYRO_Y.deg/h TEMPERATURE.degC", rows))
    return path


def test_las(las: Path) -> None:
    log = read_log(las, epoch="2026-03-01T12:00:00")
    expected = VALUES.astype(float)
    expected[1, 3] = np.nan
    assert np.array_equal(log.rate.values, expected, equal_nan=True)
    assert np.array_equal(log.time.values, STAMPS)
    assert (log.temperature.values == 21.5).all()
    summary = scan_file(las, ReadOptions(epoch="2026-03-01T12:00:00"))
    assert (summary.format, summary.axes, summary.n_rows, summary.last) == (
        "las",
        ("x", "y"),
        ROWS,
        STAMPS[-1],
    )


def make_tables(stamps: Sequence[tuple[Any, str | None] | None]) -> list[Table]:
    """Return a table with a gyro and tables with the channels ``a1``, ..., each with its stamps."""
    tables = []
    for number, clock in enumerate(stamps):
        name, unit = ("gyro_x", "deg/h") if number == 0 else (f"a{number}", "degC")
        column = TableColumn((name,), np.arange(10.0), unit)
        tables.append(Table(10, [column], TableColumn(("time",), *clock) if clock else None))
    return tables


def test_stamps_of_tables_have_their_own_units() -> None:
    times = np.arange(10.0)
    tables = make_tables([(times * 1e3, "ms"), (times, "s")])
    raw = read_tables(Path("a.dlis"), tables, ReadOptions())
    assert np.array_equal(raw.time.values, raw.time_a1.values)
    raw = read_tables(Path("a.dlis"), tables, ReadOptions(unit={"time": "us"}))
    assert raw.time.values[1].astype(np.int64) == 1_000_000


@pytest.mark.parametrize("is_dated", [False, True])
def test_tables_that_cannot_be_placed_are_left_out_with_a_note(is_dated: bool) -> None:
    clocks = [(np.arange(10.0), "s"), (STAMPS[:10], None)]
    tables = make_tables([clocks[is_dated], clocks[not is_dated], None, clocks[is_dated]])
    raw = read_tables(Path("a.tdms"), tables, ReadOptions())
    assert list(raw.data_vars) == ["rate", "a3"]
    notes = "; ".join(raw.attrs["notes"])
    assert "left out, as they have no stamps: a2" in notes
    assert "need --epoch: a1" in notes
    assert scan_tables(Path("a.tdms"), "tdms", tables, ReadOptions()).channels == ("a3",)
    raw = read_tables(Path("a.tdms"), tables, ReadOptions(epoch="2026-03-01"))
    assert list(raw.data_vars) == ["rate", "a1", "a3"]


def write_tdms(path: Path, *, waveform: bool) -> None:
    from nptdms import ChannelObject, RootObject, TdmsWriter

    clock = {
        "wf_increment": 1 / RATE,
        "wf_start_time": STAMPS[0].astype("datetime64[us]"),
        "wf_start_offset": 0.0,
    }
    properties = {"unit_string": "deg/h", **(clock if waveform else {})}
    channels = [
        ChannelObject("imu", f"gyro_{axis}", values.astype(np.int32), properties)
        for axis, values in zip("xy", VALUES, strict=True)
    ]
    if not waveform:
        channels.append(ChannelObject("imu", "stamp", STAMPS.astype("datetime64[us]")))
    slow = {
        "unit_string": "degC",
        "wf_increment": 1.0,
        "wf_start_time": STAMPS[0].astype("datetime64[us]"),
    }
    channels.append(ChannelObject("probe", "temperature", np.arange(10.0), slow))
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([RootObject(), *channels])


@pytest.mark.parametrize("waveform", [True, False])
def test_tdms(tmp_path: Path, waveform: bool) -> None:
    path = tmp_path / "run.tdms"
    write_tdms(path, waveform=waveform)
    log = read_log(path)
    assert np.array_equal(log.rate.values, VALUES)
    assert np.array_equal(log.time.values, STAMPS)
    assert np.array_equal(log.temperature.values, np.arange(10.0))
    assert np.array_equal(log.time_temperature.values, STAMPS[:ROWS:50])
    summary = scan_file(path)
    assert (summary.format, summary.axes, summary.channels, summary.n_rows) == (
        "tdms",
        ("x", "y"),
        ("temperature",),
        ROWS,
    )
    assert (summary.first, summary.last) == (STAMPS[0], STAMPS[-1])


@pytest.mark.parametrize(("seconds", "is_noted"), [(10, True), (0, False)])
def test_segments_of_tdms_with_other_starts_are_noted(
    tmp_path: Path, seconds: int, is_noted: bool
) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(str(tmp_path / "run.tdms")) as writer:
        for segment in range(2):
            start = STAMPS[0].astype("datetime64[us]") + np.timedelta64(segment * seconds, "s")
            clock = {"unit_string": "deg/h", "wf_increment": 0.5, "wf_start_time": start}
            axes = [ChannelObject("imu", f"gyro_{axis}", np.arange(9.0), clock) for axis in "xy"]
            writer.write_segment(axes)
    notes = read_log(tmp_path / "run.tdms").attrs["notes"]
    assert any("write a file for each start" in note for note in notes) == is_noted
    unfinished = bytearray((tmp_path / "run.tdms").read_bytes())
    size = slice(unfinished.rindex(b"TDSm") + 12, unfinished.rindex(b"TDSm") + 20)
    unfinished[size] = 8 * b"\xff"  # of a segment that the program did not close
    (tmp_path / "run.tdms").write_bytes(unfinished)
    assert read_log(tmp_path / "run.tdms").sizes["row"] == 18


LAYOUT = """
header_bytes = 16
byte_order = "{order}"
fields = [
    {{name = "time [ms]", type = "uint32"}},
    {{skip = 2}},
    {{name = "gyro_x [deg/h]", type = "int16"}},
    {{name = "gyro_y [0.5 deg/h]", type = "int32"}},
    {{name = "temperature [degC]", type = "float32"}},
]
"""


def write_binary(path: Path, order: str, *, tail: bytes = b"") -> None:
    sign = "<" if order == "little" else ">"
    record = np.dtype(
        [("t", f"{sign}u4"), ("", "V2"), ("x", f"{sign}i2"), ("y", f"{sign}i4"), ("T", f"{sign}f4")]
    )
    table = np.zeros(ROWS, dtype=record)
    table["t"], table["x"], table["y"], table["T"] = np.arange(ROWS) * 20, *VALUES, 21.5
    path.write_bytes(b"HEADER OF 16 BYT" + table.tobytes() + tail)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("name", ["run.bin.toml", "run.toml", "layout.toml"])
def test_binary_file_is_read_by_its_layout(tmp_path: Path, order: str, name: str) -> None:
    write_binary(tmp_path / "run.bin", order, tail=b"cut")
    (tmp_path / name).write_text(LAYOUT.format(order=order))
    log = read_log(tmp_path / "run.bin", epoch=str(START))
    assert np.array_equal(log.rate.values, VALUES * [[1.0], [0.5]])
    assert np.array_equal(log.time.values, STAMPS)
    assert (log.temperature.values == 21.5).all()
    assert any("last 3 bytes" in note for note in log.attrs["notes"])
    summary = scan_file(tmp_path / "run.bin", ReadOptions(epoch=str(START)))
    assert (summary.format, summary.n_rows, summary.last) == ("binary", ROWS, STAMPS[-1])


def test_any_file_with_a_layout_file_is_binary(tmp_path: Path) -> None:
    write_binary(tmp_path / "run.dat", "little")
    (tmp_path / "run.dat.toml").write_text(LAYOUT.format(order="little"))
    assert np.array_equal(read_log(tmp_path / "run.dat").rate.values[0], VALUES[0])


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (None, r"the layout of its records is unknown; write run\.bin\.toml"),
        ("fields = [", "not valid TOML"),
        ("fields = []", "needs fields"),
        ('fields = [{name = "a", type = "int48"}]', "field 1 is .*float64"),
        ("rows = 3", "'rows' is not a key"),
        ('byte_order = "mixed"\nfields = []', "byte_order"),
        ('sync = "GG"\nfields = [{name = "gyro_x", type = "int8"}]', "sync"),
        ('fields = [{counter = 128, type = "float32"}]', "field 1"),
        ('fields = [{counter = 1, type = "uint8"}]', "field 1"),
        ('fields = [{counter = 1000, type = "uint8"}]', "field 1"),
        ('fields = [{name = "gyro_x", type = ["int8"]}]', "field 1"),
        ("fields = 3", "needs fields"),
    ],
)
def test_wrong_layout_is_explained(tmp_path: Path, layout: str | None, message: str) -> None:
    write_binary(tmp_path / "run.bin", "little")
    if layout is not None:
        (tmp_path / "run.bin.toml").write_text(layout)
    with pytest.raises(OptionError, match=rf"^run\.bin(\.toml)?: .*{message}"):
        read_log(tmp_path / "run.bin")


def test_file_shorter_than_a_record_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.bin").write_bytes(b"HEADER OF 16 BYT12345")
    (tmp_path / "run.bin.toml").write_text(LAYOUT.format(order="little"))
    with pytest.raises(FormatError, match=r"run\.bin: it holds no record"):
        read_log(tmp_path / "run.bin")


@pytest.mark.parametrize("name", ["a.mseed", "a.ulg", "a.tdms", "a.las"])
@pytest.mark.parametrize("content", [b"~nonsense\n" * 500, b"~"])
def test_damaged_files_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(GyrostabError, match=name):
        read_log(tmp_path / name)
