"""Open NetCDF logs of gyrostab without xarray, which takes 1.1 to 1.4 times as long.

docs/scaling.md compares both. The difference counts where thousands of small files are opened.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.store.hdf5_heaps import check_global_heaps
from gyrostab.store.layout import has_known_filters
from gyrostab.store.private import library_lock
from gyrostab.store.times import GRID, follows_rule, parse_time_grids

__all__ = ["StoredLog", "open_netcdf_log"]

#: Attributes of a variable that xarray moves to its encoding.
_ENCODED = ("_FillValue", "scale_factor")
#: Attributes that change what values or coordinates mean; gyrostab writes none of them in a log.
_FOREIGN = {"_Unsigned", "add_offset", "coordinates", "dtype", "missing_value"}
_MAX_READ_VALUES = 2**17


@dataclass(frozen=True)
class StoredLog:
    """A log as it is on disk; the fields are those of a dataset, which takes longer to make."""

    variables: dict[Any, xr.Variable]
    data_vars: tuple[str, ...]
    coords: tuple[str, ...]
    sizes: dict[Any, int]
    attrs: dict[Any, Any]

    def close(self) -> None:
        """Do nothing, as the file is closed."""


def open_netcdf_log(path: Path) -> StoredLog | None:
    """Open a NetCDF log as it is on disk, with neither decoded times nor indexes.

    Returns
    -------
    StoredLog or None
        A variable with a value for each sample holds NaN in place of its values, and in its
        encoding the layout on disk. Stamps that follow their rule are reduced to it. None unless
        everything is as `gyrostab.io.to_netcdf` writes it for a log; xarray opens other files.

    Raises
    ------
    FormatError
        When the library would not return from a global heap.
    """
    import netCDF4

    try:
        with library_lock():
            values = _open_values(path)
            if values is None:
                return None
            check_global_heaps(path, skip=_find_data(values.values()))
            with netCDF4.Dataset(path) as stored:
                attrs = stored.__dict__
                variables = {
                    name: _open_variable(variable, values[name])
                    for name, variable in stored.variables.items()
                }
            for name, rule in parse_time_grids(variables, path).items():
                if variables[name].ndim:
                    start = _reduce_stamps(variables.pop(name), rule, values[name])
                    variables[f"{name}_start"] = start
    except FormatError:
        raise
    except Exception:  # the libraries raise errors of many kinds; xarray finds what is wrong
        return None
    sizes = {dim: size for item in variables.values() for dim, size in item.sizes.items()}
    return StoredLog(
        variables,
        tuple(name for name in variables if name not in sizes),
        tuple(name for name in variables if name in sizes),
        sizes,
        attrs,
    )


def _open_values(path: Path) -> dict[str, Any] | None:
    """Open the values of the variables in a file; None for anything but a log of gyrostab."""
    from h5py import h5a, h5d, h5f

    file = h5f.open(os.fsencode(path), h5f.ACC_RDONLY)
    attribute = h5a.open(file, b"gyrostab_content")
    content = np.zeros((), attribute.dtype)
    if content.dtype.kind != "S":
        return None  # text of variable length is in a heap that is not checked yet
    attribute.read(content)
    return {name.decode(): h5d.open(file, name) for name in file} if content == b"log" else None


def _find_data(values: Iterable[Any]) -> list[tuple[int, int]]:
    """Find first byte and size of the chunks of variables."""
    from h5py import h5d

    found: list[tuple[int, int]] = []
    for variable in values:
        if variable.get_create_plist().get_layout() == h5d.CHUNKED:
            variable.chunk_iter(lambda chunk: found.append((chunk.byte_offset, chunk.size)))
    return sorted(found)


def _open_variable(stored: Any, values: Any) -> xr.Variable:
    """Open a variable; `ValueError` when its values must be decoded, or are laid out otherwise."""
    attrs, dims = stored.__dict__, stored.dimensions
    encoding = {name: attrs.pop(name) for name in _ENCODED if name in attrs}
    dtype, is_packed = values.dtype, "scale_factor" in encoding
    if GRID in attrs and dims:
        data = np.broadcast_to(dtype.type(0), values.shape)
    elif dims and dims[-1].startswith("time") and (dtype.kind == "f" or is_packed):
        plist = values.get_create_plist()
        chunks = plist.get_chunk()
        missing = encoding["scale_factor"] * np.nan if is_packed else dtype.type(np.nan)
        if not has_known_filters(plist) or max(chunks[:-1], default=1) > 1:
            raise ValueError(stored.name)
        if is_packed and (missing.dtype != np.float64 or "_FillValue" not in encoding):
            raise ValueError(stored.name)
        encoding |= {"dtype": dtype, "chunksizes": chunks}
        data = np.broadcast_to(missing, values.shape)
    elif encoding or _FOREIGN & set(attrs) or math.prod(values.shape) > _MAX_READ_VALUES:
        raise ValueError(stored.name)
    else:
        data = _read_part(values, (0,) * len(dims), values.shape)
    if dtype == "S1":  # letters of labels
        attrs.pop("_Encoding", None)
        dims = dims[:-1]
        data = np.char.decode(data.view(f"S{data.shape[-1]}")[..., 0], "utf-8")
    elif dtype.kind not in "iuf":
        raise ValueError(stored.name)
    return xr.Variable(dims, data, attrs, encoding)


def _read_part(values: Any, start: tuple[int, ...], shape: tuple[int, ...]) -> NDArray[Any]:
    """Read a part of a variable; indexing in h5py takes three times as long for a few numbers."""
    from h5py import h5s

    part = np.empty(shape, values.dtype)
    if part.size:
        place = values.get_space()
        if shape:
            place.select_hyperslab(start, shape)
        values.read(h5s.create_simple(shape) if shape else h5s.create(h5s.SCALAR), place, part)
    return part


def _reduce_stamps(stamps: xr.Variable, rule: dict[str, Any], values: Any) -> xr.Variable:
    """Reduce stamps to the rule of a time axis; `ValueError` when they do not follow it."""
    ends = np.concatenate([_read_part(values, (at,), (1,)) for at in (0, stamps.size - 1)])
    if stamps.shape != (rule["size"],) or not follows_rule(ends, stamps.attrs, rule):
        raise ValueError("another program has changed the stamps")
    return xr.Variable((), 0, stamps.attrs)
