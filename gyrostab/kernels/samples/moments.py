"""Statistics of the samples of blocks: moments, sample counts, and means by phase."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import KERNEL

#: Columns of the moments of a block: mean, second and fourth central moment, and range.
MEAN, VARIANCE, FOURTH_MOMENT, LOWEST, HIGHEST = range(5)
MOMENTS = 5
#: Columns of its sample counts: samples present; exact zeros; samples equal to the one before but
#: for zeros; samples equal to the smallest and to the largest value of the block; how many of these
#: two are equal to the one before and no zeros; runs of samples that are equal to the one before
#: and no zeros; runs of zeros.
PRESENT, ZEROS, REPEATS, LOWS, HIGHS, LOW_REPEATS, HIGH_REPEATS, REPEAT_RUNS, ZERO_RUNS = range(9)
COUNTS = 9


@njit(**KERNEL)
def measure_samples(x, centred, moments, counts):  # type: ignore[no-untyped-def]
    """Compute statistics of the samples of each block, in one pass.

    Parameters
    ----------
    x : ndarray, shape (block, sample)
        Values, NaN where missing.
    centred : ndarray, shape (block, sample)
        Overwritten with the values minus the mean of their block, 0 where missing.
    moments : ndarray, shape (block, `MOMENTS`)
        Overwritten with `MEAN` to `HIGHEST`; NaN in an empty block.
    counts : ndarray of int64, shape (block, `COUNTS`)
        Overwritten with `PRESENT` to `ZERO_RUNS`.
    """
    size = x.shape[1]
    for b in range(x.shape[0]):
        row = x[b]
        first, low, high, total = np.nan, np.inf, -np.inf, 0.0
        present, zeros, repeats, runs, zero_runs = 0, 0, 0, 0, 0
        repeated, zeroed = False, False
        for i in range(size):
            value = row[i]
            if value != value:
                repeated, zeroed = False, False
                continue
            if present == 0:
                first = value
            present += 1
            total += value - first
            zeros += value == 0.0
            is_repeat = i > 0 and value == row[i - 1] and value != 0.0
            repeats += is_repeat
            runs += is_repeat and not repeated
            zero_runs += value == 0.0 and not zeroed
            repeated, zeroed = is_repeat, value == 0.0
            low, high = min(low, value), max(high, value)
        mean = first + total / max(present, 1)
        second, fourth = 0.0, 0.0
        lows, highs, low_repeats, high_repeats = 0, 0, 0, 0
        for i in range(size):
            value = row[i]
            if value != value:
                centred[b, i] = 0.0
                continue
            square = (value - mean) ** 2
            second += square
            fourth += square * square
            centred[b, i] = value - mean
            lows += value == low
            highs += value == high
            if i > 0 and value == row[i - 1] and value != 0.0:
                low_repeats += value == low
                high_repeats += value == high
        counts[b, PRESENT] = present
        counts[b, ZEROS] = zeros
        counts[b, REPEATS] = repeats
        counts[b, LOWS] = lows
        counts[b, HIGHS] = highs
        counts[b, LOW_REPEATS] = low_repeats
        counts[b, HIGH_REPEATS] = high_repeats
        counts[b, REPEAT_RUNS] = runs
        counts[b, ZERO_RUNS] = zero_runs
        moments[b, MEAN] = mean
        moments[b, VARIANCE] = second / max(present, 1)
        moments[b, FOURTH_MOMENT] = fourth / max(present, 1)
        moments[b, LOWEST] = low
        moments[b, HIGHEST] = high
        if present == 0:
            moments[b, :] = np.nan


@njit(**KERNEL)
def count_resent(bits, min_lengths, out):  # type: ignore[no-untyped-def]
    """Count the samples of each block that repeat earlier ones in their order.

    Such samples belong to a run in which each equals the one at the same distance before, at least
    two samples away. A value equal to the one right before it begins no run.

    Parameters
    ----------
    bits : ndarray of int64, shape (block, sample)
        Values as bit patterns; 0 where missing or exactly zero.
    min_lengths : sequence of int
        Samples that a run has at least.
    out : ndarray of int64, shape (block, min_length, 2)
        Overwritten with the samples in runs, and the runs.
    """
    size = bits.shape[1]
    mask = 3
    while mask < 2 * size:
        mask = 2 * mask + 1
    table = np.empty(mask + 1, np.int64)
    for b in range(bits.shape[0]):
        row = bits[b]
        table[:] = -1
        out[b] = 0
        length, lag = 0, 0
        for i in range(size):
            value = row[i]
            slot = (value ^ (value >> 23) ^ (value >> 41)) & mask
            while table[slot] >= 0 and row[table[slot]] != value:
                slot = (slot + 1) & mask
            earlier = table[slot]
            if value != 0:
                table[slot] = i
            if length > 0 and value != 0 and row[i - lag] == value:
                length += 1
            else:
                length, lag = int(value != 0 and 0 <= earlier < i - 1), i - earlier
            for place, min_length in enumerate(min_lengths):
                if length == min_length:
                    out[b, place, 0] += min_length
                    out[b, place, 1] += 1
                elif length > min_length:
                    out[b, place, 0] += 1


@njit(**KERNEL)
def add_phase_profile(centred, present, phase, low, high, sums, counts):  # type: ignore[no-untyped-def]
    """Add sum and number of the centred values by block and by phase, in equal bins.

    Parameters
    ----------
    centred, phase : ndarray, shape (block, sample)
    present : ndarray of bool, shape (block, sample)
    low, high : float
    sums, counts : ndarray, shape (block, bin)
    """
    bins = sums.shape[1]
    scale = bins / (high - low)
    for b in range(centred.shape[0]):
        for i in range(centred.shape[1]):
            if present[b, i] and phase[b, i] == phase[b, i]:
                at = min(max(np.int64((phase[b, i] - low) * scale), 0), bins - 1)
                sums[b, at] += centred[b, i]
                counts[b, at] += 1
