"""Open logs, surfaces and products that `gyrostab.io.datasets` wrote."""

from __future__ import annotations

import os
from collections.abc import Container
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.errors import DamageError, FormatError, SchemaError, TimeError, reading_of
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.formats.text import matches as is_text_log
from gyrostab.ingest.limits import check_declared
from gyrostab.schema import SIGNAL_UNITS, check_log, check_product, check_surface
from gyrostab.store.cf import find_kind, from_disk
from gyrostab.store.output import read_json
from gyrostab.store.read import open_stored


def open_dataset(path: str | os.PathLike[str], *, strict: bool = False) -> xr.Dataset:
    """Open a dataset that `to_netcdf` or `to_zarr` wrote; data stays on disk (dask) until used.

    A dataset that xarray wrote by its own `to_netcdf` or `to_zarr` is opened too.

    Parameters
    ----------
    strict : bool
        What a chunk of a log does that turns out to be damaged or missing: raise `FormatError` as
        it is read, or become a gap, of which a warning tells the file, the axis and the times.

    Raises
    ------
    FormatError
        When the file does not exist, or when it is damaged.

    Examples
    --------
    >>> open_dataset("nothing.nc")
    Traceback (most recent call last):
    ...
    gyrostab.errors.FormatError: nothing.nc: there is no such file
    """
    with reading_of(path):
        return from_disk(open_stored(Path(path), strict=strict, check=check_declared), str(path))


