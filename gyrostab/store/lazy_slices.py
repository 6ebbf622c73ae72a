"""Samples of a lazy log straight from where they lie into the array that a kernel takes, with no task of dask in between."""

from __future__ import annotations

import uuid
from bisect import bisect_right
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

__all__ = [
    "BoxReader",
    "RowReader",
    "can_read_into",
    "concatenate_columns",
    "make_lazy",
    "read_box",
    "read_into",
    "read_slice",
    "select_row",
    "select_span",
    "stack_rows",
    "transpose_lazy",
    "with_box_reader",
    "with_row_reader",
]

#: ``fill(row, begin, out)`` puts the samples of a row from `begin` on into `out`; the row of an
#: array of one dimension is 0.
RowReader = Callable[[int, int, NDArray[Any]], None]


def with_row_reader(array: Any, fill: RowReader) -> Any:
    """Let a dask array know how its samples are read directly; whatever is derived from it does not."""
    array.gyrostab_row_reader = fill
    return array


def can_read_into(array: Any) -> bool:
    """Whether `read_into` reads an array without dask."""
    return isinstance(array, np.ndarray) or hasattr(array, "gyrostab_row_reader")


def read_into(array: Any, row: int, begin: int, out: NDArray[Any]) -> None:
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
    fill: RowReader | None = getattr(array, "gyrostab_row_reader", None)
    if fill is not None:
        fill(row, begin, out)
        return
    place = slice(begin, begin + out.size)
    part = array[place] if array.ndim == 1 else array[row, place]
    out[:] = part if isinstance(part, np.ndarray) else part.compute(scheduler="synchronous")


def read_slice(array: Any, begin: int, end: int) -> NDArray[Any]:
    """Samples from `begin` to `end` along the last dimension of an array, read in the calling thread.

    Examples
    --------
    >>> stretch(held(np.arange(10.0), 4), 3, 6)
    array([3., 4., 5.])
    """
    if isinstance(array, np.ndarray):
        return array[..., begin:end]
    if not can_read_into(array):
        part = array[..., begin:end]
        return np.asarray(
            part.compute(scheduler="synchronous") if hasattr(part, "compute") else part
        )
    out = np.empty((*array.shape[:-1], end - begin), array.dtype)
    for row, line in enumerate(out if array.ndim > 1 else [out]):
        read_into(array, row, begin, line)
    return out


def make_lazy(array: NDArray[Any], chunk: int) -> Any:
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
    return with_row_reader(
        da.Array(tasks, name, chunks, dtype=array.dtype), partial(read_into, array)
    )


def concatenate_columns(columns: Sequence[Any], chunk: int) -> Any:
    """Columns, in memory or of dask, one after the other; of dask where one of them is, and read directly where all can be."""
    if all(isinstance(column, np.ndarray) for column in columns):
        return np.concatenate(columns)
    import dask.array as da

    joined = da.concatenate(
        [
            make_lazy(column, chunk) if isinstance(column, np.ndarray) else column
            for column in columns
        ]
    )
    if not all(can_read_into(column) and column.dtype == joined.dtype for column in columns):
        return joined
    edges = np.cumsum([0, *(len(column) for column in columns)]).tolist()
    return with_row_reader(joined, partial(_read_columns_into, list(columns), edges))


def _read_columns_into(
    columns: Sequence[Any], edges: Sequence[int], row: int, begin: int, out: NDArray[Any]
) -> None:
    done, piece = 0, bisect_right(edges, begin) - 1
    while done < out.size:
        most = edges[piece + 1] - begin - done
        place = out[done : done + most]
        read_into(columns[piece], row, begin + done - edges[piece], place)
        done, piece = done + place.size, piece + 1


def stack_rows(rows: Sequence[Any]) -> Any:
    """Arrays of dask of one dimension as the rows of one, read directly where all can be."""
    import dask.array as da

    stacked = da.stack(rows)
    return (
        with_row_reader(stacked, partial(_read_stacked_into, list(rows)))
        if all(map(can_read_into, rows))
        else stacked
    )


def _read_stacked_into(rows: Sequence[Any], row: int, begin: int, out: NDArray[Any]) -> None:
    read_into(rows[row], 0, begin, out)


def select_row(array: Any, row: int) -> Any:
    """One row of an array as an array of one dimension, which is read directly where the whole can be."""
    line = array[row]
    return (
        with_row_reader(line, partial(_read_selected_into, array, row))
        if hasattr(array, "gyrostab_row_reader")
        else line
    )


def _read_selected_into(array: Any, row: int, _row: int, begin: int, out: NDArray[Any]) -> None:
    read_into(array, row, begin, out)


def select_span(array: Any, begin: int, end: int) -> Any:
    """Return samples `begin` to `end` of an array, along its last dimension, read directly where the whole can be."""
    part = array[..., begin:end]
    return (
        with_row_reader(part, partial(_read_span_into, array, begin))
        if hasattr(array, "gyrostab_row_reader")
        else part
    )


def _read_span_into(array: Any, first: int, row: int, begin: int, out: NDArray[Any]) -> None:
    read_into(array, row, first + begin, out)


#: ``part(place)`` gives the values of an array at a tuple of slices, one for each dimension, each
#: with both its ends.
BoxReader = Callable[[tuple[slice, ...]], NDArray[Any]]


def with_box_reader(array: Any, part: BoxReader) -> Any:
    """Let a dask array know how a part of it is read directly; of what is derived from it only `transpose_lazy` does."""
    array.gyrostab_box_reader = part
    return array


def transpose_lazy(variable: xr.Variable, dims: Sequence[Any]) -> xr.Variable:
    """A variable with its dimensions in another order; its parts are read directly if they were before."""
    part: BoxReader | None = getattr(variable._data, "gyrostab_box_reader", None)
    turned = variable.transpose(*dims)
    if part is not None:
        with_box_reader(
            turned._data,
            partial(_read_transposed, part, [variable.dims.index(dim) for dim in dims]),
        )
    return turned


def _read_transposed(
    part: BoxReader, order: Sequence[int], place: tuple[slice, ...]
) -> NDArray[Any]:
    before = dict(zip(order, place, strict=True))
    return part(tuple(before[i] for i in range(len(order)))).transpose(order)


def read_box(array: Any, place: Sequence[slice]) -> NDArray[Any]:
    """Read the values of an array, in memory or of dask, at one slice for each dimension, in the calling thread.

    Examples
    --------
    >>> read_part(np.arange(12).reshape(3, 4), (slice(1, 3), slice(0, 2)))
    array([[4, 5],
           [8, 9]])
    """
    ends = tuple(slice(*one.indices(size)) for one, size in zip(place, array.shape, strict=True))
    part: BoxReader | None = getattr(array, "gyrostab_box_reader", None)
    if part is not None:
        return part(ends)
    found = array[ends]
    return (
        found
        if isinstance(found, np.ndarray)
        else np.asarray(found.compute(scheduler="synchronous"))
    )
