"""Place samples of several arrays on one grid, as a dask array with one task for each chunk."""

from __future__ import annotations

import uuid
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.store.lazy_slices import can_read_into, read_into, with_row_reader

__all__ = ["PlacedArray", "chunk_of", "place_on_grid", "read_parts_into"]

#: An array (time), or (axis, time) with the row to read, and its runs: first sample of the grid,
#: first of the array, length.
PlacedArray = tuple[Any, int | None, NDArray[np.int64]]

_MIN_CHUNK_SAMPLES, _MAX_CHUNK_SAMPLES = 2**16, 2**22


def chunk_of(arrays: Sequence[Any]) -> int:
    """Return the most common chunk length of the arrays, within bounds [samples]."""
    lengths = Counter(
        length
        for array in arrays
        for length in getattr(array, "chunks", [[array.shape[-1]]])[-1][:1]
    )
    return int(np.clip(lengths.most_common(1)[0][0], _MIN_CHUNK_SAMPLES, _MAX_CHUNK_SAMPLES))


def _fill_chunk(
    size: int, lead: int, blocks: list[Any], spec: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Make one chunk: each line of `spec` places a slice of a block; the first counts."""
    out = np.full(size, np.nan)
    for which, row, begin, at, length, shared in spec.tolist():
        block = np.asarray(blocks[which])
        values = (block if row < 0 else block[row])[begin : begin + length]
        if shared:
            here = out[at : at + length]
            np.copyto(here, values, where=np.isnan(here))
        else:
            out[at : at + length] = values
    return out.reshape((1,) * lead + (size,))


class _RowBlocks:
    """Location of the samples of one row of an array in its dask blocks."""

    def __init__(self, part: PlacedArray):
        import dask.array as da

        array, row, runs = part
        self.array = (
            array
            if isinstance(array, da.Array)
            else da.from_array(array, chunks=(*(1,) * (array.ndim - 1), _MAX_CHUNK_SAMPLES))
        )
        self.edges = np.concatenate([[0], np.cumsum(self.array.chunks[-1])])
        self.row = -1
        self.lead: tuple[int, ...] = ()
        if row is not None:
            above = np.concatenate([[0], np.cumsum(self.array.chunks[0])])
            block = bisect_right(above.tolist(), row) - 1
            self.row, self.lead = row - int(above[block]), (block,)
        self.runs = runs
        self.first, self.end = int(runs[0, 0]), int(runs[-1, 0] + runs[-1, 2])

    def slices(self, begin: int, end: int) -> list[tuple[tuple[Any, ...], int, int, int]]:
        """Return block key, first sample in it, first grid sample and length of slices."""
        found = []
        low = np.searchsorted(self.runs[:, 0] + self.runs[:, 2], begin, side="right")
        high = np.searchsorted(self.runs[:, 0], end, side="left")
        for sample, own, length in self.runs[low:high].tolist():
            a, b = max(sample, begin), min(sample + length, end)
            at = own + a - sample
            while a < b:
                block = bisect_right(self.edges, at) - 1
                n = min(b - a, int(self.edges[block + 1]) - at)
                found.append(
                    ((self.array.name, *self.lead, block), at - int(self.edges[block]), a, n)
                )
                a, at = a + n, at + n
        return found


def place_on_grid(
    rows: Sequence[Sequence[PlacedArray]], size: int, chunk: int, *, flat: bool = False
) -> Any:
    """Place arrays on one grid, float64, NaN where no array has a sample.

    Parameters
    ----------
    rows : sequence of sequence of Part
        Arrays with samples of each row of the result. Where they overlap, the first value that is
        not NaN counts.
    size : int
        Samples of the grid.
    chunk : int
        Samples of a chunk of the result.
    flat : bool
        Whether the result has one dimension only.

    Returns
    -------
    dask.array.Array, shape (len(rows), size) or (size,)
        Its graph has one task for each chunk in addition to the tasks of the arrays.
        `gyrostab.store.lazy_slices.read_into` reads it without the graph if it can read the arrays.
    """
    import dask.array as da
    from dask.highlevelgraph import HighLevelGraph

    name, lead = f"gyrostab-join-{uuid.uuid4().hex}", 0 if flat else 1
    lengths = tuple(min(chunk, size - begin) for begin in range(0, size, chunk))
    layer: dict[Any, Any] = {}
    sources: dict[str, Any] = {}
    for number, parts in enumerate(rows):
        placed = [_RowBlocks(part) for part in parts]
        sources.update({entry.array.name: entry.array for entry in placed})
        first = np.array([entry.first for entry in placed], dtype=np.int64)
        end = np.array([entry.end for entry in placed], dtype=np.int64)
        for place, length in enumerate(lengths):
            begin = place * chunk
            keys: dict[Any, int] = {}
            spec: list[tuple[int, ...]] = []
            for which in np.flatnonzero((first < begin + length) & (end > begin)):
                earlier = spec.copy()  # the runs of one part do not overlap
                for key, at, sample, n in placed[which].slices(begin, begin + length):
                    shared = any(
                        sample - begin < s[3] + s[4] and s[3] < sample - begin + n for s in earlier
                    )
                    spec.append(
                        (
                            keys.setdefault(key, len(keys)),
                            placed[which].row,
                            at,
                            sample - begin,
                            n,
                            int(shared),
                        )
                    )
            task = (
                _fill_chunk,
                length,
                lead,
                list(keys),
                np.array(spec, dtype=np.int64).reshape(-1, 6),
            )
            layer[(name, place) if flat else (name, number, place)] = task
    graph = HighLevelGraph.from_collections(name, layer, dependencies=list(sources.values()))
    chunks = (lengths,) if flat else ((1,) * len(rows), lengths)
    joined = da.Array(graph, name, chunks, dtype=np.float64)
    if not all(can_read_into(array) for parts in rows for array, _, _ in parts):
        return joined
    return with_row_reader(joined, partial(read_parts_into, rows))


def read_parts_into(
    rows: Sequence[Sequence[PlacedArray]], row: int, begin: int, out: NDArray[np.float64]
) -> None:
    """Read samples of one row from `begin` on into `out`, with the result of `place_on_grid`."""
    found = [
        (number, *entry)
        for number, part in enumerate(rows[row])
        for entry in _overlapping_runs(part, begin, begin + out.size)
    ]
    ends = sorted((at, at + length) for *_, at, length in found)
    if any(stop > start for (_, stop), (start, _) in pairwise(ends)):
        out[:] = np.nan  # overlaps are filled where NaN
    else:
        for (_, stop), (start, _) in pairwise([(0, 0), *ends, (out.size, 0)]):
            out[stop:start] = np.nan
    taken: dict[int, list[tuple[int, int]]] = {}  # by part: the runs of one part do not overlap
    for number, array, own_row, own, at, length in found:
        here = out[at : at + length]
        earlier = (run for other, runs in taken.items() if other != number for run in runs)
        if any(at < stop and start < at + length for start, stop in earlier):
            values = np.empty(length)
            read_into(array, own_row, own, values)
            np.copyto(here, values, where=np.isnan(here))
        else:
            read_into(array, own_row, own, here)
        taken.setdefault(number, []).append((at, at + length))


def _overlapping_runs(
    part: PlacedArray, begin: int, end: int
) -> list[tuple[Any, int, int, int, int]]:
    """Return array, row, first array sample, offset after `begin` and length of runs in a range."""
    array, row, runs = part
    low = np.searchsorted(runs[:, 0] + runs[:, 2], begin, side="right")
    high = np.searchsorted(runs[:, 0], end, side="left")
    found = []
    for sample, own, length in runs[low:high].tolist():
        a, b = max(sample, begin), min(sample + length, end)
        found.append((array, row or 0, own + a - sample, a - begin, b - a))
    return found
