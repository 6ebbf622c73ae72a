"""Least-squares trend of the rate in each window, from sums over blocks of one step."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.allan.blocks import windows_from_blocks
from gyrostab.kernels.compiled import INNER, KERNEL

__all__ = ["window_trends"]

#: Moments of a block: present samples, their places, squares of these, rates, rates times places.
_MOMENTS = 5


@njit(**INNER)
def _add_moments(x, angle, base, first, last, out):  # type: ignore[no-untyped-def]
    """Sum the moments of some samples; the rates of angles are their differences."""
    count = place = square = rate = product = 0.0
    for i in range(first, last):
        value = np.float64(x[i + 1]) - np.float64(x[i]) if angle else np.float64(x[i])
        value -= base
        if value == value:
            count += 1.0
            place += i
            square += np.float64(i) * i
            rate += value
            product += value * i
    out[0], out[1], out[2], out[3], out[4] = count, place, square, rate, product


@njit(**KERNEL)
def _block_moments(x, angle, base, window, step, n_windows):  # type: ignore[no-untyped-def]
    whole = window // step
    head = window - whole * step
    heads = np.zeros((n_windows + whole, _MOMENTS))
    tails = np.zeros((n_windows + whole, _MOMENTS))
    for block in range(n_windows + whole):
        a = block * step
        _add_moments(x, angle, base, a, a + head, heads[block])
        if block < n_windows + whole - 1:
            _add_moments(x, angle, base, a + head, a + step, tails[block])
    return heads, tails


def window_trends(
    x: NDArray[np.generic], *, angle: bool, window: int, step: int, n_windows: int
) -> NDArray[np.float64]:
    """Fit a straight line to the present rates of each window.

    Parameters
    ----------
    x : ndarray (n,)
        Rates, or cumulative angles; NaN where missing.
    angle : bool
        Whether these are angles, ``window + 1`` per window.
    window, step, n_windows : int
        Windows start at samples 0, step, 2 step ...

    Returns
    -------
    ndarray (2, n_windows)
        Slope per sample [unit of the rate; for angles: of the angle per sample]; variance of that
        slope under white noise, relative to a window without gaps. NaN where fewer than two
        samples are present.
    """
    finite = np.isfinite(x)
    present = finite[1:] & finite[:-1] if angle else finite
    first = int(np.argmax(present))
    if not present[first]:
        return np.full((2, n_windows), np.nan)
    base = float(x[first + 1]) - float(x[first]) if angle else float(x[first])
    heads, tails = _block_moments(x, angle, base, window, step, n_windows)
    moments = np.empty((n_windows, _MOMENTS))
    windows_from_blocks(heads, tails, np.full(_MOMENTS, window // step), moments)
    count, place, square, rate, product = moments.T
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.where(count > 1, square - place**2 / count, np.nan)
        slope = (product - place * rate / count) / spread
    return np.stack([slope, window * (window**2 - 1.0) / 12.0 / spread])
