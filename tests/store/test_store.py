"""The working store: counts bit for bit, chunks of 20 minutes, no stamp per sample."""

from __future__ import annotations

import json

import hypothesis.extra.numpy as hnp
import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gyrostab.errors import OptionError, SchemaError, TimeError
from gyrostab.ingest.make_log import make_log
from gyrostab.io import datasets
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_log
from gyrostab.kernels.encoding.counts import from_counts, to_counts
from gyrostab.time.grid import TimeGridIndex
from tests.support import synthetic
from tests.support.stored import (
    CHUNK,
    FACTOR,
    RATE,
    START,
    WRITERS,
    counts_log,
    same_bits,
    stored_kinds,
)


@given(
    whole=hnp.arrays(
        np.float64,
        st.integers(1, 50),
        elements=st.integers(-(2**31) + 2, 2**31 - 1).map(float) | st.just(np.nan),
    ),
    factor=st.floats(1e-12, 1e12)
    | st.floats(-1e3, -1e-3)
    | st.sampled_from([1.0, 0.1, 1 / 3, 3600.0, 0.02]),
)
def test_counts_come_back_bit_for_bit(whole, factor):
    values = whole * factor
    counts = to_counts(values, factor, "i4", -2147483647)
    assert counts is not None
    assert counts.dtype == np.int32
    back = from_counts(counts, factor, -2147483647)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    known = ~np.isnan(values)
    np.testing.assert_array_equal(
        (back[known] + 0.0).view(np.int64), (values[known] + 0.0).view(np.int64)
    )


@given(
    values=hnp.arrays(np.float64, st.integers(1, 6), elements=st.floats(width=64)),
    factor=st.sampled_from([1.0, 0.1, 1 / 3]),
)
def test_counts_are_made_only_of_what_they_give_back(values, factor):
    counts = to_counts(values, factor, "i2", -32767)
    known = ~np.isnan(values)
    if counts is None:
        n = np.rint(values[known] / factor)
        fits = (np.abs(n) < 32767) & ((n * factor) == values[known])
        assert not fits.all()
    else:
        np.testing.assert_array_equal(from_counts(counts, factor, -32767)[known], values[known])


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    whole=hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 3), st.integers(2, 40)),
        elements=st.integers(-40000, 40000).map(float),
    ),
    holes=st.lists(st.integers(0, 39), max_size=8),
    factor=st.sampled_from([1.0, 0.1, 1 / 3, 3600.0, 7.2e-5]),
    form=st.sampled_from(["nc", "zarr"]),
)
def test_a_log_of_counts_comes_back_bit_for_bit(tmp_path, whole, holes, factor, form):
    values = whole * factor
    values[:, [hole for hole in holes if hole < values.shape[1]]] = np.nan
    log = counts_log(
        samples=values.shape[1], axes="xyz"[: len(values)], factor=factor, dtype="i2"
    ).drop_vars("vibration")
    log["rate"] = (log.rate.dims, values, log.rate.attrs, log.rate.encoding)
    path = WRITERS[form](log, tmp_path / f"log.{form}", overwrite=True)
    with open_log(path) as back:
        assert same_bits(back.rate, log.rate)
        assert stored_kinds(path)["rate"] == (
            "int16"
            if np.nanmax(np.abs(np.nan_to_num(whole))) < 32767
            else stored_kinds(path)["rate"]
        )
        assert stored_kinds(path)["rate"].startswith("int")


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("lazy", [False, True])
def test_layout_and_round_trip(tmp_path, form, lazy):
    log = counts_log()
    path = WRITERS[form](
        log.chunk(time=100_001) if lazy else log, tmp_path / f"log.{form}", stamps=False
    )
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
        copy = WRITERS[form](back, tmp_path / f"again.{form}", stamps=False)
        assert stored_kinds(copy) == kinds


@pytest.mark.skipif(not datasets.has_zstd(), reason="the NetCDF library has no zstd")
def test_compression_and_checksums(tmp_path):
    with netCDF4.Dataset(to_netcdf(counts_log(), tmp_path / "log.nc", compression="zstd")) as file:
        filters = file["rate"].filters()
        assert filters["fletcher32"]
        assert filters["zstd"]
        expected = counts_log().rate.values
        np.testing.assert_allclose(file["rate"][:].filled(np.nan), expected, rtol=1e-12)
    with netCDF4.Dataset(to_netcdf(counts_log(), tmp_path / "plain.nc")) as file:
        assert file["rate"].filters()["zlib"]
        assert not file["rate"].filters()["zstd"]
    layout = json.loads(
        (to_zarr(counts_log(), tmp_path / "log.zarr") / "rate" / ".zarray").read_text()
    )
    assert layout["zarr_format"] == 2
    assert layout["compressor"]["id"] == "blosc"
    assert layout["compressor"]["cname"] == "lz4"
    assert layout["compressor"]["shuffle"] == 1
    assert [item["id"] for item in layout["filters"]] == ["fletcher32"]
    with pytest.raises(OptionError, match="compression='lzma': give 'zstd' or 'zlib'"):
        to_netcdf(counts_log(samples=10), tmp_path / "no.nc", compression="lzma")


