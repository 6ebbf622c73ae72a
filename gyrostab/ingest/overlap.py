"""Drop rows that overlapping files of one recording repeat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import NAT, read_stamps
from gyrostab.ingest.concat.place import COMPARED_SAMPLES, match_ends
from gyrostab.store.lazy import read_slice

_BLOCK_ROWS = 2**20
_FIRST_ROWS = 2**16  # read at once in search of the first stamp


def drop_repeats(parts: Sequence[xr.Dataset], signal: str) -> list[xr.Dataset]:
    """Drop the rows of each file that repeat rows of earlier files, with notes.

    Two files overlap if rows of both have the same stamps and the same values. Files whose clocks
    merely cover the same hours, as after a restart of the clock, have other values and stay
    unchanged. `parts` are in the order of their first stamps. A file without new rows is dropped as
    a whole. The notes are in the file that contains the rows.
    """
    kept_parts: list[tuple[xr.Dataset, int]] = []  # with the latest stamp of each
    for part in parts:
        first, end = stamp_span(part)
        for place, (held, held_end) in reversed(list(enumerate(kept_parts))):
            if first > held_end:
                continue
            tail, head = _rows_from(held, first), _rows_until(part, held_end)
            if not _is_copy(held, part, signal, tail, head):
                continue
            if head > held.sizes["row"] - tail and end >= held_end:
                # it contains rows that the earlier file lost
                held, part = _drop_rows(held, slice(0, tail), part)
                held_end = first - 1
            else:
                part, held = _drop_rows(part, slice(head, None), held)
                first, end = stamp_span(part)
            kept_parts[place] = held, held_end
        kept_parts = [(log, last) for log, last in [*kept_parts, (part, end)] if log.sizes["row"]]
    return [log for log, _ in kept_parts]


def _drop_rows(part: xr.Dataset, rows: slice, other: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Keep the given rows of `part`; add a note on the others to `other`, which contains them."""
    name, holder = (str(log.attrs["source_files"][0]) for log in (part, other))
    shorter = part.isel(row=rows)
    left_out = part.sizes["row"] - shorter.sizes["row"]
    note = f"{holder}: {left_out} rows of {name} are here too, and are left out there"
    return shorter, other.assign_attrs(notes=[*other.attrs["notes"], note])


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


def _is_copy(held: xr.Dataset, part: xr.Dataset, signal: str, tail: int, head: int) -> bool:
    """Return whether the first `head` rows of `part` repeat those of `held` from `tail` on."""
    most, size = COMPARED_SAMPLES, held.sizes["row"]
    ends = [
        ((tail, tail + most), (0, min(head, most))),
        ((max(tail, size - most), size), (max(0, head - most), head)),
    ]
    return match_ends(_read_common((held, part), signal, spans) for spans in ends).alike


def _read_common(
    parts: tuple[xr.Dataset, xr.Dataset], signal: str, spans: Sequence[tuple[int, int]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read the signal (axis, row) of two files on their common axes at their common stamps."""
    ours, theirs = (read_stamps(part, *span) for part, span in zip(parts, spans, strict=True))
    stamps, *rows = np.intersect1d(ours, theirs, return_indices=True)
    our_axes, their_axes = (part["axis"].values for part in parts)
    _, *axes = np.intersect1d(our_axes, their_axes, return_indices=True)
    held, new = (
        read_slice(part[signal].data, *span)[axis][:, row[stamps != NAT]]
        for part, span, axis, row in zip(parts, spans, axes, rows, strict=True)
    )
    return held, new
