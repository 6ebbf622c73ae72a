"""Drop rows that overlapping files of one recording repeat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from gyrostab.ingest.columns.stamps import NAT, read_stamps
from gyrostab.ingest.concat.place import count_alike, is_copy
from gyrostab.schema import SIGNAL_UNITS

_BLOCK_ROWS = 2**20
_FIRST_ROWS = 2**16  # read at once in search of the first stamp
_COMPARED_ROWS = 2**15  # at each end of an overlap


def drop_repeats(parts: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Drop the rows of each file that repeat rows of earlier files, with notes.

    Two files overlap if rows of both have the same stamps and the same values. Files whose clocks
    merely cover the same hours, as after a restart of the clock, have other values and stay
    unchanged. `parts` are in the order of their first stamps. A file without new rows is dropped as
    a whole, with a note in the file that contains its rows.
    """
    unique_parts: list[xr.Dataset] = []
    ends: list[int] = []
    for part in parts:
        first, end = stamp_span(part)
        for place in reversed(range(len(unique_parts))):
            held = unique_parts[place]
            if first > ends[place]:
                continue
            tail, head = _rows_from(held, first), _rows_until(part, ends[place])
            if not _is_copy(held, part, tail, head):
                continue
            if (
                head > held.sizes["row"] - tail and end >= ends[place]
            ):  # it contains rows that the earlier file lost
                unique_parts[place], part = _drop_rows(held, slice(0, tail), part)
                ends[place] = first - 1
            else:
                part, unique_parts[place] = _drop_rows(part, slice(head, None), held)
                first, end = stamp_span(part)
        unique_parts.append(part)
        ends.append(end)
        full = [place for place, part in enumerate(unique_parts) if part.sizes["row"]]
        unique_parts, ends = (
            [unique_parts[place] for place in full],
            [ends[place] for place in full],
        )
    return unique_parts


def _drop_rows(part: xr.Dataset, rows: slice, other: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Keep the given rows of `part`; add a note on the dropped rows to `part` or `other`."""
    name, holder = (str(log.attrs["source_files"][0]) for log in (part, other))
    shorter = part.isel(row=rows)
    left_out = part.sizes["row"] - shorter.sizes["row"]
    if shorter.sizes["row"]:
        return _with_note(
            shorter, f"{name}: {left_out} rows are in {holder} too and were left out here"
        ), other
    return shorter, _with_note(
        other, f"{holder}: all {left_out} rows of {name} are here too, so that file was left out"
    )


def _with_note(part: xr.Dataset, note: str) -> xr.Dataset:
    return part.assign_attrs(notes=[*part.attrs["notes"], note])


def first_known_stamp(part: xr.Dataset) -> int:
    """Return the first stamp of a raw log [ns since 1970]; the largest integer without any."""
    for begin in range(0, part.sizes["row"], _FIRST_ROWS):
        stamps = read_stamps(part, begin, begin + _FIRST_ROWS)
        if (stamps != NAT).any():
            return int(stamps[np.argmax(stamps != NAT)])
    return int(np.iinfo(np.int64).max)


def stamp_span(part: xr.Dataset) -> tuple[int, int]:
    """Return the first and the latest stamp of a raw log [ns since 1970]."""
    latest = NAT
    for begin in range(0, part.sizes["row"], _BLOCK_ROWS):
        stamps = read_stamps(part, begin, begin + _BLOCK_ROWS)
        latest = max(latest, int(stamps.max()))  # NAT is the smallest integer
    return first_known_stamp(part), latest


def _rows_from(part: xr.Dataset, first: int) -> int:
    """Return the row from which all stamps are `first` or later, searching from the end."""
    row = part.sizes["row"]
    while row > 0:
        stamps = read_stamps(part, row - _BLOCK_ROWS, row)
        early = np.flatnonzero((stamps < first) & (stamps != NAT))
        if len(early):
            return row - len(stamps) + int(early[-1]) + 1
        row -= len(stamps)
    return 0


def _rows_until(part: xr.Dataset, last: int) -> int:
    """Return the number of rows before the first stamp later than `last`."""
    for begin in range(0, part.sizes["row"], _BLOCK_ROWS):
        late = np.flatnonzero(read_stamps(part, begin, begin + _BLOCK_ROWS) > last)
        if len(late):
            return begin + int(late[0])
    return part.sizes["row"]


def _is_copy(held: xr.Dataset, part: xr.Dataset, tail: int, head: int) -> bool:
    """Return whether the first `head` rows of `part` repeat those of `held` from `tail` on."""
    first_counts = _count_common(
        held, part, (tail, tail + _COMPARED_ROWS), (0, min(head, _COMPARED_ROWS))
    )
    size = held.sizes["row"]
    last_counts = _count_common(
        held, part, (max(tail, size - _COMPARED_ROWS), size), (max(0, head - _COMPARED_ROWS), head)
    )
    common, same = (int(a + b) for a, b in zip(first_counts, last_counts, strict=True))
    return is_copy(common, same)


def _count_common(
    held: xr.Dataset, part: xr.Dataset, held_rows: tuple[int, int], part_rows: tuple[int, int]
) -> tuple[int, int]:
    """Count rows with equal stamps, and those with equal values; NaN equals anything."""
    ours, theirs = read_stamps(held, *held_rows), read_stamps(part, *part_rows)
    stamps, a, b = np.intersect1d(ours, theirs, return_indices=True)
    a, b = a[stamps != NAT], b[stamps != NAT]
    signal = next(
        (name for name in SIGNAL_UNITS if name in held.data_vars and name in part.data_vars), None
    )
    if signal is None or not len(a):
        return 0, 0
    axes = [axis for axis in held["axis"].values if axis in part["axis"].values]
    if not axes:
        return 0, 0
    left = np.asarray(held[signal].sel(axis=axes)[:, held_rows[0] : held_rows[1]].values)[:, a]
    right = np.asarray(part[signal].sel(axis=axes)[:, part_rows[0] : part_rows[1]].values)[:, b]
    return count_alike(left, right)
