"""Departures of samples from their neighbours, and single outliers.

The departure of a sample is its difference from the median of the four samples on either side, of
which only pairs at the same distance are used: a slope gives no departure, and an outlier gives
none in its neighbours. At the edges of a block and of gaps, without two pairs, the departure is the
smaller of those from the level and from the slope of four samples on one side.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import INNER, KERNEL

#: Bins of the histogram of departures: one for zero, then four an octave from 2**-32 to 2**32.
HISTOGRAM = 256
_PAIRS = 4
#: Variance of the median of 0, 2, 4, 6 and 8 normal numbers.
_MEDIANS = (0.0, 0.5, 0.2982, 0.2147, 0.1682)
_ALONE = 0.4  # share of the departure by which an outlier exceeds both direct neighbours
_WINDOWS = (8, 16, 64, 256)  # samples before or after that give the noise level there
_NEAR = 16  # samples within which outliers share one noise level
_MEDIAN = 0.6745  # of the absolute value of a standard normal number
_ERROR = 1.17  # of the deviation from the median of one number


@njit(**INNER)
def _bin_index(value):  # type: ignore[no-untyped-def]
    if value == 0.0:
        return np.int64(0)
    return np.int64(min(max(4.0 * math.log2(value) + 128.0, 1.0), 255.0))


def histogram_edge(number: Any) -> Floats:
    """Lower edge of bin `number` of the histogram of departures; fractions of a bin are allowed."""
    return np.asarray(np.exp2((np.asarray(number, np.float64) - 128.0) / 4.0))


@njit(**INNER)
def _insert_sorted(values, count, value):  # type: ignore[no-untyped-def]
    """Put a value among the first `count`, which are sorted."""
    at = count
    while at > 0 and values[at - 1] > value:
        values[at] = values[at - 1]
        at -= 1
    values[at] = value


@njit(**INNER)
def _median_pairs(row, i, neighbours):  # type: ignore[no-untyped-def]
    """Median of the pairs of samples that are both there, and their number."""
    count = 0
    for apart in range(1, _PAIRS + 1):
        if i - apart < 0 or i + apart >= row.size:
            break
        left, right = row[i - apart], row[i + apart]
        if left != left or right != right:
            continue
        _insert_sorted(neighbours, count, left)
        _insert_sorted(neighbours, count + 1, right)
        count += 2
    if count == 0:
        return np.nan, 0
    return 0.5 * (neighbours[count // 2 - 1] + neighbours[count // 2]), count // 2


@njit(**INNER)
def _one_sided(row, i, neighbours):  # type: ignore[no-untyped-def]
    """Compute the departure at an edge from the level or slope of four samples on one side."""
    for side in (1, -1):
        if 0 <= i + _PAIRS * side < row.size:
            total = 0.0
            for apart in range(1, _PAIRS + 1):
                _insert_sorted(neighbours, apart - 1, row[i + apart * side])
                total += row[i + apart * side]
            level = (row[i] - 0.5 * (neighbours[1] + neighbours[2])) * math.sqrt(
                (1.0 + _MEDIANS[4]) / (1.0 + _MEDIANS[2])
            )
            slope = (row[i] - 2.0 * row[i + side] + row[i + 2 * side]) * math.sqrt(
                (1.0 + _MEDIANS[4]) / 6.0
            )
            if total == total:
                if level * slope <= 0.0:
                    return 0.0
                return level if abs(level) < abs(slope) else slope
    return np.nan


@njit(**KERNEL)
def departures(x, out, histogram):  # type: ignore[no-untyped-def]
    """Compute the departure of each sample from its neighbours, as if there were always eight.

    Parameters
    ----------
    x : ndarray, shape (block, sample)
        Values, NaN where missing.
    out : ndarray, shape (block, sample)
        Overwritten with the departures, NaN where missing; those from fewer samples are scaled
        down, so that all scatter equally.
    histogram : ndarray of uint32, shape (block, `HISTOGRAM`)
        The number of absolute departures by size is added to it.
    """
    size = x.shape[1]
    neighbours = np.empty(2 * _PAIRS)
    share = np.empty(_PAIRS + 1)
    for pairs in range(_PAIRS + 1):
        share[pairs] = math.sqrt((1.0 + _MEDIANS[_PAIRS]) / (1.0 + _MEDIANS[pairs]))
    for b in range(x.shape[0]):
        row = x[b]
        for i in range(size):
            middle, pairs = _median_pairs(row, i, neighbours)
            away = _one_sided(row, i, neighbours) if pairs < 2 else np.nan
            if away != away:
                away = (row[i] - middle) * share[pairs]
            out[b, i] = away
            if away == away:
                histogram[b, _bin_index(abs(away))] += np.uint32(1)


@njit(**INNER)
def _noise_level(away, low, high, room):  # type: ignore[no-untyped-def]
    """Estimate the deviation of the departures from `low` to `high`, less its error; 0 if few."""
    count = 0
    for j in range(max(low, 0), min(high, away.size)):
        value = abs(away[j])
        if value > 0.0:
            _insert_sorted(room, count, value)
            count += 1
    if count < _WINDOWS[0]:
        return 0.0
    return (1.0 - _ERROR / math.sqrt(count)) * room[count // 2] / _MEDIAN


@njit(**INNER)
def _largest_noise_level(away, i, room):  # type: ignore[no-untyped-def]
    """Find a lower bound of the noise level directly before or after a sample."""
    level = 0.0
    for window in _WINDOWS:
        level = max(
            level,
            _noise_level(away, i - 1 - window, i - 1, room),
            _noise_level(away, i + 2, i + 2 + window, room),
        )
    return level


@njit(**INNER)
def _is_outlier(row, away, i, limit):  # type: ignore[no-untyped-def]
    """Check that a sample exceeds both neighbours by far, with no half as large one nearby."""
    side = 1.0 if away[i] > 0.0 else -1.0
    min_excess = _ALONE * abs(away[i])
    for j in range(max(i - 2, 0), min(i + 3, row.size)):
        if j != i and (
            abs(away[j]) > max(limit, 0.5 * abs(away[i]))
            or (abs(i - j) == 1 and side * (row[i] - row[j]) < min_excess)
        ):
            return False
    return True


@njit(**KERNEL)
def peaks(x, away, deviation, limit):  # type: ignore[no-untyped-def]
    """Find single samples beyond a limit that grows with the noise around them.

    Parameters
    ----------
    x, away : ndarray, shape (block, sample)
        Values and their `departures`.
    deviation : ndarray, shape (block,)
        Standard deviation of the departures of a block; 0 without departures.
    limit : float
        Deviations beyond which a departure may be a peak: of the block, and of the samples directly
        before and after it.

    Returns
    -------
    block : ndarray of int64, shape (peak,)
    size : ndarray, shape (peak,)
        Absolute departure.
    level : ndarray, shape (peak,)
        Lower bound of the standard deviation of departures there: the largest of those directly
        before and after it, and before and after other outliers within 16 samples, because bursts
        of noise are rarely longer.
    """
    count = 0
    for b in range(x.shape[0]):
        for i in range(x.shape[1]):
            count += deviation[b] > 0.0 and abs(away[b, i]) > limit * deviation[b]
    block, size, level = np.empty(count, np.int64), np.empty(count), np.empty(count)
    place, loud = np.empty(count, np.int64), np.empty(count)
    room = np.empty(_WINDOWS[-1])
    n_peaks = 0
    for b in range(x.shape[0]):
        beyond = 0
        for i in range(x.shape[1]):
            if deviation[b] > 0.0 and abs(away[b, i]) > limit * deviation[b]:
                place[beyond], loud[beyond] = i, _largest_noise_level(away[b], i, room)
                beyond += 1
        for k in range(beyond):
            i = place[k]
            level_here = 0.0
            for other in range(max(k - _NEAR, 0), min(k + _NEAR + 1, beyond)):
                if abs(place[other] - i) <= _NEAR:
                    level_here = max(level_here, loud[other])
            if abs(away[b, i]) > limit * level_here and _is_outlier(
                x[b], away[b], i, limit * deviation[b]
            ):
                block[n_peaks], size[n_peaks], level[n_peaks] = b, abs(away[b, i]), level_here
                n_peaks += 1
    return block[:n_peaks], size[:n_peaks], level[:n_peaks]
