"""Fast reading of a log without its long variables: attributes, dimensions, small variables.

xarray takes two to three times as long, which matters for archives of hundreds of logs. Only files
that gyrostab wrote are understood. For any other file, and for a damaged one, the result is None,
and the caller uses xarray.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.store.layout import decode_chunk, find_zarr_codecs
from gyrostab.store.netcdf_lock import library_lock

__all__ = ["MIN_LAZY_VALUES", "Header", "read_header"]

#: Values from which a variable of a log is a dask array.
MIN_LAZY_VALUES = 2**17


class Header(NamedTuple):
    """A log as it is on disk.

    Attributes
    ----------
    variables : dict
        Variables, not decoded; those of `long` without their values.
    attrs : dict
        Attributes of the file.
    long : set of str
        Variables along time, with shape, type and encoding only.
    """

    variables: dict[str, xr.Variable]
    attrs: dict[str, Any]
    long: set[str]


def read_header(path: Path) -> Header | None:
    """Read the header of a log that gyrostab wrote; None for anything else or unexpected."""
    try:
        header = _read_zarr_header(path) if path.is_dir() else _read_netcdf_header(path)
    except Exception:  # whatever the libraries raise on damaged bytes
        return None
    if (
        header is None
        or header.attrs.get("gyrostab_content") != "log"
        or "gyrostab_version" not in header.attrs
    ):
        return None
    return header if "axis" in header.variables else None


def _is_long(
    dims: tuple[str, ...],
    attrs: dict[str, Any],
    dtype: np.dtype[Any],
    chunks: Any,
    shape: tuple[int, ...],
) -> bool:
    """Whether `gyrostab.store.read` reads the variable chunk by chunk."""
    doubles = dtype.kind == "f" or (dtype.kind in "iu" and "scale_factor" in attrs)
    return bool(dims and dims[-1].startswith("time") and doubles and chunks and 0 not in shape)


def _make_placeholder(dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Make an array of zeros that takes no memory, in place of values that are read later."""
    return np.broadcast_to(np.zeros((), dtype), shape)


def _read_zarr_header(folder: Path) -> Header:
    described = json.loads((folder / ".zmetadata").read_bytes())["metadata"]
    variables: dict[str, xr.Variable] = {}
    long: set[str] = set()
    for key, layout in described.items():
        name, _, kind = key.rpartition("/")
        if kind != ".zarray" or not name:
            continue
        attrs = dict(described.get(f"{name}/.zattrs", {}))
        dims, shape, chunks = (
            tuple(found)
            for found in (attrs.pop("_ARRAY_DIMENSIONS"), layout["shape"], layout["chunks"])
        )
        dtype = np.dtype(layout["dtype"])
        if layout["order"] != "C":
            raise ValueError("order")
        if layout["fill_value"] is not None:
            attrs["_FillValue"] = dtype.type(layout["fill_value"])
        encoding = {
            "chunks": chunks,
            "preferred_chunks": dict(zip(dims, chunks, strict=True)),
            "dtype": dtype,
        }
        if _is_long(dims, attrs, dtype, chunks, shape):
            long.add(name)
            values = _make_placeholder(dtype, shape)
        else:
            values = _read_values(folder / name, layout, shape, chunks, dtype)
        variables[name] = xr.Variable(dims, values, attrs, encoding)
    return Header(variables, dict(described.get(".zattrs", {})), long)


def _read_netcdf_header(path: Path) -> Header:
    import netCDF4

    variables: dict[str, xr.Variable] = {}
    long: set[str] = set()
    with library_lock(), netCDF4.Dataset(path) as file:
        if file.groups or file.getncattr("gyrostab_content") != "log":
            raise ValueError("content")
        file.set_auto_maskandscale(False)
        file.set_auto_chartostring(False)
        for name, stored in file.variables.items():
            dims, shape, dtype, chunking = (
                stored.dimensions,
                stored.shape,
                stored.dtype,
                stored.chunking(),
            )
            if not isinstance(dtype, np.dtype):
                raise ValueError("type")
            attrs = {key: stored.getncattr(key) for key in stored.ncattrs()}
            chunks = None if isinstance(chunking, str) else tuple(chunking)
            encoding: dict[str, Any] = {"dtype": dtype}
            if _is_long(dims, attrs, dtype, chunks, shape):
                long.add(name)
                values = _make_placeholder(dtype, shape)
                encoding.update(stored.filters(), chunksizes=chunks)
            elif stored.size < MIN_LAZY_VALUES or dims == (name,):
                values = np.asarray(stored[...])
            else:
                raise ValueError("size")
            variables[name] = xr.Variable(dims, values, attrs, encoding)
        return Header(variables, {key: file.getncattr(key) for key in file.ncattrs()}, long)


def _read_values(
    folder: Path,
    layout: dict[str, Any],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dtype: np.dtype[Any],
) -> NDArray[Any]:
    if len(shape) > 1:
        raise ValueError("dimensions")
    codecs = find_zarr_codecs(layout)
    if not shape:
        return decode_chunk((folder / "0").read_bytes(), codecs, dtype)[:1].reshape(())
    pieces = [
        decode_chunk((folder / str(n)).read_bytes(), codecs, dtype)
        for n in range(-(-shape[0] // chunks[0]) if shape[0] else 0)
    ]
    return _join_chunks(pieces, shape[0], chunks[0], dtype)


def _join_chunks(
    pieces: list[NDArray[Any]], size: int, length: int, dtype: np.dtype[Any]
) -> NDArray[Any]:
    """Concatenate chunks of `length` values to `size` values."""
    if any(piece.size != length for piece in pieces):
        raise ValueError("size")
    return np.concatenate([np.empty(0, dtype), *pieces])[:size]
