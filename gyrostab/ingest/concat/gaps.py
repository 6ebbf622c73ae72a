"""Merge the tables of gaps of several logs on one grid, with the gaps between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.concat.axes import group_axes
from gyrostab.ingest.concat.grid import PlacedLog
from gyrostab.ingest.gap_table import (
    DUPLICATE,
    END,
    FIRST,
    MISSING,
    clip_table,
    read_gaps,
    sort_gaps,
)

Table = NDArray[np.int64]

_EMPTY: Table = np.empty((0, 5), dtype=np.int64)
_MAX_SAMPLE = np.iinfo(np.int64).max // 2


def _own_gaps(piece: PlacedLog) -> Table:
    """Return the table of gaps of one log, on the common grid."""
    table = read_gaps(piece.source.log, piece.source.start, piece.source.rate)
    if table is None:
        table = _EMPTY
    for column in (FIRST, END) if len(table) else ():
        table[:, column] = piece.on_grid(table[:, column])
    return np.concatenate([table, _rate_slips(piece)]) if len(piece.runs) > 1 else table


def _rate_slips(piece: PlacedLog) -> Table:
    """Return the samples left empty or dropped where a different rate has drifted by one sample."""
    end, own_end = piece.runs[:-1, 0] + piece.runs[:-1, 2], piece.runs[:-1, 1] + piece.runs[:-1, 2]
    start, own_start = piece.runs[1:, 0], piece.runs[1:, 1]
    cause = np.where(start > end, MISSING, DUPLICATE)
    return np.stack([end, start, start - end, own_start - own_end, cause], axis=1)


def _missing_in_both(held: Table, new: Table) -> Table:
    """Return the samples missing in both logs, with the causes and the events of the first."""
    lines = [held[held[:, FIRST] == held[:, END]]]
    lines += [
        clip_table(held[held[:, END] > held[:, FIRST]], int(first), int(end))
        for first, end in new[:, [FIRST, END]]
        if end > first
    ]
    return np.concatenate(lines)


def merge_gaps(pieces: Sequence[PlacedLog]) -> Table:
    """Return the table of gaps of the concatenated log; a gap on some axes counts as a gap.

    Its columns are those of `gyrostab.ingest.gap_table.COLUMNS`, sorted by sample.
    """
    groups = group_axes(pieces, [piece.source.axes for piece in pieces])
    spans = sorted(
        (min(piece.first for piece in group), max(piece.end for piece in group)) for group in groups
    )
    if len(groups) == 1 or any(later[0] >= earlier[1] for earlier, later in pairwise(spans)):
        # shared axes, or other axes at another time
        return sort_gaps(_merge_group(pieces, pieces[0].first, None))
    end = max(end for _, end in spans)
    tables = [_merge_group(group, spans[0][0], end) for group in groups]
    return sort_gaps(np.unique(np.concatenate(tables), axis=0))  # a gap of several axes is one line


def _merge_group(pieces: Sequence[PlacedLog], begin: int, stop_at: int | None) -> Table:
    """Return the gaps of logs that share axes, from `begin` on and up to `stop_at` if given."""
    tables: list[Table] = []
    firsts: list[int] = []
    ends: list[int] = []
    end = begin
    for piece in pieces:
        new = _own_gaps(piece)
        tables.append(new)
        if piece.first > end:
            cause = piece.cause if piece.cause >= 0 else MISSING
            tables[-1] = np.concatenate([[[end, piece.first, piece.first - end, 0, cause]], new])
        stop = min(piece.end, end)
        if piece.first < stop:
            for place in np.flatnonzero((np.array(ends) > piece.first) & (np.array(firsts) < stop)):
                held = tables[place]
                inside = _missing_in_both(
                    clip_table(held, piece.first, stop), clip_table(new, piece.first, stop)
                )
                tables[place] = np.concatenate(
                    [
                        clip_table(held, -_MAX_SAMPLE, piece.first),
                        inside,
                        clip_table(held, stop, _MAX_SAMPLE),
                    ]
                )
            tables[-1] = np.concatenate(
                [clip_table(new, -_MAX_SAMPLE, piece.first), clip_table(new, stop, _MAX_SAMPLE)]
            )
        firsts.append(min(piece.first, end))
        ends.append(piece.end)
        end = max(end, piece.end)
    if stop_at is not None and stop_at > end:
        tables.append(np.array([[end, stop_at, stop_at - end, 0, MISSING]], dtype=np.int64))
    return np.concatenate([*tables, _EMPTY])
