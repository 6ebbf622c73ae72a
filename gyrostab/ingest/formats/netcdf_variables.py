"""Variables of foreign NetCDF files and Zarr stores: dimensions, attributes, location of data."""

from __future__ import annotations

import base64
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import reading_of
from gyrostab.ingest.formats.netcdf_classic import read_classic_header
from gyrostab.ingest.limits import check_chunk
from gyrostab.store.private import library_lock
from gyrostab.store.rows import ChunkedRows, EvenRows, LibraryRows, Rows, hdf5_rows

__all__ = ["StoredVariable", "open_variables", "with_default_fill"]

#: Dimension of the rows, index along the other -> column.
Locate = Callable[[int, int], Rows]


@dataclass(frozen=True)
class StoredVariable:
    """A variable as it is stored.

    Attributes
    ----------
    name : str
    dimensions : tuple of str
    shape : tuple of int
    dtype : dtype
    attributes : mapping
        As in the file, with the default fill value of the format if the variable has none.
    values : Any
        Returns the stored numbers when indexed, while the file is open.
    locate : callable
        Dimension of the rows, index along the other -> column.
    """

    name: str
    dimensions: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attributes: Mapping[str, Any]
    values: Any = field(repr=False)
    locate: Locate = field(repr=False)


@contextmanager
def open_variables(path: Path, limits: Mapping[str, float]) -> Iterator[dict[str, StoredVariable]]:
    """Open a file or store, and describe its variables.

    Parameters
    ----------
    path : Path
        NetCDF file or Zarr store.
    limits : mapping of str to float
        Limits that the user set.

    Raises
    ------
    FormatError
        When the file is damaged, or a chunk is too large.
    """
    if path.is_dir():
        yield {variable.name: variable for variable in _zarr_variables(path, limits)}
        return
    import netCDF4

    with reading_of(path):
        file = netCDF4.Dataset(path)
    with file:
        with reading_of(path):
            found = {
                name: _netcdf_variable(path, variable, limits)
                for name, variable in file.variables.items()
            }
            _locate_directly(path, found)
        yield found


def _netcdf_variable(path: Path, variable: Any, limits: Mapping[str, float]) -> StoredVariable:
    variable.set_auto_maskandscale(False)
    dtype = variable.dtype if isinstance(variable.dtype, np.dtype) else np.dtype(object)
    attributes = with_default_fill(
        {name: variable.getncattr(name) for name in variable.ncattrs()}, dtype
    )
    cut = variable.chunking()
    if isinstance(cut, list | tuple):
        check_chunk(path, variable.name, _bytes_of(cut, dtype), limits)
    locate = partial(LibraryRows, variable)
    return StoredVariable(
        variable.name, variable.dimensions, variable.shape, dtype, attributes, variable, locate
    )


def _locate_directly(path: Path, found: dict[str, StoredVariable]) -> None:
    """Locate the numbers, so that they can be read without the library where possible."""
    import h5py

    numeric = [
        variable
        for variable in found.values()
        if variable.dtype.kind in "iuf" and len(variable.shape) in (1, 2)
    ]
    classic = read_classic_header(path)
    for variable in numeric if classic is not None else ():
        assert classic is not None
        place = classic.get(variable.name)
        if place is not None and place.shape == variable.shape:
            _replace_locate(
                found,
                variable,
                partial(
                    _classic_rows,
                    path.absolute(),
                    place.dtype,
                    place.begin,
                    place.stride,
                    place.shape,
                ),
            )
    if classic is not None or not h5py.is_hdf5(path):
        return
    with library_lock(), h5py.File(path, "r") as file:
        for variable in numeric:
            stored = file.get(variable.name)
            if (
                isinstance(stored, h5py.Dataset)
                and stored.shape == variable.shape
                and stored.dtype == variable.dtype
            ):
                located = hdf5_rows(path, stored)
                if located is not None:
                    _replace_locate(found, variable, located)


def _replace_locate(
    found: dict[str, StoredVariable], variable: StoredVariable, locate: Locate
) -> None:
    found[variable.name] = replace(variable, locate=locate)


def _classic_rows(
    path: Path,
    dtype: np.dtype[Any],
    begin: int,
    stride: int,
    shape: tuple[int, ...],
    along: int,
    place: int,
) -> EvenRows:
    if len(shape) == 1 or along == 0:
        return EvenRows(path, dtype, begin + place * dtype.itemsize, stride)
    return EvenRows(path, dtype, begin + place * stride, dtype.itemsize)


def _zarr_variables(path: Path, limits: Mapping[str, float]) -> Iterator[StoredVariable]:
    import zarr

    with reading_of(path):
        arrays = sorted(zarr.open_group(path, mode="r").arrays())
    for name, array in arrays:
        with reading_of(path):
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
        check_chunk(path, name, _bytes_of(chunks, dtype), limits)
        load = partial(_load_zarr, path, array, chunks)

        def locate(
            along: int,
            place: int,
            array: Any = array,
            load: Any = load,
            key: tuple[Any, ...] = (str(path), name),
        ) -> ChunkedRows:
            opened = (*key, id(array))
            return ChunkedRows(
                load,
                array.shape,
                tuple(array.chunks),
                np.dtype(array.dtype),
                array.fill_value,
                along,
                place,
                opened,
            )

        yield StoredVariable(
            name, tuple(map(str, dims)), array.shape, dtype, attributes, array, locate
        )


def _load_zarr(
    path: Path, array: Any, chunks: tuple[int, ...], at: tuple[int, ...]
) -> NDArray[Any]:
    with reading_of(path):
        return np.asarray(
            array[
                tuple(
                    slice(number * length, (number + 1) * length)
                    for number, length in zip(at, chunks, strict=True)
                )
            ]
        )


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


def _bytes_of(chunks: Any, dtype: np.dtype[Any]) -> int:
    total = dtype.itemsize
    for length in chunks:  # Python integers do not overflow
        total *= int(length)
    return total
