"""The working store: counts bit for bit, chunks of 20 minutes, no stamp per sample, lazy, and damage that is never silent."""

from __future__ import annotations

import json
import pickle
import sys
import time
import warnings
from pathlib import Path

import dask
import h5py
import hypothesis.extra.numpy as hnp
import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gyrostab
from gyrostab.errors import FormatError, OptionError, SchemaError
from gyrostab.export import open_log, to_netcdf, to_zarr
from gyrostab.kernels.counts import from_counts, to_counts
from gyrostab.store import chunk_samples
from gyrostab.timegrid import TimeGridIndex, grid_times, time_coordinate
from tests import synthetic

WRITERS = {"nc": to_netcdf, "zarr": to_zarr}
RATE = 100.0
CHUNK = 120_000  # 20 minutes at 100 Hz
FACTOR = 0.1 / 3.0
START = 1_790_000_000_123_456_789


def counts_log(*, samples: int = 2 * CHUNK + 1000, axes: str = "xy", factor: float = FACTOR, dtype: str = "i4") -> xr.Dataset:
    """White noise in counts with a gap, and a channel in counts of another factor."""
    rng = np.random.default_rng(5)
    counts = rng.integers(-500, 700, (len(axes), samples)).astype(float)
    counts[0, 100:200] = np.nan
    log = xr.Dataset(
        {
            "rate": (("axis", "time"), counts * factor, {"units": "degree hour-1"}, {"dtype": np.dtype(dtype), "scale_factor": factor}),
            "vibration": ("time", counts[0] * 0.001, {"units": "g"}, {"dtype": np.dtype("i2"), "scale_factor": 0.001}),
        },
        coords={"axis": list(axes)},
        attrs={"sampling_rate_hz": RATE, "kind": "rate"},
    )
    return log.assign_coords(time_coordinate(START, RATE, samples))


def same_bits(a: xr.DataArray, b: xr.DataArray) -> bool:
    """Equal to the last bit, any NaN being like any other, and zero having no sign."""
    left, right = (np.where(np.isnan(x.values), np.float64(np.nan), x.values + 0.0).view(np.int64) for x in (a, b))
    return a.dims == b.dims and np.array_equal(left, right)


def stored_kinds(path: Path) -> dict[str, str]:
    """Types on disk as other programs see them."""
    if path.is_dir():
        return {array.parent.name: np.dtype(json.loads(array.read_text())["dtype"]).name for array in path.glob("*/.zarray")}
    with netCDF4.Dataset(path) as file:
        return {name: getattr(variable.dtype, "name", "text") for name, variable in file.variables.items()}


@settings(max_examples=60, deadline=None)
@given(
    whole=hnp.arrays(np.float64, st.integers(1, 50), elements=st.integers(-(2**31) + 2, 2**31 - 1).map(float) | st.just(np.nan)),
    factor=st.floats(1e-12, 1e12) | st.floats(-1e3, -1e-3) | st.sampled_from([1.0, 0.1, 1 / 3, 3600.0, 0.02]),
)
def test_counts_come_back_bit_for_bit(whole, factor):
    values = whole * factor
    counts = to_counts(values, factor, "i4", -2147483647)
    assert counts is not None
    assert counts.dtype == np.int32
    back = from_counts(counts, factor, -2147483647)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    known = ~np.isnan(values)
    np.testing.assert_array_equal((back[known] + 0.0).view(np.int64), (values[known] + 0.0).view(np.int64))


