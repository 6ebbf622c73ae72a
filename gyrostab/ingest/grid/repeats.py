"""Find repeated rows: the clock is set back, and the same samples follow again."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.concat.place import is_copy
from gyrostab.ingest.grid.fill import samples_of
from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS
from gyrostab.kernels.grid.stamps import DUPLICATE, NO_STAMP, RESTART, STEP
from gyrostab.store.lazy import read_slice

_MAX_CANDIDATES = 8  # earlier rows with the stamp of a set-back that are compared
_MIN_ROWS = 16  # shorter repetitions are found by their stamps alone


def find_repeats(raw: xr.Dataset, name: str, placement: Placement) -> NDArray[np.int64]:
    """Find the rows after each set-back of the clock that repeat rows before it.

    Rows are equal if their stamps and values are. A clock that restarts may write the same stamps
    again, but with other values; values that never change are not taken as a repetition.

    Parameters
    ----------
    placement : Placement
        Rows on the grid, with the set-backs of the clock among the events.

    Returns
    -------
    ndarray of int64, shape (n, 3)
        First row of the repetition, first row of what it repeats, number of rows.
    """
    events = placement.events
    back = events[np.isin(events[:, 0], (STEP, RESTART)) & (events[:, 4] < events[:, 3])]
    repeats: list[tuple[int, int, int]] = []
    for row, stamp in sorted(zip(back[:, 2].tolist(), back[:, 4].tolist(), strict=True)):
        if repeats and row < repeats[-1][0] + repeats[-1][2]:
            continue
        for source in _rows_at(raw, stamp, row):
            length = _same_stamps(raw, source, row)
            if length >= _MIN_ROWS and _same_values(raw, name, source, row, length):
                repeats.append((row, source, length))
                break
    return np.array(repeats, dtype=np.int64).reshape(-1, 3)


def _rows_at(raw: xr.Dataset, stamp: int, end_row: int) -> list[int]:
    """Return the first few rows with a stamp."""
    rows: list[int] = []
    for begin in range(0, end_row, BLOCK_ROWS):
        rows += (
            np.flatnonzero(read_stamps(raw, begin, min(begin + BLOCK_ROWS, end_row)) == stamp)
            + begin
        ).tolist()
        if len(rows) >= _MAX_CANDIDATES:
            break
    return rows[:_MAX_CANDIDATES]


def _same_stamps(raw: xr.Dataset, source: int, row: int) -> int:
    """Return how many rows from `row` on have the stamps of those from `source` on."""
    room = min(raw.sizes["row"] - row, row - source)
    for begin in range(0, room, BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, room)
        mismatches = np.flatnonzero(
            read_stamps(raw, source + begin, source + end)
            != read_stamps(raw, row + begin, row + end)
        )
        if len(mismatches):
            return begin + int(mismatches[0])
    return room


def _same_values(raw: xr.Dataset, name: str, source: int, row: int, length: int) -> bool:
    """Return whether values are equal where both are known, and not constant."""
    compared = same = 0
    changes = False
    for begin in range(0, length, BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, length)
        left, right = (
            read_slice(raw[name].data, first + begin, first + end) for first in (source, row)
        )
        is_known = np.isfinite(left) & np.isfinite(right)
        rows = is_known.any(axis=0)
        compared += int(rows.sum())
        same += int(((left == right) | ~is_known).all(axis=0)[rows].sum())
        changes = changes or bool(
            ((np.diff(left, axis=1) != 0) & is_known[:, 1:] & is_known[:, :-1]).any()
        )
    return changes and is_copy(compared, same)


def with_repeats(placement: Placement, raw: xr.Dataset, repeats: NDArray[np.int64]) -> Placement:
    """Add repeated rows as duplicates to the events of a placement made without them."""
    events = [placement.events]
    for row, source, length in repeats.tolist():
        rows = np.arange(length)
        sample = np.maximum.accumulate(np.maximum(samples_of(placement, rows + source), 0))
        stamps = read_stamps(raw, row, row + length)
        is_readable = stamps != NO_STAMP
        table = np.stack([np.full(length, DUPLICATE), sample, rows + row, stamps, stamps], axis=1)
        events.append(table[is_readable])
    table = np.concatenate(events)
    return Placement(
        placement.start,
        placement.runs,
        table[np.argsort(table[:, 1], kind="stable")],
        placement.wander,
    )
