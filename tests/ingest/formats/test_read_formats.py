"""Contract of the formats: the same data in every format give the same raw log."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pyarrow as pa
import pytest
import xarray as xr
from pyarrow import parquet
from scipy.io import savemat

import gyrostab
from gyrostab.errors import FormatError, MissingUnitError, OptionError, UnitError
from gyrostab.ingest import ReadOptions, read_log, readers, scan_file
from gyrostab.ingest.columns import pieces
from gyrostab.ingest.columns.pieces import Buffers, Spool
from gyrostab.io.datasets import has_zstd
from gyrostab.schema import check_raw
from tests.support.columns import write_columns

ROWS = 500
START_US = 1_767_225_600_000_000  # 2026-01-01
HEADERS = ["time [us]", "gyro_y [deg/s]", "gyro_x [deg/s]", "temperature [K]", "humidity [%]"]


def columns() -> list[np.ndarray]:
    """Return integer stamps with jitter, two axes in reverse order, two channels."""
    rng = np.random.default_rng(7)
    stamps = START_US + 2500 * np.arange(ROWS) + rng.integers(-3, 4, ROWS)
    gyro = np.round(rng.normal(size=(2, ROWS)), 6)
    gyro[0, 20] = np.nan
    temperature = np.full(ROWS, np.nan)
    temperature[::50] = 300.0 + np.arange(ROWS // 50)
    return [stamps, *gyro, temperature, np.round(rng.uniform(size=ROWS), 4)]


def as_text(path: Path, separator: str = ",") -> dict[str, Any]:
    void = "nan" if separator == " " else ""
    rows = [
        separator.join(
            str(int(v)) if i == 0 else void if np.isnan(v) else repr(float(v))
            for i, v in enumerate(row)
        )
        for row in zip(*columns(), strict=True)
    ]
    text = "# tool 7\n" + separator.join(HEADERS) + "\n" + "\n".join(rows) + "\n"
    if path.suffix == ".gz":
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_text(text)
    return {}


def as_parquet(path: Path) -> dict[str, Any]:
    parquet.write_table(
        pa.table(dict(zip(HEADERS, columns(), strict=True))), path, row_group_size=170
    )
    return {}


def _bare() -> dict[str, tuple[str, np.ndarray]]:
    names = [header.split(" [") for header in HEADERS]
    return {
        name: (unit.rstrip("]"), values)
        for (name, unit), values in zip(names, columns(), strict=True)
    }


def as_netcdf(path: Path) -> dict[str, Any]:
    write_columns(path, {name: (values, unit) for name, (unit, values) in _bare().items()})
    return {}


def as_netcdf_matrix(path: Path) -> dict[str, Any]:
    bare = _bare()
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("obs", ROWS)
        file.createDimension("axis", 2)
        file.createVariable("axis", str, ("axis",))[:] = np.array(["y", "x"], dtype=object)
        gyro = file.createVariable("gyro", "f8", ("axis", "obs"))
        gyro.units = "deg/s"
        gyro[:] = np.stack([bare.pop("gyro_y")[1], bare.pop("gyro_x")[1]])
        for name, (unit, values) in bare.items():
            variable = file.createVariable(name, values.dtype, ("obs",))
            variable.units = "microseconds since 2000-01-01T00:00:00Z" if name == "time" else unit
            variable[:] = values - (946_684_800_000_000 if name == "time" else 0)
    return {}


UNITS = {"time": "us", "gyro": "deg/s", "temperature": "K", "humidity": "%"}


def as_mat5(path: Path) -> dict[str, Any]:
    savemat(path, {name: values for name, (_, values) in _bare().items()}, oned_as="column")
    return {"unit": UNITS}


def as_mat5_matrix(path: Path) -> dict[str, Any]:
    bare = _bare()
    names = list(bare)
    table = np.stack([bare[name][1] for name in names[1:]])
    savemat(path, {"log": {"t": bare["time"][1], "DATA": table}, "note": "text", "scalar": 3.0})
    return {
        "unit": UNITS,
        "map": {"log.t": "time", **{f"log.DATA/{i}": name for i, name in enumerate(names[1:])}},
    }


def as_mat73(path: Path) -> dict[str, Any]:
    bare = _bare()
    names = list(bare)
    with h5py.File(path, "w", userblock_size=512) as file:
        file["DATA"] = np.stack([bare[name][1] for name in names[1:]])
        file["stamp"] = bare["time"][1].reshape(1, -1)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: none".ljust(124) + b"\x00\x02IM")
    return {
        "unit": UNITS,
        "map": {"stamp": "time", **{f"DATA/{i}": name for i, name in enumerate(names[1:])}},
    }


#: File name -> function that writes the file and returns the reading options that it needs.
CONTRACT: dict[str, Callable[[Path], dict[str, Any]]] = {
    "comma.csv": as_text,
    "comma.csv.gz": as_text,
    "semicolon.txt": lambda path: as_text(path, ";"),
    "tab.tsv": lambda path: as_text(path, "\t"),
    "blanks.dat": lambda path: as_text(path, " "),
    "table.parquet": as_parquet,
    "vectors.nc": as_netcdf,
    "matrix.nc": as_netcdf_matrix,
    "vectors.mat": as_mat5,
    "matrix.mat": as_mat5_matrix,
    "hdf.mat": as_mat73,
}


@pytest.fixture(params=CONTRACT, scope="module")
def made(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    path = tmp_path_factory.mktemp("contract") / request.param
    return path, CONTRACT[request.param](path)


def test_every_registered_format_is_in_the_table() -> None:
    assert {"text", "parquet", "netcdf", "matlab"} <= set(readers())


def test_the_raw_log_is_the_same_in_every_format(made: tuple[Path, dict[str, Any]]) -> None:
    path, options = made
    raw = read_log(path, **options)
    check_raw(raw)
    stamps, gyro_y, gyro_x, temperature, humidity = columns()
    np.testing.assert_array_equal(
        raw.time.values, stamps.astype("datetime64[us]").astype("datetime64[ns]")
    )
    assert raw.time.dtype == "datetime64[ns]"
    assert list(raw.axis.values) == ["x", "y"]
    np.testing.assert_array_equal(raw.rate.sel(axis="x"), gyro_x * 3600.0)
    np.testing.assert_array_equal(raw.rate.sel(axis="y"), gyro_y * 3600.0)
    np.testing.assert_allclose(raw.temperature, temperature - 273.15, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(raw.humidity, humidity)
    assert raw.rate.attrs["units"] == "degree hour-1"
    assert (raw.temperature.attrs["units"], raw.humidity.attrs["units"]) == ("degree_Celsius", "%")
    assert raw.attrs["kind"] == "rate"
    assert raw.attrs["source_files"] == [path.name]
    assert raw.attrs["row_start"] == [0]
    assert (raw.attrs["unreadable_rows"], raw.attrs["unreadable_cells"]) == (0, 1)


def test_a_scan_agrees_with_the_reading(made: tuple[Path, dict[str, Any]]) -> None:
    path, options = made
    summary = scan_file(path, ReadOptions(**options))
    raw = read_log(path, **options)
    assert summary.axes == ("x", "y")
    assert set(summary.channels) == {"temperature", "humidity"}
    assert summary.first == raw.time.values[0]
    assert summary.last in (None, raw.time.values[-1])
    assert summary.n_rows in (None, ROWS)
    if path.suffix != ".gz":
        assert (summary.last, summary.n_rows) == (raw.time.values[-1], ROWS)
    roles = {column.name: (column.role, column.unit) for column in summary.columns}
    assert roles["gyro_x"] == ("gyro", "deg/s")
    assert roles["time"][0] == "time"


def test_columns_on_disk_equal_columns_in_memory(
    made: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, options = made
    in_memory = read_log(path, **options)
    module = __import__(f"gyrostab.ingest.formats.{scan_file(path).format}", fromlist=["read"])
    monkeypatch.setattr(pieces, "SPILL_BYTES", 1000)
    on_disk = module.read(path, ReadOptions(**options))
    assert on_disk.rate.chunks is not None
    assert on_disk.time.chunks is not None
    xr.testing.assert_identical(on_disk.compute().drop_attrs(), in_memory.drop_attrs())


def test_without_a_time_column_the_rate_is_required_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "ch.mat"
    savemat(path, {"gyro": np.ones((50, 3))})
    mapping = {f"gyro/{i}": f"gyro_{axis} [deg/h]" for i, axis in enumerate("xyz")}
    with pytest.raises(OptionError, match="--rate HZ"):
        read_log(path, map=mapping)
    raw = read_log(path, map=mapping, rate=100.0, start="2026-01-01T00:00:00")
    assert "time" not in raw.variables
    assert (raw.attrs["declared_rate_hz"], raw.attrs["start"]) == (100.0, "2026-01-01T00:00:00")


def test_float32_rates_convert_in_float64(tmp_path: Path) -> None:
    values = np.linspace(-1, 1, 40, dtype=np.float32)
    path = tmp_path / "single.parquet"
    parquet.write_table(pa.table({"gyro_x [rad/s]": values}), path)
    raw = read_log(path, rate=10)
    np.testing.assert_allclose(
        raw.rate[0], np.rad2deg(values.astype(np.float64)) * 3600, rtol=1e-14
    )


def test_times_of_day_in_parquet_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "clock.parquet"
    times = pa.array([10**6, 2 * 10**6], pa.time64("us"))
    parquet.write_table(pa.table({"time": times, "gyro_x [rad/s]": [1.0, 2.0]}), path)
    with pytest.raises(UnitError, match=r"'time' holds times of day without a date"):
        read_log(path)


def test_parquet_dates_and_field_units(tmp_path: Path) -> None:
    stamps = np.datetime64("2026-01-01T00:00:00.000000001", "ns") + np.arange(5) * np.timedelta64(
        10_000_000, "ns"
    )
    field = pa.field("gyro_z", pa.int16(), metadata={"units": "deg/h"})
    schema = pa.schema([pa.field("Time", pa.timestamp("ns", tz="UTC")), field])
    path = tmp_path / "dates.parquet"
    parquet.write_table(
        pa.Table.from_arrays(
            [pa.array(stamps), pa.array([1, None, 3, 4, 5], pa.int16())], schema=schema
        ),
        path,
    )
    raw = read_log(path)
    np.testing.assert_array_equal(raw.time, stamps)
    np.testing.assert_array_equal(raw.rate[0], [1, np.nan, 3, 4, 5])
    assert raw.attrs["unreadable_cells"] == 1


@pytest.mark.parametrize("name", ["time", "time [s]"])
def test_times_of_parquet_are_durations(tmp_path: Path, name: str) -> None:
    since = pa.array([0, 10, None, 30], pa.duration("ms"))
    table = pa.table({name: since, "gyro_x [deg/h]": [0.0, 1.0, 2.0, 3.0]})
    parquet.write_table(table, tmp_path / "log.parquet")
    raw = read_log(tmp_path / "log.parquet", epoch="2026-03-01")
    since = raw.time.values - np.datetime64("2026-03-01", "ns")
    assert since[[0, 1, 3]].astype(np.int64).tolist() == [0, 10_000_000, 30_000_000]
    assert np.isnat(since[2])
    summary = scan_file(tmp_path / "log.parquet")
    assert summary.last is not None
    assert summary.last.astype(np.int64) == 30_000_000


def test_the_last_stamp_of_a_short_parquet_file_is_in_its_last_row_group(tmp_path: Path) -> None:
    table = pa.table({"time [s]": np.arange(50.0), "gyro_x [deg/h]": np.arange(50.0)})
    parquet.write_table(table, tmp_path / "log.parquet", row_group_size=10)
    summary = scan_file(tmp_path / "log.parquet")
    assert (summary.first, summary.last) == (np.datetime64(0, "s"), np.datetime64(49, "s"))


def test_float32_stamps_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "single.parquet"
    parquet.write_table(
        pa.table({"time [s]": np.arange(5, dtype=np.float32), "gyro_x [deg/h]": np.ones(5)}), path
    )
    assert "float32" in " ".join(read_log(path).attrs["notes"])


def test_unit_option_overrules_netcdf_units(tmp_path: Path) -> None:
    path = tmp_path / "counts.nc"
    write_columns(path, {"BJZ": (np.arange(1, 5, dtype="i4"), "counts")})
    with pytest.raises(
        Exception, match=r"'counts', which is a unit of number, not of rate.*--unit"
    ):
        read_log(path, rate=20, map={"BJZ": "gyro_z"})
    raw = read_log(path, rate=20, map={"BJZ": "gyro_z"}, unit={"gyro": "0.5 deg/h"})
    np.testing.assert_array_equal(raw.rate[0], [0.5, 1.0, 1.5, 2.0])


def test_labels_of_axes_in_netcdf_are_characters(tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "log.nc", "w", format="NETCDF3_CLASSIC") as file:
        file.createDimension("time", 40)
        file.createDimension("axis", 3)
        clock = file.createVariable("time", "f8", ("time",))
        clock.units, clock[:] = "seconds since 2026-01-01", np.arange(40)
        file.createVariable("axis", "S1", ("axis",))[:] = np.array([b"x", b"y", b"z"])
        gyro = file.createVariable("gyro", "f8", ("time", "axis"))
        gyro.units, gyro[:] = "deg/h", np.zeros((40, 3))
    assert read_log(tmp_path / "log.nc").axis.values.tolist() == ["x", "y", "z"]


@pytest.mark.parametrize("name", ["gyro_x", "omega"])
def test_gyro_axes_of_netcdf_are_on_a_shorter_dimension(tmp_path: Path, name: str) -> None:
    slow, fast = ((np.arange(n) / n, "seconds since 2026-01-01") for n in (50, 200))
    axis, other = {name: (np.zeros(50), "deg/h")}, {"accel_x": (np.zeros(200), "m/s^2")}
    write_columns(tmp_path / "log.nc", {"a": fast, **other, "time": slow, **axis})
    options = {"map": {"OMEGA": "gyro_x"}} if name == "omega" else {}
    raw = read_log(tmp_path / "log.nc", **options)
    assert (raw.sizes["row"], raw.sizes["time_accel_x"]) == (50, 200)
    assert raw.axis.values.tolist() == ["x"]


@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC"])  # strings, characters
def test_text_of_netcdf_is_left_out_with_a_note(tmp_path: Path, form: Any) -> None:
    rate = ("time", np.arange(50.0), {"units": "deg/h"})
    pump = ("time", np.where(np.arange(50) < 20, "on", "off"))
    log = xr.Dataset({"gyro_x": rate, "pump": pump})
    log.to_netcdf(tmp_path / "a.nc", format=form)
    notes = read_log(tmp_path / "a.nc", rate=10.0).attrs["notes"]
    assert "a.nc: left out, as they hold text, not numbers: pump" in notes


def test_masked_netcdf_cells_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "packed.nc"
    since = {"units": "milliseconds since 2026-01-01", "_FillValue": -1}
    packing = {"units": "degree hour-1", "scale_factor": 0.25, "_FillValue": -9999}
    gyro = np.array([4, -9999, 8, 12], "i2"), packing
    raw = read_log(write_columns(path, {"time": ([0, 10, -1, 30], since), "gyro_x": gyro}))
    np.testing.assert_array_equal(raw.rate[0], [1.0, np.nan, 2.0, 3.0])
    assert np.isnat(raw.time.values).tolist() == [False, False, True, False]
    assert raw.time.values[3] == np.datetime64("2026-01-01T00:00:00.030")
    assert raw.attrs["unreadable_rows"] == 2


@pytest.mark.parametrize("name", ["cut.parquet", "cut.nc", "cut.mat"])
def test_a_damaged_file_is_named(tmp_path: Path, name: str) -> None:
    whole = tmp_path / f"whole{Path(name).suffix}"
    {".parquet": as_parquet, ".nc": as_netcdf, ".mat": as_mat73}[whole.suffix](whole)
    cut = tmp_path / name
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(FormatError, match=rf"{name}.*copy it again"):
        read_log(cut)


def test_empty_row_groups_of_parquet_are_passed_over(tmp_path: Path) -> None:
    table = pa.table({"time [s]": np.arange(100) * 0.01, "gyro_x [deg/h]": np.arange(100.0)})
    path = tmp_path / "log.parquet"
    with parquet.ParquetWriter(path, table.schema) as writer:
        for part in (table[:0], table[:60], table[60:], table[:0]):
            writer.write_table(part)
    assert parquet.ParquetFile(path).metadata.row_group(0).num_rows == 0
    row = gyrostab.scan(path).iloc[0]
    assert row["rows"] == 100
    assert (row["end"] - row["start"]) / np.timedelta64(1, "ms") == pytest.approx(990.0)
    assert read_log(path).sizes["row"] == 100


@pytest.mark.parametrize("suffix", [".parquet", ".mat"])
def test_damage_within_the_data_is_an_input_error(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    noise = np.random.default_rng(2).normal(size=50_000)
    if suffix == ".parquet":
        table = pa.table({"time [s]": np.arange(50_000) * 0.01, "gyro_x [deg/h]": noise})
        parquet.write_table(table, path, row_group_size=5000)
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("time", data=np.arange(50_000) * 0.01)
            file.create_dataset("gyro_x", data=noise, chunks=(1000,), compression="gzip")
    whole = bytearray(path.read_bytes())
    place = int(0.8 * len(whole))
    whole[place : place + 300] = b"\xff" * 300
    path.write_bytes(bytes(whole))
    given = {} if suffix == ".parquet" else {"time": "s", "gyro": "deg/h"}
    with pytest.raises(FormatError, match=rf"log{suffix}: is damaged, .*copy it again"):
        read_log(path, unit=given)


def test_plain_hdf5_with_units_as_attributes(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    columns = {"time": ([0.0, 0.5, 1.0], "s"), "gyro_x": ([1.0, 2.0, 3.0], "deg/s")}
    raw = read_log(write_columns(path, columns))
    np.testing.assert_array_equal(raw.rate[0], [3600.0, 7200.0, 10800.0])
    assert raw.time.values[1] == np.datetime64(500, "ms")
    assert scan_file(path).format == "hdf5"


def test_groups_of_hdf5_with_other_rates_are_channels(tmp_path: Path) -> None:
    lengths = {"imu/gyro_x": 200, "acc/accel_x": 800, "env/temperature": 20, "odd/spare": 7}
    units = ("deg/h", "g", "degC", "V")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for (name, length), unit in zip(lengths.items(), units, strict=True):
            file[name] = np.arange(float(length))
            file[name].attrs["units"] = unit
            if unit != "V":
                clock = file.create_dataset(f"{name[:3]}/time", data=np.arange(length) * 8 / length)
                clock.attrs["units"] = "s"
    raw = read_log(tmp_path / "log.h5")
    assert raw.rate.values.tolist() == [list(range(200))]
    assert raw.sizes["time_accel_x"] == 800
    second = np.timedelta64(1, "s")
    seconds = (raw["time_temperature"].values - raw["time"].values[0]) / second
    np.testing.assert_allclose(seconds, np.arange(20) * 0.4)
    np.testing.assert_array_equal(raw["temperature"], np.arange(20))
    assert any("left out" in note and "odd.spare" in note for note in raw.attrs["notes"])


@pytest.mark.skipif(not has_zstd(), reason="the NetCDF library has no zstd")
def test_hdf5_with_a_filter_of_netcdf_is_read(tmp_path: Path) -> None:
    values = np.arange(500) / 100
    columns = {"time": (values, "s"), "gyro_x": (values, "deg/h")}
    stored = write_columns(tmp_path / "log.nc", columns, compression="zstd")
    raw = read_log(stored.rename(tmp_path / "log.h5"))
    assert raw.rate.values[0, -1] == 4.99


def test_matlab_file_without_numbers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "words.mat"
    savemat(path, {"note": "hello", "scalar": 4.0})
    with pytest.raises(FormatError, match="no vector or matrix"):
        read_log(path)


def test_shorter_matlab_vectors_are_left_out_with_a_note(tmp_path: Path) -> None:
    path = tmp_path / "two.mat"
    savemat(path, {"gyro_x": np.ones(30), "slow": np.ones(3)})
    raw = read_log(path, rate=1, unit={"gyro": "deg/h"})
    assert any("slow" in note and "30 rows" in note for note in raw.attrs["notes"])
    with pytest.raises(MissingUnitError, match="--unit gyro=deg/s"):
        read_log(path, rate=1)


def test_buffers_spill_to_disk_and_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    blocks = [{"a": rng.normal(size=n), "b": np.arange(n)} for n in (5, 1, 30, 7)]
    expected = {key: np.concatenate([block[key] for block in blocks]) for key in "ab"}
    for limit in (0, 200, 10**6):
        monkeypatch.setattr(pieces, "SPILL_BYTES", limit)
        buffers = Buffers({"a": np.float64, "b": np.int64})
        for block in blocks:
            buffers.add(block)
        columns = buffers.finish()
        assert isinstance(columns["a"], np.ndarray) == (limit == 10**6)
        for key in "ab":
            np.testing.assert_array_equal(np.asarray(columns[key]), expected[key])
            for part in (slice(3, 38), slice(6, 6), slice(1, 40, 7), slice(-9, None)):
                np.testing.assert_array_equal(columns[key][part], expected[key][part])
    spool = Spool()
    first, second = (
        spool.store(np.arange(5.0)),
        spool.store(np.array(["2026-01-01", "NaT"], dtype="datetime64[ns]")),
    )
    np.testing.assert_array_equal(first[1:3], [1, 2])
    np.testing.assert_array_equal(
        second[:], np.array(["2026-01-01", "NaT"], dtype="datetime64[ns]")
    )


def test_attributes_of_a_classic_file_may_have_any_name(tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "log.nc", "w", format="NETCDF3_CLASSIC") as file:
        file.setncatts({"variables": "gyro_x", "dimensions": "n", "fp": 1, "_recs": 5})
        file.createDimension("n", None)
        gyro = file.createVariable("gyro_x", "i2", ("n",))
        gyro.units = "deg/h"
        gyro[:] = [1, 2, 3]
    assert read_log(tmp_path / "log.nc", rate=10.0).rate.values.tolist() == [[1.0, 2.0, 3.0]]
