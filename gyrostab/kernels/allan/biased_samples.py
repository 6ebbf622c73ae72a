"""Samples that bias the noise of a window: single outliers, and losses while the noise is high.

A sample is an outlier where it exceeds both neighbours, or falls below both, by more than
`LIMIT_SIGMA` standard deviations of the difference of two samples, measured over its segment and
again over the samples around it, so that temporarily higher noise is not counted. In white noise
both differences reach 8 standard deviations with a probability of about exp(-8**2 * 2 / 3), which
is 3e-19: never in a record.

Where one neighbour is missing, or the record begins or ends, the two samples on the other side are
used. In white noise their differences have the same distribution. Cumulative angles rise
steadily, so the sample must also be 8 standard deviations from the line through these two.

If samples are lost independently of the noise, those next to gaps scatter like the others, and the
ratio is 1. If samples are lost while the noise is high, the samples that are left next to the gaps
are noisier, and the window underestimates the noise of the record.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.kernels.allan.blocks import windows_from_blocks
from gyrostab.kernels.compiled import INNER, KERNEL

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
#: Samples on either side of a gap that count as next to it: few enough that a fifth of the samples
#: lost one by one leaves others.
EDGE_SAMPLES = 8
#: Smallest number of second differences of either kind; in white noise the ratio then has a
#: standard deviation of at most 15 %.
MIN_DIFFERENCES = 100


def _measure_noise(x: Array, places: Ints) -> Floats:
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


@njit(**INNER)
def _measure_deviation(x, i):  # type: ignore[no-untyped-def]
    """Find how far sample i is above or below its neighbours; not above zero if it is between."""
    before, after = i > 0 and np.isfinite(x[i - 1]), i + 1 < x.size and np.isfinite(x[i + 1])
    side = 1 if after else -1
    other = i - 1 if before and after else i + 2 * side
    if not (before or after) or other < 0 or other >= x.size:
        return np.nan
    sample, neighbour, second = np.float64(x[i]), np.float64(x[i + side]), np.float64(x[other])
    low, high = min(sample - neighbour, sample - second), max(sample - neighbour, sample - second)
    if not (before and after):
        line = (sample - 2.0 * neighbour + second) / np.sqrt(3.0)
        low, high = min(low, line), max(high, line)
    return max(low, -high) if np.isfinite(sample + second) else np.nan


@njit(**INNER)
def _note_candidate(x, i, limit, places, deviations, count):  # type: ignore[no-untyped-def]
    """Write sample i to the lists if it deviates by more than `limit`; returns how many do."""
    deviation = _measure_deviation(x, i)
    if not deviation > limit:
        return count
    if count < places.size:
        places[count], deviations[count] = i, deviation
    return count + 1


@njit(**KERNEL)
def _find_candidates(x, limits, places, deviations):  # type: ignore[no-untyped-def]
    """List the samples beyond the limit of their segment; returns how many there are."""
    count = _note_candidate(x, np.int64(0), limits[0], places, deviations, np.int64(0))
    for segment in range(limits.size):
        begin, limit = np.int64(1 + segment * _SEGMENT_SAMPLES), limits[segment]
        end = min(begin + _SEGMENT_SAMPLES, x.size - 1)
        # A loop over slices that only counts, because it vectorises.
        hits = whole = 0
        first, middle, last = x[begin - 1 : end - 1], x[begin:end], x[begin + 1 : end + 1]
        for i in range(middle.size):
            rise = np.float64(middle[i]) - np.float64(first[i])
            fall = np.float64(middle[i]) - np.float64(last[i])
            hits += 1 if (rise * fall > 0.0) & (min(abs(rise), abs(fall)) > limit) else 0
            whole += 1 if np.isfinite(rise + fall) else 0
        if hits == 0 and whole == middle.size:
            continue
        for i in range(middle.size):
            rise = np.float64(middle[i]) - np.float64(first[i])
            fall = np.float64(middle[i]) - np.float64(last[i])
            if not (abs(rise) <= limit or abs(fall) <= limit):  # also where one is missing
                count = _note_candidate(x, begin + i, limit, places, deviations, count)
    return _note_candidate(x, np.int64(x.size - 1), limits[-1], places, deviations, count)


def _find_outliers(x: Array) -> Ints:
    """Find the numbers of the outliers, rising."""
    begins = np.arange(1, max(x.size - 1, 1), _SEGMENT_SAMPLES)
    lengths = np.minimum(begins + _SEGMENT_SAMPLES, x.size - 1) - begins
    if x.size < 3:
        return np.empty(0, np.int64)
    apart = np.maximum(1, lengths // _MEDIAN_OF)
    steps = apart[:, None] * np.arange((lengths // apart).max() + 1)
    noise = _measure_noise(x, np.where(steps < lengths[:, None], begins[:, None] + steps, -1))
    limits = np.where(noise > 0.0, LIMIT_SIGMA * noise, np.inf)
    places, deviations = np.empty(1024, np.int64), np.empty(1024)
    count = _find_candidates(x, limits, places, deviations)
    if count > places.size:
        places, deviations = np.empty(count, np.int64), np.empty(count)
        _find_candidates(x, limits, places, deviations)
    around = np.arange(2, _AROUND_SAMPLES + 2)
    outliers = []
    for chunk in range(0, count, 4096):
        part = slice(chunk, min(chunk + 4096, count))
        level = np.maximum(
            _measure_noise(x, places[part, None] - around[:-1]),
            _measure_noise(x, places[part, None] + around),
        )
        outliers.append(places[part][deviations[part] > LIMIT_SIGMA * level])
    return np.concatenate([np.empty(0, np.int64), *outliers])


def count_outliers(x: Array, starts: Ints, length: int) -> Floats:
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


@njit(**KERNEL)
def _edge_blocks(x, step, head, out):  # type: ignore[no-untyped-def]
    """Sum and count absolute second differences near gaps and elsewhere, (2, n_blocks, 4)."""
    reach = EDGE_SAMPLES + 1
    missing = 0  # within `reach` of the difference
    for i in range(2 * reach):
        missing += 0 if np.isfinite(x[i]) else 1
    for block in range(out.shape[1]):
        for half in range(2):
            begin, end = block * step + half * head, block * step + (step if half else head)
            for i in range(begin, min(end, x.size - 2 * reach)):
                part = x[i : i + 2 * reach + 1]
                missing += 0 if np.isfinite(part[2 * reach]) else 1
                before, after = np.float64(part[reach - 1]), np.float64(part[reach + 1])
                difference = abs(before - 2.0 * np.float64(part[reach]) + after)
                if np.isfinite(difference):
                    kind = 0 if missing > 0 else 1
                    out[half, block, kind] += difference
                    out[half, block, 2 + kind] += 1.0
                missing -= 0 if np.isfinite(part[0]) else 1


def gap_edge_ratio(x: Array, *, window: int, step: int, n_windows: int) -> Floats:
    """Compute the ratio of mean absolute second differences next to gaps and elsewhere.

    Parameters
    ----------
    x : ndarray, shape (n_samples,)
        Samples, NaN where missing; rates, or cumulative angles.
    window, step, n_windows : int
        Windows start at samples 0, step, 2 step ...

    Returns
    -------
    ndarray of float64, shape (n_windows,)
        NaN with fewer than `MIN_DIFFERENCES` of either kind. A gap outside the window has no
        effect.
    """
    length = window - 2 * (EDGE_SAMPLES + 1)
    sums = np.zeros((n_windows, 4))
    if length > 0:
        whole_blocks, head = divmod(length, step)
        blocks = np.zeros((2, n_windows + whole_blocks, 4))
        _edge_blocks(x, step, head, blocks)
        windows_from_blocks(*blocks, np.full(4, whole_blocks), sums)
    near_gaps, elsewhere, *counts = sums.T
    enough = np.minimum(*counts) >= MIN_DIFFERENCES
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = near_gaps / counts[0] / (elsewhere / counts[1])
    return np.where(enough & (elsewhere > 0.0), ratio, np.nan)