def test_a_library_without_zstd_warns_and_compresses_with_zlib(tmp_path, monkeypatch):
    monkeypatch.setattr(datasets, "has_zstd", lambda: False)
    with pytest.warns(UserWarning, match="has no zstd here: the log is compressed with zlib"):
        path = to_netcdf(counts_log(samples=100), tmp_path / "log.nc", compression="zstd")
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
    with pytest.warns(
        UserWarning,
        match=r"rate: not every value is a whole multiple of 0\.0333333; stored as doubles",
    ):
        path = WRITERS[form](log.chunk(time=70_000) if lazy else log, tmp_path / f"log.{form}")
    assert stored_kinds(path)["rate"] == "float64"
    assert stored_kinds(path)["vibration"] == "int16"
    with open_log(path) as back:
        assert same_bits(back.rate, log.rate)
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted(
        [f"wide.{form}", f"log.{form}"]
    )


def test_a_value_that_stands_for_missing_is_not_lost(tmp_path):
    log = counts_log(samples=4, axes="x", factor=1.0, dtype="i4").drop_vars("vibration")
    log["rate"] = (
        log.rate.dims,
        np.array([[-2147483647.0, 1.0, np.nan, 2.0]]),
        log.rate.attrs,
        log.rate.encoding,
    )
    with pytest.warns(UserWarning, match="stored as doubles"):
        path = to_netcdf(log, tmp_path / "log.nc")
    assert same_bits(open_log(path).rate, log.rate)


def test_samples_that_were_dropped_are_missing(tmp_path):
    log = synthetic.log(samples=100)
    picked = log.isel(time=[0, 1, 5, 50])
    with open_log(to_netcdf(picked, tmp_path / "log.nc", stamps=False)) as back:
        np.testing.assert_array_equal(back.time.values, log.time.values[:51])
        np.testing.assert_array_equal(
            back.rate.sel(time=picked.time.values).values, picked.rate.values
        )
        assert int(back.rate.notnull().sum()) == int(picked.rate.notnull().sum())
    assert "time" not in stored_kinds(tmp_path / "log.nc")


def test_a_log_that_runs_backwards_is_refused(tmp_path):
    with pytest.raises(TimeError, match=r"runs backwards.*log\.sortby\('time'\)"):
        to_netcdf(synthetic.log(samples=1000).isel(time=slice(900, 10, -3)), tmp_path / "log.nc")
    assert not list(tmp_path.iterdir())


def test_plain_stamps_that_are_a_grid_are_not_stored(tmp_path):
    log = (
        counts_log(samples=1000)
        .drop_vars("time")
        .assign_coords(time=pd.date_range("2026-11-20", periods=1000, freq="10ms"))
    )
    with open_log(to_netcdf(log, tmp_path / "log.nc", stamps=False)) as back:
        np.testing.assert_array_equal(back.time.values, log.time.values)
    assert "time" not in stored_kinds(tmp_path / "log.nc")


def test_a_name_that_the_time_axis_needs(tmp_path):
    log = counts_log(samples=10).assign(time_start=3)
    with pytest.raises(SchemaError, match="'time_start' is needed for the time axis; rename"):
        to_netcdf(log, tmp_path / "log.nc")


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize(
    "packing",
    [
        {"dtype": "int16", "add_offset": 100.0, "_FillValue": -32767},
        {"dtype": "int16", "missing_value": -9},
        {"dtype": "uint8", "add_offset": -20.0, "_FillValue": 255},
        {"dtype": "int8", "_Unsigned": "true", "_FillValue": -1},
    ],
)
def test_counts_that_another_program_packed_are_read_as_xarray_reads_them(tmp_path, form, packing):
    values = np.arange(50.0)[None, :] * 0.5
    values[0, 7] = np.nan
    log = make_log(values, rate=10.0, unit="deg/h")
    path = WRITERS[form](log, tmp_path / f"own.{form}")
    with xr.open_dataset(path) as plain:
        plain = plain.load().drop_encoding()
    cut = {"chunks": (1, 50)} if form == "zarr" else {"chunksizes": (1, 50)}
    packing = {"scale_factor": 0.5, "_FillValue": None, **packing, **cut}
    copy, encoding = tmp_path / f"copy.{form}", {"rate": packing}
    if form == "zarr":
        plain.to_zarr(copy, encoding=encoding, zarr_format=2)
    else:
        plain.to_netcdf(copy, encoding=encoding)
    with open_log(copy) as back:
        np.testing.assert_array_equal(back.rate.values, values)