def open_product(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a product: a dynamic Allan variance with the coefficients of every window.

    Parameters
    ----------
    path : path-like
        NetCDF file or Zarr directory that ``gyrostab run``, ``gyrostab fit``, `to_netcdf` or
        `to_zarr` wrote.

    Returns
    -------
    xarray.Dataset
        ``avar(axis, time, tau)`` [degree2 hour-2], ``Q, N, B, K, R (axis, time)`` with errors and
        limits, and the rest of ``docs/product.md``; data stays on disk (dask) until it is used.

    Raises
    ------
    FormatError
        When the file does not exist, when it is damaged, or when it holds something else.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from gyrostab.io.datasets import to_netcdf
    >>> from gyrostab.allan.davar import davar
    >>> from gyrostab.allan.fit import fit_noise
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = to_netcdf(fit_noise(davar(log, window="60s")), folder + "/product.nc")
    ...     with open_product(folder + "/product.nc") as product:
    ...         print(product.N.dims, product.N.unit_label)
    ('axis', 'time') deg/sqrt(h)
    """
    return _open_path(
        path, "a product", check_product, "make one with 'gyrostab run' or 'gyrostab fit'"
    )


def open_surface(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a dynamic Allan variance without coefficients, or a product, which holds one.

    Parameters
    ----------
    path : path-like
        NetCDF file or Zarr directory that ``gyrostab davar``, `to_netcdf` or `to_zarr` wrote, or a
        product.

    Returns
    -------
    xarray.Dataset
        ``avar(axis, time, tau)`` [degree2 hour-2] with ``count``, ``coverage`` and ``edf``; data
        stays on disk (dask) until it is used.

    Raises
    ------
    FormatError
        When the file does not exist, when it is damaged, or when it holds something else.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from gyrostab import davar, make_log, to_netcdf
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = to_netcdf(davar(log, window="20s"), folder + "/davar.nc")
    ...     with open_surface(folder + "/davar.nc") as surface:
    ...         print(surface.avar.dims)
    ('axis', 'time', 'tau')
    """
    return _open_path(path, "a DAVAR surface", check_surface, "make one with 'gyrostab davar'")


def open_log(path: str | os.PathLike[str], *, strict: bool = False) -> xr.Dataset:
    """Open a regular log.

    Parameters
    ----------
    path : path-like
        NetCDF file or Zarr directory that ``gyrostab ingest``, ``gyrostab simulate``, `to_netcdf`
        or `to_zarr` wrote.
    strict : bool
        Raise `FormatError` where a chunk that is read turns out to be damaged or missing; by
        default it becomes a gap, of which a warning tells the file, the axis and the times.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1] or ``angle`` [degree], NaN where a sample is missing,
        with the channels and the table of gaps; data stays on disk (dask, the chunks of the file)
        until it is used.

    Raises
    ------
    FormatError
        When the file does not exist, when it is damaged, or when it holds something else.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from gyrostab.io.datasets import to_netcdf
    >>> from gyrostab.ingest.make_log import make_log
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = make_log([[1.0, np.nan, 2.0]], rate=100.0, unit="deg/h")
    ...     _ = to_netcdf(log, folder + "/log.nc")
    ...     with open_log(folder + "/log.nc") as log:
    ...         print(log.rate.values)
    [[ 1. nan  2.]]
    """
    log = _open_path(
        path,
        "a regular log",
        partial(check_log, rate=False),
        "make one with 'gyrostab ingest'",
        strict=strict,
    )
    return _restore_log(log, path)


def open_content(path: str | os.PathLike[str], *, strict: bool = False) -> xr.Dataset:
    """Open a log, a surface or a product, whichever the file holds, as the functions above do.

    Raises
    ------
    FormatError
        When the file does not exist, when it is damaged, or when it holds something else.
    SchemaError, TimeError
        When it holds a log of other units, or one whose time is not uniform.
    """
    advice = "; gyrostab.read_log reads logs of other programs"
    dataset = _open_binary(path, advice, strict=strict)
    if any(name in dataset.data_vars for name in SIGNAL_UNITS):
        return _restore_log(dataset, path)
    if "gyrostab_content" not in dataset.attrs and find_kind(dataset) == "dataset":
        dataset.close()
        raise FormatError(
            f"{path}: holds no log, surface or product of gyrostab; gyrostab.read_log reads logs "
            "of other programs"
        )
    return dataset


def _restore_log(log: xr.Dataset, path: str | os.PathLike[str]) -> xr.Dataset:
    try:
        return as_log(log, converts_channels=False)
    except (SchemaError, TimeError) as error:
        log.close()
        raise type(error)(f"{path}: {error}") from error


def _open_binary(path: str | os.PathLike[str], text_advice: str, *, strict: bool) -> xr.Dataset:
    """Open a dataset; of a text file or an output of another command, say that it is one."""
    try:
        return open_dataset(path, strict=strict)
    except DamageError as error:
        _refuse_other_output(Path(path), error)
        if not is_text_log(Path(path)):
            raise
        raise FormatError(f"{path}: is a text file{text_advice}") from error


def _refuse_other_output(path: Path, cause: Exception, dims: Container[Any] = ()) -> None:
    """Raise `FormatError` if this is a diagnosis, a fleet or a part of one: say what reads it."""
    marks = [path] if path.suffix == ".json" else [path / "diagnosis.json", path / "fleet.json"]
    contents = (read_json(mark) for mark in marks)
    schemas = [str(content.get("schema")) for content in contents if isinstance(content, dict)]
    if any(schema.startswith("gyrostab.diagnosis/") for schema in schemas) or (
        "case" in dims and "window" in dims
    ):
        is_folder = path.is_dir()
        folder = path if is_folder else path.parent
        raise FormatError(
            f"{path}: is {'' if is_folder else 'a file of '}a diagnosis; "
            f"'gyrostab report {folder} -o report.html' draws its figures, and "
            "gyrostab.open_diagnosis opens its folder"
        ) from cause
    if any(schema.startswith("gyrostab.fleet/") for schema in schemas):
        raise FormatError(
            f"{path}: is the output of 'gyrostab fleet'; its report is index.html in this folder; "
            "give the product of one of its runs, or the whole fleet to "
            "'gyrostab export --format iscwsa'"
        ) from cause


def _open_path(
    path: str | os.PathLike[str], content: str, check: Any, advice: str, *, strict: bool = False
) -> xr.Dataset:
    text_advice = f", not {content}; if it is a log, {advice}"
    dataset = _open_binary(path, text_advice, strict=strict)
    try:
        with reading_of(path):
            check(dataset)
    except SchemaError as error:
        kind = find_kind(dataset)
        dataset.close()
        _refuse_other_output(Path(path), error, dims=dataset.sizes)
        # a product with a fault passes as a surface
        if kind != "dataset" and not (kind == "surface" and "observable" in dataset):
            raise FormatError(f"{path}: holds a {kind}, not {content}; {advice}") from error
        raise FormatError(f"{path}: does not hold {content} ({error}); {advice}") from error
    return dataset
