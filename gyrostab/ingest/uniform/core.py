"""Restore a log after xarray operations: rate from its time, NaN at missing samples, gaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.arrays import Array, Ints
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.concat.lazy import chunk_of, place_array
from gyrostab.ingest.gap_table import (
    END,
    FIRST,
    MISSING,
    ROWS,
    SAMPLES,
    clip_table,
    gap_variables,
    read_gaps,
    sort_gaps,
)
from gyrostab.ingest.uniform.grid import UniformGrid, find_grid
from gyrostab.schema import check_log, name_axes, require_dataset, signal_name, texts
from gyrostab.store.lazy import find_source, hide_infinite
from gyrostab.store.private import close_function, is_in_memory
from gyrostab.time.grid import TimeGridIndex, time_coordinate
from gyrostab.time.stamps import to_nanoseconds

#: Largest variable that stays in memory after placing [numbers]; 16 MB.
SMALL_SIZE = 2**21
#: Chunk length of variables that were in memory [samples].
CHUNK_SAMPLES = 2**20


def as_uniform(log: xr.Dataset) -> xr.Dataset:
    """Place a log on the uniform time axis of its stamps.

    xarray keeps attributes through every operation, and tables of gaps through most of them. This
    function trusts neither: the sampling rate comes from ``time``, and the table of gaps is
    clipped, converted or dropped. A log with a computed time axis (see `gyrostab.time.grid`) is
    uniform and needs no check.

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
        if len(grid.runs) > 1:
            log = place_samples(log, grid)
        else:
            time = time_coordinate(grid.start, grid.rate, grid.size)
            log = log.drop_vars("time").assign_coords(time)
    if "gap" in log.dims:
        log = _with_true_table(log, grid, nominal, computed=computed)
    true = {"sampling_rate_hz": grid.rate, "kind": signal_name(log)}
    if all(log.attrs.get(name) == value for name, value in true.items()):
        return log
    return log.assign_attrs(true)


def check_same_rate(log: xr.Dataset, rate: float, name: str) -> None:
    """Refuse a given rate [Hz] that contradicts that of a regular log; `name` names the log."""
    own_rate = float(log.attrs["sampling_rate_hz"])
    if abs(rate / own_rate - 1) > 1e-6:
        raise OptionError(
            f"{name} is a regular log of {own_rate:.10g} Hz, not of {rate:.10g} Hz; leave "
            "out --rate, or ingest its source again"
        )


def grid_of(log: xr.Dataset, nominal: float | None = None) -> tuple[UniformGrid, bool]:
    """Return the grid of a log's time, and whether its time axis is computed."""
    index, size = log.xindexes.get("time"), log.sizes["time"]
    if isinstance(index, TimeGridIndex):
        return UniformGrid(
            index.start, index.rate, size, np.array([[0, 0, size]], dtype=np.int64)
        ), True
    time = log.variables["time"]
    if time.dtype.kind != "M":
        raise SchemaError(
            f"the time of the log is of type {time.dtype}, not dates; give it datetime64 stamps: "
            f"{advise_dates(time.values, 'log') or 'log.assign_coords(time=...)'}"
        )
    return find_grid(to_nanoseconds(time.values), nominal=nominal), False


def advise_dates(times: Array, name: str) -> str:
    """Return the call that makes datetime64 of cftime dates or pandas periods, or "".

    `name` is that of the Dataset or DataArray in the call.
    """
    first = times.flat[0] if times.size else None
    if isinstance(first, pd.Period):
        return f"{name}.assign_coords(time={name}.indexes['time'].to_timestamp())"
    if hasattr(first, "calendar"):
        return f"{name}.convert_calendar('standard', use_cftime=False)"
    return ""


def _with_dimensions(log: Any) -> xr.Dataset:
    """Return the log with its signal on ``(axis, time)``, from another order or a single axis.

    Axes have names, and infinite values become NaN.
    """
    require_dataset(log, "log")
    if "row" in log.dims:
        raise SchemaError(
            "these are raw rows with their stamps as written; call gyrostab.regularise(raw) first"
        )
    name, names = signal_name(log), name_axes(log)
    dims = log.variables[name].dims
    if dims == ("time",):
        if "axis" not in log.variables:
            log = log.assign_coords(axis="x")
        if log.variables["axis"].ndim == 0:
            log = log.assign({name: log[name].expand_dims("axis")})
    elif dims == ("time", "axis"):
        log = log.assign({name: log.variables[name].transpose("axis", "time")})
    if "axis" in log.dims and names != log["axis"].values.tolist():
        log = log.assign_coords(axis=("axis", names, log["axis"].attrs))
    signal = log.variables[name]
    if is_in_memory(signal) or (signal.chunks is not None and find_source(signal.data) is None):
        finite = hide_infinite(signal.data)
        if finite is not signal.data:
            log = log.assign({name: signal.copy(data=finite)})
    turned: xr.Dataset = log
    return turned


def _declared_rate(log: xr.Dataset) -> float | None:
    try:
        rate = float(log.attrs.get("sampling_rate_hz", np.nan))
    except (TypeError, ValueError):
        return None
    return rate if np.isfinite(rate) and rate > 0 else None


