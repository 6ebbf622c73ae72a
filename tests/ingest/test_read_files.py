"""Several files as one log, channel files, logs that gyrostab wrote, and the registry."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import gyrostab.ingest.files as files
import gyrostab.ingest.reading as reading
from gyrostab.errors import FormatError, OptionError, SchemaError, TimeError, UnitError
from gyrostab.ingest import FileSummary, ReadOptions, read_log, readers, scan_file
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.scan import scan
from gyrostab.schema import check_log, check_raw
from gyrostab.store.read import MIN_LAZY_VALUES
from gyrostab.time.grid import TimeGridIndex, time_coordinate
from tests.support.columns import write_columns

HEADER = "time [s],gyro_x [deg/h],gyro_y [deg/h],temperature [degC]\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.fixture
def pair(tmp_path: Path) -> list[Path]:
    """Write two pieces of a log in reverse order, the earlier without gyro_y and temperature."""
    late = write(tmp_path / "a.csv", HEADER + "10,1,2,20\n11,3,4,\n12,****,5,21\n")
    early = write(tmp_path / "b.csv", "time [ms],gyro_x [deg/s],depth [m]\n0,1,7\n1000,2,8\n")
    return [late, early]


def test_files_are_concatenated_in_the_order_of_their_stamps(pair: list[Path]) -> None:
    raw = read_log(pair)
    check_raw(raw)
    assert raw.attrs["source_files"] == ["b.csv", "a.csv"]
    assert raw.attrs["row_start"] == [0, 2]
    np.testing.assert_array_equal(
        raw.time.values, np.array([0, 1, 10, 11, 12], dtype="datetime64[s]")
    )
    nan = np.nan
    np.testing.assert_array_equal(raw.rate, [[3600, 7200, 1, 3, nan], [nan, nan, 2, 4, 5]])
    np.testing.assert_array_equal(raw.temperature, [nan, nan, 20, nan, 21])
    np.testing.assert_array_equal(raw.depth, [7, 8, nan, nan, nan])
    notes = " | ".join(raw.attrs["notes"])
    assert "axis y is not in b.csv and is missing there" in notes
    assert "channel depth is not in a.csv" in notes
    assert raw.attrs["unreadable_cells"] == 1


def test_patterns_and_repeated_paths(pair: list[Path]) -> None:
    folder = pair[0].parent
    xr.testing.assert_identical(read_log(str(folder / "*.csv")), read_log(pair))
    xr.testing.assert_identical(read_log([*pair, pair[0]]), read_log(pair))
    with pytest.raises(FormatError, match="no file fits"):
        read_log(folder / "*.tsv")
    with pytest.raises(FormatError, match="no such file"):
        read_log(folder / "nothing.csv")
    with pytest.raises(OptionError, match="at least one"):
        read_log([])
    with pytest.raises(
        FormatError, match=r"no reader takes this file with the suffix '.xyz'.*text"
    ):
        read_log(write(folder / "log.xyz", "?"))
    with pytest.raises(
        FormatError,
        match=r"no reader takes this directory; name the files in it, for instance .*\*\.csv",
    ):
        read_log(folder)


def test_the_working_directory_is_refused_like_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (".", "/"):
        with pytest.raises(FormatError, match="name the files in it"):
            read_log(name)


def test_a_pipe_is_refused_with_advice() -> None:
    with pytest.raises(FormatError, match=r"a pipe or a device.*write its content to a file"):
        read_log("/dev/null")


@pytest.mark.parametrize(
    ("name", "head", "message"),
    [
        ("log.zip", b"PK\x03\x04", "log.zip: this file is packed; unpack it"),
        ("log.csv.xz", b"\xfd7zXZ\0", "log.csv.xz: this file is packed"),
        ("log.npz", b"PK\x03\x04", "log.npz: numpy files state neither units nor times"),
        ("log.npy", b"\x93NUMPY\x01\0", "log.npy: numpy files state neither units nor times"),
        ("log.xlsx", b"PK\x03\x04", "log.xlsx: spreadsheets are not read; save the sheet"),
        ("log.xls", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "log.xls: spreadsheets are not read"),
    ],
)
def test_packed_files_and_spreadsheets_are_refused_with_advice(
    name: str, head: bytes, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(head + bytes(100))
    with pytest.raises(FormatError, match=message):
        read_log(tmp_path / name)


def test_many_files_are_moved_to_disk(pair: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    expected = read_log(pair)
    monkeypatch.setattr(reading, "SPILL_BYTES", 100)
    raw = read_log(pair)
    assert raw.rate.chunks is not None
    xr.testing.assert_identical(raw.compute(), expected)


def _rows(values: np.ndarray, rows: slice | np.ndarray) -> str:
    return "".join(f"{n},{values[n]:.3f},{-values[n]:.3f},\n" for n in np.arange(len(values))[rows])


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(4).normal(size=60)


@pytest.mark.parametrize("spilled", [False, True])
@pytest.mark.parametrize(
    "pieces",
    [
        [slice(0, 30), slice(20, 60)],
        [slice(40, 60), slice(0, 25), slice(22, 45)],
        [slice(0, 60), slice(10, 20), slice(30, 60)],
        [slice(0, 60), slice(0, 60)],
        [
            np.r_[0:20, 25:30],
            slice(15, 60),
        ],  # the earlier file has lost rows that the later one has
        [slice(0, 30), np.r_[15:20, 24:60]],  # and the other way round
        [slice(5, 30), slice(5, 60), slice(0, 10)],
    ],
)
def test_rows_that_two_files_hold_count_once(
    tmp_path: Path, values: np.ndarray, pieces: list, spilled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = read_log(write(tmp_path / "whole.csv", HEADER + _rows(values, slice(None))))
    if spilled:
        monkeypatch.setattr(reading, "SPILL_BYTES", 100)
    paths = [
        write(tmp_path / f"{place}.csv", HEADER + _rows(values, piece))
        for place, piece in enumerate(pieces)
    ]
    raw = read_log(paths)
    np.testing.assert_array_equal(raw.time, whole.time)
    np.testing.assert_array_equal(raw.rate, whole.rate)
    assert any("are here too, and are left out there" in note for note in raw.attrs["notes"])
    assert len(raw.attrs["row_start"]) == len(raw.attrs["source_files"])


@pytest.mark.parametrize("digits", [12, 3])
def test_a_copy_in_another_unit_with_fewer_digits_and_damage_is_a_copy(
    tmp_path: Path, values: np.ndarray, digits: int
) -> None:
    first = write(tmp_path / "a.csv", HEADER + _rows(values, slice(None)))
    rows = "".join(
        f"{n * 1000},{'****' if n == 7 else f'{value / 3600:.{digits}g}'}\n"
        for n, value in enumerate(np.round(values, 3))
    )
    second = write(tmp_path / "b.csv", "time [ms],gyro_x [deg/s]\n" + rows)
    raw = read_log([first, second])
    np.testing.assert_array_equal(raw.rate, read_log(first).rate)
    assert any(
        note.startswith("a.csv: 60 rows of b.csv are here too") for note in raw.attrs["notes"]
    )


OVERLAPPING = {
    # columns and rows of each file
    "axis": [("x", slice(0, 60)), ("xy", slice(0, 60))],
    "channel": [("x", slice(0, 60)), ("xt", slice(0, 60))],
    "channel within": [("x", slice(0, 60)), ("xt", slice(20, 40))],
    "channel later": [("x", slice(0, 40)), ("xt", slice(20, 60))],
    "axis earlier": [("xy", slice(0, 40)), ("x", slice(20, 60))],
    "both": [("xy", slice(0, 40)), ("yz", slice(20, 60))],
    "three": [("xy", slice(0, 30)), ("yz", slice(10, 50)), ("xzt", slice(40, 60))],
}


@pytest.mark.parametrize("files", OVERLAPPING.values(), ids=OVERLAPPING)
@pytest.mark.parametrize("is_reversed", [False, True])
def test_files_that_overlap_add_their_axes_and_channels(
    tmp_path: Path, files: list[tuple[str, slice]], is_reversed: bool
) -> None:
    truth = np.round(np.random.default_rng(6).normal(size=(4, 60)), 3)
    filled = np.zeros((4, 60), dtype=bool)
    headers = {**{axis: f"gyro_{axis} [deg/h]" for axis in "xyz"}, "t": "temperature [degC]"}
    paths = []
    for place, (columns, rows) in enumerate(files):
        numbers = ["xyzt".index(name) for name in columns]
        filled[numbers, rows] = True
        lines = [",".join(map(str, [k, *truth[numbers, k]])) for k in range(60)[rows]]
        header = ",".join(["time [s]", *(headers[name] for name in columns)])
        paths.append(write(tmp_path / f"{place}.csv", "\n".join([header, *lines, ""])))
    log = regularise(read_log(paths[::-1] if is_reversed else paths))
    assert log.sizes["time"] == 60
    expected = np.where(filled, truth, np.nan)
    for axis in "xyz":
        if filled["xyz".index(axis)].any():
            np.testing.assert_array_equal(log.rate.sel(axis=axis), expected["xyz".index(axis)])
    if filled[3].any():
        temperature = log.temperature.rename({log.temperature.dims[0]: "time"})
        np.testing.assert_array_equal(temperature.dropna("time"), truth[3][filled[3]])
        seconds = temperature.dropna("time").time.values.astype(np.int64) // 10**9
        np.testing.assert_array_equal(seconds, np.flatnonzero(filled[3]))
    assert not any("no row holds" in note for note in log.attrs["notes"])


def test_of_a_damaged_file_and_its_copy_the_copy_is_read(
    tmp_path: Path, values: np.ndarray
) -> None:
    damaged = [
        line.replace(",", ",*" * (n % 20 == 3) or ",", 1)
        for n, line in enumerate(_rows(values, slice(None)).splitlines())
    ]
    first = write(tmp_path / "a.csv", HEADER + "\n".join(damaged))
    second = write(tmp_path / "b.csv", HEADER + _rows(values, slice(None)))
    np.testing.assert_array_equal(read_log([first, second]).rate, read_log(second).rate)


def test_restarted_clock_in_the_next_file_is_not_an_overlap(
    tmp_path: Path, values: np.ndarray
) -> None:
    first = write(tmp_path / "a.csv", HEADER + _rows(values, slice(None)))
    second = write(tmp_path / "b.csv", HEADER + _rows(values[::-1], slice(None)))
    raw = read_log([first, second])
    assert raw.sizes["row"] == 120
    np.testing.assert_array_equal(raw.rate[0, 60:], np.round(values[::-1], 3))


@pytest.mark.parametrize("name", ["tool.d01", "noending", "TOOL.CSV"])
def test_text_is_read_with_any_suffix(pair: list[Path], name: str) -> None:
    other = pair[0].rename(pair[0].with_name(name))
    np.testing.assert_array_equal(read_log(other).rate, [[1, 3, np.nan], [2, 4, 5]])


def test_files_without_stamps_keep_their_order_and_do_not_mix(tmp_path: Path) -> None:
    first, second = (
        write(tmp_path / name, f"gyro_x [deg/h]\n{value}\n{value}\n")
        for name, value in (("z.csv", 1), ("a.csv", 2))
    )
    raw = read_log([first, second], rate=10, start="2026-01-01")
    np.testing.assert_array_equal(raw.rate[0], [1, 1, 2, 2])
    assert raw.attrs["start"] == "2026-01-01"
    timed = write(tmp_path / "timed.csv", "time [s],gyro_x [deg/h]\n0,1\n1,2\n")
    with pytest.raises(TimeError, match=r"timed.csv has time stamps and z.csv has none"):
        read_log([first, timed], rate=10)


@pytest.mark.parametrize("first_stamps", [None, [0.3, 0.1, 0.2]], ids=["no time", "from zero"])
def test_files_without_a_common_clock_are_in_the_order_of_their_numbers(
    tmp_path: Path, first_stamps: list[float] | None
) -> None:
    for number in range(1, 13):
        text = "gyro_x [deg/h]\n" + f"{number}\n" * 3
        if first_stamps is not None:
            start = first_stamps[number % 3]
            rows = [f"{start + k},{100 * number + k}\n" for k in range(10)]
            text = "time [s],gyro_x [deg/h]\n" + "".join(rows)
        write(tmp_path / f"run_{number}.csv", text)
    shell = sorted(tmp_path.glob("run_*.csv"))
    assert shell[1].name == "run_10.csv"
    for paths in (str(tmp_path / "run_*.csv"), shell):
        raw = read_log(paths, rate=1.0)
        assert raw.attrs["source_files"] == [f"run_{number}.csv" for number in range(1, 13)]
        assert (np.diff(raw.rate[0]) >= 0).all()
        is_noted = any(
            "order: run_1.csv, run_2.csv, run_3.csv" in note for note in raw.attrs["notes"]
        )
        assert is_noted == (first_stamps is None)


def test_files_of_one_clock_are_in_the_order_of_their_stamps_not_of_their_numbers(
    tmp_path: Path,
) -> None:
    header = "time [s],gyro_x [deg/h]\n"
    for number, start in ((1, 100), (2, 50), (10, 0)):
        rows = "".join(f"{start + k},{start + k}\n" for k in range(50))
        write(tmp_path / f"run_{number}.csv", header + rows)
    np.testing.assert_array_equal(read_log(str(tmp_path / "*.csv")).rate[0], np.arange(150))


def test_kinds_and_channel_units_must_agree(tmp_path: Path) -> None:
    rate = write(tmp_path / "rate.csv", "time [s],gyro_x [deg/h],flow [l/min]\n0,1,1\n1,2,1\n")
    angle = write(tmp_path / "angle.csv", "time [s],angle_x [deg]\n2,1\n3,2\n")
    other = write(tmp_path / "other.csv", "time [s],gyro_x [deg/h],flow [m3/h]\n2,1,1\n3,2,1\n")
    with pytest.raises(
        UnitError,
        match=r"rate.csv holds a gyro signal of kind 'rate', angle.csv of kind 'increment'",
    ):
        read_log([rate, angle], kind="rate")
    with pytest.raises(
        UnitError, match=r"'flow' has different units: 'm3/h' in other.csv.*--map \"flow="
    ):
        read_log([rate, other])


def test_channels_in_other_units_are_converted_to_those_of_the_first_file(tmp_path: Path) -> None:
    """Without a name that gyrostab knows, a channel keeps the unit of its header."""
    paths = [
        write(
            tmp_path / f"{name}.csv",
            f"time [s],gyro_x [deg/h],board temp [{degree}],bias [{volt}]\n"
            f"{start},1,{temperature},{bias}\n{start + 1},2,{temperature},{bias}\n",
        )
        for name, start, degree, temperature, volt, bias in (
            ("a", 2, "degF", 77, "mV", 1500), ("b", 0, "degC", 25, "V", 1.5),
            ("c", 4, "degC", 25, "mV", 1500),
        )
    ]  # fmt: skip
    together = read_log(paths)
    gyro = write(tmp_path / "gyro.csv", "time [s],gyro_x [deg/h]\n0,1\n1,2\n2,3\n3,4\n")
    for log in (together, read_log(gyro, channel=[paths[1], *paths[::2]])):
        np.testing.assert_allclose(log["board_temp"], [25.0] * 6)
        np.testing.assert_allclose(log["bias"], [1.5] * 6)
        assert (log["board_temp"].units, log["bias"].units) == ("degC", "V")


def test_map_that_matches_one_of_the_files_is_accepted(pair: list[Path]) -> None:
    raw = read_log(pair, map={"depth": "bit_depth"})
    assert "bit_depth" in raw
    with pytest.raises(OptionError, match=r"--map depht: no such column in a.csv, b.csv"):
        read_log(pair, map={"depht": "bit_depth"})


def test_channels_of_another_file_keep_their_own_time(tmp_path: Path) -> None:
    log = write(
        tmp_path / "log.csv", "time [s],gyro_x [deg/h]\n" + "".join(f"{n},{n}\n" for n in range(10))
    )
    rows = (
        "1970-01-01T00:00:00,20,\n1970-01-01T00:00:04,,101325\nnever,21,1\n1970-01-01T00:00:08,22,\n"
        + "1970-01-01T00:00:09,,\n" * 5
    )
    slow = write(
        tmp_path / "slow.csv",
        "time,temperature [degC],pressure [Pa],gyro_x [deg/h]\n" + rows.replace("\n", ",1\n"),
    )
    raw = read_log(log, channel=slow)
    check_raw(raw)
    assert raw.temperature.dims == ("time_temperature",)
    np.testing.assert_array_equal(raw.temperature, [20, 22])
    np.testing.assert_array_equal(
        raw.time_temperature.values, np.array([0, 8], dtype="datetime64[s]")
    )
    np.testing.assert_array_equal(raw.pressure, [101325])
    assert raw.temperature.attrs["units"] == "degree_Celsius"
    np.testing.assert_array_equal(raw.rate[0], np.arange(10))
    more = write(tmp_path / "more.csv", "time [s],temperature [K]\n-2,273.15\n-1,274.15\n")
    joined = read_log(log, channel=[slow, more])
    np.testing.assert_allclose(joined.temperature, [0, 1, 20, 22])
    assert joined.attrs["channel_files"] == ["slow.csv", "more.csv"]


def test_a_row_of_overlapping_channel_files_counts_once(tmp_path: Path) -> None:
    """Within a file, equal rows are readings of a coarse clock."""
    log = write(tmp_path / "log.csv", HEADER + "".join(f"{n},1,1,20\n" for n in range(9)))
    probe = ["0,20\n", "2,21\n", "2,21\n", "4,21\n", "6,22\n", "8,23\n"]
    parts = ("".join(probe[:5]), "".join(probe[3:]), "6,30\n")
    paths = [
        write(tmp_path / f"{number}.csv", f"time [s],probe [degC]\n{rows}")
        for number, rows in enumerate(parts)
    ]
    raw = read_log(log, channel=paths)
    np.testing.assert_array_equal(raw["probe"], [20, 21, 21, 21, 22, 30, 23])
    assert raw["time_probe"].dt.second.values.tolist() == [0, 2, 2, 4, 6, 6, 8]


def test_unusable_channel_files_are_explained(tmp_path: Path) -> None:
    log = write(tmp_path / "log.csv", HEADER + "0,1,1,20\n1,1,1,20\n")
    doubled = write(tmp_path / "slow.csv", "time [s],temperature [degC]\n0,1\n1,1\n")
    with pytest.raises(
        OptionError,
        match=r"channel 'temperature' of slow.csv is in the log too.*--map "
        r"temperature=temperature_2",
    ):
        read_log(log, channel=doubled)
    with pytest.raises(OptionError, match=r"no channel with a unit"):
        read_log(log, channel=write(tmp_path / "bare.csv", "time [s],speed\n0,1\n1,1\n"))
    with pytest.raises(OptionError, match=r"no time column"):
        read_log(log, channel=write(tmp_path / "timeless.csv", "flow [m3/h]\n1\n1\n"))


def test_channels_from_netcdf(tmp_path: Path) -> None:
    log = write(tmp_path / "log.csv", "time [s],gyro_x [deg/h]\n0,1\n1,2\n")
    stamps = np.array([0, 5, 9], "i4"), "seconds since 1970-01-01"
    pressure = np.array([1, 2, 3], "f4"), "kPa"
    write_columns(tmp_path / "slow.nc", {"time": stamps, "pressure": pressure})
    np.testing.assert_array_equal(
        read_log(log, channel=tmp_path / "slow.nc").pressure, [1000, 2000, 3000]
    )


# --- logs that gyrostab wrote


def regular_log(size: int = 5000, rate: float = 300.0) -> xr.Dataset:
    rng = np.random.default_rng(3)
    start = int(np.datetime64("2026-01-01T00:00:00.000000007", "ns").astype(np.int64))
    slow = np.datetime64("2026-01-01", "ns") + np.arange(4) * np.timedelta64(3, "s")
    return xr.Dataset(
        {
            "rate": (("axis", "time"), rng.normal(size=(2, size)), {"units": "degree hour-1"}),
            "vibration": ("time", rng.uniform(size=size), {"units": "9.80665 m s-2"}),
            "temperature": ("time_temperature", np.arange(4.0), {"units": "degree_Celsius"}),
        },
        coords={"axis": ["x", "z"], "time_temperature": slow, **time_coordinate(start, rate, size)},
        attrs={"kind": "rate", "sampling_rate_hz": rate},
    )


def store(log: xr.Dataset, path: Path) -> Path:
    plain = (
        log.assign_coords(time=("time", log.time.values)).drop_indexes("time")
        if "time" in log.xindexes
        else log
    )
    encoding = {"time": {"units": "nanoseconds since 2026-01-01", "dtype": "int64"}}
    if path.suffix == ".zarr":
        plain.chunk(time=20_000).to_zarr(path, encoding=encoding, consolidated=False)
    else:
        plain.to_netcdf(
            path, encoding={**encoding, "axis": {"dtype": "S1"}}
        )  # netCDF-C crashes on strings of a file opened twice
    return path


@pytest.mark.parametrize("name", ["log.nc", "log.zarr"])
@pytest.mark.filterwarnings("ignore:.*does not have a Zarr V3 specification.*")
def test_a_log_of_gyrostab_comes_back_lazily_on_its_exact_grid(tmp_path: Path, name: str) -> None:
    log = regular_log(MIN_LAZY_VALUES)
    path = store(log, tmp_path / name)
    back = read_log(path)
    check_log(back)
    assert back.rate.chunks is not None
    assert isinstance(back.xindexes["time"], TimeGridIndex)
    np.testing.assert_array_equal(back.time.values, log.time.values)
    np.testing.assert_array_equal(back.rate, log.rate)
    assert list(back.axis.values) == ["x", "z"]
    assert back.vibration.attrs["units"] == "g"
    assert back.temperature.dims == ("time_temperature",)
    summary = scan_file(path)
    assert (summary.format, summary.axes) == ("gyrostab log", ("x", "z"))
    assert summary.n_rows == MIN_LAZY_VALUES
    assert summary.channels == (
        ("vibration", "temperature") if path.suffix == ".nc" else ("temperature", "vibration")
    )
    assert (summary.first, summary.last) == (log.time.values[0], log.time.values[-1])


@pytest.mark.filterwarnings("ignore:.*does not have a Zarr V3 specification.*")
def test_channels_of_a_zarr_store_come_in_the_order_of_their_names(tmp_path: Path) -> None:
    """The order within its directory is arbitrary."""
    names = [f"channel_{letter}" for letter in "gbhdafce"]
    log = regular_log(100)
    path = store(
        log.assign({name: ("time", log.vibration.values, {"units": "g"}) for name in names}),
        tmp_path / "log.zarr",
    )
    assert scan_file(path).channels == (*sorted(names), "temperature", "vibration")
    assert list(read_log(path).data_vars) == [*sorted(names), "rate", "temperature", "vibration"]


@pytest.mark.parametrize("name", ["log.nc", "log.zarr"])
def test_exported_files_are_read(tmp_path: Path, name: str) -> None:
    from gyrostab.io import datasets as export
    from gyrostab.io.opening import open_log

    log = regular_log()
    log["vibration"].attrs["units"] = "g"
    log.attrs |= {"source_files": ["a.csv", "b.csv"], "notes": ["a.csv: says something"]}
    write_log = export.to_netcdf if name.endswith(".nc") else export.to_zarr
    path = write_log(log, tmp_path / name)
    back, opened = read_log(path), open_log(path)
    assert isinstance(back.xindexes["time"], TimeGridIndex)
    for variable in log.variables:
        np.testing.assert_array_equal(back[variable].values, log[variable].values)
        assert back[variable].attrs.get("units") == opened[variable].attrs.get("units")
    for attribute in log.attrs:
        assert back.attrs[attribute] == log.attrs[attribute]
    assert scan_file(path).axes == ("x", "z")


def test_stored_stamps_off_the_grid_are_kept_as_rows(tmp_path: Path) -> None:
    log = regular_log(500)
    stamps = log.time.values.copy()
    stamps[300:] += np.timedelta64(1, "ms")
    path = store(log.drop_vars("time").assign_coords(time=stamps), tmp_path / "log.nc")
    raw = read_log(path)
    np.testing.assert_array_equal(raw.time.values, stamps)
    assert raw["time"].dims == ("row",)
    assert "sampling_rate_hz" not in raw.attrs


def test_channels_can_be_added_to_and_read_from_a_regular_log(tmp_path: Path) -> None:
    path = store(regular_log(), tmp_path / "log.nc")
    extra = write(
        tmp_path / "extra.csv", "time,pressure [Pa]\n2026-01-01T00:00:01,5\n2026-01-01T00:00:02,6\n"
    )
    log = read_log(path, channel=extra)
    check_log(log)
    np.testing.assert_array_equal(log.pressure, [5, 6])
    raw = read_log(
        write(
            tmp_path / "raw.csv",
            "time,gyro_x [deg/h]\n2026-01-01T00:00:00,5\n2026-01-01T00:00:02,6\n",
        ),
        channel=path,
    )
    assert raw.vibration.sizes["time_vibration"] == 5000
    assert raw.temperature.sizes["time_temperature"] == 4


@pytest.mark.parametrize(
    ("option", "advice"),
    [
        ({"unit": "deg/s"}, "unit='deg/s': give a mapping, for instance {'gyro': 'deg/s'}"),
        ({"map": "wx=gyro_x"}, "map='wx=gyro_x': give a mapping, for instance {'wx': 'gyro_x'}"),
        ({"max_gap": "soon"}, "max_gap 'soon' is not a duration"),
    ],
)
def test_invalid_options_are_refused(tmp_path: Path, option: dict[str, str], advice: str) -> None:
    path = write(tmp_path / "a.csv", "time [s],gyro_x [deg/h]\n0,1\n1,2\n")
    with pytest.raises(OptionError, match=re.escape(advice)):
        read_log(path, **option)


def test_a_log_in_wrong_units_is_refused(tmp_path: Path) -> None:
    log = regular_log()
    log["rate"].attrs["units"] = "degree s-1"
    with pytest.raises(SchemaError, match=r"log.nc: variable 'rate' has units 'degree s-1'"):
        read_log(store(log, tmp_path / "log.nc"))


# --- registry


class _Point:
    """An entry point of a format in another package."""

    name = "counts"

    @staticmethod
    def load() -> type:
        class Counts:
            @staticmethod
            def matches(path: Path) -> bool:
                return path.suffix == ".counts"

            @staticmethod
            def scan(path: Path, options: ReadOptions) -> FileSummary:
                return FileSummary(path, "counts")

            @staticmethod
            def read(path: Path, options: ReadOptions) -> xr.Dataset:
                text = path.with_suffix(".csv")
                text.write_text("gyro_x [deg/h]\n" + path.read_text())
                return files._entry_points()["text"].load().read(text, options)

        return Counts


def test_a_format_of_another_package_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = {**files._entry_points(), "counts": _Point()}
    monkeypatch.setattr(files, "_entry_points", lambda: points)
    path = write(tmp_path / "log.counts", "1\n2\n3\n")
    assert "counts" in readers()
    assert scan_file(path).format == "counts"
    np.testing.assert_array_equal(read_log(path, rate=1).rate[0], [1, 2, 3])


def test_heavy_libraries_load_when_they_are_used() -> None:
    code = (
        "import sys, gyrostab.ingest; print([m for m in ('pyarrow.csv', 'netCDF4', 'h5py', "
        "'scipy.io', 'dask.array') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_what_is_not_the_name_of_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time [s],gyro_x [deg/h]\n0,1\n1,2\n")
    with (tmp_path / "log.csv").open() as opened:
        for given in (opened, 5, None, b"log.csv", [tmp_path / "log.csv", 5]):
            for function in (read_log, scan):
                with pytest.raises(OptionError, match="is not the name of a file; give a text or"):
                    function(given)
