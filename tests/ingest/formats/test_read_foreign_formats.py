"""Files of other programs: truncated, with codes as names, in proprietary objects."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from gyrostab.errors import FormatError, MissingUnitError, UnitError
from gyrostab.ingest import read_log, scan_file
from tests.ingest.field_files import las_text, write_trace

RATE = 50.0
ROWS = 3000
START = np.datetime64("2026-03-01T12:00:00", "ns")
VALUES = np.random.default_rng(11).integers(-20000, 20000, (3, ROWS)).astype(np.int32)


def write_miniseed(path: Path, codes: str = "ENZ", band: str = "H") -> bytes:
    """Write channels of a rotation sensor one after the other, as in archives."""
    from pymseed import DataEncoding

    steim = {"encoding": DataEncoding.STEIM2, "format_version": 2}
    with path.open("wb") as file:
        for code, values in zip(codes, VALUES, strict=True):
            write_trace(file, f"{band}_J_{code}", values, RATE, START, **steim)
    return path.read_bytes()


@pytest.mark.parametrize(("codes", "band"), [("ENZ", "H"), ("123", "B"), ("XYZ", "L")])
def test_rotation_channels_of_miniseed_are_axes(tmp_path: Path, codes: str, band: str) -> None:
    path = tmp_path / "a.mseed"
    write_miniseed(path, codes, band)
    with pytest.raises(MissingUnitError, match="--unit gyro="):
        read_log(path)
    raw = read_log(path, unit={"gyro": "0.5 deg/h"})
    assert raw.axis.values.tolist() == sorted(codes.lower())
    assert np.array_equal(raw.rate.values, VALUES * 0.5)
    assert any(
        f"{band}J{codes[0]} is gyro_{codes[0].lower()}" in note for note in raw.attrs["notes"]
    )
    mapped = read_log(path, map={f"{band}J{codes[2]}": "gyro_w"}, unit={"gyro": "0.5 deg/h"})
    assert mapped.axis.values.tolist() == ["w"]


@pytest.mark.parametrize(("late_us", "period_us"), [(900, 20018), (1, 20000)])
def test_stamps_of_miniseed_follow_those_of_its_records(
    tmp_path: Path, late_us: int, period_us: float
) -> None:
    """Records of 50 samples, each later than the nominal rate says: by 900 us, or by rounding."""
    path = tmp_path / "a.mseed"
    with path.open("wb") as file:
        for number in range(20):
            start = START + np.timedelta64(number * (50 * 20_000 + late_us), "us")
            values = VALUES[0, 50 * number : 50 * number + 50]
            write_trace(file, "H_J_Z", values, RATE, start, format_version=2)
    raw = read_log(path, unit={"gyro": "0.5 deg/h"})
    assert np.array_equal(raw.rate[0].values, VALUES[0, :1000] * 0.5)
    late = (raw.time - (START + np.arange(1000) * np.timedelta64(period_us, "us"))).values
    assert np.abs(late).max() <= np.timedelta64(late_us, "us")  # the last record ends on time


@pytest.mark.parametrize("cut", [1, 100, 470, 511, 512, 900])
def test_truncated_miniseed_keeps_its_complete_records(tmp_path: Path, cut: int) -> None:
    whole, path = tmp_path / "a.mseed", tmp_path / "b.mseed"
    data = write_miniseed(whole)
    path.write_bytes(data[:-cut])
    raw = read_log(path, unit={"gyro": "0.5 deg/h"})
    assert raw.sizes["row"] == ROWS
    assert np.array_equal(raw.rate.sel(axis=["e", "n"]).values, VALUES[:2] * 0.5)
    last = raw.rate.sel(axis="z").values
    held = np.isfinite(last)
    assert ROWS / 2 < held.sum() < ROWS
    assert held[: held.sum()].all()
    assert np.array_equal(last[held], VALUES[2, : held.sum()] * 0.5)
    noted = any("cut off in its last record" in note for note in raw.attrs["notes"])
    assert noted == (cut % 512 != 0)
    assert any("cut off" in note for note in scan_file(path).notes) == noted


def write_las(path: Path, date: str, clock: str, rows: list[str]) -> Path:
    curves = f"DATE.{date} TIME.{clock} GYRO_X.deg/h TEMPERATURE.degC"
    path.write_text(las_text(curves, [f"{row} 1.5 60" for row in rows]))
    return path


@pytest.mark.parametrize(
    ("date", "clock", "rows"),
    [
        ("D", "S", ["14-Mar-26 23:59:59", "15-Mar-26 00:00:00.500"]),
        ("", "", ["2026-03-14 23:59:59", "2026-03-15 00:00:00.500"]),
        ("", "HHMMSS", ["20260314 235959", "20260315 000000.5"]),
        ("", "S", ["20260314 86399", "20260315 0.5"]),
        ("DD/MM/YY", "", ["14/03/26 23:59:59", "15/03/26 00:00:00.500"]),
        ("MM/DD/YYYY", "", ["03/14/2026 23:59:59", "03/15/2026 00:00:00.500"]),
        ("", "", ["14/03/2026 23:59:59", "15/03/2026 00:00:00.500"]),
        ("YYYYMMDD", "MS", ["20260314 86399000", "20260315 500"]),
    ],
)
def test_date_and_time_curves_of_las_are_the_time(
    tmp_path: Path, date: str, clock: str, rows: list[str]
) -> None:
    raw = read_log(write_las(tmp_path / "a.las", date, clock, rows))
    assert raw.time.values.astype(str).tolist() == [
        "2026-03-14T23:59:59.000000000",
        "2026-03-15T00:00:00.500000000",
    ]
    assert raw.rate[0].values.tolist() == [1.5, 1.5]
    assert list(raw.data_vars) == ["rate", "temperature"]


@pytest.mark.parametrize(
    ("date", "clock", "row", "first"),
    [
        ("DDMMYY", "HHMMSS", "010526 080001", "2026-05-01T08:00:01"),
        ("YYYYMMDD", "HHMM", "20260501 0830", "2026-05-01T08:30"),
        ("YYYYMMDD", "HR", "20260501 8.25", "2026-05-01T08:15"),
    ],
)
def test_units_of_las_give_digits_of_dates_and_times(
    tmp_path: Path, date: str, clock: str, row: str, first: str
) -> None:
    raw = read_log(write_las(tmp_path / "a.las", date, clock, [row] * 2))
    assert raw.time.values[0] == np.datetime64(first)


@pytest.mark.parametrize(
    ("curves", "row"),
    [
        ("DATE. TIME. TZ. GYRO_X.deg/h", "14-Mar-26 08:00:00 +02:00 1.5"),
        ("TIME. TZ. GYRO_X.deg/h", "2026-03-14T08:00:00 CEST 1.5"),
    ],
)
def test_zone_of_a_las_file_is_asked_for(tmp_path: Path, curves: str, row: str) -> None:
    path = tmp_path / "a.las"
    path.write_text(las_text(curves, [row] * 2))
    with pytest.raises(UnitError, match=r"column 'TZ' holds .*--unit time=UTC"):
        read_log(path)
    for offset, first in (("UTC", "08:00"), ("UTC+02:00", "06:00")):
        raw = read_log(path, unit={"time": offset})
        assert raw.time.values[0] == np.datetime64(f"2026-03-14T{first}")


def test_las_without_rows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"^a\.las: it holds no values"):
        read_log(write_las(tmp_path / "a.las", "YYYYMMDD", "HHMMSS", []))


def test_las_3_with_commas_is_refused(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", "YYYYMMDD", "HHMMSS", [])
    head, _, rows = path.read_text().partition("WRAP. NO :\n")
    path.write_text(f"{head}WRAP. NO :\nDLM . COMMA : of LAS 3\n{rows}20260314,120000,1.5,60\n")
    with pytest.raises(FormatError, match=r"a\.las: commas separate.*export the log as LAS 2"):
        read_log(path)


def test_dates_with_the_year_first_or_last_are_refused(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", "", "S", ["26/03/14 1", "26/03/14 2"])
    with pytest.raises(FormatError, match=r"is not clear.*--map DATE=-"):
        read_log(path)


def test_ambiguous_dates_are_refused(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", "", "S", ["03/04/2026 1", "03/05/2026 2"])
    with pytest.raises(FormatError, match=r"order of day and month.*--map DATE=-"):
        read_log(path)
    assert read_log(path, map={"DATE": "-"}).sizes["row"] == 2


def matlab_element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def write_timeseries(path: Path) -> None:
    """Write a MATLAB 5 file with a timeseries `ts`, an object that only MATLAB can read."""
    inner = (
        matlab_element(6, struct.pack("<II", 13, 0))
        + matlab_element(5, struct.pack("<ii", 6, 1))
        + matlab_element(1, b"")
    )
    inner += matlab_element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1))
    body = matlab_element(6, struct.pack("<II", 17, 0)) + b"".join(
        matlab_element(1, text) for text in (b"ts", b"MCOS", b"timeseries")
    )
    head = (
        b"MATLAB 5.0 MAT-file, made by hand".ljust(116)
        + b"\0" * 8
        + struct.pack("<HH", 0x0100, 0x4D49)
    )
    path.write_bytes(head + matlab_element(14, body + matlab_element(14, inner)))


def test_matlab_timeseries_is_refused_with_advice(tmp_path: Path) -> None:
    write_timeseries(tmp_path / "ts.mat")
    with pytest.raises(FormatError, match=r"a timeseries 'ts'.*MATLAB alone.*ts\.Data") as caught:
        read_log(tmp_path / "ts.mat")
    assert "None" not in str(caught.value)


def test_function_handles_of_matlab_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"gyro_x": np.arange(20.0)})
    flags = matlab_element(6, struct.pack("<II", 16, 0))
    head = matlab_element(5, struct.pack("<ii", 1, 1)) + matlab_element(1, b"f")
    inner = matlab_element(6, struct.pack("<II", 6, 0)) + matlab_element(
        5, struct.pack("<ii", 40, 1)
    )
    inner += matlab_element(1, b"") + matlab_element(9, bytes(320))
    handle = matlab_element(14, flags + head + matlab_element(14, inner))
    path.write_bytes(path.read_bytes() + handle)
    raw = read_log(path, rate=10.0, unit={"gyro": "deg/h"})
    assert raw.rate.values.tolist() == [list(range(20))]
    path.write_bytes(path.read_bytes()[:-330])
    with pytest.raises(FormatError, match=r"a\.mat: this MATLAB file is damaged"):
        read_log(path, rate=10.0, unit={"gyro": "deg/h"})


def test_a_matlab_object_of_version_7_3_is_named(tmp_path: Path) -> None:
    import h5py

    with h5py.File(tmp_path / "tt.mat", "w") as file:
        file["tt"] = np.zeros(6, dtype=np.uint32)
        file["tt"].attrs["MATLAB_class"] = np.bytes_("timeseries")
        file["tt"].attrs["MATLAB_object_decode"] = np.int32(3)
    with pytest.raises(FormatError, match=r"a timeseries 'tt'.*ts\.Data"):
        read_log(tmp_path / "tt.mat")


def test_a_matlab_table_saved_as_structures_is_read(tmp_path: Path) -> None:
    from scipy.io import savemat

    rows = np.zeros((3, 1), dtype=[("time", object), ("gx", object)])
    for row in range(3):
        rows[row, 0] = (np.array([[row / 10]]), np.array([[row * 2.0]]))
    savemat(tmp_path / "s.mat", {"S": rows})
    raw = read_log(tmp_path / "s.mat", map={"S.time": "time [s]", "S.gx": "gyro_x [deg/h]"})
    assert raw.rate[0].values.tolist() == [0, 2, 4]


def test_structure_fields_are_recognised_by_their_names(tmp_path: Path) -> None:
    from scipy.io import savemat

    time, rates = np.arange(5) / 10, np.arange(15.0).reshape(3, 5)
    fields = {
        "time_ms": time * 1e3,
        "temperature": 20 + time,
        **dict(zip(("gyro_x", "gyro_y", "gyro_z"), rates, strict=True)),
    }
    savemat(tmp_path / "s.mat", {"S": fields})
    raw = read_log(tmp_path / "s.mat", unit={"gyro": "deg/h", "temperature": "degC"})
    assert np.array_equal(raw.rate.values, rates)
    assert np.diff(raw.time.values).astype(np.int64).tolist() == [10**8] * 4
    assert np.allclose(raw.temperature.values, 20 + time)
    savemat(tmp_path / "two.mat", {"a": fields, "b": fields})
    with pytest.raises(FormatError, match=r"a\.gyro_x, "):
        read_log(tmp_path / "two.mat", unit={"gyro": "deg/h"})


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("x.rda", gzip.compress(b"RDX3\nX\n" + bytes(200), mtime=0), r"R data.*write\.csv"),
        ("x.csv", b"RDX2\nX\n" + bytes(200), "R data"),
    ],
)
def test_known_formats_that_are_not_read_are_refused_by_name(
    tmp_path: Path, name: str, data: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(data)
    for look in (read_log, scan_file):
        with pytest.raises(FormatError, match=message):
            look(tmp_path / name)


def test_layout_file_overrules_a_signature(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"\xa3\x95\x80\x80" * 10)
    path.with_name("a.bin.toml").write_text('fields = [{name = "gyro_x [deg/h]", type = "int32"}]')
    assert read_log(path, rate=1.0).sizes["row"] == 10
