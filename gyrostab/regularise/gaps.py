"""The table of gaps: which samples are missing, and which rows were dropped, moved or could not be read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import SchemaError
from gyrostab.kernels.stamps import DUPLICATE, OUT_OF_ORDER, RESTART, STEP
from gyrostab.regularise.fill import samples_of
from gyrostab.regularise.place import Placement
from gyrostab.regularise.survey import Survey
from gyrostab.schema import GAP_CAUSES
from gyrostab.timegrid import grid_times

__all__ = ["MOST_GAPS", "find_gaps", "gap_table", "gap_variables"]

#: Rows of the table from which on neighbours of one cause are counted in one row.
MOST_GAPS = 10_000

_MISSING, _UNREADABLE, _OUTSIDE = (GAP_CAUSES.index(name) for name in ("missing", "unreadable", "outside_range"))
# columns of the table while it is made
_FIRST, _END, _SAMPLES, _ROWS, _CAUSE = range(5)


def _holes(placement: Placement, found: Survey) -> NDArray[np.int64]:
    """Stretches of samples without a row, between the runs."""
    runs, events = placement.runs, placement.events
    end, row_end = runs[:-1, 0] + runs[:-1, 2], runs[:-1, 1] + runs[:-1, 2]
    start, row_start = runs[1:, 0], runs[1:, 1]
    told = np.sort(events[np.isin(events[:, 0], (DUPLICATE, OUT_OF_ORDER)), 2])  # rows whose fate is known otherwise
    skipped = row_start - row_end - (np.searchsorted(told, row_start) - np.searchsorted(told, row_end))
    skipped = np.where(row_start > row_end, np.maximum(skipped, 0), 0)
    broken = events[np.isin(events[:, 0], (STEP, RESTART))]
    at = np.searchsorted(broken[:, 1], end)
    at_break = np.zeros(len(end), dtype=bool)
    cause = np.where(skipped > 0, _UNREADABLE, _MISSING)
    if len(broken):
        at = np.minimum(at, len(broken) - 1)
        at_break = broken[at, 1] == end
        cause = np.where(at_break, broken[at, 0], cause)
    listed = (start > end) | ((skipped > 0) & (found.absent <= 0.01 * found.rows))
    return np.stack([end, start, start - end, skipped, cause], axis=1)[listed]


def _cells(spans: NDArray[np.int64], cause: int, placement: Placement) -> NDArray[np.int64]:
    """Rows that were placed although an axis has no usable number there."""
    first, last = samples_of(placement, spans[:, 0]), samples_of(placement, spans[:, 1] - 1)
    kept = (first >= 0) & (last >= first)
    rows = (spans[:, 1] - spans[:, 0])[kept]
    return np.stack([first[kept], last[kept] + 1, rows, rows, np.full(len(rows), cause)], axis=1)


def _dropped(events: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows dropped or moved; consecutive rows of one cause are one line."""
    rows = events[np.isin(events[:, 0], (DUPLICATE, OUT_OF_ORDER))]
    rows = rows[np.argsort(rows[:, 2], kind="stable")]
    if len(rows) == 0:
        return np.empty((0, 5), dtype=np.int64)
    new = np.concatenate([[True], (np.diff(rows[:, 2]) > 1) | (np.diff(rows[:, 0]) != 0)])
    at = np.flatnonzero(new)
    count = np.diff(np.append(at, len(rows)))
    sample = np.minimum.reduceat(rows[:, 1], at)
    return np.stack([sample, sample, np.zeros_like(count), count, rows[at, 0]], axis=1)


