"""Place samples of several arrays on one grid, as a lazy array."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.store.lazy import RowSource, find_source, make_dask, read_into

#: An array (time), or (axis, time) with the row to read, and its runs: first sample of the grid,
#: first of the array, length.
PlacedArray = tuple[Any, int | None, Ints]
#: One run, as above.
Run = tuple[int, int, int]

_MIN_CHUNK_SAMPLES, _MAX_CHUNK_SAMPLES = 2**16, 2**22
#: Samples of an array that are read at once where a gap of the grid divides them; bounds memory.
_READ_AHEAD_SAMPLES = 2**16


def chunk_of(arrays: Sequence[Any]) -> int:
    """Return the most common chunk length of the arrays, within bounds [samples]."""
    lengths = Counter(
        length
        for array in arrays
        for length in getattr(array, "chunks", [[array.shape[-1]]])[-1][:1]
    )
    return int(np.clip(lengths.most_common(1)[0][0], _MIN_CHUNK_SAMPLES, _MAX_CHUNK_SAMPLES))


def place_in_memory(array: Array, runs: Ints, size: int) -> Floats:
    """Place the runs of one array (..., sample) on a grid in memory, NaN where it has no sample."""
    out = np.full((*array.shape[:-1], size), np.nan)
    length = runs[:, 2]
    within = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
    samples, rows = (np.repeat(runs[:, column], length) + within for column in (0, 1))
    out[..., samples] = array[..., rows]
    return out


def place_array(
    array: Any,
    runs: Ints,
    size: int,
    chunk: int,
    *,
    most_in_memory: int,
    convert: Callable[[Floats], None] | None = None,
) -> Any:
    """Place one array (..., sample) on a grid: up to so many numbers in memory, else lazily.

    The other parameters are those of `place_on_grid`.
    """
    lead = array.shape[:-1]
    if size * math.prod(lead) <= most_in_memory:
        out = place_in_memory(np.asarray(array), runs, size)
        if convert is not None:
            convert(out)
        return out
    placed = [[(array, row if lead else None, runs)] for row in range(math.prod(lead))]
    return place_on_grid(placed, size, chunk, flat=not lead, convert=convert)


class GridSource(RowSource):
    """Arrays placed on one grid; the parameters are those of `place_on_grid`."""

    dtype = np.dtype(np.float64)

    def __init__(
        self,
        rows: Sequence[Sequence[PlacedArray]],
        shape: tuple[int, ...],
        convert: Callable[[Floats], None] | None,
    ):
        # the sources alone: dask arrays around them are slow to look into and to send
        self.rows = [
            [(find_source(array) or array, row, runs) for array, row, runs in parts]
            for parts in rows
        ]
        self.shape, self.convert = shape, convert
        self.parts = [array for parts in self.rows for array, _, _ in parts]

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read samples of one row from `begin` on into `out`; the first that is not NaN counts."""
        end, done = begin + out.size, 0
        parts = [(array, own, clip_runs(runs, begin, end)) for array, own, runs in self.rows[row]]
        parts = [part for part in parts if part[2]]
        if len(parts) != 1 or parts[0][2][0][2] < out.size:
            out[:] = np.nan
        for array, own_row, runs in parts:
            for group in _group_runs(array, runs):
                (at, low, length), last_run = group[0], group[-1]
                if len(group) == 1 and at >= done:
                    read_into(array, own_row or 0, low, out[at : at + length])
                else:
                    values = np.empty(last_run[1] + last_run[2] - low)
                    read_into(array, own_row or 0, low, values)
                    for at, first, length in group:
                        place, read = out[at : at + length], values[first - low :][:length]
                        np.copyto(place, read, where=np.isnan(place))
                done = max(done, last_run[0] + last_run[2])
        if self.convert is not None:
            self.convert(out)


def place_on_grid(
    rows: Sequence[Sequence[PlacedArray]],
    size: int,
    chunk: int,
    *,
    flat: bool = False,
    convert: Callable[[Floats], None] | None = None,
) -> Any:
    """Place arrays on one grid, float64, NaN where no array has a sample.

    `rows` lists the arrays of each row of the result; where they overlap, the first value that is
    not NaN counts. A `flat` result has one dimension only; `convert` changes samples of a row in
    place.
    """
    source = GridSource(rows, (size,) if flat else (len(rows), size), convert)
    return make_dask(source, chunk if flat else (1, chunk))


def _group_runs(array: Any, runs: Sequence[Run]) -> Iterator[Sequence[Run]]:
    """Group the runs to read at once: short ones that follow each other in a file.

    Each slice of a file takes milliseconds, and a log with many gaps has many runs.
    """
    begin = 0
    for stop in range(1, len(runs) + 1):
        if stop < len(runs) and not isinstance(array, np.ndarray):
            end, (_, first, length) = runs[stop - 1][1] + runs[stop - 1][2], runs[stop]
            if first == end and end + length - runs[begin][1] <= _READ_AHEAD_SAMPLES:
                continue
        yield runs[begin:stop]
        begin = stop


def clip_runs(runs: Ints, begin: int, end: int) -> list[Run]:
    """Return the parts of runs in a range of the grid, by their offset after `begin`."""
    low = np.searchsorted(runs[:, 0] + runs[:, 2], begin, side="right")
    high = np.searchsorted(runs[:, 0], end, side="left")
    clipped = []
    for sample, at_source, length in runs[low:high].tolist():
        a, b = max(sample, begin), min(sample + length, end)
        clipped.append((a - begin, at_source + a - sample, b - a))
    return clipped
