"""Find repeated rows: the clock is set back, and the same samples follow again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.concat.copies import Match, count_alike
from gyrostab.ingest.grid.fill import samples_of
from gyrostab.ingest.grid.place import Placement
from gyrostab.ingest.grid.scan_pass import BLOCK_ROWS
from gyrostab.kernels.grid.stamps import DUPLICATE, NO_STAMP, RESTART, STEP
from gyrostab.store.lazy import read_slice

_MAX_CANDIDATES = 8  # earlier rows with the stamp of a set-back that are compared
_FIRST_ROWS = 256  # rows that are compared first
_MIN_SAME_SHARE = 0.5  # smaller share of equal values at which the comparison ends
_MIN_ROWS = 16  # shorter repetitions are found by their stamps alone


def find_repeats(raw: xr.Dataset, name: str, placement: Placement) -> NDArray[np.int64]:
    """Find the rows after each set-back of the clock that repeat rows before it.

    Rows are equal if their stamps and values are. A clock that restarts may write the same stamps
    again, but with other values; values that never change are not taken as a repetition.

    Returns (n, 3): first row of the repetition, first row of what it repeats, number of rows.
    """
    events = placement.events
    back = events[np.isin(events[:, 0], (STEP, RESTART)) & (events[:, 4] < events[:, 3])]
    repeats: list[tuple[int, int, int]] = []
    for row, stamp in sorted(zip(back[:, 2].tolist(), back[:, 4].tolist(), strict=True)):
        if repeats and row < repeats[-1][0] + repeats[-1][2]:
            continue
        for source in _rows_at(raw, stamp, row):
            length = _count_repeated(raw, name, source, row)
            if length >= _MIN_ROWS:
                repeats.append((row, source, length))
                break
    return np.array(repeats, dtype=np.int64).reshape(-1, 3)


def _growing_blocks(rows: int) -> Iterator[tuple[int, int]]:
    """Yield begin and end of blocks, first small ones, as most comparisons end soon."""
    begin, size = 0, _FIRST_ROWS
    while begin < rows:
        yield begin, min(begin + size, rows)
        begin, size = begin + size, min(2 * size, BLOCK_ROWS)


def _rows_at(raw: xr.Dataset, stamp: int, end_row: int) -> list[int]:
    """Return the first few rows with a stamp."""
    rows: list[int] = []
    for begin, end in _growing_blocks(end_row):
        rows += (np.flatnonzero(read_stamps(raw, begin, end) == stamp) + begin).tolist()
        if len(rows) >= _MAX_CANDIDATES:
            break
    return rows[:_MAX_CANDIDATES]


def _count_repeated(raw: xr.Dataset, name: str, source: int, row: int) -> int:
    """Return how many rows from `row` on repeat those from `source` on, 0 if none do.

    Their stamps are equal, and their values where both are known, but not constant.
    """
    compared = same = length = 0
    changes = False
    for begin, end in _growing_blocks(min(raw.sizes["row"] - row, row - source)):
        differ = read_stamps(raw, source + begin, source + end) != read_stamps(
            raw, row + begin, row + end
        )
        length = begin + int(differ.argmax()) if differ.any() else end
        left, right = (
            read_slice(raw[name].data, first + begin, first + length) for first in (source, row)
        )
        known, equal_rows = count_alike(left, right)
        compared, same = compared + int(known), same + int(equal_rows)
        changes = changes or bool((np.abs(np.diff(left, axis=1)) > 0).any())
        if differ.any() or same < _MIN_SAME_SHARE * compared:
            break
    return length if changes and Match(compared, same).alike else 0


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
    return replace(placement, events=table[np.argsort(table[:, 1], kind="stable")])
