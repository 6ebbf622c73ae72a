"""One of several logs: its samples, and the samples of the common grid that they take."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import SchemaError
from gyrostab.ingest.gap_table import (
    DUPLICATE,
    END,
    FIRST,
    MISSING,
    clip_table,
    read_gaps,
    sort_gaps,
)
from gyrostab.schema import signal_name, texts
from gyrostab.store.lazy import read_slice, select_part, stack_rows
from gyrostab.time.grid import TimeGridIndex, first_stamp, grid_times


@dataclass(frozen=True, eq=False)
class SourceLog:
    """A regular log: file name, first stamp [ns since 1970], rate [Hz], number of samples."""

    name: str
    log: xr.Dataset
    start: int
    rate: float
    size: int

    @cached_property
    def end(self) -> int:
        """Stamp of the last sample [ns since 1970]."""
        return int(grid_times(self.start, self.rate, self.size - 1))

    @cached_property
    def axes(self) -> list[str]:
        """Names of the axes in the order of the rows; cached, as the look-up in xarray is slow."""
        return [str(axis) for axis in self.log["axis"].values]


@dataclass(frozen=True, eq=False)
class PlacedLog:
    """A log placed on the common grid."""

    source: SourceLog
    #: (n, 3): first sample of the grid, first sample of the log, length; more than one where the
    #: log's rate differs from the grid's.
    runs: Ints
    off: float  # offset of its samples from those of the grid [samples]
    #: A stamp of its clock [ns since 1970] and the corresponding sample of the grid.
    clock: tuple[int, int]
    #: Cause (number in schema.GAP_CAUSES) of the gap before it; -1 if the stamps define the gap.
    cause: int = -1

    @property
    def first(self) -> int:
        """First sample of the grid that it takes."""
        return int(self.runs[0, 0])

    @property
    def end(self) -> int:
        """Sample of the grid after its last one."""
        return int(self.runs[-1, 0] + self.runs[-1, 2])

    def on_grid(self, samples: Any) -> Ints:
        """Return the grid samples of log samples, extrapolated beyond the ends of the log."""
        samples = np.asarray(samples, dtype=np.int64)
        which = np.clip(
            np.searchsorted(self.runs[:, 1], samples, side="right") - 1, 0, len(self.runs) - 1
        )
        return np.asarray(self.runs[which, 0] + samples - self.runs[which, 1])


def read_log_slice(source: SourceLog, begin: int, end: int) -> Floats:
    """Read the signal of some samples (axis, sample); NaN beyond the ends of a log."""
    data = source.log.variables[signal_name(source.log)].data
    values = np.full((data.shape[0], end - begin), np.nan)
    low, high = min(max(begin, 0), source.size), max(min(end, source.size), 0)
    if high > low:
        values[:, low - begin : high - begin] = read_slice(data, low, high)
    return values


def source_of(log: xr.Dataset, name: str) -> SourceLog:
    """Return a regular log with its first stamp, rate and size."""
    index = log.xindexes.get("time")
    if isinstance(index, TimeGridIndex):
        return SourceLog(name, log, index.start, index.rate, log.sizes["time"])
    return SourceLog(
        name, log, first_stamp(log), float(log.attrs["sampling_rate_hz"]), log.sizes["time"]
    )


def log_span(log: xr.Dataset) -> tuple[int, int]:
    """Return the first and last stamp of a regular log [ns since 1970]."""
    source = source_of(log, "")
    return source.start, source.end


def runs_of(first: int, off: float, size: int, ratio: float) -> Ints:
    """Return the runs of a log whose sample n lies at grid sample ``first + off + n * ratio``.

    A log that is faster than the grid (ratio < 1) drops a sample now and then; a slower one leaves
    samples of the grid empty.

    Examples
    --------
    >>> runs_of(10, 0.25, 8, 1.1).tolist()  # sample 3 lies at 13.55, sample 4 at 14.65
    [[10, 0, 3], [14, 3, 5]]
    """
    if ratio == 1.0 or size == 1:
        return np.array([[first, 0, size]], dtype=np.int64)

    def shift(n: Any) -> Any:
        return np.rint(off + n * (ratio - 1.0)).astype(np.int64)

    steps = np.arange(1, abs(int(shift(np.int64(size - 1)) - shift(np.int64(0)))) + 1)
    way = 1 if ratio > 1.0 else -1
    at = np.ceil((shift(np.int64(0)) + way * (steps - 0.5) - off) / (ratio - 1.0)).astype(np.int64)
    at = np.clip(at, 1, size - 1)
    at += shift(at) != shift(np.int64(0)) + way * steps  # ties round to even
    begin = np.concatenate([[0], at])
    begin = np.unique(begin[begin < size])
    end = np.append(begin[1:], size)
    if way < 0:
        begin[1:] += 1  # the grid sample of the dropped one is taken
    is_nonempty = end > begin
    begin, end = begin[is_nonempty], end[is_nonempty]
    return np.stack([first + begin + shift(begin), begin, end - begin], axis=1)


_EMPTY: Ints = np.empty((0, 5), dtype=np.int64)
_MAX_SAMPLE = np.iinfo(np.int64).max // 2


def _own_gaps(piece: PlacedLog) -> Ints:
    """Return the table of gaps of one log, on the common grid."""
    table = read_gaps(piece.source.log, piece.source.start, piece.source.rate)
    if table is None:
        table = _EMPTY
    for column in (FIRST, END) if len(table) else ():
        table[:, column] = piece.on_grid(table[:, column])
    if len(piece.runs) == 1:
        return table
    # samples left empty or dropped where a different rate has drifted by one sample
    runs = piece.runs
    end, own_end = (runs[:-1, column] + runs[:-1, 2] for column in (0, 1))
    start, own_start = runs[1:, 0], runs[1:, 1]
    cause = np.where(start > end, MISSING, DUPLICATE)
    slips = np.stack([end, start, start - end, own_start - own_end, cause], axis=1)
    return np.concatenate([table, slips])


def _missing_in_both(held: Ints, new: Ints) -> Ints:
    """Return the samples missing in both logs, with the causes and the events of the first."""
    lines = [held[held[:, FIRST] == held[:, END]]]
    lines += [
        clip_table(held[held[:, END] > held[:, FIRST]], int(first), int(end))
        for first, end in new[:, [FIRST, END]]
        if end > first
    ]
    return np.concatenate(lines)


def merge_gaps(pieces: Sequence[PlacedLog]) -> Ints:
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


def _merge_group(pieces: Sequence[PlacedLog], begin: int, stop_at: int | None) -> Ints:
    """Return the gaps of logs that share axes, from `begin` on and up to `stop_at` if given."""
    tables: list[Ints] = []
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


Log = TypeVar("Log")


def group_axes(logs: Sequence[Log], axes: Iterable[Sequence[str]]) -> list[list[Log]]:
    """Group logs by their axes: logs of one group share axes, directly or through other logs.

    The groups are in the order of their first axes.

    Examples
    --------
    >>> group_axes("abcd", [["z"], ["x", "y"], ["z"], ["y"]])
    [['b', 'd'], ['a', 'c']]
    """
    groups: list[tuple[set[str], list[int]]] = []
    for number, log_axes in enumerate(axes):
        sharing_groups = [group for group in groups if group[0] & set(log_axes)]
        groups = [group for group in groups if group not in sharing_groups]
        members = sorted([number, *(member for group in sharing_groups for member in group[1])])
        groups.append((set(log_axes).union(*(group[0] for group in sharing_groups)), members))
    ordered = sorted(groups, key=lambda group: sorted(group[0]))
    return [[logs[number] for number in members] for _, members in ordered]


def split_axes(raw: xr.Dataset) -> list[xr.Dataset]:
    """Split a raw log whose groups of axes have separate stamps into one raw log for each group.

    Its attribute ``axis_rows`` lists axes, first row and row after the last of each group.
    `SchemaError` when rows were selected from the log after it was read.
    """
    groups = raw.attrs.get("axis_rows")
    if groups is None:
        return [raw]
    if int(groups[-1][2]) != raw.sizes["row"]:
        raise SchemaError(
            "the rows of this raw log were selected after it was read; regularise the whole, and "
            "select from the regular log"
        )
    return [_select_group(raw, *group, is_first=not number) for number, group in enumerate(groups)]


def _select_group(
    raw: xr.Dataset, axes: Sequence[str], first: int, end: int, *, is_first: bool
) -> xr.Dataset:
    """Return some axes and rows of a raw log; channels with separate stamps if they come first."""
    name, places = signal_name(raw), [str(axis) for axis in raw["axis"].values]
    signal = raw[name]
    rows = [select_part(signal.data, places.index(axis), first, end) for axis in axes]
    columns: dict[Any, Any] = {
        name: (("axis", "row"), stack_rows(rows), signal.attrs, signal.encoding)
    }
    for key, column in raw.variables.items():
        if column.dims == ("row",):
            part = select_part(column.data, None, first, end)
            columns[key] = ("row", part, column.attrs, column.encoding)
    files = zip(texts(raw, "source_files"), np.atleast_1d(raw.attrs["row_start"]), strict=True)
    own_files = [(file, int(start) - first) for file, start in files if first <= start < end]
    attrs = {key: value for key, value in raw.attrs.items() if key != "axis_rows"}
    attrs |= {"source_files": [file for file, _ in own_files]}
    attrs |= {"row_start": [start for _, start in own_files]}
    if not is_first:
        attrs |= {"notes": [], "history": "", "unreadable_rows": 0, "unreadable_cells": 0}
    others = raw.drop_dims(["axis", "row"]) if is_first else xr.Dataset()
    group = others.assign(columns).assign_coords(axis=list(axes))
    group.attrs = attrs
    return group.set_coords({"time"} & set(columns))
