"""Variables of foreign NetCDF files and Zarr stores, as they are stored."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError
from gyrostab.ingest.limits import check_chunk


@contextmanager
def open_undecoded(path: Path) -> Iterator[xr.Dataset]:
    """Open a file or store with xarray, which decodes neither numbers nor stamps."""
    options: dict[str, Any] = {"engine": "netcdf4"}
    if path.is_dir():
        options = {"engine": "zarr", "consolidated": False}
    try:
        stored = xr.open_dataset(
            path, chunks=None, decode_cf=False, create_default_indexes=False, **options
        )
    except KeyError as error:
        if "dimension" not in str(error):
            raise
        raise FormatError(
            f"{path.name}: an array does not name its dimensions; give it the attribute "
            "_ARRAY_DIMENSIONS (Zarr format 2) or dimension_names (format 3)"
        ) from error
    with stored:
        yield stored


def find_variables(
    path: Path, stored: xr.Dataset, limits: Mapping[str, float]
) -> dict[str, xr.Variable]:
    """Return the variables, with the fill value of the format if they have none.

    `FormatError` if a chunk is too large. In Zarr format 2 the fill value of an array marks missing
    values, except for 0, which is its default.
    """
    variables = {str(name): variable for name, variable in stored.variables.items()}
    for name, variable in variables.items():
        chunks = variable.encoding.get("chunks" if path.is_dir() else "chunksizes") or ()
        check_chunk(path, name, variable.dtype.itemsize * math.prod(map(int, chunks)), limits)
        if not path.is_dir():
            variable.attrs = _with_default_fill(variable.attrs, variable.dtype)
        elif not (path / "zarr.json").exists() and not np.all(variable.attrs.get("_FillValue", 1)):
            del variable.attrs["_FillValue"]
    return dict(sorted(variables.items())) if path.is_dir() else variables


def _with_default_fill(attributes: dict[Any, Any], dtype: Any) -> dict[Any, Any]:
    """Add the default fill value of the NetCDF library; bytes have none (users guide)."""
    import netCDF4

    if (
        {"_FillValue", "_Unsigned"} & set(attributes)
        or dtype.kind not in "iuf"
        or dtype.itemsize == 1
    ):
        return attributes
    return {**attributes, "_FillValue": dtype.type(netCDF4.default_fillvals[dtype.str[1:]])}
