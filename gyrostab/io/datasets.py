"""Write logs, surfaces and products to CF NetCDF or Zarr, and products to CSV.

On disk the dimensions are ``(axis, tau, time)``, every time is an exact integer, every unit string
is one that UDUNITS reads rightly, only data carries a fill value, and lists stand in the attributes
as JSON (`gyrostab.store.cf` and `.times` hold the rules; `gyrostab.store` the chunks of a log). A
file takes its final name only once it is complete. `gyrostab.io.opening` opens the files.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import OptionError
from gyrostab.ingest.convert import as_log
from gyrostab.noise import LAWS
from gyrostab.schema import SIGNAL_UNITS, check_product, with_axis
from gyrostab.store.cf import to_disk
from gyrostab.store.output import find_foreign_item, find_sources, new_output
from gyrostab.store.private import library_lock
from gyrostab.store.times import GRID, index_dim
from gyrostab.store.write import (
    NotCountsError,
    Progress,
    append_netcdf,
    append_zarr,
    as_counts,
    chunk_samples,
    large_variables,
)

#: Values in one compressed chunk of a surface or product: 1 MiB of float64.
CHUNK_VALUES = 2**17
#: Samples from which a log is stored without the time of each sample by default.
MAX_STAMPED_SAMPLES = 10**7
_STAMPS_PER_CHUNK = 2**13  # of a computed time axis in NetCDF


def to_netcdf(
    dataset: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    compression: str | None = None,
    stamps: bool | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a product, a DAVAR surface or a log as one flat CF NetCDF file.

    Lazy (dask) variables are computed together and chunk by chunk; none is held in memory as a
    whole. A variable whose encoding declares an integer dtype and a ``scale_factor`` (counts of the
    source) is stored as integers if that gives back the same numbers, bit for bit.

    Parameters
    ----------
    dataset : xarray.Dataset
        In memory ``(axis, time, tau)``, units as in `gyrostab.units.INNER`. A log is written with
        the sampling rate of its ``time``, with NaN where samples have been dropped, and with its
        signal in degree hour-1 or degree; other coordinates and channels are kept as they are.
    path : path-like
        The file to write. It takes this name only once it is complete.
    overwrite : bool
        Replace an existing file, unless the dataset is lazy and still reads from it.
    compression : {"zstd", "zlib"}, optional
        zlib is read by every NetCDF program and is the default; zstd is two to four times as fast,
        and Octave, MATLAB and h5netcdf do not read it.
    stamps : bool, optional
        Store the time of every sample of a log as a CF coordinate, for programs other than
        gyrostab; by default in logs of less than 10 000 000 samples.
    progress : callable, optional
        Called with the share of the long variables that is written.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OptionError
        When the compression is unknown, or when the dataset reads from the file.
    OutputError
        When the file exists, or cannot be written; nothing half-written is left behind.
    SchemaError
        When the signal of a log has no units, or no known ones.
    TimeError
        When the time of a log is not in order, or not uniform.

    Examples
    --------
    >>> import tempfile
    >>> from gyrostab.io.opening import open_log
    >>> from gyrostab.time.grid import time_coordinate
    >>> log = xr.Dataset(
    ...     {"rate": (("axis", "time"), np.zeros((1, 4)), {"units": "degree hour-1"})},
    ...     coords={"axis": ["x"]},
    ...     attrs={"sampling_rate_hz": 300.0},
    ... ).assign_coords(time_coordinate(0, 300.0, 4))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     open_log(to_netcdf(log, folder + "/log.nc")).time.values[1]
    np.datetime64('1970-01-01T00:00:00.003333333')
    """
    stored, sources = _encode_dataset(dataset, "to_netcdf", stamps)
    plan = partial(_plan_netcdf, filters=_make_filters(compression))
    output = partial(new_output, path, overwrite=overwrite, inputs=sources)
    _write_counts(stored, output, plan, _begin_netcdf, partial(append_netcdf, progress=progress))
    return Path(path)


