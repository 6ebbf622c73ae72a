"""Stores that are read in part or damaged: lost chunks become gaps, with a warning."""

from __future__ import annotations

import pickle
import warnings

import dask
import h5py
import numpy as np
import pytest
import xarray as xr
from numcodecs import Blosc

import gyrostab
import gyrostab.store.layout as layout_module
import gyrostab.store.read as read_module
from gyrostab.errors import DamageError, FormatError
from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.io.opening import open_log, open_product
from gyrostab.store.layout import ChunkCache
from gyrostab.store.lazy import read_into
from gyrostab.time.grid import time_coordinate
from tests.support import synthetic
from tests.support.stored import CHUNK, START, WRITERS, counts_log, same_bits, spoil


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
            assert float(
                np.nansum(data[:, :1000].compute(scheduler=scheduler, num_workers=2))
            ) == float(np.nansum(data[:, :1000]))


@pytest.mark.parametrize(
    ("form", "how"), [("nc", "flip"), ("zarr", "flip"), ("zarr", "cut"), ("zarr", "remove")]
)
def test_a_damaged_chunk_becomes_a_gap_with_one_warning(tmp_path, form, how):
    path = WRITERS[form](counts_log(), tmp_path / f"log.{form}")
    spoil(path, 1, 1, how=how)
    expected = counts_log().rate.copy()
    expected[1, CHUNK : 2 * CHUNK] = np.nan
    with open_log(path) as log, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with dask.config.set(scheduler="threads", num_workers=2):
            assert same_bits(log.rate, expected)
            assert np.isnan(log.rate[1, CHUNK + 3 :: 1000]).sum() == 120
    (message,) = [
        str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)
    ]
    assert str(path) in message
    assert (
        "axis y: the chunk from 2026-09-21T14:33:20.123456789 to 2026-09-21T14:53:20.113456789 is "
        in message
    )
    assert ("is missing: no file rate/1.1" if how == "remove" else "is damaged") in message
    with (
        open_log(path, strict=True) as log,
        pytest.raises(FormatError, match=r"axis y: the chunk from .*; copy it again, or leave out"),
    ):
        log.rate.compute()
    with open_log(path, strict=True) as log:
        assert same_bits(log.rate[0], expected[0])  # strict or not, what is sound is read


@pytest.mark.parametrize(
    "content", [b"", bytes(20), Blosc("lz4").encode(b"abc"), Blosc("lz4").encode(bytes(7))]
)
def test_a_chunk_of_a_few_bytes_is_damaged(tmp_path, content):
    """Not long enough for a header of blosc, for a checksum, or for a sample."""
    path = to_zarr(counts_log(), tmp_path / "log.zarr")
    (path / "rate" / "1.1").write_bytes(content)
    with (
        open_log(path) as log,
        pytest.warns(UserWarning, match=r"axis y: the chunk from .* is damaged: rate/1\.1: "),
    ):
        assert np.isnan(log.rate.values[1]).sum() == CHUNK


@pytest.mark.parametrize("form", WRITERS)
def test_the_chunk_cache_keeps_to_its_memory_limit(tmp_path, monkeypatch, form):
    """Parts of the same chunks in turn: one read while they fit the cache, another after that."""
    cache, chunk = ChunkCache(4 * CHUNK * 2, 4 * CHUNK), 4 * CHUNK
    decoded = []
    monkeypatch.setattr(read_module, "_CACHE", cache)
    monkeypatch.setattr(
        read_module,
        "read_chunk",
        lambda *where, **how: decoded.append(where) or layout_module.read_chunk(*where, **how),
    )
    with open_log(WRITERS[form](counts_log(), tmp_path / f"log.{form}")) as log:
        for place in (0, 1, 0, 1, 2, 0):
            read_into(log.rate.data, 1, place * CHUNK + 10, part := np.empty(10))
            np.testing.assert_array_equal(
                part, counts_log().rate[1, place * CHUNK + 10 : place * CHUNK + 20]
            )
            assert sum(item.nbytes for item in cache._chunks.values()) == cache._bytes <= 2 * chunk
    assert [where[2] for where in decoded] == [(1, 0), (1, 1), (1, 2), (1, 0)]


