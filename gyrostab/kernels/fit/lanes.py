"""Problems side by side: eight as vectors of LLVM, or one where these cannot be built."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER

__all__ = ["PLACES", "eights", "number", "put", "root", "take", "take_four", "where_above"]

try:
    from gyrostab.kernels.fit.eights import PLACES, eights, put, root, take, where_above
except (ImportError, AttributeError):  # numba or llvmlite has moved what the vectors are built with
    PLACES = 1

    @njit(**INNER)
    def eights(n):  # type: ignore[no-untyped-def]
        """Zeros (n, 1)."""
        return np.zeros((n, PLACES))

    @njit(**INNER)
    def take(array, index):  # type: ignore[no-untyped-def]
        """Number `index` of an array of `eights`."""
        return array[index, 0]

    @njit(**INNER)
    def put(array, index, value):  # type: ignore[no-untyped-def]
        """Write a number to place `index` of an array of `eights`."""
        array[index, 0] = value

    @njit(**INNER)
    def root(value):  # type: ignore[no-untyped-def]
        """Square root."""
        return math.sqrt(value)

    @njit(**INNER)
    def where_above(x, y, yes, no):  # type: ignore[no-untyped-def]
        """`yes` where ``x > y``, otherwise `no`, even where x or y is NaN."""
        return yes if x > y else no


@njit(**INNER)
def number(array, index):  # type: ignore[no-untyped-def]
    """Load element `index` of a flat array, without the test for negative indices."""
    return array[np.uint64(index)]


@njit(**INNER)
def take_four(array, index, apart):  # type: ignore[no-untyped-def]
    """Take the numbers `index`, ``index + apart`` and so on of an array of `eights`."""
    return (
        take(array, index),
        take(array, index + apart),
        take(array, index + 2 * apart),
        take(array, index + 3 * apart),
    )
