"""Time and memory of the readers are bounded by the bytes of the file and by named limits."""

from __future__ import annotations

import json
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr
import zarr

from gyrostab import davar, make_log, open_log, read_log, regularise, scan, to_netcdf, to_zarr
from gyrostab.allan.davar import davar_part
from gyrostab.errors import FormatError, OptionError, TimeError
from gyrostab.ingest import ReadOptions, scan_file
from gyrostab.ingest.columns import pieces
from gyrostab.ingest.columns import typed as arrays
from gyrostab.ingest.files import Reader
from gyrostab.ingest.formats import matlab
from gyrostab.ingest.formats import netcdf as netcdf_reader
from gyrostab.ingest.limits import check_limits
from tests.support.columns import write_columns
from tests.support.published import published_davar

place_rows_module = sys.modules["gyrostab.ingest.grid.place_rows"]


def write_stamped_netcdf(path: Path, rows: int) -> Path:
    """Write a CF file with an int64 stamp for each sample at 400 Hz."""
    stamps, gyro = np.arange(rows) * 2_500_000, np.arange(rows) % 7 + 0.5
    return write_columns(path, {"time": (stamps, SINCE), "gyro_x": (gyro, "deg/h")})


def peak_of(work: Callable[[], object]) -> int:
    """Return the peak of the memory that Python and numpy allocate in `work` [bytes]."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_foreign_netcdf_takes_less_memory_than_its_stamps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "BATCH_ROWS", 2**16)
    rows = 1_500_000
    path = write_stamped_netcdf(tmp_path / "log.nc", rows)
    read_with(1000, write_stamped_netcdf(tmp_path / "short.nc", 3000))  # loads modules
    assert peak_of(lambda: read_with(2**20, path)) < 8 * rows  # the stamps alone have that many


def read_with(limit: int, path: Path, reader: Reader = netcdf_reader) -> xr.Dataset:
    """Read a file whose columns leave memory above a number of bytes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pieces, "SPILL_BYTES", limit)
        return reader.read(path, ReadOptions())


def test_regular_log_is_read_without_its_time_axis(tmp_path: Path) -> None:
    rows = 1_000_000
    log = make_log(np.zeros(rows, np.int16), rate=400.0, unit="deg/h")
    path = to_zarr(log, tmp_path / "log.zarr")
    read_log(path)  # loads modules
    assert peak_of(lambda: read_log(path)) < 8 * rows


def write_csv(path: Path, stamps_ns: np.ndarray) -> Path:
    """Write a text log of one axis with these stamps."""
    rows = "".join(f"{stamp},{row % 7}.5\n" for row, stamp in enumerate(stamps_ns.tolist()))
    path.write_text("time [ns],gyro_x [deg/h]\n" + rows)
    return path


START_NS = 1_780_000_000 * 10**9
DAY_NS = 86_400 * 10**9


def test_stamp_days_ahead_at_10_khz_is_named_before_the_grid_is_allocated(tmp_path: Path) -> None:
    stamps = START_NS + np.arange(5000) * 100_000
    stamps[-1] += 9 * DAY_NS
    path = write_csv(tmp_path / "log.csv", stamps)
    with pytest.raises(
        TimeError,
        match=r"log\.csv: from 2026-05-28T20:26:40.499 \(row 4998\) to 2026-06-06.*--max-gap "
        r".*--limit grid_samp",
    ):
        regularise(read_log(path))
    stepped = regularise(read_log(path), max_gap="1h")  # as the message advises
    assert stepped.sizes["time"] == 5001


def test_stamps_a_nanosecond_apart_are_refused_before_the_grid_is_allocated(tmp_path: Path) -> None:
    stamps = START_NS + np.sort(
        np.concatenate([np.arange(3000) * 2_500_000, np.arange(3000) * 2_500_000 + 1])
    )
    with pytest.raises(
        TimeError, match=r"row 1\).*row 2\).*1e-06 ms apart.*--limit grid_samples=7.5e\+09"
    ):
        scan(write_csv(tmp_path / "log.csv", stamps))


