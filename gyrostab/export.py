"""Logs, surfaces and products as CF NetCDF or Zarr, and back as they were in memory.

On disk the dimensions are ``(axis, tau, time)``, every time is an exact integer, every unit string is one that UDUNITS reads
rightly, only data carries a fill value, and lists stand in the attributes as JSON. `open_dataset` turns all of that back
(`gyrostab.cf` holds the rules). A file takes its final name only once it is complete.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.cf import from_disk, to_disk
from gyrostab.errors import FormatError, SchemaError
from gyrostab.output import new_output
from gyrostab.schema import check_log, check_product, check_surface

__all__ = ["open_dataset", "open_log", "open_product", "open_surface", "to_netcdf", "to_zarr"]

_CHUNK = 2**17  # values in one compressed chunk: 1 MiB of float64


def to_netcdf(dataset: xr.Dataset, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a product, a DAVAR surface or a log as one flat CF NetCDF file.

    Lazy (dask) variables are computed together and chunk by chunk; none is held in memory as a whole.
    A variable whose encoding declares an integer dtype and a ``scale_factor`` (counts of the source) is stored as integers.

    Parameters
    ----------
    dataset : xarray.Dataset
        In memory ``(axis, time, tau)``, units as in `gyrostab.units.INNER`.
    path : path-like
        The file to make. It takes this name only once it is complete.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OutputError
        When the file exists, or cannot be written; nothing half-written is left behind.

    Examples
    --------
    >>> import tempfile
    >>> from gyrostab.timegrid import time_coordinate
    >>> log = xr.Dataset(
    ...     {"rate": (("axis", "time"), np.zeros((1, 4)), {"units": "degree hour-1"})},
    ...     coords={"axis": ["x"]},
    ...     attrs={"sampling_rate_hz": 300.0},
    ... ).assign_coords(time_coordinate(0, 300.0, 4))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     open_log(to_netcdf(log, folder + "/log.nc")).time.values[1]
    np.datetime64('1970-01-01T00:00:00.003333333')
    """
    import netCDF4

    stored = to_disk(dataset, "to_netcdf")
    encoding: dict[Any, dict[str, Any]] = {}
    for name, variable in stored.variables.items():
        text = variable.dtype.kind in "OUST"
        encoding[name] = {"_FillValue": None, **({"dtype": "S1"} if text else {})}
        if _is_data(stored, name) and variable.dtype.kind == "f":
            kept = np.dtype(variable.encoding.get("dtype", variable.dtype))
            encoding[name] |= {**variable.encoding, "_FillValue": kept.type(netCDF4.default_fillvals[kept.str[1:]])}
        if variable.ndim and variable.size and not text:
            encoding[name] |= {"zlib": True, "complevel": 4, "shuffle": True, "chunksizes": _chunks(variable)}
    with new_output(path, overwrite=overwrite) as temporary:
        stored.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
    return Path(path)


def to_zarr(dataset: xr.Dataset, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a product, a DAVAR surface or a log as a Zarr store (a directory, format 2), by the same rules as `to_netcdf`.

    Parameters
    ----------
    dataset : xarray.Dataset
        In memory ``(axis, time, tau)``.
    path : path-like
        The directory to make.
    overwrite : bool
        Replace an existing store.

    Returns
    -------
    pathlib.Path
        The directory.

    Raises
    ------
    OutputError
        When it exists, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> cube = xr.Dataset({"avar": (("axis", "time", "tau"), np.ones((1, 2, 3)))}, coords={"axis": ["x"]})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     xr.open_zarr(to_zarr(cube, folder + "/cube.zarr")).avar.dims
    ('axis', 'tau', 'time')
    """
    stored = to_disk(dataset, "to_zarr")
    encoding: dict[Any, dict[str, Any]] = {}
    for name, variable in stored.variables.items():
        encoding[name] = {"_FillValue": None}
        if _is_data(stored, name) and variable.dtype.kind == "f":
            encoding[name]["_FillValue"] = variable.dtype.type(np.nan)
        if variable.ndim and variable.size:
            chunks = _chunks(variable)
            encoding[name]["chunks"] = chunks
            if variable.chunks is not None:
                stored[name] = variable.chunk(dict(zip(variable.dims, chunks, strict=True)))
    with new_output(path, overwrite=overwrite, directory=True) as temporary:
        stored.to_zarr(temporary, mode="w", zarr_format=2, consolidated=True, encoding=encoding)
    return Path(path)


def _is_data(dataset: xr.Dataset, name: Any) -> bool:
    """Whether a variable is data, as opposed to a coordinate or the bounds of one."""
    bounds = {variable.attrs.get("bounds") for variable in dataset.variables.values()}
    return name not in dataset.coords and name not in bounds


def _chunks(variable: xr.Variable) -> tuple[int, ...]:
    """One axis (and one term) a chunk, every tau, and as much time as fits."""
    inner = int(np.prod([size for dim, size in variable.sizes.items() if dim not in ("axis", "term", variable.dims[-1])]))
    last = max(1, min(variable.shape[-1], _CHUNK // max(1, inner)))
    return tuple(last if dim == variable.dims[-1] else 1 if dim in ("axis", "term") else size for dim, size in variable.sizes.items())


def open_dataset(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open what `to_netcdf` or `to_zarr` wrote, as it was in memory; data stays on disk (dask) until it is used.

    Parameters
    ----------
    path : path-like
        A NetCDF file or a Zarr directory.

    Returns
    -------
    xarray.Dataset
        Product, surface or log: ``(axis, time, tau)``, units of `gyrostab.units.INNER`, a computed time axis for a log.

    Raises
    ------
    FormatError
        When there is no such file, when it is damaged, or when gyrostab did not write it.

    Examples
    --------
    >>> open_dataset("nothing.nc")
    Traceback (most recent call last):
    ...
    gyrostab.errors.FormatError: nothing.nc: there is no such file
    """
    path = Path(path)
    if not path.exists():
        raise FormatError(f"{path}: there is no such file")
    engine: Any = "zarr" if path.is_dir() else "netcdf4"
    name = "Zarr" if path.is_dir() else "NetCDF"
    try:
        stored = xr.open_dataset(path, engine=engine, chunks={}, decode_times=False, create_default_indexes=False)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise FormatError(f"{path}: is not {name}, or is damaged or cut short ({error}); make or copy it again") from error
    if "gyrostab_version" not in stored.attrs:
        stored.close()
        raise FormatError(f"{path}: is {name}, but not one that gyrostab wrote; read it with gyrostab.read_log (gyrostab ingest)")
    return from_disk(stored)


def open_product(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a product (surface with coefficients); as `open_dataset`, and `FormatError` when the file holds something else."""
    return _open(path, "a product", check_product, "make one with 'gyrostab run' or 'gyrostab fit'")


def open_surface(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a DAVAR surface, or a product, which holds one; as `open_dataset`, and `FormatError` when it holds something else."""
    return _open(path, "a DAVAR surface", check_surface, "make one with 'gyrostab davar'")


def open_log(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a regular log; as `open_dataset`, and `FormatError` when the file holds something else."""
    return _open(path, "a regular log", check_log, "make one with 'gyrostab ingest'")


def _open(path: str | os.PathLike[str], what: str, check: Any, advice: str) -> xr.Dataset:
    dataset = open_dataset(path)
    try:
        check(dataset)
    except SchemaError as error:
        dataset.close()
        raise FormatError(f"{path}: does not hold {what} ({error}); {advice}") from error
    return dataset
