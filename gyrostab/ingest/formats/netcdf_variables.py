"""Variables of foreign NetCDF files and Zarr stores: dimensions, attributes, location of data."""

from __future__ import annotations

import base64
import math
import struct
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.formats.netcdf_classic import read_classic_header
from gyrostab.ingest.limits import check_chunk
from gyrostab.store.private import library_lock
from gyrostab.store.rows import ChunkedRows, EvenRows, LibraryRows, Rows, hdf5_rows

#: Dimension of the rows, index along the other -> column.
Locate = Callable[[int, int], Rows]


@dataclass(frozen=True)
class StoredVariable:
    """A variable as it is stored."""

    name: str
    dimensions: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    #: As in the file, with the default fill value of the format if the variable has none.
    attributes: Mapping[str, Any]
    #: Returns the stored numbers when indexed, while the file is open.
    values: Any = field(repr=False)
    locate: Locate = field(repr=False)  # dimension of the rows, index along the other -> column


@contextmanager
def open_variables(path: Path, limits: Mapping[str, float]) -> Iterator[dict[str, StoredVariable]]:
    """Open a file or store, and describe its variables; `FormatError` if a chunk is too large."""
    if path.is_dir():
        yield {variable.name: variable for variable in _zarr_variables(path, limits)}
        return
    import netCDF4

    with netCDF4.Dataset(path) as file:
        located = _find_rows(path, list(file.variables.values()))
        yield {
            name: _netcdf_variable(path, variable, located.get(name), limits)
            for name, variable in file.variables.items()
        }


def _netcdf_variable(
    path: Path, variable: Any, located: Locate | None, limits: Mapping[str, float]
) -> StoredVariable:
    variable.set_auto_maskandscale(False)
    dtype = variable.dtype if isinstance(variable.dtype, np.dtype) else np.dtype(object)
    attributes = with_default_fill(
        {name: variable.getncattr(name) for name in variable.ncattrs()}, dtype
    )
    cut = variable.chunking()
    if isinstance(cut, list | tuple):
        check_chunk(path, variable.name, dtype.itemsize * math.prod(map(int, cut)), limits)
    locate = located or partial(LibraryRows, variable)
    return StoredVariable(
        variable.name, variable.dimensions, variable.shape, dtype, attributes, variable, locate
    )


def _find_rows(path: Path, variables: Sequence[Any]) -> dict[str, Locate]:
    """Locate the numbers of the variables that can be read without the library."""
    import h5py

    numeric = [
        variable
        for variable in variables
        if isinstance(variable.dtype, np.dtype)
        and variable.dtype.kind in "iuf"
        and len(variable.shape) in (1, 2)
    ]
    classic = read_classic_header(path)
    if classic is not None:
        places = [classic[v.name] for v in numeric if v.name in classic]
        shapes = {variable.name: variable.shape for variable in numeric}
        return {
            place.name: partial(
                EvenRows.of_array, path.absolute(), place.dtype, place.begin, place.stride
            )
            for place in places
            if place.shape == shapes[place.name]
        }
    if not h5py.is_hdf5(path):
        return {}
    locators = {}
    with library_lock(), h5py.File(path, "r") as file:
        for variable in numeric:
            stored = file.get(variable.name)
            if isinstance(stored, h5py.Dataset) and (stored.shape, stored.dtype) == (
                variable.shape,
                variable.dtype,
            ):
                locators[variable.name] = hdf5_rows(path, stored)
    return {name: locate for name, locate in locators.items() if locate is not None}


def _zarr_variables(path: Path, limits: Mapping[str, float]) -> Iterator[StoredVariable]:
    import zarr

    for name, array in sorted(zarr.open_group(path, mode="r").arrays()):
        attributes = dict(array.attrs)
        named: Any = attributes.pop("_ARRAY_DIMENSIONS", None) or getattr(
            array.metadata, "dimension_names", None
        )
        dims = [
            dim or f"rows_{size}"
            for dim, size in zip(named or [None] * array.ndim, array.shape, strict=True)
        ]
        attributes |= _zarr_fill(array, attributes)
        chunks, dtype = tuple(array.chunks), np.dtype(array.dtype)
        check_chunk(path, name, dtype.itemsize * math.prod(map(int, chunks)), limits)
        locate = partial(
            ChunkedRows,
            partial(_load_zarr, array, chunks),
            array.shape,
            chunks,
            dtype,
            array.fill_value,
            key=(uuid.uuid4().hex,),
        )
        yield StoredVariable(
            name, tuple(map(str, dims)), array.shape, dtype, attributes, array, locate
        )


def _load_zarr(array: Any, chunks: tuple[int, ...], at: tuple[int, ...]) -> NDArray[Any]:
    box = [slice(n * length, (n + 1) * length) for n, length in zip(at, chunks, strict=True)]
    return np.asarray(array[tuple(box)])


def _zarr_fill(array: Any, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the number that marks missing values.

    xarray stores it as the fill value of the array in format 2, and as an attribute in format 3 (of
    floats, eight bytes in base64). A fill value of 0 is the default of Zarr and does not
    mark missing values.
    """
    if "_FillValue" in attributes:
        value = attributes["_FillValue"]
        if isinstance(value, str) and np.dtype(array.dtype).kind == "f":
            value = struct.unpack("<d", base64.standard_b64decode(value))[0]
        return {"_FillValue": value}
    usable = (
        array.metadata.zarr_format == 2 and array.fill_value is not None and bool(array.fill_value)
    )
    return {"_FillValue": array.fill_value} if usable else {}


def with_default_fill(attributes: dict[str, Any], dtype: Any) -> dict[str, Any]:
    """Add the default fill value of the NetCDF library; bytes have none (users guide)."""
    import netCDF4

    if (
        {"_FillValue", "_Unsigned"} & set(attributes)
        or dtype.kind not in "iuf"
        or dtype.itemsize == 1
    ):
        return attributes
    return {**attributes, "_FillValue": dtype.type(netCDF4.default_fillvals[dtype.str[1:]])}
