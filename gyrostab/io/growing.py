"""A product as a Zarr store that grows along time, window by window.

A reader can open the store at any moment: it reads the consolidated metadata, which is replaced
last, and sees no window beyond the number that they declare. A window of the last chunks may be of
the update before or after.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import SchemaError
from gyrostab.io.datasets import begin_zarr, plan_chunks, plan_zarr
from gyrostab.store.cf import to_disk
from gyrostab.store.output import find_foreign_item, new_output

#: Smallest number of windows in one chunk.
_MIN_CHUNK_WINDOWS = 1024


class LayoutError(SchemaError):
    """A part does not fit into the store: it has other variables, averaging times or axes."""


def write_windows(
    path: Path, parts: Iterable[tuple[slice, xr.Dataset]], *, size: int, unit: int, new: bool
) -> None:
    """Write parts of a product, in memory, to a Zarr store, which then has `size` windows.

    Chunks consist of whole parts of `unit` windows. With `new`, the parts are all of the product,
    in order, and the new store replaces an existing one once it is complete.

    Raises
    ------
    LayoutError
        When a part does not fit into the existing store, of which some windows may have been
        written.
    """
    chunk = unit * -(-_MIN_CHUNK_WINDOWS // unit)
    if not new:
        _write_parts(path, parts, size=size, chunk=chunk)
        return
    with new_output(path, overwrite=True, find_foreign=find_foreign_item) as temporary:
        _write_parts(temporary, parts, size=size, chunk=chunk)


def _write_parts(
    folder: Path, parts: Iterable[tuple[slice, xr.Dataset]], *, size: int, chunk: int
) -> None:
    import zarr

    group: Any = None
    for windows, part in parts:
        stored = to_disk(part, "watch", nanoseconds=True)
        if group is None:
            if not (folder / ".zgroup").exists():
                _make_store(folder, stored, chunk)
            group = zarr.open_group(folder, mode="r+", zarr_format=2, use_consolidated=False)
        _write_part(group, stored, windows, size)
    if group is not None:
        zarr.consolidate_metadata(folder, zarr_format=2)


def _make_store(folder: Path, stored: xr.Dataset, chunk: int) -> None:
    """Make a store with the layout of a part."""
    encoding = plan_zarr(stored)
    for name, variable in stored.variables.items():
        if "time" in variable.dims:
            encoding[name]["chunks"] = plan_chunks(variable.sizes, "time", chunk)
    begin_zarr(stored, folder, encoding)


def _write_part(group: Any, stored: xr.Dataset, windows: slice, size: int) -> None:
    """Write some windows, everything without time, and the attributes."""
    arrays = dict(group.arrays())
    if arrays.keys() != set(map(str, stored.variables)):
        raise LayoutError("the product has other variables than before")
    for name, variable in stored.variables.items():
        array = arrays[str(name)]
        values = np.asarray(variable.values)
        shape = tuple(size if dim == "time" else n for dim, n in variable.sizes.items())
        fixed = [place for place, dim in enumerate(variable.dims) if dim != "time"]
        if len(array.shape) != values.ndim or any(array.shape[i] != shape[i] for i in fixed):
            raise LayoutError(f"{name} has another shape than before")
        if array.dtype != values.dtype or (array.attrs.get("units") != variable.attrs.get("units")):
            raise LayoutError(f"{name} has another type or unit than before")
        if name in ("axis", "tau", "term") and not np.array_equal(array[...], values):
            raise LayoutError(f"{name} differs from before")
        if array.shape != shape:
            array.resize(shape)
        array[tuple(windows if dim == "time" else slice(None) for dim in variable.dims)] = values
    inner = {"time_coverage_start": windows.start > 0, "time_coverage_end": windows.stop < size}
    attrs = {key: value for key, value in stored.attrs.items() if not inner.get(key)}
    group.attrs.update(attrs)
