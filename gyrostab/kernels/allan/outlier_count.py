"""Count the single samples of each window that are far from both neighbours.

A sample is an outlier where it exceeds both neighbours, or falls below both, by more than
`LIMIT_SIGMA` standard deviations of the difference of two samples, measured over its segment and
again over the samples around it, so that temporarily higher noise is not counted. In white noise
both differences reach 8 standard deviations with a probability of about exp(-8**2 * 2 / 3), which
is 3e-19: never in a record.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL

__all__ = ["LIMIT_SIGMA", "count_outliers"]

LIMIT_SIGMA = 8.0
#: Samples of a segment, and second differences spread over it whose median gives its noise to 10 %,
#: which is precise enough for 8 sigma.
_SEGMENT_SAMPLES, _MEDIAN_OF = 8192, 128
#: Samples on either side of an outlier that give the noise around it: several bit errors in a
#: damaged packet leave most of them intact, while longer periods of higher noise raise their
#: median.
_AROUND_SAMPLES = 128
#: From the median of absolute second differences of white noise to the standard deviation of first
#: differences: sqrt(2) / (sqrt(6) * 0.6745).
_TO_DIFFERENCE = 0.8560


@njit(**INNER)
def _measure_noise(x, first, last, apart, room):  # type: ignore[no-untyped-def]
    """Estimate the standard deviation of first differences from second differences; 0 without."""
    count = 0
    for i in range(max(first, 1), min(last, x.size - 1), apart):
        second = abs(np.float64(x[i - 1]) - 2.0 * np.float64(x[i]) + np.float64(x[i + 1]))
        if second == second and second > 0.0 and count < room.size:
            room[count] = second
            count += 1
    return _TO_DIFFERENCE * np.median(room[:count]) if count else 0.0


@njit(**INNER)
def _count_beyond(x, limit):  # type: ignore[no-untyped-def]
    """Count samples beyond both neighbours, in a separate loop over slices that vectorises."""
    found = 0
    before, here, after = x[:-2], x[1:-1], x[2:]
    for i in range(here.size):
        rise = np.float64(here[i]) - np.float64(before[i])
        fall = np.float64(here[i]) - np.float64(after[i])
        found += 1 if (rise * fall > 0.0) & (min(abs(rise), abs(fall)) > limit) else 0
    return found


@njit(**KERNEL)
def count_outliers(x, starts, length):  # type: ignore[no-untyped-def]
    """Count the outliers of each window.

    Parameters
    ----------
    x : ndarray, shape (n_samples,)
        Samples, NaN where missing; rates, or cumulative angles.
    starts : ndarray of int64, shape (n_windows,)
        First sample of each window, rising.
    length : int
        Samples of a window.

    Returns
    -------
    ndarray of float64, shape (n_windows,)
        Outliers of each window.
    """
    places = np.empty(16, np.int64)
    room, near = np.empty(_MEDIAN_OF), np.empty(_AROUND_SAMPLES)
    total = 0
    for begin in range(1, x.size - 1, _SEGMENT_SAMPLES):
        end = min(begin + _SEGMENT_SAMPLES, x.size - 1)
        limit = LIMIT_SIGMA * _measure_noise(
            x, begin, end, max(1, (end - begin) // _MEDIAN_OF), room
        )
        if limit == 0.0 or _count_beyond(x[begin - 1 : end + 1], limit) == 0:
            continue
        for i in range(begin, end):
            before = np.float64(x[i]) - np.float64(x[i - 1])
            after = np.float64(x[i]) - np.float64(x[i + 1])
            if (before > limit and after > limit) or (before < -limit and after < -limit):
                noise = max(
                    _measure_noise(x, i - _AROUND_SAMPLES, i - 1, 1, near),
                    _measure_noise(x, i + 2, i + 2 + _AROUND_SAMPLES, 1, near),
                )
                if min(abs(before), abs(after)) > LIMIT_SIGMA * noise:
                    if total == places.size:
                        larger = np.empty(2 * total, np.int64)
                        larger[:total] = places
                        places = larger
                    places[total] = i
                    total += 1
    counts = np.empty(starts.size)
    for window in range(starts.size):
        low = np.searchsorted(places[:total], starts[window])
        counts[window] = np.searchsorted(places[:total], starts[window] + length) - low
    return counts