def _compute_time_axes(dataset: Any) -> xr.Dataset:
    """Compute the time axis, sampling rate and table of gaps of a log; return others unchanged."""
    if not isinstance(dataset, xr.Dataset):
        return as_log(dataset)
    for name in SIGNAL_UNITS:
        signal = dataset.data_vars.get(name)
        if signal is not None and "time" in signal.dims and set(signal.dims) <= {"axis", "time"}:
            return as_log(dataset, converts_channels=False)
    return dataset


def _encode_dataset(dataset: Any, verb: str, stamps: bool | None) -> tuple[xr.Dataset, list[Path]]:
    """Encode a dataset as the file will hold it, and find the files that it still reads from."""
    dataset = _compute_time_axes(dataset)
    sources = find_sources(dataset)
    if stamps is None:
        stamps = dataset.sizes.get("time", 0) < MAX_STAMPED_SAMPLES
    return to_disk(dataset, verb, stamps=stamps), sources


def _begin_netcdf(dataset: xr.Dataset, path: Path, encoding: dict[Any, dict[str, Any]]) -> None:
    """Write variables in memory to a new file; `Dataset.to_netcdf` would load dask.distributed."""
    open_store: Any = xr.backends.NetCDF4DataStore.open
    store = open_store(path, mode="w", format="NETCDF4", lock=library_lock())
    try:
        dataset.dump_to_store(store, encoding=encoding)
    finally:
        store.close()


def _plan_netcdf(stored: xr.Dataset, filters: dict[str, Any]) -> dict[Any, dict[str, Any]]:
    import netCDF4

    encoding = _plan_encoding(stored, netCDF4.default_fillvals.__getitem__, chunks="chunksizes")
    for name, variable in stored.variables.items():
        if variable.dtype.kind in "OUST":
            encoding[name] = {"_FillValue": None, "dtype": "S1"}
        elif "chunksizes" in encoding[name]:
            encoding[name] |= filters
            if _has_rule(variable):  # both ends are read whenever the file is opened
                encoding[name]["chunksizes"] = (min(variable.size, _STAMPS_PER_CHUNK),)
    return encoding


def _make_filters(compression: str | None) -> dict[str, Any]:
    """Choose the filters of a NetCDF file; a checksum if the compression has none."""
    import netCDF4

    if compression not in (None, "zstd", "zlib"):
        raise OptionError(f"compression={compression!r}: give 'zstd' or 'zlib'")
    if compression == "zstd":
        if has_zstd():
            return {"compression": "zstd", "complevel": 3, "fletcher32": True}
        warnings.warn(
            f"netCDF library {netCDF4.__netcdf4libversion__} has no zstd here: "
            "the log is compressed with zlib",
            stacklevel=3,
        )
    return {"zlib": True, "complevel": 4, "shuffle": True}


def has_zstd() -> bool:
    """Whether the NetCDF library can compress with zstd."""
    import netCDF4

    with netCDF4.Dataset("probe", "w", diskless=True, persist=False) as probe:
        return bool(probe.has_zstd_filter())