def _thinned(table: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """At most about `most` lines: the nearest neighbours of one cause are counted together."""
    if len(table) <= most:
        return table
    parts = []
    for cause in np.unique(table[:, _CAUSE]):
        part = table[table[:, _CAUSE] == cause]
        room = max(1, int(most * len(part) / len(table)))
        if len(part) > room and cause not in (STEP, RESTART):
            distance = part[1:, _FIRST] - part[:-1, _END]
            at = np.concatenate([[0], np.sort(np.argsort(distance, kind="stable")[len(distance) - room + 1 :]) + 1])
            last = np.append(at[1:], len(part)) - 1
            sums = np.add.reduceat(part[:, [_SAMPLES, _ROWS]], at, axis=0)
            part = np.column_stack([part[at, _FIRST], part[last, _END], sums, part[at, _CAUSE]])
        parts.append(part)
    return np.concatenate(parts)


def find_gaps(placement: Placement, found: Survey, *, most: int = MOST_GAPS) -> NDArray[np.int64]:
    """Make the table of gaps, in samples.

    Returns
    -------
    ndarray of int64, shape (n, 5)
        First missing sample, first present sample after, samples missing, rows concerned, cause.
    """
    table = np.concatenate(
        [
            _holes(placement, found),
            _cells(found.unreadable, _UNREADABLE, placement),
            _cells(found.infinite, _OUTSIDE, placement),
            _dropped(placement.events),
        ]
    )
    table = _thinned(table, most)
    return table[np.lexsort((table[:, _CAUSE], table[:, _FIRST]))]


def gap_variables(table: NDArray[np.int64], start: int, rate: float) -> dict[str, Any]:
    """Variables of the table of gaps, for a log that starts at `start` [ns] with `rate` [Hz]."""
    flags = {"flag_values": np.arange(len(GAP_CAUSES), dtype=np.int8), "flag_meanings": " ".join(GAP_CAUSES)}
    first, end = (grid_times(start, rate, table[:, column]).view("datetime64[ns]") for column in (_FIRST, _END))
    return {
        "gap_start": ("gap", first, {"long_name": "first missing sample"}),
        "gap_end": ("gap", end, {"long_name": "first present sample after the gap"}),
        "gap_samples": ("gap", table[:, _SAMPLES], {"long_name": "samples missing", "units": "1"}),
        "gap_rows": ("gap", table[:, _ROWS], {"long_name": "rows concerned", "units": "1"}),
        "gap_cause": ("gap", table[:, _CAUSE].astype(np.int8), {"long_name": "cause of the gap", **flags}),
    }


def gap_table(log: xr.Dataset) -> pd.DataFrame:
    """List the gaps of a regular log.

    Parameters
    ----------
    log : xarray.Dataset
        From `regularise`, with the variables ``gap_start``, ``gap_end``, ``gap_samples``, ``gap_rows``, ``gap_cause`` on ``gap``.

    Returns
    -------
    pandas.DataFrame
        Columns start, end (half-open), seconds, samples, rows, cause.

    Raises
    ------
    SchemaError
        When the log has no table of gaps.

    Examples
    --------
    >>> from gyrostab.regularise import regularise
    >>> time = np.array([0, 10, 20, 50, 60], dtype="datetime64[ms]").astype("datetime64[ns]")
    >>> raw = xr.Dataset({"rate": (("axis", "row"), np.ones((1, 5)), {"units": "degree hour-1"})}, {"time": ("row", time), "axis": ["z"]})
    >>> gap_table(regularise(raw))[["seconds", "samples", "rows", "cause"]]
       seconds  samples  rows    cause
    0     0.02        2     0  missing
    """
    if "gap_start" not in log.variables:
        raise SchemaError("this log has no table of gaps (gap_start, gap_end, ...); it comes with a log made by gyrostab.regularise")
    start, end = log["gap_start"].values, log["gap_end"].values
    cause = np.array(GAP_CAUSES, dtype=object)[log["gap_cause"].values.astype(int)]
    samples = log["gap_samples"].values
    rows = log["gap_rows"].values if "gap_rows" in log.variables else np.zeros_like(samples)
    seconds = (end - start) / np.timedelta64(1, "s")
    return pd.DataFrame({"start": start, "end": end, "seconds": seconds, "samples": samples, "rows": rows, "cause": cause})
