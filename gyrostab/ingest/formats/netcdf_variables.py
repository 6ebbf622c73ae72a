"""Variables of foreign NetCDF files and Zarr stores: dimensions, attributes, stored numbers."""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.ingest.limits import check_chunk
from gyrostab.store.private import library_lock


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


@contextmanager
def open_variables(path: Path, limits: Mapping[str, float]) -> Iterator[dict[str, StoredVariable]]:
    """Open a file or store, and describe its variables; `FormatError` if a chunk is too large."""
    with ExitStack() as stack:
        if path.is_dir():
            variables = list(_zarr_variables(path))
        else:
            import netCDF4

            with library_lock():
                file = stack.enter_context(netCDF4.Dataset(path))
                variables = [_netcdf_variable(variable) for variable in file.variables.values()]
        for variable, chunks in variables:
            check_chunk(
                path, variable.name, variable.dtype.itemsize * math.prod(map(int, chunks)), limits
            )
        yield {variable.name: variable for variable, _ in variables}


def _netcdf_variable(variable: Any) -> tuple[StoredVariable, Sequence[int]]:
    """Describe a variable, and return the shape of its chunks, which is empty without chunks."""
    variable.set_auto_maskandscale(False)
    dtype = variable.dtype if isinstance(variable.dtype, np.dtype) else np.dtype(object)
    attributes = with_default_fill(
        {name: variable.getncattr(name) for name in variable.ncattrs()}, dtype
    )
    cut = variable.chunking()
    chunks = cut if isinstance(cut, list | tuple) else ()
    named = variable.name, variable.dimensions, variable.shape, dtype
    return StoredVariable(*named, attributes, variable), chunks


def _zarr_variables(path: Path) -> Iterator[tuple[StoredVariable, Sequence[int]]]:
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
        described = name, tuple(map(str, dims)), array.shape, np.dtype(array.dtype)
        yield StoredVariable(*described, attributes, array), array.chunks


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
