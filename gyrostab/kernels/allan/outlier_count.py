"""Count the single samples of each window that are far from both neighbours.

A sample is an outlier where it exceeds both neighbours, or falls below both, by more than
`LIMIT_SIGMA` standard deviations of the difference of two samples, measured over its segment and
again over the samples around it, so that temporarily higher noise is not counted. In white noise
both differences reach 8 standard deviations with a probability of about exp(-8**2 * 2 / 3), which
is 3e-19: never in a record.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import KERNEL

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


def _measure_noise(x: NDArray[Any], places: NDArray[np.int64]) -> NDArray[np.float64]:
    """Estimate the standard deviation of first differences from second differences; 0 without.

    In each row of `places` (n, m), the first `_MEDIAN_OF` with a second difference are used.
    """
    inside = (places >= 1) & (places < x.size - 1)
    place = np.where(inside, places, 1)
    before, sample, after = (x[place + shift].astype(np.float64) for shift in (-1, 0, 1))
    difference = np.abs(before - 2.0 * sample + after)
    is_usable = inside & (difference > 0.0)
    is_usable &= np.cumsum(is_usable, axis=1) <= _MEDIAN_OF
    count = is_usable.sum(axis=1)
    difference = np.sort(np.where(is_usable, difference, np.nan), axis=1)
    row, last = np.arange(count.size), np.maximum(count - 1, 0)
    median = (difference[row, last // 2] + difference[row, count // 2 * (count > 1)]) / 2.0
    return np.where(count > 0, _TO_DIFFERENCE * median, 0.0)


@njit(**KERNEL)
def _find_candidates(x, limits, places):  # type: ignore[no-untyped-def]
    """Write the samples beyond both neighbours to `places`; returns how many there are."""
    count = np.int64(0)
    for segment in range(limits.size):
        begin, limit = np.int64(1 + segment * _SEGMENT_SAMPLES), limits[segment]
        end = min(begin + _SEGMENT_SAMPLES, x.size - 1)
        # A loop over slices that only counts, because it vectorises.
        hits = 0
        first, middle, last = x[begin - 1 : end - 1], x[begin:end], x[begin + 1 : end + 1]
        for i in range(middle.size):
            rise = np.float64(middle[i]) - np.float64(first[i])
            fall = np.float64(middle[i]) - np.float64(last[i])
            hits += 1 if (rise * fall > 0.0) & (min(abs(rise), abs(fall)) > limit) else 0
        if hits == 0 or limit == 0.0:
            continue
        for i in range(middle.size):
            rise = np.float64(middle[i]) - np.float64(first[i])
            fall = np.float64(middle[i]) - np.float64(last[i])
            if (rise > limit and fall > limit) or (rise < -limit and fall < -limit):
                if count < places.size:
                    places[count] = begin + i
                count += 1
    return count


def _find_outliers(x: NDArray[Any]) -> NDArray[np.int64]:
    """Find the numbers of the outliers, rising."""
    begins = np.arange(1, max(x.size - 1, 1), _SEGMENT_SAMPLES)
    lengths = np.minimum(begins + _SEGMENT_SAMPLES, x.size - 1) - begins
    if x.size < 3:
        return np.empty(0, np.int64)
    apart = np.maximum(1, lengths // _MEDIAN_OF)[:, None]
    steps = apart * np.arange(2 * _MEDIAN_OF)
    noise = _measure_noise(x, np.where(steps < lengths[:, None], begins[:, None] + steps, -1))
    places = np.empty(1024, np.int64)
    count = _find_candidates(x, LIMIT_SIGMA * noise, places)
    if count > places.size:
        places = np.empty(count, np.int64)
        _find_candidates(x, LIMIT_SIGMA * noise, places)
    around = np.arange(2, _AROUND_SAMPLES + 2)
    outliers = []
    for chunk in range(0, count, 4096):
        place = places[chunk : min(chunk + 4096, count)]
        level = np.maximum(
            _measure_noise(x, place[:, None] - around[:-1]),
            _measure_noise(x, place[:, None] + around),
        )
        before, sample, after = (x[place + shift].astype(np.float64) for shift in (-1, 0, 1))
        nearest = np.minimum(np.abs(sample - before), np.abs(sample - after))
        outliers.append(place[nearest > LIMIT_SIGMA * level])
    return np.concatenate([np.empty(0, np.int64), *outliers])


def count_outliers(x: NDArray[Any], starts: NDArray[np.int64], length: int) -> NDArray[np.float64]:
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
    places = _find_outliers(x)
    counts = np.searchsorted(places, starts + length) - np.searchsorted(places, starts)
    return np.asarray(counts, dtype=np.float64)