def test_gap_of_eight_days_at_400_hz_stays_a_gap(tmp_path: Path) -> None:
    stamps = START_NS + np.arange(6000) * 2_500_000
    stamps[3000:] += 8 * DAY_NS
    table = scan(write_csv(tmp_path / "log.csv", stamps))
    assert table.loc[0, "gaps"] == 1
    assert table.loc[0, "missing_share"] == pytest.approx(1.0 - 6000 / (8 * 86_400 * 400 + 6000))


def test_logs_years_apart_are_refused_before_the_grid_is_allocated(tmp_path: Path) -> None:
    for number, start in enumerate(("2026-01-01", "2026-01-09T12:00:00")):
        to_netcdf(
            make_log(np.arange(2000.0) % 5, rate=1e4, unit="deg/h", start=start),
            tmp_path / f"{number}.nc",
        )
    with pytest.raises(
        TimeError,
        match=r"0\.nc ends at 2026-01-01.*1\.nc begins at 2026-01-09.*--max-gap.*--limit "
        r"grid_samples=",
    ):
        read_log(tmp_path / "?.nc")


def test_long_gap_costs_no_window_sums_and_changes_no_cell() -> None:
    values = np.random.default_rng(1).standard_normal(1_200_000)
    values[300_000:900_000] = np.nan
    log = make_log(values, rate=100.0, unit="deg/h")
    options = {"window": "60s", "step": "30s", "taus": "octave"}
    whole = davar(log, **options)
    direct = published_davar(log, method="direct", **options)
    np.testing.assert_array_equal(np.isnan(whole["avar"]), np.isnan(direct["avar"]))
    inside = davar_part(log, part=slice(150, 200), **options)
    for name in ("avar", "count", "coverage", "edf", "window_mean"):
        np.testing.assert_array_equal(inside[name], whole[name].isel(time=slice(150, 200)))
    assert not inside["count"].any()
    assert not inside["window_coverage"].any()


def test_limits_have_names_and_are_above_zero() -> None:
    with pytest.raises(OptionError, match="the limits are columns, "):
        check_limits({"rows": 1})
    with pytest.raises(OptionError, match="above 0"):
        check_limits({"columns": "-1"})
    with pytest.raises(OptionError, match="give a number of columns"):
        check_limits({"columns": "many"})


ROWS = 5000
STAMPS = (
    START_NS + np.arange(ROWS) * 10_000_000 + np.random.default_rng(2).integers(-9000, 9000, ROWS)
)  # no even steps
RATES = np.random.default_rng(3).integers(-900, 900, (3, ROWS)).astype(float)
SINCE = "nanoseconds since 1970-01-01"


def write_netcdf(path: Path, kind: str, layout: str) -> None:
    with netCDF4.Dataset(path, "w", format=kind) as file:
        file.createDimension("time", None if layout == "records" else ROWS)
        file.createDimension("axis", 3)
        options = {"zlib": True, "shuffle": True, "fletcher32": True} if layout == "chunks" else {}
        chunks = {"chunksizes": (700,)} if layout == "chunks" else {}
        time = file.createVariable(
            "time", "i8" if kind != "NETCDF3_CLASSIC" else "f8", ("time",), **options, **chunks
        )
        time.units = SINCE
        dims = ("axis", "time") if layout == "axis first" else ("time", "axis")
        gyro = file.createVariable(
            "gyro", "i2", dims, **options, **({"chunksizes": (700, 2)} if options else {})
        )
        gyro.units, gyro.scale_factor = "deg/h", 0.5
        gyro.set_auto_scale(False)
        time[:] = STAMPS
        gyro[:] = RATES if layout == "axis first" else RATES.T


