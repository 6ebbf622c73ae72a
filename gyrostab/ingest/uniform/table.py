"""Adapt the table of gaps of a log whose samples were cut, thinned or placed."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import SchemaError
from gyrostab.ingest.gap_table import (
    CAUSE,
    END,
    FIRST,
    ROWS,
    SAMPLES,
    gap_variables,
    merge_neighbours,
)
from gyrostab.schema import GAP_CAUSES
from gyrostab.time.grid import grid_index

__all__ = ["add_holes", "add_spans", "change_rate", "has_gap_table", "read_table", "with_table"]

Table = NDArray[np.int64]

_MISSING = GAP_CAUSES.index("missing")


def has_gap_table(log: xr.Dataset) -> bool:
    """Return whether a log has variables by gap."""
    return "gap" in log.dims


def read_table(log: xr.Dataset, start: int, rate: float) -> Table | None:
    """Read the table of gaps in grid samples (`gap_table.COLUMNS`); None if it is inconsistent."""
    found = _read_columns(log)
    if found is None:
        return None
    first, end, *rest = found
    return np.stack(
        [
            *(np.rint(grid_index(start, rate, stamps)).astype(np.int64) for stamps in (first, end)),
            *rest,
        ],
        axis=1,
    )


def _read_columns(log: xr.Dataset) -> list[NDArray[np.int64]] | None:
    """Return stamps of both ends [ns since 1970], samples, rows, cause; None if inconsistent."""
    columns: list[NDArray[np.int64]] = []
    for name, kind in (
        ("gap_start", "M"),
        ("gap_end", "M"),
        ("gap_samples", "iu"),
        ("gap_rows", "iu"),
        ("gap_cause", "iu"),
    ):
        variable = log.variables.get(name)
        if variable is None and name == "gap_rows":
            columns.append(np.zeros_like(columns[-1]))
            continue
        if variable is None or variable.dims != ("gap",) or variable.dtype.kind not in kind:
            return None
        values = np.asarray(variable.values)
        if kind == "M" and np.isnat(values).any():
            raise SchemaError(
                f"{name!r} holds {int(np.isnat(values).sum())} missing times (NaT); every time "
                "must be known"
            )
        columns.append(
            values.astype("datetime64[ns]").view(np.int64)
            if kind == "M"
            else values.astype(np.int64)
        )
    first, end, samples, _, cause = columns
    spoilt = (
        np.any(end < first)
        or np.any(samples < 0)
        or np.any((cause < 0) | (cause >= len(GAP_CAUSES)))
    )
    return None if spoilt else columns


def change_rate(table: Table, log: xr.Dataset, old_rate: float, start: int, rate: float) -> Table:
    """Convert the table for a log of which every n-th sample was selected.

    Parameters
    ----------
    table : ndarray of int64, shape (n, 5)
        Table of `read_table`, on the grid of the selected samples.
    log : xarray.Dataset
        Log with the exact ends of the gaps.
    old_rate : float
        Sampling rate for which the table was made [Hz].
    start, rate : int, float
        First stamp [ns since 1970] and present sampling rate [Hz].
    """
    columns = _read_columns(log)
    assert columns is not None  # read_table has read them
    table = table.copy()
    old_length = np.rint((columns[1] - columns[0]) * (old_rate / 1e9)).astype(np.int64)
    for column, stamps in ((FIRST, columns[0]), (END, columns[1])):
        table[:, column] = np.ceil(
            grid_index(start, rate, stamps) - 1e-6
        )  # the first selected sample at or after it
    length = table[:, END] - table[:, FIRST]
    share = np.divide(table[:, SAMPLES], old_length, out=np.zeros(len(table)), where=old_length > 0)
    lost = (table[:, SAMPLES] > 0) & (length == 0)  # between two selected samples
    table[:, SAMPLES] = np.rint(share * length)
    table[:, ROWS] = np.minimum(table[:, ROWS], np.maximum(length, 1))
    return np.asarray(table[~lost])


def add_holes(table: Table, runs: Table) -> Table:
    """Add the samples between runs that the table does not list, with cause "missing"."""
    first, end = runs[:-1, 0] + runs[:-1, 2], runs[1:, 0]
    begin, stop = _merge_lines(table[table[:, END] > table[:, FIRST]])
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
    cause = np.full(int(new.sum()), _MISSING)
    holes = np.stack([first[new], end[new], samples[new], np.zeros_like(cause), cause], axis=1)
    return _sort_table(np.concatenate([table, holes]))


def _merge_lines(table: Table) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first samples and ends of the union of the lines of a table."""
    order = np.argsort(table[:, FIRST], kind="stable")
    first, end = (
        table[order, FIRST],
        np.maximum.accumulate(table[order, END]) if len(table) else table[:, END],
    )
    new = np.concatenate([[True], first[1:] > end[:-1]]) if len(table) else np.zeros(0, np.bool_)
    last = np.concatenate([new[1:], [True]]) if len(table) else new
    return first[new], end[last]


def add_spans(table: Table, spans: Table, cause: int) -> Table:
    """Add spans of samples (first, end) of one cause to a table."""
    rows = [
        np.array([[first, end, end - first, 0, cause]], dtype=np.int64)
        for first, end in spans.tolist()
    ]
    return _sort_table(np.concatenate([table, *rows]))


def _sort_table(table: Table) -> Table:
    table = merge_neighbours(table)
    return np.asarray(table[np.lexsort((table[:, CAUSE], table[:, FIRST]))])


def with_table(log: xr.Dataset, table: Table | None, start: int, rate: float) -> xr.Dataset:
    """Replace the table of gaps of a log; None removes it."""
    bare = log.drop_vars(
        [name for name, variable in log.variables.items() if "gap" in variable.dims]
    )
    return bare if table is None else bare.assign(gap_variables(table, start, rate))
