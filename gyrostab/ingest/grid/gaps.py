"""Table of gaps: missing samples, and rows that were dropped, moved or unreadable."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.ingest.gap_table import MISSING, OUTSIDE_RANGE, UNREADABLE, sort_lines
from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS, ScanPass, find_spans
from gyrostab.ingest.uniform.core import add_spans, as_uniform, grid_of, merge_spans, with_table
from gyrostab.kernels.grid.stamps import (
    DUPLICATE,
    EVENT_CAUSE,
    EVENT_ROW,
    EVENT_SAMPLE,
    OUT_OF_ORDER,
)
from gyrostab.schema import GAP_CAUSES, signal_name


def _missing_samples(placement: Placement, scanned: ScanPass) -> Ints:
    """List the samples without a row between the runs."""
    runs = placement.runs
    end, start = runs[:-1, 0] + runs[:-1, 2], runs[1:, 0]
    # a late row that was put in its place has no neighbours among the rows
    is_late = np.isin(runs[:, 1], placement.events_of(OUT_OF_ORDER)[:, EVENT_ROW])
    row_end = np.maximum.accumulate(np.where(is_late, 0, runs[:, 1] + runs[:, 2]))[:-1]
    row_start = np.where(is_late[1:], row_end, runs[1:, 1])
    # rows that have a line of another cause
    listed_rows = np.sort(placement.events_of(DUPLICATE, OUT_OF_ORDER)[:, EVENT_ROW])
    listed_between = np.searchsorted(listed_rows, row_start) - np.searchsorted(listed_rows, row_end)
    skipped = np.maximum(row_start - row_end - listed_between, 0)
    cause = np.where(skipped > 0, UNREADABLE, MISSING)
    broken = placement.breaks
    if len(broken):
        at = np.minimum(np.searchsorted(broken[:, EVENT_SAMPLE], end), len(broken) - 1)
        at_break = broken[at, EVENT_SAMPLE] == end
        cause = np.where(at_break, broken[at, EVENT_CAUSE], cause)
    listed = (start > end) | ((skipped > 0) & (scanned.absent_count <= 0.01 * scanned.row_count))
    return np.asarray(np.stack([end, start, start - end, skipped, cause], axis=1)[listed])


def _unusable_cells(spans: Ints, cause: int, placement: Placement) -> Ints:
    """List the placed rows in which an axis has no usable number; each run has its own lines."""
    runs = placement.runs[np.argsort(placement.runs[:, 1], kind="stable")]
    run_ends = runs[:, 1] + runs[:, 2]
    first_run = np.searchsorted(run_ends, spans[:, 0], side="right")
    n_runs = np.maximum(np.searchsorted(runs[:, 1], spans[:, 1]) - first_run, 0)
    span = np.repeat(spans, n_runs, axis=0)
    run = np.arange(len(span)) + np.repeat(first_run - np.cumsum(n_runs) + n_runs, n_runs)
    begin = np.maximum(span[:, 0], runs[run, 1])
    rows = np.minimum(span[:, 1], run_ends[run]) - begin
    first = runs[run, 0] + begin - runs[run, 1]
    return np.stack([first, first + rows, rows, rows, np.full_like(rows, cause)], axis=1)


def _dropped_rows(placement: Placement) -> Ints:
    """List the dropped or moved rows; consecutive rows of one cause are one line."""
    rows = placement.events_of(DUPLICATE, OUT_OF_ORDER)
    rows = rows[np.argsort(rows[:, EVENT_ROW], kind="stable")]
    if len(rows) == 0:
        return np.empty((0, 5), dtype=np.int64)
    row_steps, cause_steps = np.diff(rows[:, [EVENT_ROW, EVENT_CAUSE]], axis=0).T
    new = np.concatenate([[True], (row_steps > 1) | (cause_steps != 0)])
    at = np.flatnonzero(new)
    count = np.diff(np.append(at, len(rows)))
    sample, cause = np.minimum.reduceat(rows[:, EVENT_SAMPLE], at), rows[at, EVENT_CAUSE]
    return np.stack([sample, sample, np.zeros_like(count), count, cause], axis=1)


def find_gaps(placement: Placement, scanned: ScanPass) -> Ints:
    """Make the table of all gaps in samples, with the columns of `ingest.gap_table.COLUMNS`."""
    unreadable = [scanned.unreadable]
    if placement.placed_count > scanned.present_count - scanned.repeated_count:
        # rows without any number have samples too, because they count
        absent = [
            find_spans(~scanned.mask(begin, min(begin + BLOCK_ROWS, scanned.row_count)), begin)
            for begin in range(0, scanned.row_count, BLOCK_ROWS)
        ]
        unreadable.append(merge_spans(absent))
    table = np.concatenate(
        [
            _missing_samples(placement, scanned),
            *(_unusable_cells(spans, UNREADABLE, placement) for spans in unreadable),
            _unusable_cells(scanned.infinite, OUTSIDE_RANGE, placement),
            _dropped_rows(placement),
        ]
    )
    return sort_lines(table)


def _missing_spans(log: xr.Dataset) -> Ints:
    """List the spans of samples that are NaN on any axis, read block by block."""
    signal = log[signal_name(log)]
    spans = []
    for begin in range(0, signal.sizes["time"], BLOCK_ROWS):
        block = signal.isel(time=slice(begin, begin + BLOCK_ROWS))
        spans.append(find_spans(block.isnull().any("axis").values, begin))
    return add_spans(np.empty((0, 5), dtype=np.int64), merge_spans(spans), MISSING)


def gap_table(log: xr.Dataset) -> pd.DataFrame:
    """List the gaps of a regular log.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, with a table of gaps (``gap_start``, ``gap_end``, ``gap_samples``,
        ``gap_rows``, ``gap_cause`` on ``gap``) as from `regularise`, or without one: then the
        samples that are NaN on any axis are listed, with cause "missing".

    Returns
    -------
    pandas.DataFrame
        Columns start, end (half-open), seconds, samples, rows, cause.

    Raises
    ------
    SchemaError
        When it is not a regular log.

    Examples
    --------
    >>> from gyrostab.ingest.grid.regularise import regularise
    >>> time = np.array([0, 10, 20, 50, 60], dtype="datetime64[ms]").astype("datetime64[ns]")
    >>> rate = ("axis", "row"), np.ones((1, 5)), {"units": "degree hour-1"}
    >>> raw = xr.Dataset({"rate": rate}, {"time": ("row", time), "axis": ["z"]})
    >>> gap_table(regularise(raw))[["seconds", "samples", "rows", "cause"]]
       seconds  samples  rows    cause
    0     0.02        2     0  missing
    """
    log = as_uniform(log)
    if "gap_start" not in log.variables:
        log = with_table(log, _missing_spans(log), grid_of(log)[0])
    start, end = log["gap_start"].values, log["gap_end"].values
    cause = np.array(GAP_CAUSES, dtype=object)[log["gap_cause"].values.astype(int)]
    samples = log["gap_samples"].values
    rows = log["gap_rows"].values if "gap_rows" in log.variables else np.zeros_like(samples)
    seconds = (end - start) / np.timedelta64(1, "s")
    return pd.DataFrame(
        {
            "start": start,
            "end": end,
            "seconds": seconds,
            "samples": samples,
            "rows": rows,
            "cause": cause,
        }
    )