@settings(max_examples=60, deadline=None)
@given(values=hnp.arrays(np.float64, st.integers(1, 6), elements=st.floats(width=64)), factor=st.sampled_from([1.0, 0.1, 1 / 3]))
def test_counts_are_made_only_of_what_they_give_back(values, factor):
    counts = to_counts(values, factor, "i2", -32767)
    known = ~np.isnan(values)
    if counts is None:
        n = np.rint(values[known] / factor)
        fits = (np.abs(n) < 32767) & ((n * factor) == values[known])
        assert not fits.all()
    else:
        np.testing.assert_array_equal(from_counts(counts, factor, -32767)[known], values[known])


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    whole=hnp.arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(2, 40)), elements=st.integers(-40000, 40000).map(float)),
    holes=st.lists(st.integers(0, 39), max_size=8),
    factor=st.sampled_from([1.0, 0.1, 1 / 3, 3600.0, 7.2e-5]),
    form=st.sampled_from(["nc", "zarr"]),
)
def test_a_log_of_counts_comes_back_bit_for_bit(tmp_path, whole, holes, factor, form):
    values = whole * factor
    values[:, [hole for hole in holes if hole < values.shape[1]]] = np.nan
    log = counts_log(samples=values.shape[1], axes="xyz"[: len(values)], factor=factor, dtype="i2").drop_vars("vibration")
    log["rate"] = (log.rate.dims, values, log.rate.attrs, log.rate.encoding)
    path = WRITERS[form](log, tmp_path / f"log.{form}", overwrite=True)
    with open_log(path) as back:
        assert same_bits(back.rate, log.rate)
        assert stored_kinds(path)["rate"] == ("int16" if np.nanmax(np.abs(np.nan_to_num(whole))) < 32767 else stored_kinds(path)["rate"])
        assert stored_kinds(path)["rate"].startswith("int")


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("lazy", [False, True])
def test_layout_and_round_trip(tmp_path, form, lazy):
    log = counts_log()
    path = WRITERS[form](log.chunk(time=100_001) if lazy else log, tmp_path / f"log.{form}")
    kinds = stored_kinds(path)
    assert kinds["rate"] == "int32"
    assert kinds["vibration"] == "int16"
    assert "time" not in kinds  # no stamp per sample
    with xr.open_dataset(path, engine="netcdf4" if form == "nc" else "zarr", chunks={}) as plain:
        assert plain.attrs["time_coverage_start"] == "2026-09-21T14:13:20.123456Z"
        assert plain.rate.dims == ("axis", "time_index")
        assert plain.rate.chunks == ((1, 1), (CHUNK, CHUNK, 1000))
        assert plain.rate.dtype == np.float64
        np.testing.assert_array_equal(plain.rate, log.rate)  # other programs see the same numbers
        assert plain.time_start.values == np.datetime64(START, "ns")
        assert plain.time_start.attrs["sampling_rate_hz"] == RATE
    with open_log(path) as back:
        assert same_bits(back.rate, log.rate)
        assert same_bits(back.vibration, log.vibration)
        assert back.rate.chunks == ((1, 1), (CHUNK, CHUNK, 1000))
        assert isinstance(back.xindexes["time"], TimeGridIndex)
        np.testing.assert_array_equal(back.time[-3:], log.time[-3:])
        again = WRITERS[form](back, tmp_path / f"again.{form}")
        assert stored_kinds(again) == kinds


def test_compression_and_checksums(tmp_path):
    with netCDF4.Dataset(to_netcdf(counts_log(), tmp_path / "log.nc")) as file:
        found = file["rate"].filters()
        assert found["fletcher32"]
        assert found["zstd"]
    with netCDF4.Dataset(to_netcdf(counts_log(), tmp_path / "plain.nc", compression="zlib")) as file:
        assert file["rate"].filters()["zlib"]
        assert not file["rate"].filters()["zstd"]
    layout = json.loads((to_zarr(counts_log(), tmp_path / "log.zarr") / "rate" / ".zarray").read_text())
    assert layout["zarr_format"] == 2
    assert layout["compressor"]["id"] == "blosc"
    assert layout["compressor"]["cname"] == "lz4"
    assert layout["compressor"]["shuffle"] == 1
    assert [item["id"] for item in layout["filters"]] == ["fletcher32"]
    with pytest.raises(OptionError, match="compression='lzma': give 'zstd' or 'zlib'"):
        to_netcdf(counts_log(samples=10), tmp_path / "no.nc", compression="lzma")


def test_a_library_without_zstd_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(netCDF4.Dataset, "has_zstd_filter", lambda self: False, raising=False)
    with pytest.warns(UserWarning, match="has no zstd here: the log is compressed with zlib"):
        path = to_netcdf(counts_log(samples=100), tmp_path / "log.nc")
    with netCDF4.Dataset(path) as file:
        assert file["rate"].filters()["zlib"]


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("lazy", [False, True])
def test_wider_counts_or_doubles_where_the_declaration_does_not_hold(tmp_path, form, lazy):
    log = counts_log(samples=200_000, dtype="i2")
    log.rate.values[1, 150_000] = 40_000 * FACTOR
    wide = WRITERS[form](log.chunk(time=70_000) if lazy else log, tmp_path / f"wide.{form}")
    assert stored_kinds(wide)["rate"] == "int32"
    log.rate.values[1, 199_999] = np.pi
    with pytest.warns(UserWarning, match=r"rate: not every value is a whole multiple of 0\.0333333; stored as doubles"):
        path = WRITERS[form](log.chunk(time=70_000) if lazy else log, tmp_path / f"log.{form}")
    assert stored_kinds(path)["rate"] == "float64"
    assert stored_kinds(path)["vibration"] == "int16"
    with open_log(path) as back:
        assert same_bits(back.rate, log.rate)
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted([f"wide.{form}", f"log.{form}"])


