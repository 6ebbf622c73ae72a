"""Lazy reading: slices of a dask array read into memory without a task of dask.

An array may carry a reader of rows along time (`read_into`, `read_slice`) or a reader of boxes in
any dimensions (`read_box`). For one small slice, dask takes ten times as long.
"""

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

#: ``read(row, begin, out)`` reads the samples of a row from `begin` on into `out`; the row of an
#: array of one dimension is 0.
RowReader = Callable[[int, int, NDArray[Any]], None]


def with_row_reader(array: Any, reader: RowReader) -> Any:
    """Attach a row reader to a dask array; arrays that are derived from it do not carry it."""
    array.gyrostab_row_reader = reader
    return array


def can_read_into(array: Any) -> bool:
    """Whether `read_into` reads an array without dask."""
    return isinstance(array, np.ndarray) or hasattr(array, "gyrostab_row_reader")


def read_into(array: Any, row: int, begin: int, out: NDArray[Any]) -> None:
    """Read samples of one row of an array into `out`, in the calling thread.

    Parameters
    ----------
    array : ndarray or dask.array.Array, shape (time,) or (row, time)
        The source.
    row : int
        The row; 0 for an array of one dimension.
    begin : int
        First sample.
    out : ndarray
        Receives as many samples as it has elements.
    """
    reader: RowReader | None = getattr(array, "gyrostab_row_reader", None)
    if reader is not None:
        reader(row, begin, out)
        return
    place = slice(begin, begin + out.size)
    part = array[place] if array.ndim == 1 else array[row, place]
    out[:] = part if isinstance(part, np.ndarray) else part.compute(scheduler="synchronous")


def read_slice(array: Any, begin: int, end: int) -> NDArray[Any]:
    """Read samples `begin` to `end` along the last dimension of an array, in the calling thread.

    Examples
    --------
    >>> read_slice(make_lazy(np.arange(10.0), 4), 3, 6)
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
    """Wrap an array in memory as a dask array; `dask.array.from_array` would copy all of it."""
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
    """Concatenate columns, in memory or of dask; the result is a dask array if one of them is.

    It has a row reader when all columns have one.
    """
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
    """Stack dask arrays of one dimension as rows, with a row reader when all have one."""
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
    """Select one row of an array; the result keeps the row reader."""
    line = array[row]
    return (
        with_row_reader(line, partial(_read_selected_into, array, row))
        if hasattr(array, "gyrostab_row_reader")
        else line
    )


def _read_selected_into(array: Any, row: int, _row: int, begin: int, out: NDArray[Any]) -> None:
    read_into(array, row, begin, out)


def select_span(array: Any, begin: int, end: int) -> Any:
    """Select samples `begin` to `end` along the last dimension; the result keeps the row reader."""
    part = array[..., begin:end]
    return (
        with_row_reader(part, partial(_read_span_into, array, begin))
        if hasattr(array, "gyrostab_row_reader")
        else part
    )


def _read_span_into(array: Any, first: int, row: int, begin: int, out: NDArray[Any]) -> None:
    read_into(array, row, first + begin, out)


#: ``read(box)`` returns the values of an array in a box: one slice per dimension, each with start
#: and stop.
BoxReader = Callable[[tuple[slice, ...]], NDArray[Any]]


def with_box_reader(array: Any, reader: BoxReader) -> Any:
    """Attach a box reader to a dask array; of derived arrays only `transpose_lazy` keeps it."""
    array.gyrostab_box_reader = reader
    return array


def transpose_lazy(variable: xr.Variable, dims: Sequence[Any]) -> xr.Variable:
    """Transpose a variable and keep its box reader."""
    reader: BoxReader | None = getattr(variable._data, "gyrostab_box_reader", None)
    turned = variable.transpose(*dims)
    if reader is not None:
        with_box_reader(
            turned._data,
            partial(_read_transposed, reader, [variable.dims.index(dim) for dim in dims]),
        )
    return turned


def _read_transposed(
    reader: BoxReader, order: Sequence[int], box: tuple[slice, ...]
) -> NDArray[Any]:
    before = dict(zip(order, box, strict=True))
    return reader(tuple(before[i] for i in range(len(order)))).transpose(order)


def read_box(array: Any, box: Sequence[slice]) -> NDArray[Any]:
    """Read the values of an array in a box, one slice per dimension, in the calling thread.

    Examples
    --------
    >>> read_box(np.arange(12).reshape(3, 4), (slice(1, 3), slice(0, 2)))
    array([[4, 5],
           [8, 9]])
    """
    ends = tuple(slice(*part.indices(size)) for part, size in zip(box, array.shape, strict=True))
    reader: BoxReader | None = getattr(array, "gyrostab_box_reader", None)
    if reader is not None:
        return reader(ends)
    found = array[ends]
    return (
        found
        if isinstance(found, np.ndarray)
        else np.asarray(found.compute(scheduler="synchronous"))
    )
