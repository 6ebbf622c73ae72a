"""Parallel compression of large variables of a NetCDF file.

The NetCDF library compresses one chunk after the other; here several threads do so.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.store.lazy import read_box
from gyrostab.store.private import library_lock
from gyrostab.store.threads import map_in_order
from gyrostab.store.write import Progress, create_variables

__all__ = ["append_compressed", "large_variables"]

#: Values from which the chunks of a variable are compressed in parallel.
_MIN_PARALLEL_VALUES = 2**15


def large_variables(
    stored: xr.Dataset, encoding: Mapping[Any, Mapping[str, Any]]
) -> dict[str, xr.Variable]:
    """Find the numeric variables that are large enough for `append_compressed`."""
    data = {
        str(name): array.variable
        for name, array in stored.data_vars.items()
        if array.size >= _MIN_PARALLEL_VALUES and array.dtype.kind in "if"
    }
    return {
        name: variable
        for name, variable in data.items()
        if encoding[name].get("zlib") and "_FillValue" not in variable.attrs
    }


def append_compressed(
    path: Path,
    large: Mapping[str, xr.Variable],
    encoding: Mapping[Any, Mapping[str, Any]],
    *,
    progress: Progress | None = None,
) -> None:
    """Add variables to a NetCDF file, compressed in several threads.

    The result is what the library would write: bytes shuffled, then deflated. Variables of dask are
    computed chunk by chunk. `encoding` is as for xarray.
    """
    import h5py
    import netCDF4

    if not large:
        return
    lock = library_lock()
    with lock, netCDF4.Dataset(path, "a") as file:
        create_variables(file, large, encoding)
    total, done = sum(variable.size for variable in large.values()), 0
    pieces = _list_chunks(large, encoding)
    with lock:
        target = h5py.File(path, "r+")
        chunked = {name: target[name].id for name in large}
    try:
        for name, begin, size, packed in map_in_order(
            partial(_compress_chunk, large, encoding), pieces
        ):
            with lock:
                chunked[name].write_direct_chunk(begin, packed)
            done += size
            if progress is not None:
                progress(done / total)
    finally:
        with lock:
            target.close()


_ChunkOrigin = tuple[str, tuple[int, ...]]


def _list_chunks(
    large: Mapping[str, xr.Variable], encoding: Mapping[Any, Mapping[str, Any]]
) -> Iterator[_ChunkOrigin]:
    """List the name and the first index of every chunk."""
    for name, variable in large.items():
        steps = encoding[name]["chunksizes"]
        yield from (
            (name, begin)
            for begin in product(
                *(range(0, size, step) for size, step in zip(variable.shape, steps, strict=True))
            )
        )


def _compress_chunk(
    large: Mapping[str, xr.Variable], encoding: Mapping[Any, Mapping[str, Any]], piece: _ChunkOrigin
) -> tuple[str, tuple[int, ...], int, bytes]:
    """Compress a chunk; return its name, first index, number of values and bytes."""
    name, begin = piece
    options = encoding[name]
    place = tuple(
        slice(first, first + step) for first, step in zip(begin, options["chunksizes"], strict=True)
    )
    values = read_box(large[name].data, place)
    fill = options["_FillValue"]
    chunk = np.full(options["chunksizes"], 0 if fill is None else fill, values.dtype)
    inside = chunk[tuple(map(slice, values.shape))]
    inside[...] = values
    if fill is not None:
        inside[np.isnan(values)] = fill
    raw = chunk.reshape(-1).view(np.uint8).reshape(-1, chunk.itemsize)
    return name, begin, values.size, zlib.compress(raw.T.tobytes(), options["complevel"])
