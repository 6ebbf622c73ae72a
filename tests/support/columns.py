"""Columns of numbers with attributes in NetCDF and HDF5 files, as other programs write them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np


def write_columns(
    path: Path,
    columns: Mapping[str, tuple[Any, str | Mapping[str, Any]]],
    form: str = "NETCDF4",
    **options: Any,
) -> Path:
    """Write columns, each with its unit or attributes, to HDF5 (``.h5``) or to NetCDF.

    Numbers are stored as they are. The fill value is among the attributes; `options` are those with
    which the library makes a variable. Columns of one length have one dimension.
    """
    is_hdf5 = path.suffix == ".h5"
    with h5py.File(path, "w") if is_hdf5 else netCDF4.Dataset(path, "w", format=form) as file:
        for name, (numbers, given) in columns.items():
            values = np.asarray(numbers)
            attributes = {"units": given} if isinstance(given, str) else dict(given)
            if is_hdf5:
                file.create_dataset(name, data=values, **options).attrs.update(attributes)
                continue
            dim = f"rows_{values.size}"
            if dim not in file.dimensions:
                file.createDimension(dim, values.size)
            kind = values.dtype if form == "NETCDF4" else values.dtype.newbyteorder("=")
            fill = attributes.pop("_FillValue", None)
            endian = "big" if kind.str[0] == ">" else "native"
            variable = file.createVariable(
                name, kind, (dim,), fill_value=fill, endian=endian, **options
            )
            variable.set_auto_maskandscale(False)
            variable.setncatts(attributes)
            variable[:] = values.astype(kind)
    return path