def test_a_value_that_stands_for_missing_is_not_lost(tmp_path):
    log = counts_log(samples=4, axes="x", factor=1.0, dtype="i4").drop_vars("vibration")
    log["rate"] = (log.rate.dims, np.array([[-2147483647.0, 1.0, np.nan, 2.0]]), log.rate.attrs, log.rate.encoding)
    with pytest.warns(UserWarning, match="stored as doubles"):
        path = to_netcdf(log, tmp_path / "log.nc")
    assert same_bits(open_log(path).rate, log.rate)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("rate", [300.0, 99.3])
@pytest.mark.parametrize("part", [slice(7, None), slice(3, 900, 7), slice(None, None, 2), slice(900, 10, -3)])
def test_a_cut_log_keeps_its_exact_times(tmp_path, form, rate, part):
    log = synthetic.log(samples=1000, rate=rate).isel(time=part)
    with open_log(WRITERS[form](log, tmp_path / f"cut.{form}")) as back:
        np.testing.assert_array_equal(back.time.values, grid_times(synthetic.START, rate, np.arange(1000)[part]).view("M8[ns]"))
        assert same_bits(back.rate, log.rate)


def test_times_that_are_no_grid_are_stored_one_by_one(tmp_path):
    log = synthetic.log(samples=100).isel(time=[0, 1, 5, 50])
    with open_log(to_netcdf(log, tmp_path / "log.nc")) as back:
        np.testing.assert_array_equal(back.time.values, log.time.values)
    assert stored_kinds(tmp_path / "log.nc")["time"] == "int64"


def test_plain_stamps_that_are_a_grid_are_not_stored(tmp_path):
    log = counts_log(samples=1000).drop_vars("time").assign_coords(time=pd.date_range("2026-11-20", periods=1000, freq="10ms"))
    with open_log(to_netcdf(log, tmp_path / "log.nc")) as back:
        np.testing.assert_array_equal(back.time.values, log.time.values)
    assert "time" not in stored_kinds(tmp_path / "log.nc")


def test_a_name_that_the_time_axis_needs(tmp_path):
    log = counts_log(samples=10).assign(time_start=3)
    with pytest.raises(SchemaError, match="'time_start' is needed for the time axis; rename"):
        to_netcdf(log, tmp_path / "log.nc")


@pytest.mark.parametrize("form", WRITERS)
def test_only_the_chunk_that_is_asked_for_is_read(tmp_path, form):
    """All other chunks are spoiled, and nobody notices."""
    path = WRITERS[form](counts_log(), tmp_path / f"log.{form}")
    for row, number in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)]:
        spoil(path, row, number)
    with warnings.catch_warnings(), open_log(path) as log:
        warnings.simplefilter("error")
        got = log.rate.sel(axis="y")[CHUNK + 5 : CHUNK + 105].values
    np.testing.assert_array_equal(got, counts_log().rate[1, CHUNK + 5 : CHUNK + 105])


@pytest.mark.parametrize("form", WRITERS)
def test_the_graph_is_small_and_travels(tmp_path, form):
    path = WRITERS[form](counts_log(), tmp_path / f"log.{form}")
    with open_log(path) as log:
        data = pickle.loads(pickle.dumps(log.rate.data))
        assert len(pickle.dumps(log.rate.data)) < 5000 + 2000 * data.npartitions
        assert same_bits(log.rate.copy(data=data), counts_log().rate)
        for scheduler in ("threads", "synchronous", *(["processes"] if form == "nc" else [])):
            assert float(np.nansum(data[:, :1000].compute(scheduler=scheduler, num_workers=2))) == float(np.nansum(data[:, :1000]))