@pytest.mark.parametrize("form", WRITERS)
def test_a_gap_in_the_chunk_of_a_channel_names_it(tmp_path, form):
    stamps = time_coordinate(START, 1.0, 70_000, name="time_temperature")
    slow = xr.Dataset(
        {"temperature": ("time_temperature", np.arange(70_000.0), {"units": "degree_Celsius"})}
    )
    log = (
        counts_log(samples=100)
        .assign(slow)
        .assign_coords(time_temperature=stamps["time_temperature"].values)
    )
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
        pytest.warns(
            UserWarning,
            match=r"channel temperature: the chunk from 2026-09-22T08:25:36\.1\d* to 2026-09-22T",
        ),
    ):
        values = back.temperature.values
    assert np.isnan(values).sum() == 70_000 - 65_536
    np.testing.assert_array_equal(values[:65_536], np.arange(65_536))


def test_every_chunk_of_a_zarr_store_is_written_even_if_it_is_all_gap(tmp_path):
    log = counts_log()
    log.rate.values[0] = np.nan
    path = to_zarr(log, tmp_path / "log.zarr")
    assert {item.name for item in (path / "rate").iterdir()} == {
        ".zarray",
        ".zattrs",
        *(f"{r}.{n}" for r in (0, 1) for n in (0, 1, 2)),
    }
    path = to_zarr(log.chunk(time=1000), tmp_path / "lazy.zarr")
    assert len(list((path / "rate").iterdir())) == 8
    with warnings.catch_warnings(), open_log(path) as back:
        warnings.simplefilter("error")
        assert np.isnan(back.rate[0]).all()


@pytest.mark.parametrize(
    ("form", "message"), [("nc", "cannot be opened again"), ("zarr", "no longer exists")]
)
def test_a_vanished_store_is_an_error(tmp_path, form, message):
    path = WRITERS[form](counts_log(), tmp_path / f"log.{form}")
    with open_log(path) as log:
        path.rename(tmp_path / "away")
        with pytest.raises(FormatError, match=f"{message}.*has it been moved"):
            log.rate.compute()
    with open_log((tmp_path / "away").rename(path)) as log:
        log.rate[:, :5].compute()
        path.rename(tmp_path / "away")
        with pytest.raises(FormatError, match=f"{message}.*has it been moved"):
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


def test_what_stands_behind_a_chunk_that_is_cut_short_is_not_read():
    """Blosc trusts its header; here it would find the rest of the bytes just behind the end."""
    packed = Blosc("lz4").encode(np.random.default_rng(1).integers(0, 9, 10_000))
    codecs = layout_module.find_zarr_codecs(
        {"compressor": Blosc("lz4").get_config(), "filters": None}
    )
    assert layout_module.decode_chunk(packed, codecs, np.dtype("i8"), 10_000).size == 10_000
    with pytest.raises(layout_module.ChunkDamage, match="it is cut short"):
        layout_module.decode_chunk(memoryview(packed)[:-1], codecs, np.dtype("i8"), 10_000)


def test_a_library_that_fails_in_a_late_read_names_the_file(tmp_path, monkeypatch):
    """Long variables are read when used, and errors of the library name the file even then."""
    monkeypatch.setattr(read_module, "MIN_LAZY_VALUES", 0)
    product = synthetic.product(windows=400)
    path = to_netcdf(product, tmp_path / "product.nc")
    with h5py.File(path) as stored:
        chunk = stored["avar"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 0x10
    path.write_bytes(bytes(data))
    with open_product(path) as opened:
        with pytest.raises(DamageError, match=r"product\.nc: is damaged") as raised:
            opened["avar"].mean().compute()
        assert isinstance(raised.value.__cause__, RuntimeError)
        with pytest.raises(DamageError, match=r"product\.nc: is damaged"):
            to_netcdf(opened, tmp_path / "copy.nc")
    assert not (tmp_path / "copy.nc").exists()
