"""Place samples of several arrays on one grid, as a lazy array."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.store.lazy import RowSource, can_read_directly, find_source, make_dask, read_into

#: An array (time), or (axis, time) with the row to read, and its runs: first sample of the grid,
#: first of the array, length.
PlacedArray = tuple[Any, int | None, NDArray[np.int64]]

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


def place_in_memory(array: NDArray[Any], runs: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    """Place the runs of one array (..., sample) on a grid in memory, NaN where it has no sample."""
    out = np.full((*array.shape[:-1], size), np.nan)
    length = runs[:, 2]
    within = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
    samples, rows = (np.repeat(runs[:, column], length) + within for column in (0, 1))
    out[..., samples] = array[..., rows]
    return out


class GridSource(RowSource):
    """Arrays placed on one grid; the parameters are those of `place_on_grid`."""

    dtype = np.dtype(np.float64)

    def __init__(
        self,
        rows: Sequence[Sequence[PlacedArray]],
        shape: tuple[int, ...],
        convert: Callable[[NDArray[np.float64]], None] | None,
    ):
        # the sources alone: dask arrays around them are slow to look into and to send
        self.rows = [
            [(find_source(array) or array, row, runs) for array, row, runs in parts]
            for parts in rows
        ]
        self.shape, self.convert = shape, convert
        self.parts = [array for parts in self.rows for array, _, _ in parts]

    def read_into(self, row: int, begin: int, out: NDArray[Any]) -> None:
        """Read samples of one row from `begin` on into `out`."""
        runs = [
            (which, *entry)
            for which, part in enumerate(self.rows[row])
            for entry in _overlapping_runs(part, begin, begin + out.size)
        ]
        _fill(out, runs)
        if self.convert is not None:
            self.convert(out)

    def has_samples(self, begin: int, end: int) -> bool:
        """Whether any row has a sample in a range of the grid."""
        return any(_overlapping_runs(part, begin, end) for row in self.rows for part in row)


def place_on_grid(
    rows: Sequence[Sequence[PlacedArray]],
    size: int,
    chunk: int,
    *,
    flat: bool = False,
    convert: Callable[[NDArray[np.float64]], None] | None = None,
) -> Any:
    """Place arrays on one grid, float64, NaN where no array has a sample.

    `rows` lists the arrays of each row of the result; where they overlap, the first value that is
    not NaN counts. A `flat` result has one dimension only; `convert` changes samples of a row in
    place. The dask array has a source if all arrays can be read without dask; otherwise, its tasks
    depend on those of the arrays.
    """
    source = GridSource(rows, (size,) if flat else (len(rows), size), convert)
    if all(map(can_read_directly, source.parts)):
        return make_dask(source, chunk if flat else (1, chunk))
    import dask.array as da

    made = [
        da.concatenate(
            [
                _chunk_of_dask(parts, begin, min(begin + chunk, size), convert)
                for begin in range(0, size, chunk)
            ]
        )
        for parts in rows
    ]
    return made[0] if flat else da.stack(made)


def _chunk_of_dask(
    parts: Sequence[PlacedArray],
    begin: int,
    end: int,
    convert: Callable[[NDArray[np.float64]], None] | None,
) -> Any:
    """Make one chunk of one row from dask arrays, by a task that depends on theirs."""
    import dask
    import dask.array as da

    pieces = []
    for part in parts:
        runs = [
            (at, first, length) for *_, first, at, length in _overlapping_runs(part, begin, end)
        ]
        if runs:
            # one slice for all runs, because each slice of a dask array takes time
            low, high = min(run[1] for run in runs), max(run[1] + run[2] for run in runs)
            line = da.asarray(part[0] if part[0].ndim == 1 else part[0][part[1] or 0])
            pieces.append((line[low:high], np.array(runs) - [0, low, 0]))
    placed = dask.delayed(_place_pieces, pure=False)(pieces, end - begin, convert)
    return da.from_delayed(placed, (end - begin,), np.float64)


def _place_pieces(
    pieces: Sequence[tuple[NDArray[Any], NDArray[np.int64]]],
    size: int,
    convert: Callable[[NDArray[np.float64]], None] | None,
) -> NDArray[np.float64]:
    parts: list[PlacedArray] = [(values, None, runs) for values, runs in pieces]
    return GridSource([parts], (size,), convert)[:]


def _fill(
    out: NDArray[np.float64],
    runs: Sequence[tuple[int, Any, int, int, int, int]],
) -> None:
    """Read runs (number of the part, array, row, first, place in `out`, length) into `out`."""
    ends = sorted((at, at + length) for *_, at, length in runs)
    overlap = any(stop > start for (_, stop), (start, _) in pairwise(ends))
    if overlap:
        out[:] = np.nan
    else:
        for (_, stop), (start, _) in pairwise([(0, 0), *ends, (out.size, 0)]):
            out[stop:start] = np.nan
    for _, array, row, at_source, at, length in _read_ahead(runs):
        place = out[at : at + length]
        if overlap:  # the first value that is not NaN counts
            values = np.empty(length)
            read_into(array, row, at_source, values)
            np.copyto(place, values, where=np.isnan(place))
        else:
            read_into(array, row, at_source, place)


def _read_ahead(
    runs: Sequence[tuple[int, Any, int, int, int, int]],
) -> Iterator[tuple[int, Any, int, int, int, int]]:
    """Yield the runs; short ones that follow each other in a file come from one slice of it.

    Each slice of a file takes milliseconds, and a log with many gaps has many runs.
    """
    begin = 0
    while begin < len(runs):
        number, array, row, source_begin, *_, length = runs[begin]
        stop, end = begin + 1, source_begin + length
        while (
            not isinstance(array, np.ndarray)
            and stop < len(runs)
            and (runs[stop][0], runs[stop][3]) == (number, end)
            and end + runs[stop][5] - source_begin <= _READ_AHEAD_SAMPLES
        ):
            end += runs[stop][5]
            stop += 1
        if stop > begin + 1:
            array, row, first = np.empty(end - source_begin), 0, source_begin
            read_into(runs[begin][1], runs[begin][2], source_begin, array)
        else:
            first = 0
        for _, _, _, at_source, at, length in runs[begin:stop]:
            yield number, array, row, at_source - first, at, length
        begin = stop


def _overlapping_runs(
    part: PlacedArray, begin: int, end: int
) -> list[tuple[Any, int, int, int, int]]:
    """Return array, row, first array sample, offset after `begin` and length of runs in a range."""
    array, row, runs = part
    low = np.searchsorted(runs[:, 0] + runs[:, 2], begin, side="right")
    high = np.searchsorted(runs[:, 0], end, side="left")
    overlapping = []
    for sample, at_source, length in runs[low:high].tolist():
        a, b = max(sample, begin), min(sample + length, end)
        overlapping.append((array, row or 0, at_source + a - sample, a - begin, b - a))
    return overlapping
