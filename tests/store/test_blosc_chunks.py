"""Blosc chunks that are cut short, beyond whose end the library reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numcodecs
import numpy as np
import pytest
import xarray as xr
import zarr

from gyrostab import davar, make_log, open_product, read_log, scan, to_zarr
from gyrostab.allan.fit import fit_noise
from gyrostab.errors import FormatError
from gyrostab.store.damage import check_blosc_chunks, is_blosc_cut
from gyrostab.store.output import find_foreign_item


def write_foreign(path: Path, zarr_format: int) -> None:
    """Write stamps and two axes, compressed with Blosc."""
    group = zarr.open_group(path, mode="w", zarr_format=zarr_format)
    draw = np.random.default_rng(3)
    blosc = zarr.codecs.BloscCodec() if zarr_format == 3 else numcodecs.Blosc("lz4", shuffle=1)
    for name, unit in (("time", "s"), ("gyro_x", "deg/h"), ("gyro_y", "deg/h")):
        values = np.arange(500) * 0.1 if name == "time" else draw.standard_normal(500)
        named = {"dimension_names": ["obs"]} if zarr_format == 3 else {}
        array = group.create_array(
            name, shape=values.shape, chunks=(200,), dtype="f8", compressors=blosc, **named
        )
        array[:] = values
        array.attrs.update({"units": unit, "_ARRAY_DIMENSIONS": ["obs"]})


def chunk_files(path: Path, name: str) -> list[Path]:
    """The files of the chunks of an array."""
    files = [file for file in (path / name).rglob("*") if file.is_file()]
    return sorted(
        file for file in files if not file.name.startswith(".z") and file.suffix != ".json"
    )


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("left", [0, 3, 15, 16, 23, -1])
@pytest.mark.parametrize("call", [scan, read_log])
def test_cut_chunk_of_a_foreign_store_is_refused(
    zarr_format: int, left: int, call: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "log.zarr"
    write_foreign(path, zarr_format)
    call(path)
    chunk = chunk_files(path, "gyro_x")[1]
    chunk.write_bytes(chunk.read_bytes()[:left])
    with pytest.raises(FormatError, match=r"log\.zarr: is damaged: the chunk gyro_x.* cut short"):
        call(path)


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_consolidated_metadata_count_where_those_of_the_array_are_damaged(
    zarr_format: int, tmp_path: Path
) -> None:
    path = tmp_path / "log.zarr"
    write_foreign(path, zarr_format)
    zarr.consolidate_metadata(path)
    (path / "gyro_x" / (".zarray" if zarr_format == 2 else "zarr.json")).write_text("{")
    chunk = chunk_files(path, "gyro_x")[1]
    chunk.write_bytes(chunk.read_bytes()[:20])
    with pytest.raises(FormatError, match=r"the chunk gyro_x.* cut short"):
        check_blosc_chunks(path)


def test_chunk_with_a_length_beyond_its_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.zarr"
    write_foreign(path, 2)
    chunk = chunk_files(path, "time")[0]
    data = bytearray(chunk.read_bytes())
    data[12:16] = (0x290B1108).to_bytes(4, "little")
    chunk.write_bytes(data)
    with pytest.raises(FormatError, match=r"the chunk time/0 is cut short"):
        read_log(path)


def test_cut_chunk_of_a_product_is_refused(tmp_path: Path) -> None:
    log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    path = to_zarr(fit_noise(davar(log, window="20s")), tmp_path / "product.zarr")
    open_product(path)
    chunk = chunk_files(path, "avar")[0]
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(FormatError, match=r"product\.zarr: is damaged: the chunk avar"):
        open_product(path)


def test_files_that_the_library_is_writing_are_no_damage(tmp_path: Path) -> None:
    log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    path = to_zarr(fit_noise(davar(log, window="20s")), tmp_path / "product.zarr")
    for name in ("0.0", ".zarray"):
        (path / "avar" / f"{name}.{'0123456789abcdef' * 2}.partial").write_bytes(b"")
    open_product(path)
    assert find_foreign_item(path) is None
    (path / "avar" / "0.0.partial").touch()
    assert find_foreign_item(path) == "avar/0.0.partial"


def test_stores_without_blosc_pass(tmp_path: Path) -> None:
    xr.Dataset({"a": ("x", np.arange(9))}).to_zarr(
        tmp_path / "plain.zarr", zarr_format=2, encoding={"a": {"compressors": None}}
    )
    (tmp_path / "plain.zarr" / "b").mkdir()
    (tmp_path / "plain.zarr" / "b" / ".zarray").write_text('{"compressor": 3')
    check_blosc_chunks(tmp_path / "plain.zarr")


@pytest.mark.parametrize(("length", "cut"), [(16, False), (17, True), (0, False)])
def test_length_in_the_header(length: int, cut: bool) -> None:
    assert is_blosc_cut(bytes(12) + length.to_bytes(4, "little"), 16) is cut
    assert is_blosc_cut(b"short", 5)
