"""Find and drop rows of files that repeat rows of other files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.ingest.columns.stamps import NAT, read_stamps
from gyrostab.ingest.concat.place import COMPARED_SAMPLES, match_ends
from gyrostab.ingest.raw_rows import (
    BLOCK_ROWS,
    count_rows_until,
    find_first_row,
    list_axes,
    stamp_span,
)
from gyrostab.store.lazy import read_slice


def drop_repeats(
    parts: Sequence[xr.Dataset], signal: str
) -> tuple[list[xr.Dataset], list[xr.Dataset]]:
    """Drop the rows of each file that repeat rows of other files, with notes.

    Two files overlap if rows of both have the same stamps and the same values. Files whose clocks
    merely cover the same hours, for instance after a restart of the clock, differ and stay
    unchanged. `parts` are in the order of their first stamps. A file without new rows is dropped as
    a whole. The notes are in the file that contains the rows.

    Rows are dropped from a file whose axes and channels the other has too. Where neither has all,
    the later file is returned in the second list.
    """
    kept_parts: list[tuple[xr.Dataset, int]] = []  # with the latest stamp of each
    parts_apart: list[xr.Dataset] = []
    for part in parts:
        first, end = stamp_span(part)
        is_apart = False
        for place, (held, held_end) in reversed(list(enumerate(kept_parts))):
            if first > held_end:
                continue
            tail, head = find_first_row(held, first), count_rows_until(part, held_end)
            if not _is_copy(held, part, signal, tail, head):
                continue
            ours, theirs = ({*list_axes(log), *log.data_vars} for log in (held, part))
            size = held.sizes["row"]
            cells = _count_filled(held, signal, tail, size), _count_filled(part, signal, 0, head)
            is_fuller = cells[1] > cells[0] and head >= size - tail
            if is_fuller and theirs >= ours and end >= held_end:
                # it contains cells that the earlier file lost
                held, part = _drop_rows(held, slice(0, tail), part)
                held_end = first - 1
            elif theirs <= ours:
                part, held = _drop_rows(part, slice(head, None), held)
                first, end = stamp_span(part)
            else:
                is_apart = True
                break
            kept_parts[place] = held, held_end
        if is_apart:
            parts_apart.append(part)
        else:
            kept_parts.append((part, end))
        kept_parts = [(log, last) for log, last in kept_parts if log.sizes["row"]]
    return [log for log, _ in kept_parts], parts_apart


def _count_filled(part: xr.Dataset, signal: str, begin: int, end: int) -> int:
    """Count the filled cells of some rows; those of the signal are read if some are unreadable."""
    count = (end - begin) * len({*list_axes(part), *part.data_vars})
    if part.attrs["unreadable_rows"] or part.attrs["unreadable_cells"]:
        for start in range(begin, end, BLOCK_ROWS):
            block = read_slice(part[signal].data, start, min(start + BLOCK_ROWS, end))
            count -= int(np.count_nonzero(np.isnan(block)))
    return count


def _drop_rows(part: xr.Dataset, rows: slice, other: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Keep the given rows of `part`; add a note on the others to `other`, which contains them."""
    name, holder = (str(log.attrs["source_files"][0]) for log in (part, other))
    shorter = part.isel(row=rows)
    left_out = part.sizes["row"] - shorter.sizes["row"]
    note = f"{holder}: {left_out} rows of {name} are here too, and are left out there"
    return shorter, other.assign_attrs(notes=[*other.attrs["notes"], note])


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
) -> tuple[Floats, Floats]:
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