def write_zarr(path: Path, version: int) -> None:
    group = zarr.open_group(path, mode="w", zarr_format=version)
    for name, values, chunks in (("time", STAMPS, (700,)), ("gyro", 0.5 * RATES.T, (700, 2))):
        dims = ["time", "axis"][: values.ndim]
        named = {"dimension_names": dims} if version == 3 else {}
        array = group.create_array(name, data=values, chunks=chunks, **named)
        array.attrs.update(
            {"units": "deg/h" if values.ndim == 2 else SINCE}
            | ({} if named else {"_ARRAY_DIMENSIONS": dims})
        )


def write_hdf5(path: Path, layout: str) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        options = {"chunks": (700, 1), "compression": "gzip"} if layout == "chunks" else {}
        file.create_dataset("time", data=STAMPS[:, None], **options).attrs["units"] = SINCE
        for axis, values in zip("xyz", RATES, strict=True):
            file.create_dataset(f"gyro_{axis}", data=0.5 * values[:, None], **options).attrs[
                "units"
            ] = "deg/h"


FOREIGN = {
    "chunks.nc": lambda path: write_netcdf(path, "NETCDF4", "chunks"),
    "even.nc": lambda path: write_netcdf(path, "NETCDF4", "even"),
    "axis_first.nc": lambda path: write_netcdf(path, "NETCDF4", "axis first"),
    "records.nc": lambda path: write_netcdf(path, "NETCDF3_64BIT_DATA", "records"),
    "classic.nc": lambda path: write_netcdf(path, "NETCDF3_64BIT_DATA", "axis first"),
    "two.zarr": lambda path: write_zarr(path, 2),
    "three.zarr": lambda path: write_zarr(path, 3),
    "chunks.h5": lambda path: write_hdf5(path, "chunks"),
    "even.mat": lambda path: write_hdf5(path, "even"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_columns_of_foreign_files_leave_memory_unchanged(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    FOREIGN[name](path)
    monkeypatch.setattr(arrays, "BATCH_ROWS", 1024)
    reader = matlab if path.suffix in (".h5", ".mat") else netcdf_reader
    whole, lazy = (read_with(limit, path, reader) for limit in (2**27, 1000))
    assert whole["rate"].chunks is None
    assert lazy["rate"].chunks is not None
    for raw in (whole, lazy):
        np.testing.assert_array_equal(raw["rate"], 0.5 * RATES)
        np.testing.assert_array_equal(raw["time"].values.astype(np.int64), STAMPS)
    np.testing.assert_array_equal(regularise(lazy)["rate"], regularise(whole)["rate"])


def test_windows_of_columns_on_disk_equal_those_in_memory(
    tmp_path: Path,
) -> None:
    path = write_stamped_netcdf(tmp_path / "log.nc", 300_000)
    raw = read_with(1000, path)
    log = regularise(raw)
    part = davar_part(log, part=slice(0, 5), window="60s", step="30s")
    whole = davar(regularise(netcdf_reader.read(path, ReadOptions())), window="60s", step="30s")
    np.testing.assert_array_equal(part["avar"], whole["avar"].isel(time=slice(0, 5)))


def test_store_that_declares_unwritten_samples_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.zarr"
    write_zarr(path, 3)
    for name, shape in (("time", [10**11]), ("gyro", [10**11, 3])):
        place = path / name / "zarr.json"
        place.write_text(json.dumps(json.loads(place.read_text("utf-8")) | {"shape": shape}))
    with pytest.raises(
        FormatError,
        match=r"log\.zarr: it declares 1e\+11 samples in each of 4 columns, but holds .* "
        r"bytes.*--limit stored_samples=4e\+11",
    ):
        read_log(path)


@pytest.mark.parametrize("suffix", ["nc", "h5"])
def test_file_of_unwritten_variables_is_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"log.{suffix}"
    with h5py.File(path, "w") as file:
        for name, kind in (("time", "i8"), ("gyro_x", "f8")):
            array = file.create_dataset(name, (10**11,), kind, chunks=(10**6,))
            array.attrs["units"] = SINCE if name == "time" else "deg/h"
            array[:1000] = np.arange(1000)
        if suffix == "nc":
            file["time"].make_scale("time")
            file["gyro_x"].dims[0].attach_scale(file["time"])
    with pytest.raises(
        FormatError, match=r"declares 1e\+11 samples .*--limit stored_samples=2e\+11"
    ):
        read_log(path)


@pytest.mark.parametrize("stamps", [False, True])
@pytest.mark.parametrize("opened", [read_log, open_log])
def test_own_log_that_declares_unwritten_samples_is_refused(
    opened: Callable[[Path], object], stamps: bool, tmp_path: Path
) -> None:
    path = tmp_path / "log.zarr"
    to_zarr(make_log(np.arange(200_000.0) % 7, rate=100.0, unit="deg/h"), path, stamps=stamps)
    for file in (*path.glob("*/.zarray"), path / ".zmetadata"):
        file.write_text(file.read_text().replace("200000", "100000000000"))
    with pytest.raises(
        FormatError, match=r"log\.zarr: it declares 1e\+11 samples .*--limit stored_samples"
    ):
        opened(path)


@pytest.mark.parametrize("name", ["log.zarr", "log.nc", "log.h5"])
def test_chunk_of_a_terabyte_is_refused_before_it_is_allocated(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "log.zarr":
        group = zarr.open_group(path, mode="w", zarr_format=2)
        for column in ("time", "gyro_x"):
            group.create_array(column, shape=(1000,), chunks=(10**11,), dtype="f8").attrs[
                "_ARRAY_DIMENSIONS"
            ] = ["time"]
    else:
        with h5py.File(path, "w") as file:
            for column in ("time", "gyro_x"):  # HDF5 itself allows 4 GiB
                file.create_dataset(column, (1000,), "f8", chunks=(2**28,), maxshape=(None,))
    with pytest.raises(
        FormatError, match=r"a chunk of '(time|gyro_x)' has .* bytes.*--limit chunk_bytes="
    ):
        read_log(path)


def test_flipped_bytes_in_a_classic_header_take_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "log.nc"
    write_netcdf(path, "NETCDF3_CLASSIC", "axis first")
    netcdf_reader.scan(path, ReadOptions())  # loads modules
    whole, header = bytearray(path.read_bytes()), 400
    draw = np.random.default_rng(4)
    refused = 0
    for place in draw.integers(4, header, 60):
        damaged = whole.copy()
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)

        def read() -> None:
            nonlocal refused
            try:
                netcdf_reader.read(path, ReadOptions())
            except (FormatError, OptionError, TimeError, ValueError):
                refused += 1

        assert peak_of(read) < 2**24
    assert refused > 20


def write_wide_csv(path: Path, header: str, columns: int) -> Path:
    """Write a text log of one axis with very many further columns."""
    names = ["time [s]", "gyro_x [deg/h]", *(header.format(number) for number in range(columns))]
    rows = (",".join([f"{row / 100}", "2.5", *["1.5"] * columns]) for row in range(6))
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "channels"),
    [("c{} [V]", 200), *(pytest.param(name, 0, marks=pytest.mark.full) for name in ("c{}", "c"))],
)
def test_table_of_20_000_columns_is_read_for_those_that_are_used(
    header: str, channels: int, tmp_path: Path
) -> None:
    path = write_wide_csv(tmp_path / "log.csv", header, 20_000)
    begun = time.process_time()
    raw = read_log(path)
    assert time.process_time() - begun < 10.0  # above two minutes before
    assert len(raw.data_vars) == 1 + channels
    np.testing.assert_array_equal(raw["rate"], np.full((1, 6), 2.5))
    assert any("left out" in note for note in raw.attrs["notes"])
    if channels:
        assert any(
            "the limit is 200 channels, and --limit channels=2e+04 lifts it" in note
            for note in raw.attrs["notes"]
        )


def test_limit_of_channels_is_raised_by_its_option(tmp_path: Path) -> None:
    path = write_wide_csv(tmp_path / "log.csv", "c{} [V]", 5)
    assert len(read_log(path, limits={"channels": 2}).data_vars) == 3
    mapped = read_log(path, limits={"channels": 2}, map={"c4": "c4"})
    assert set(mapped.data_vars) == {"rate", "c0", "c1", "c4"}


@pytest.mark.parametrize("header", ["c", "gyro_x [deg/h]", "c{}"])
def test_table_of_100_000_columns_is_refused_at_once(header: str, tmp_path: Path) -> None:
    path = write_wide_csv(tmp_path / "log.csv", header, 100_000)
    begun = time.process_time()
    with pytest.raises(
        FormatError,
        match=r"it has 100,002 columns.* the limit is 3e\+04 columns, and --limit "
        r"columns=1.1e\+05 lifts it",
    ):
        read_log(path)
    assert time.process_time() - begun < 10.0


@pytest.mark.parametrize("cell", ["[" * 64_000, f"a{' ' * 64_000}b", "1" * 16_000 + "x"])
def test_hostile_header_takes_linear_time(cell: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(f"time [s],gyro_x [deg/h],{cell}\n0,1,2\n1,2,3\n")
    begin = time.process_time()
    assert scan_file(path).axes == ("x",)
    assert time.process_time() - begin < 0.5


def test_line_of_a_wide_table_is_longer_than_the_usual_head(tmp_path: Path) -> None:
    path = write_wide_csv(tmp_path / "log.csv", "a_long_name_of_a_channel_{}", 9000)
    assert path.read_text().index("\n") > 2**17
    assert read_log(path).sizes["row"] == 6


def write_gappy_netcdf(path: Path, rows: int, stamps: np.ndarray) -> Path:
    """Write a CF file with lost rows, missing cells, and a channel filled in every tenth row."""
    x, y, temperature = np.random.default_rng(6).normal(size=(3, rows))
    x[3000:3100] = y[3000:3100] = y[1000:1016] = np.nan
    y[rows - 5] = np.inf
    temperature[np.arange(rows) % 10 > 0] = np.nan
    columns = {"time": (stamps, SINCE), "gyro_x": (x, "deg/h"), "gyro_y": (y, "deg/h")}
    return write_columns(path, {**columns, "temperature": (temperature, "degC")})


@pytest.mark.parametrize("even", [True, False])
def test_log_of_columns_on_disk_equals_that_in_memory(
    even: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "BATCH_ROWS", 1024)
    stamps = START_NS + np.arange(20_000) * 2_500_000
    stamps[10_000:] += 0 if even else 7_500_000
    path = write_gappy_netcdf(tmp_path / "log.nc", 20_000, stamps)
    whole, lazy = (regularise(read_with(limit, path)) for limit in (2**27, 1000))
    xr.testing.assert_identical(whole.drop_attrs(deep=False), lazy.load().drop_attrs(deep=False))
    assert whole.attrs["notes"] == lazy.attrs["notes"]


def test_even_stamps_are_placed_without_reading_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_stamped_netcdf(tmp_path / "log.nc", 100_000)
    whole, lazy = (read_with(limit, path) for limit in (2**27, 1000))
    blocks_read = []
    rate = place_rows_module.estimate_rate
    monkeypatch.setattr(
        place_rows_module,
        "estimate_rate",
        lambda stamps, **where: blocks_read.append(list(stamps())) or rate(stamps, **where),
    )
    logs = [regularise(raw) for raw in (whole, lazy)]
    assert [sum(len(rows) for rows, _ in blocks) for blocks in blocks_read] == [100_000]
    xr.testing.assert_identical(
        logs[0].drop_attrs(deep=False), logs[1].load().drop_attrs(deep=False)
    )
    assert logs[0].attrs["sampling_rate_hz"] == logs[1].attrs["sampling_rate_hz"] == 400.0