def to_zarr(
    dataset: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    stamps: bool | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a product, a DAVAR surface or a log as a Zarr store (a directory, format 2).

    The rules are those of `to_netcdf`.

    Parameters
    ----------
    dataset : xarray.Dataset
        In memory ``(axis, time, tau)``.
    path : path-like
        The directory to write, or an address such as ``s3://bucket/log.zarr``, where nothing is
        replaced.
    overwrite : bool
        Replace an existing store, unless other files are in it, or the dataset is lazy and still
        reads from it.
    stamps, progress
        As for `to_netcdf`.

    Returns
    -------
    pathlib.Path
        The directory.

    Raises
    ------
    OutputError
        When it exists, holds foreign files, or cannot be written.
    OptionError
        When the dataset reads from it.

    Examples
    --------
    >>> import tempfile
    >>> avar = ("axis", "time", "tau"), np.ones((1, 2, 3))
    >>> cube = xr.Dataset({"avar": avar}, coords={"axis": ["x"]})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     xr.open_zarr(to_zarr(cube, folder + "/cube.zarr")).avar.dims
    ('axis', 'tau', 'time')
    """
    stored, sources = _encode_dataset(dataset, "to_zarr", stamps)
    output = partial(
        new_output, path, overwrite=overwrite, find_foreign=find_foreign_item, inputs=sources
    )
    _write_counts(stored, output, plan_zarr, begin_zarr, partial(append_zarr, progress=progress))
    return Path(path)


def begin_zarr(dataset: xr.Dataset, path: Path, encoding: dict[Any, dict[str, Any]]) -> None:
    """Write variables in memory to a new Zarr store, without consolidated metadata."""
    dataset.to_zarr(
        path,
        mode="w-",  # "w" would make the folder anew, with other permissions
        zarr_format=2,
        consolidated=False,
        encoding=encoding,
        write_empty_chunks=True,
    )


def plan_zarr(stored: xr.Dataset) -> dict[Any, dict[str, Any]]:
    """Choose chunks and compression; add a checksum to every chunk of a log, as blosc has none."""
    from numcodecs import Blosc, Fletcher32

    encoding = _plan_encoding(stored, lambda _: np.nan, chunks="chunks")
    for name, variable in stored.variables.items():
        if "chunks" not in encoding[name]:
            continue
        if _has_rule(variable):  # from which they are restored: a checksum is not needed
            encoding[name]["compressors"] = Blosc("zlib", clevel=4, shuffle=Blosc.SHUFFLE)
        elif _find_rate(stored) is not None and variable.dtype.kind in "if":
            encoding[name] |= {
                "compressors": Blosc("lz4", clevel=5, shuffle=Blosc.SHUFFLE),
                "filters": [Fletcher32()],
            }
    return encoding


def _plan_encoding(
    stored: xr.Dataset, find_fill: Callable[[str], Any], *, chunks: str
) -> dict[Any, dict[str, Any]]:
    """Choose the value for missing data and, under the key `chunks`, the chunks."""
    bounds = {variable.attrs.get("bounds") for variable in stored.variables.values()}
    encoding: dict[Any, dict[str, Any]] = {}
    for name, variable in stored.variables.items():
        fill = variable.encoding.get("_FillValue")  # of counts
        if variable.dtype.kind == "f" and name not in {*stored.coords, *bounds}:
            fill = variable.dtype.type(find_fill(variable.dtype.str[1:]))
        encoding[name] = {"_FillValue": fill}
        if variable.ndim and variable.size:
            encoding[name][chunks] = _plan_chunks(variable, _find_rate(stored))
    return encoding


def _write_counts(
    stored: xr.Dataset,
    output: Callable[[], AbstractContextManager[Path]],
    plan: Callable[[xr.Dataset], dict[Any, dict[str, Any]]],
    begin: Callable[[xr.Dataset, Path, dict[Any, dict[str, Any]]], None],
    append: Callable[[Path, dict[str, xr.Variable], dict[Any, dict[str, Any]]], None],
) -> None:
    """Write a file: the short variables at once, then the large ones chunk by chunk.

    Declared integer counts are written in a wider type or as doubles if they do not fit.
    """
    while True:
        try:
            packed = stored.assign(
                {name: as_counts(str(name), v.variable) for name, v in stored.data_vars.items()}
            )
            large, encoding = large_variables(packed), plan(packed)
            short = {name: options for name, options in encoding.items() if name not in large}
            with output() as temporary:
                begin(packed.drop_vars(large).load(), temporary, short)
                append(temporary, large, encoding)
            return
        except NotCountsError as misfit:
            (name,) = misfit.args
            declared = stored[name].encoding
            if np.dtype(declared["dtype"]) != np.dtype("i4"):
                stored[name].encoding = {**declared, "dtype": np.dtype("i4")}
                continue
            warnings.warn(
                f"{name}: not every value is a whole multiple of {declared['scale_factor']:g}; "
                "stored as doubles",
                stacklevel=3,
            )
            stored[name].encoding = {}


def _find_rate(stored: xr.Dataset) -> float | None:
    """Find the sampling rate [Hz] of a log; None for other datasets."""
    return (
        float(stored.attrs["sampling_rate_hz"])
        if stored.attrs["gyrostab_content"] == "log"
        else None
    )


def _has_rule(variable: xr.Variable) -> bool:
    """Whether a variable holds the stamps of a computed time axis."""
    return GRID in variable.attrs and variable.ndim == 1


def _plan_chunks(variable: xr.Variable, rate: float | None) -> tuple[int, ...]:
    """Plan the chunks of a variable; those of a log have 20 minutes."""
    dim = variable.dims[-1]
    if rate is None:
        return plan_chunks(variable.sizes, dim)
    on_time = dim in ("time", index_dim("time")) and not _has_rule(variable)
    length = chunk_samples(rate if on_time else 0.0)
    return plan_chunks(variable.sizes, dim, min(variable.shape[-1], length))


def plan_chunks(sizes: Mapping[Any, int], along: Any, length: int | None = None) -> tuple[int, ...]:
    """Plan chunks of one axis and one term that have `length` values along a dimension.

    By default a chunk has at most `CHUNK_VALUES`, if that is one value along the dimension or more.
    """
    if length is None:
        inner = math.prod(size for dim, size in sizes.items() if dim not in ("axis", "term", along))
        length = max(1, min(sizes[along], CHUNK_VALUES // max(1, inner)))
    return tuple(
        length if dim == along else 1 if dim in ("axis", "term") else size
        for dim, size in sizes.items()
    )


def to_csv(product: xr.Dataset, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a product as a CSV table with a row for each window and axis.

    Parameters
    ----------
    product : xarray.Dataset
        What `gyrostab.fit_noise` or `gyrostab.open_product` returns.
    path : path
        File to write.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    Path
        The file. Its columns are ``time`` (centre of the window, UTC), ``axis``, ``window_mean``,
        each coefficient with its error (``N_stderr``) and 95 % upper limit (``N_upper``), and the
        channels, with units in square brackets. Missing values are empty cells.

    Raises
    ------
    OutputError, SchemaError
        When the file exists or cannot be written, or `product` is not a product.

    Examples
    --------
    >>> import tempfile
    >>> from gyrostab import davar, fit_noise, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = to_csv(fit_noise(davar(log, window="20s")), folder + "/product.csv")
    ...     table = pd.read_csv(path)
    >>> list(table.columns[:3]), len(table)
    (['time', 'axis', 'window_mean [degree hour-1]'], 21)
    """
    product = with_axis(product)
    check_product(product)
    units = {name: law.label for name, law in LAWS.items()}
    units |= {f"{name}_{end}": units[name] for name in LAWS for end in ("stderr", "upper")}
    names = ["window_mean", *(f"{name}{end}" for name in LAWS for end in ("", "_stderr", "_upper"))]
    names += [str(name) for name, part in product.data_vars.items() if part.dims == ("time",)]
    table = pd.DataFrame(
        {
            "time": np.repeat(
                pd.DatetimeIndex(product["time"].values).round("us"), product.sizes["axis"]
            ),
            "axis": np.tile(product["axis"].values, product.sizes["time"]),
        }
    )
    for name in names:
        unit = units.get(name) or str(product[name].attrs.get("units", "1"))
        cells = product[name].broadcast_like(product["window_mean"]).transpose("time", "axis")
        table[f"{name} [{unit}]"] = cells.values.ravel()
    with new_output(Path(path), overwrite=overwrite) as temporary:
        table.to_csv(temporary, index=False, date_format="%Y-%m-%dT%H:%M:%S.%fZ")
    return Path(path)
