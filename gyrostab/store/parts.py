"""Parts of an array of any number of dimensions straight from where they lie: dask takes ten times as long over one small part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

__all__ = ["Part", "read_part", "transposed", "with_part"]

#: ``part(place)`` gives the values of an array at a tuple of slices, one for each dimension, each
#: with both its ends.
Part = Callable[[tuple[slice, ...]], NDArray[Any]]


def with_part(array: Any, part: Part) -> Any:
    """Let a dask array know how a part of it is read directly; of what is derived from it only `transposed` does."""
    array.gyrostab_part = part
    return array


def transposed(variable: xr.Variable, dims: Sequence[Any]) -> xr.Variable:
    """A variable with its dimensions in another order; its parts are read directly if they were before."""
    part: Part | None = getattr(variable._data, "gyrostab_part", None)
    turned = variable.transpose(*dims)
    if part is not None:
        with_part(turned._data, partial(_turned, part, [variable.dims.index(dim) for dim in dims]))
    return turned


def _turned(part: Part, order: Sequence[int], place: tuple[slice, ...]) -> NDArray[Any]:
    before = dict(zip(order, place, strict=True))
    return part(tuple(before[i] for i in range(len(order)))).transpose(order)


def read_part(array: Any, place: Sequence[slice]) -> NDArray[Any]:
    """Read the values of an array, in memory or of dask, at one slice for each dimension, in the calling thread.

    Examples
    --------
    >>> read_part(np.arange(12).reshape(3, 4), (slice(1, 3), slice(0, 2)))
    array([[4, 5],
           [8, 9]])
    """
    ends = tuple(slice(*one.indices(size)) for one, size in zip(place, array.shape, strict=True))
    part: Part | None = getattr(array, "gyrostab_part", None)
    if part is not None:
        return part(ends)
    found = array[ends]
    return (
        found
        if isinstance(found, np.ndarray)
        else np.asarray(found.compute(scheduler="synchronous"))
    )
