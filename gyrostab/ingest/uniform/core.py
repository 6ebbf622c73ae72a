"""Restore a log after xarray operations: sampling rate from its time, NaN at missing samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import SchemaError, TimeError
from gyrostab.ingest.gap_table import clip_table
from gyrostab.ingest.uniform.grid import UniformGrid, find_grid
from gyrostab.ingest.uniform.place import place_samples
from gyrostab.ingest.uniform.table import (
    add_holes,
    change_rate,
    has_gap_table,
    read_table,
    with_table,
)
from gyrostab.schema import check_log, signal_name
from gyrostab.time.grid import TimeGridIndex, time_coordinate

__all__ = ["as_uniform", "grid_of"]


def as_uniform(log: xr.Dataset) -> xr.Dataset:
    """Place a log on the uniform time axis of its stamps.

    xarray keeps attributes through every operation, and tables of gaps through most of them. This
    function trusts neither: the sampling rate comes from ``time``, and the table of gaps is
    clipped, converted or dropped. A log with a computed time axis (see `gyrostab.time.grid`) is
    uniform and needs no check. Explicit stamps are checked in blocks.

    Parameters
    ----------
    log : xarray.Dataset
        ``rate`` or ``angle`` on ``time`` and ``axis``, in any order of dimensions, or on ``time``
        alone; in memory or lazy.

    Returns
    -------
    xarray.Dataset
        The same log if nothing changes. Otherwise ``(axis, time)`` with a computed time axis, NaN
        at every sample missing between its stamps, and consistent attributes.

    Raises
    ------
    SchemaError
        When it is not a log.
    TimeError
        When its time is not in order or not uniform.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log([[1.0, np.nan, 3.0, 4.0, 5.0]], rate=100.0, unit="deg/h")
    >>> as_uniform(log.isel(time=slice(None, None, 2))).attrs["sampling_rate_hz"]
    50.0
    >>> as_uniform(log.dropna("time")).rate.values
    array([[ 1., nan,  3.,  4.,  5.]])
    """
    log = _with_dimensions(log)
    check_log(log, rate=False)
    nominal = _declared_rate(log)
    grid, computed = grid_of(log, nominal)
    if not computed:
        log = _onto_grid(log, grid)
    if has_gap_table(log):
        log = _with_true_table(log, grid, nominal, computed=computed)
    true = {"sampling_rate_hz": grid.rate, "kind": signal_name(log)}
    if all(log.attrs.get(name) == value for name, value in true.items()):
        return log
    return log.assign_attrs(true)


def grid_of(log: xr.Dataset, nominal: float | None = None) -> tuple[UniformGrid, bool]:
    """Return the grid of a log's time, and whether its time axis is computed."""
    index, size = log.xindexes.get("time"), log.sizes["time"]
    if isinstance(index, TimeGridIndex):
        if index.rate < 0:
            raise TimeError("the time of the log runs backwards; sort it: log.sortby('time')")
        return UniformGrid(
            index.start, index.rate, size, np.array([[0, 0, size]], dtype=np.int64)
        ), True
    time = log.variables["time"]
    if time.dtype.kind != "M":
        raise SchemaError(
            f"the time of the log is of type {time.dtype}, not dates; give it datetime64 stamps: "
            "log.assign_coords(time=...)"
        )

    def read(begin: int, end: int) -> NDArray[np.int64]:
        return np.asarray(time[begin:end].values).astype("datetime64[ns]").view(np.int64)

    return find_grid(read, size, nominal=nominal), False


def _with_dimensions(log: Any) -> xr.Dataset:
    """Return the log with its signal on ``(axis, time)``, from another order or a single axis."""
    if not isinstance(log, xr.Dataset):
        raise SchemaError(
            f"this is a {type(log).__name__}, not a log (an xarray.Dataset); make one with "
            "gyrostab.make_log"
        )
    if "row" in log.dims:
        raise SchemaError(
            "these are raw rows with their stamps as written; call gyrostab.regularise(raw) first"
        )
    name = signal_name(log)
    dims = log.variables[name].dims
    if dims == ("time",):
        if "axis" not in log.variables:
            log = log.assign_coords(axis="x")
        if log.variables["axis"].ndim == 0:
            log = log.assign({name: log[name].expand_dims("axis")})
    elif dims == ("time", "axis"):
        log = log.assign({name: log.variables[name].transpose("axis", "time")})
    turned: xr.Dataset = log
    return turned


def _declared_rate(log: xr.Dataset) -> float | None:
    try:
        rate = float(log.attrs.get("sampling_rate_hz", np.nan))
    except (TypeError, ValueError):
        return None
    return rate if np.isfinite(rate) and rate > 0 else None


def _onto_grid(log: xr.Dataset, grid: UniformGrid) -> xr.Dataset:
    if len(grid.runs) > 1:
        return place_samples(log, grid.runs, grid.start, grid.rate, grid.size)
    bare: xr.Dataset = log.drop_vars("time")
    timed: xr.Dataset = bare.assign_coords(time_coordinate(grid.start, grid.rate, grid.size))
    return timed


def _with_true_table(
    log: xr.Dataset, grid: UniformGrid, declared: float | None, *, computed: bool
) -> xr.Dataset:
    """Return the log with a table of gaps that fits its time, or without one if that is unknown."""
    table = read_table(log, grid.start, grid.rate)
    if table is None:
        return with_table(log, None, grid.start, grid.rate)
    same_rate = declared is not None and abs(declared / grid.rate - 1) < 1e-9
    if not same_rate and not (computed and declared is not None):
        return with_table(
            log, None, grid.start, grid.rate
        )  # averaged samples have other gaps than selected ones
    fitting = table if same_rate else change_rate(table, log, declared, grid.start, grid.rate)  # type: ignore[arg-type]
    fitting = clip_table(fitting, 0, grid.size)
    if len(grid.runs) > 1:
        fitting = add_holes(fitting, grid.runs)
    if fitting is table or np.array_equal(fitting, table):
        return log
    return with_table(log, fitting, grid.start, grid.rate)