def spoil(path: Path, row: int, number: int, *, how: str = "flip", name: str = "rate") -> None:
    """Damage one chunk of a stored log."""
    if path.is_dir():
        chunk = path / name / f"{row}.{number}"
        content = chunk.read_bytes()
        if how == "remove":
            chunk.unlink()
        elif how == "cut":
            chunk.write_bytes(content[: len(content) // 2])
        else:
            place = len(content) // 2
            chunk.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        return
    with h5py.File(path) as file:
        stored = file[name].id
        info = next(i for i in map(stored.get_chunk_info, range(stored.get_num_chunks())) if i.chunk_offset == (row, number * CHUNK))
    with path.open("r+b") as raw:
        raw.seek(info.byte_offset + info.size // 2)
        byte = raw.read(1)[0]
        raw.seek(info.byte_offset + info.size // 2)
        raw.write(bytes([byte ^ 0x55]))


@pytest.mark.parametrize(("form", "how"), [("nc", "flip"), ("zarr", "flip"), ("zarr", "cut"), ("zarr", "remove")])
def test_a_damaged_chunk_becomes_a_gap_and_is_told_once(tmp_path, form, how):
    path = WRITERS[form](counts_log(), tmp_path / f"log.{form}")
    spoil(path, 1, 1, how=how)
    wanted = counts_log().rate.copy()
    wanted[1, CHUNK : 2 * CHUNK] = np.nan
    with open_log(path) as log, warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        with dask.config.set(scheduler="threads", num_workers=2):
            assert same_bits(log.rate, wanted)
            assert np.isnan(log.rate[1, CHUNK + 3 :: 1000]).sum() == 120
    (message,) = [str(warning.message) for warning in seen if issubclass(warning.category, UserWarning)]
    assert str(path) in message
    assert "axis y: the chunk from 2026-09-21T14:33:20.123456789 to 2026-09-21T14:53:20.113456789 is " in message
    assert ("is missing: no file rate/1.1" if how == "remove" else "is damaged") in message
    with open_log(path, strict=True) as log, pytest.raises(FormatError, match=r"axis y: the chunk from .*; copy it again, or leave out"):
        log.rate.compute()
    with open_log(path, strict=True) as log:
        assert same_bits(log.rate[0], wanted[0])  # strict or not, what is sound is read


@pytest.mark.parametrize("form", WRITERS)
def test_a_gap_in_the_chunk_of_a_channel_names_it(tmp_path, form):
    stamps = time_coordinate(START, 1.0, 70_000, name="time_temperature")
    slow = xr.Dataset({"temperature": ("time_temperature", np.arange(70_000.0), {"units": "degree_Celsius"})})
    log = counts_log(samples=100).assign(slow).assign_coords(time_temperature=stamps["time_temperature"].values)
    path = WRITERS[form](log, tmp_path / f"log.{form}")
    if form == "zarr":
        (path / "temperature" / "1").unlink()
    else:
        with h5py.File(path) as file:
            info = file["temperature"].id.get_chunk_info(1)
        with path.open("r+b") as raw:
            raw.seek(info.byte_offset + 20)
            raw.write(b"\x55" * 20)
    with (
        open_log(path) as back,
        pytest.warns(UserWarning, match=r"channel temperature: the chunk from 2026-09-22T08:25:36\.1\d* to 2026-09-22T"),
    ):
        values = back.temperature.values
    assert np.isnan(values).sum() == 70_000 - 65_536
    np.testing.assert_array_equal(values[:65_536], np.arange(65_536))


def test_every_chunk_of_a_zarr_store_is_written_even_if_it_is_all_gap(tmp_path):
    log = counts_log()
    log.rate.values[0] = np.nan
    path = to_zarr(log, tmp_path / "log.zarr")
    assert {item.name for item in (path / "rate").iterdir()} == {".zarray", ".zattrs", *(f"{r}.{n}" for r in (0, 1) for n in (0, 1, 2))}
    path = to_zarr(log.chunk(time=1000), tmp_path / "lazy.zarr")
    assert len(list((path / "rate").iterdir())) == 8
    with warnings.catch_warnings(), open_log(path) as back:
        warnings.simplefilter("error")
        assert np.isnan(back.rate[0]).all()


@pytest.mark.parametrize(("form", "said"), [("nc", "cannot be opened again"), ("zarr", "is not there any more")])
def test_a_store_that_vanishes_is_no_gap(tmp_path, form, said):
    path = WRITERS[form](counts_log(), tmp_path / f"log.{form}")
    with open_log(path) as log:
        path.rename(tmp_path / "away")
        with pytest.raises(FormatError, match=f"{said}.*has it been moved"):
            log.rate.compute()
    with open_log((tmp_path / "away").rename(path)) as log:
        log.rate[:, :5].compute()
        path.rename(tmp_path / "away")
        with pytest.raises(FormatError, match=f"{said}.*has it been moved"):
            log.rate.compute()


def test_a_damaged_store_goes_on_to_a_product(tmp_path):
    path = to_zarr(counts_log(samples=3 * CHUNK), tmp_path / "log.zarr")
    spoil(path, 0, 1, how="remove")
    with open_log(path) as log, pytest.warns(UserWarning, match="axis x: the chunk from"):
        surface = gyrostab.davar(log, window="4min", step="4min", taus="10s").compute()
    coverage = surface.window_coverage.values
    assert (coverage[0, 5:10] == 0).all()
    assert (coverage[1] == 1).all()
    assert (coverage[0, 10:] == 1).all()


def write_csv(path: Path, header: str, columns: list[np.ndarray], first: int = 0, step: int = 10_000_000) -> Path:
    stamps = first + np.arange(len(columns[0])) * step
    rows = "\n".join(",".join([str(t), *("" if c != c else f"{c:.10g}" for c in row)]) for t, *row in zip(stamps, *columns, strict=True))
    path.write_text(f"time [ns],{header}\n{rows}\n")
    return path


def ingested(*paths: Path, **reading: object) -> xr.Dataset:
    return gyrostab.regularise(gyrostab.read_log(list(paths), **reading))


@pytest.mark.parametrize("form", WRITERS)
def test_integer_columns_of_a_text_log_are_stored_as_counts(tmp_path, form):
    rng = np.random.default_rng(3)
    columns = [
        np.rint(rng.normal(0, 3000, 500)),
        np.rint(rng.normal(5, 3000, 500)),
        np.rint(rng.normal(20, 3, 500)),
        rng.normal(1, 0.1, 500),
    ]
    columns[0][7] = np.nan
    source = write_csv(tmp_path / "a.csv", "gyro_x,gyro_y,temperature [degC],vibration [g]", columns)
    log = ingested(source, unit={"gyro": "0.1 arcsec/s"})
    path = WRITERS[form](log, tmp_path / f"log.{form}")
    kinds = stored_kinds(path)
    assert (kinds["rate"], kinds["temperature"], kinds["vibration"]) == ("int16", "int16", "float64")
    with open_log(path) as back:
        for name in ("rate", "temperature", "vibration"):
            assert same_bits(back[name], log[name])


def test_counts_through_every_door(tmp_path):
    """Parquet, MATLAB and packed NetCDF; several files; increments; axes of different factors; a fraction in the last row."""
    counts = np.rint(np.random.default_rng(3).normal(0, 3e5, 1000))
    time = np.arange(1000) * 10_000_000
    frame = pd.DataFrame({"time [ns]": time, "gyro_x [deg/s]": counts.astype(np.int32)})
    frame.to_parquet(tmp_path / "a.parquet")
    with netCDF4.Dataset(tmp_path / "b.nc", "w") as file:
        file.createDimension("n", 1000)
        file.createVariable("time", "i8", "n")[:] = time
        file["time"].units = "nanoseconds since 1970-01-01"
        gyro = file.createVariable("gyro_x", "i4", "n", fill_value=-1)
        gyro.setncatts({"units": "deg/s", "scale_factor": 0.0003})
        gyro.set_auto_scale(False)
        gyro[:] = np.where(counts == 0, 1, counts)
    from scipy.io import savemat

    savemat(tmp_path / "c.mat", {"time": time, "gyro_x": counts.astype(np.int32)})
    write_csv(tmp_path / "d1.csv", "gyro_x [deg/h]", [counts])
    write_csv(tmp_path / "d2.csv", "gyro_x [deg/h]", [np.rint(counts / 1e3)], first=10**10 + 50_000_000)
    write_csv(tmp_path / "e.csv", "angle_x", [np.rint(counts / 100)])
    write_csv(tmp_path / "f.csv", "gyro_x,gyro_y", [counts, counts])
    write_csv(tmp_path / "g.csv", "gyro_x [deg/h]", [np.append(counts[:-1], 0.5)])
    cases = {
        "a": (ingested(tmp_path / "a.parquet"), "int32"),
        "b": (ingested(tmp_path / "b.nc"), "int32"),
        "c": (ingested(tmp_path / "c.mat", unit={"time": "ns", "gyro": "0.3 arcsec/s"}), "int32"),
        "d": (ingested(tmp_path / "d1.csv", tmp_path / "d2.csv"), "int32"),
        "d2": (ingested(tmp_path / "d2.csv"), "int16"),
        "e": (ingested(tmp_path / "e.csv", unit={"angle": "0.07 arcsec"}, kind="rate"), "int16"),
        "f": (ingested(tmp_path / "f.csv", unit={"gyro_x": "deg/s", "gyro_y": "deg/h"}), "float64"),
        "g": (ingested(tmp_path / "g.csv"), "float64"),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing that is declared as counts turns out to be none
        for name, (log, kind) in cases.items():
            path = to_netcdf(log, tmp_path / f"{name}-log.nc")
            assert stored_kinds(path)["rate"] == kind, name
            with open_log(path) as back:
                assert same_bits(back.rate, log.rate), name


def test_ingest_writes_the_working_store(tmp_path, capsys):
    from gyrostab.cli import main

    source = write_csv(tmp_path / "a.csv", "gyro_x [deg/s],temperature [degC]", [np.arange(900.0) % 7, np.full(900, 20.5)])
    assert main(["ingest", str(source), "-o", str(tmp_path / "log.zarr"), "--quiet-progress"]) == 0
    assert main(["ingest", str(source), "-o", str(tmp_path / "log.nc"), "--compression", "zlib"]) == 0
    assert main(["ingest", str(source), "-o", str(tmp_path / "b.zarr"), "--compression", "zlib"]) == 2
    assert "--compression zlib is for NetCDF" in capsys.readouterr().err
    for name in ("log.nc", "log.zarr"):
        assert stored_kinds(tmp_path / name)["rate"] == "int16"
        with open_log(tmp_path / name) as log:
            np.testing.assert_array_equal(log.rate[0], np.arange(900) % 7 * 3600.0)


def test_a_worker_of_a_cluster_tells_the_client(tmp_path):
    distributed = pytest.importorskip("distributed")
    path = to_zarr(counts_log(samples=2 * CHUNK), tmp_path / "log.zarr")
    spoil(path, 1, 1, how="remove")
    settings = {"n_workers": 1, "threads_per_worker": 2, "processes": True, "dashboard_address": None, "memory_limit": 0}

    def compute(client):
        found = client.compute(log.rate.data).result()
        time.sleep(1.0)  # the message takes its own way
        return found

    with distributed.LocalCluster(**settings) as cluster, distributed.Client(cluster) as client, open_log(path) as log:
        with pytest.warns(UserWarning, match=r"axis y: the chunk from .* is missing: no file rate/1\.1"):
            found = compute(client)
        assert client.scheduler_info(n_workers=-1)["workers"]
    assert np.isnan(found[1, CHUNK:]).all()
    assert not np.isnan(found[1, :CHUNK]).any()


@pytest.mark.parametrize("form", ["nc", "zarr", "csv"])
def test_a_small_archive(tmp_path, form):
    """The generator of `benchmarks`: files that overlap, gaps in and between them, the same from the same seed, one log when read."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    import make_archive

    sys.path.pop(0)
    options = {"hours": 0.1, "rate": 50, "axes": 2, "file-hours": 0.025, "gaps": 0.05, "overlap": "5s", "seed": 3, "scale": 0.02}
    given = [f"--{name}={value}" for name, value in {**options, "format": form}.items()]
    files = make_archive.main([str(tmp_path / "a"), *given])
    make_archive.main([str(tmp_path / "b"), *given])
    assert len(files) == 4
    log, again = (gyrostab.regularise(gyrostab.read_log(sorted((tmp_path / name).iterdir()))) for name in "ab")
    assert same_bits(log.rate, again.rate)
    assert log.attrs["sampling_rate_hz"] == 50.0
    assert 0.95 * 18_000 < log.sizes["time"] <= 18_000
    present = log.rate.values[~np.isnan(log.rate.values)]
    assert 0.90 < present.size / log.rate.size < 0.97
    assert present.std() / 0.02 == pytest.approx(180, rel=0.05)
    np.testing.assert_array_equal(np.rint(present / 0.02) * 0.02, present)
    assert log.rate.encoding["scale_factor"] == 0.02
    assert 300 < log.temperature.size < 400
    assert (log.gap_samples.values > 0).sum() >= 4


def test_chunks_of_slow_and_fast_logs():
    assert chunk_samples(400.0) == 480_000
    assert chunk_samples(300.0) == 360_000
    assert chunk_samples(1.0) == 65_536
    assert chunk_samples(1e5) == 2**22
