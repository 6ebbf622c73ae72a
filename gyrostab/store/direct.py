"""Samples of a lazy log straight from where they lie into the array that a kernel takes, with no task of dask in between."""

from __future__ import annotations

import uuid
from bisect import bisect_right
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Fill",
    "can_fill",
    "cut",
    "end_to_end",
    "fill_row",
    "held",
    "one_row",
    "stack_rows",
    "stretch",
    "with_fill",
]

#: ``fill(row, begin, out)`` puts the samples of a row from `begin` on into `out`; the row of an
#: array of one dimension is 0.
Fill = Callable[[int, int, NDArray[Any]], None]


def with_fill(array: Any, fill: Fill) -> Any:
    """Let a dask array know how its samples are read directly; whatever is derived from it does not."""
    array.gyrostab_fill = fill
    return array


def can_fill(array: Any) -> bool:
    """Whether `fill_row` reads an array without dask."""
    return isinstance(array, np.ndarray) or hasattr(array, "gyrostab_fill")


def fill_row(array: Any, row: int, begin: int, out: NDArray[Any]) -> None:
    """Put samples of one row of an array into `out`, in the calling thread.

    Parameters
    ----------
    array : ndarray or dask.array.Array, shape (time,) or (row, time)
        Where the samples are.
    row : int
        The row; 0 where there is one dimension.
    begin : int
        First sample.
    out : ndarray
        Filled with as many samples as there is room for.
    """
    fill: Fill | None = getattr(array, "gyrostab_fill", None)
    if fill is not None:
        fill(row, begin, out)
        return
    place = slice(begin, begin + out.size)
    part = array[place] if array.ndim == 1 else array[row, place]
    out[:] = part if isinstance(part, np.ndarray) else part.compute(scheduler="synchronous")


def stretch(array: Any, begin: int, end: int) -> NDArray[Any]:
    """Samples from `begin` to `end` along the last dimension of an array, read in the calling thread.

    Examples
    --------
    >>> stretch(held(np.arange(10.0), 4), 3, 6)
    array([3., 4., 5.])
    """
    if isinstance(array, np.ndarray):
        return array[..., begin:end]
    if not can_fill(array):
        part = array[..., begin:end]
        return np.asarray(
            part.compute(scheduler="synchronous") if hasattr(part, "compute") else part
        )
    out = np.empty((*array.shape[:-1], end - begin), array.dtype)
    for row, line in enumerate(out if array.ndim > 1 else [out]):
        fill_row(array, row, begin, line)
    return out


def held(array: NDArray[Any], chunk: int) -> Any:
    """An array in memory as one of dask that is read directly; `dask.array.from_array` would copy all of it."""
    import dask.array as da

    name, lead = f"gyrostab-held-{uuid.uuid4().hex}", array.ndim - 1
    begins = range(0, max(array.shape[-1], 1), chunk)
    tasks = {
        (name, *(0,) * lead, number): array[..., begin : begin + chunk]
        for number, begin in enumerate(begins)
    }
    chunks = (
        *((size,) for size in array.shape[:-1]),
        tuple(min(chunk, array.shape[-1] - begin) for begin in begins),
    )
    return with_fill(da.Array(tasks, name, chunks, dtype=array.dtype), partial(fill_row, array))


def end_to_end(columns: Sequence[Any], chunk: int) -> Any:
    """Columns, in memory or of dask, one after the other; of dask where one of them is, and read directly where all can be."""
    if all(isinstance(column, np.ndarray) for column in columns):
        return np.concatenate(columns)
    import dask.array as da

    joined = da.concatenate(
        [held(column, chunk) if isinstance(column, np.ndarray) else column for column in columns]
    )
    if not all(can_fill(column) and column.dtype == joined.dtype for column in columns):
        return joined
    edges = np.cumsum([0, *(len(column) for column in columns)]).tolist()
    return with_fill(joined, partial(_fill_pieces, list(columns), edges))


def _fill_pieces(
    columns: Sequence[Any], edges: Sequence[int], row: int, begin: int, out: NDArray[Any]
) -> None:
    done, piece = 0, bisect_right(edges, begin) - 1
    while done < out.size:
        most = edges[piece + 1] - begin - done
        place = out[done : done + most]
        fill_row(columns[piece], row, begin + done - edges[piece], place)
        done, piece = done + place.size, piece + 1


def stack_rows(rows: Sequence[Any]) -> Any:
    """Arrays of dask of one dimension as the rows of one, read directly where all can be."""
    import dask.array as da

    stacked = da.stack(rows)
    return (
        with_fill(stacked, partial(_fill_one, list(rows))) if all(map(can_fill, rows)) else stacked
    )


def _fill_one(rows: Sequence[Any], row: int, begin: int, out: NDArray[Any]) -> None:
    fill_row(rows[row], 0, begin, out)


def one_row(array: Any, row: int) -> Any:
    """One row of an array as an array of one dimension, which is read directly where the whole can be."""
    line = array[row]
    return (
        with_fill(line, partial(_fill_of, array, row)) if hasattr(array, "gyrostab_fill") else line
    )


def _fill_of(array: Any, row: int, _row: int, begin: int, out: NDArray[Any]) -> None:
    fill_row(array, row, begin, out)


def cut(array: Any, begin: int, end: int) -> Any:
    """Return samples `begin` to `end` of an array, along its last dimension, read directly where the whole can be."""
    part = array[..., begin:end]
    return (
        with_fill(part, partial(_fill_cut, array, begin))
        if hasattr(array, "gyrostab_fill")
        else part
    )


def _fill_cut(array: Any, first: int, row: int, begin: int, out: NDArray[Any]) -> None:
    fill_row(array, row, first + begin, out)
