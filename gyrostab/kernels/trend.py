"""Mean and slope of a channel over many overlapping windows."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import KERNEL

__all__ = ["window_trend"]


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
        Mean [unit of the channel], NaN where nothing is there; slope [unit per s], NaN with fewer than two instants.
    """
    out = np.full((2, first.size), np.nan)
    for j in range(first.size):
        count = 0
        mean = 0.0
        centre = 0.0
        for i in range(first[j], last[j]):
            if np.isfinite(values[i]):
                count += 1
                mean += (values[i] - mean) / count
                centre += (seconds[i] - centre) / count
        if count == 0:
            continue
        out[0, j] = mean
        covariance = 0.0
        variance = 0.0
        for i in range(first[j], last[j]):
            if np.isfinite(values[i]):
                covariance += (seconds[i] - centre) * (values[i] - mean)
                variance += (seconds[i] - centre) ** 2
        if variance > 0.0:
            out[1, j] = covariance / variance
    return out