def _with_true_table(
    log: xr.Dataset, grid: UniformGrid, declared: float | None, *, computed: bool
) -> xr.Dataset:
    """Return the log with a table of gaps that fits its time, or without one if that is unknown."""
    table, fitting = read_gaps(log, grid.start, grid.rate), None
    if table is not None and declared is not None:
        if abs(declared / grid.rate - 1) < 1e-9:
            fitting = table
        elif computed:  # averaged samples have other gaps than selected ones
            old_table = read_gaps(log, grid.start, declared)
            fitting = None if old_table is None else _change_rate(old_table, grid.rate / declared)
    if table is None or fitting is None:
        return with_table(log, None, grid)
    fitting = clip_table(fitting, 0, grid.size)
    if len(grid.runs) > 1:
        fitting = _add_holes(fitting, grid.runs)
    return log if np.array_equal(fitting, table) else with_table(log, fitting, grid)


def place_samples(log: xr.Dataset, grid: UniformGrid) -> xr.Dataset:
    """Place the variables along ``time`` of a log on a grid; lazy ones stay lazy.

    Missing samples are NaN. Variables without numbers are left out, with a note.
    """
    moved = {name: variable for name, variable in log.variables.items() if "time" in variable.dims}
    placed, left_out = {}, []
    for name, variable in moved.items():
        if name not in log.data_vars:
            continue
        if variable.dtype.kind not in "biuf" or variable.ndim > 2:
            left_out.append(str(name))
            continue
        turned = variable.transpose(..., "time")
        in_memory = isinstance(turned.data, np.ndarray)
        array = place_array(
            turned.data,
            grid.runs,
            grid.size,
            chunk=CHUNK_SAMPLES if in_memory else chunk_of([turned.data]),
            most_in_memory=max(SMALL_SIZE, 2 * variable.size) if in_memory else 0,
        )
        placed[name] = xr.Variable(turned.dims, array, variable.attrs, variable.encoding).transpose(
            *variable.dims
        )
    time = time_coordinate(grid.start, grid.rate, grid.size)
    placed_log = log.drop_vars(list(moved)).assign(placed).assign_coords(time)
    placed_log = placed_log[[name for name in log.data_vars if name in placed_log.data_vars]]
    placed_log.set_close(close_function(log))
    if left_out:
        note = f"left out, as missing samples of it could not be marked: {', '.join(left_out)}"
        placed_log = placed_log.assign_attrs(notes=[*texts(log, "notes"), note])
    return placed_log


def _change_rate(table: Ints, ratio: float) -> Ints:
    """Convert a table for a log of which every n-th sample was selected; `ratio` is 1 / n."""
    old_length = table[:, END] - table[:, FIRST]
    table = table.copy()
    # the first selected sample at or after it
    table[:, [FIRST, END]] = np.ceil(table[:, [FIRST, END]] * ratio - 1e-6)
    length = table[:, END] - table[:, FIRST]
    share = np.divide(table[:, SAMPLES], old_length, out=np.zeros(len(table)), where=old_length > 0)
    lost = (table[:, SAMPLES] > 0) & (length == 0)  # between two selected samples
    table[:, SAMPLES] = np.rint(share * length)
    table[:, ROWS] = np.minimum(table[:, ROWS], np.maximum(length, 1))
    return np.asarray(table[~lost])


def _add_holes(table: Ints, runs: Ints) -> Ints:
    """Add the samples between runs that the table does not list, with cause "missing"."""
    first, end = runs[:-1, 0] + runs[:-1, 2], runs[1:, 0]
    begin, stop = merge_spans([table[table[:, END] > table[:, FIRST]][:, [FIRST, END]]]).T
    if len(begin):  # clip by listed gaps at either end, then count listed samples within
        which = np.maximum(np.searchsorted(begin, first, side="right") - 1, 0)
        first = np.where((begin[which] <= first) & (first < stop[which]), stop[which], first)
        which = np.minimum(np.searchsorted(stop, end, side="left"), len(stop) - 1)
        end = np.where((begin[which] < end) & (end <= stop[which]), begin[which], end)
        listed = np.concatenate([[0], np.cumsum(stop - begin)])
        within = (
            listed[np.searchsorted(stop, end, side="right")] - listed[np.searchsorted(begin, first)]
        )
    else:
        within = np.zeros_like(first)
    samples = end - first - np.maximum(within, 0)
    new = (end > first) & (samples > 0)
    cause = np.full(int(new.sum()), MISSING)
    holes = np.stack([first[new], end[new], samples[new], np.zeros_like(cause), cause], axis=1)
    return sort_gaps(np.concatenate([table, holes]))


def merge_spans(spans: Sequence[Ints]) -> Ints:
    """Return the union of half-open spans (first, end), in order."""
    table = np.concatenate([*spans, np.empty((0, 2), np.int64)])
    first, end = table[np.argsort(table[:, 0], kind="stable")].T
    end = np.maximum.accumulate(end)
    is_apart = first[1:] > end[:-1]
    edge = np.ones(min(len(table), 1), dtype=bool)
    return np.stack([first[np.append(edge, is_apart)], end[np.append(is_apart, edge)]], axis=1)


def add_spans(table: Ints, spans: Ints, cause: int) -> Ints:
    """Add spans of samples (first, end) of one cause to a table."""
    length = spans[:, 1] - spans[:, 0]
    lines = np.column_stack([spans, length, np.zeros_like(length), np.full_like(length, cause)])
    return sort_gaps(np.concatenate([table, lines]))


def with_table(log: xr.Dataset, table: Ints | None, grid: UniformGrid) -> xr.Dataset:
    """Replace the table of gaps of a log on this grid; None removes it."""
    bare = log.drop_vars(
        [name for name, variable in log.variables.items() if "gap" in variable.dims]
    )
    return bare if table is None else bare.assign(gap_variables(table, grid.start, grid.rate))
