"""Conversion of multiples of one factor to integer counts and back, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def to_counts(
    values: NDArray[np.floating[Any]], scale: float, dtype: Any, fill: int
) -> NDArray[np.integer[Any]] | None:
    """Find integers from which ``from_counts`` makes these values (except the sign of zero).

    Parameters
    ----------
    values : ndarray of float64
        Values, NaN where missing.
    scale : float
        Factor.
    dtype : dtype
        Integer type of the counts.
    fill : int
        Count for NaN.

    Examples
    --------
    >>> to_counts(np.array([0.1, np.nan, 0.1 * 3]), 0.1, "i2", -32767)
    array([     1, -32767,      3], dtype=int16)
    >>> to_counts(np.array([0.1, 0.3]), 0.1, "i2", -32767) is None  # 3 * 0.1 is another double
    True
    """
    limits = np.iinfo(dtype)
    missing = np.isnan(values)
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = np.rint(values / scale)
        rounded[missing] = fill
        if not ((rounded >= limits.min) & (rounded <= limits.max)).all():
            return None
    counts = rounded.astype(dtype)
    same = counts * np.float64(scale) == values
    same &= counts != fill
    same |= missing
    return counts if same.all() else None


def from_counts(
    counts: NDArray[np.integer[Any]],
    scale: float,
    fill: int,
    *,
    out: NDArray[np.floating[Any]] | None = None,
) -> NDArray[np.floating[Any]]:
    """Multiply counts by their factor, NaN for `fill`, into `out` or a new array of doubles.

    Examples
    --------
    >>> from_counts(np.array([1, -32767, 3], dtype="i2"), 0.1, -32767)
    array([0.1, nan, 0.3])
    """
    values = np.empty(counts.shape) if out is None else out
    np.multiply(counts, np.float64(scale), out=values)
    np.copyto(values, np.nan, where=counts == fill)
    return values
