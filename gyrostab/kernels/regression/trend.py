"""Mean and slope of a channel over many overlapping windows."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL, REORDER


@njit(fastmath=REORDER, **INNER)
def _sum_finite(values, seconds, origin, start):  # type: ignore[no-untyped-def]
    """Number of finite values, and the sums of them and of their times beyond an origin."""
    count, total, elapsed = 0.0, 0.0, 0.0
    for i in range(values.size):
        finite = np.isfinite(values[i])
        count += 1.0 if finite else 0.0
        total += values[i] - origin if finite else 0.0
        elapsed += seconds[i] - start if finite else 0.0
    return count, total, elapsed


@njit(fastmath=REORDER, **INNER)
def _sum_products(values, seconds, mean, centre):  # type: ignore[no-untyped-def]
    """Sum the products of deviations of values and times, and the squares of those of times."""
    covariance, variance = 0.0, 0.0
    for i in range(values.size):
        finite = np.isfinite(values[i])
        step = seconds[i] - centre if finite else 0.0
        covariance += step * (values[i] - mean) if finite else 0.0
        variance += step * step
    return covariance, variance


@njit(**KERNEL)
def window_trend(values, seconds, first, last):  # type: ignore[no-untyped-def]
    """Mean and least-squares slope over ``[first[j], last[j])`` for every window j, NaN left out.

    Parameters
    ----------
    values : float64 (n,)
        Channel.
    seconds : float64 (n,)
        Time of each value [s].
    first, last : int64 (n_windows,)
        Bounds of the windows, as indices.

    Returns
    -------
    float64 (2, n_windows)
        Mean [unit of the channel], NaN in empty windows; slope [unit per s], NaN with fewer than
        two times.
    """
    out = np.full((2, first.size), np.nan)
    for j in range(first.size):
        begin, end = first[j], last[j]
        while begin < end and not np.isfinite(values[begin]):
            begin += 1
        if begin >= end:
            continue
        # near the mean, so that the sums lose no digits
        origin, start = values[begin], seconds[begin]
        window_values, window_seconds = values[begin:end], seconds[begin:end]
        count, total, elapsed = _sum_finite(window_values, window_seconds, origin, start)
        out[0, j] = mean = origin + total / count
        covariance, variance = _sum_products(
            window_values, window_seconds, mean, start + elapsed / count
        )
        if variance > 0.0:
            out[1, j] = covariance / variance
    return out
