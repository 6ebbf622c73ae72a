"""Samples of a lazy log straight from where they lie into the array that a kernel takes, with no task of dask in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Fill", "can_fill", "fill_row", "with_fill"]

#: ``fill(row, begin, out)`` puts the samples of a row from `begin` on into `out`; the row of an array of one dimension is 0.
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
