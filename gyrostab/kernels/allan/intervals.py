"""Block sums interval by interval, for angles that need two doubles or that have gaps.

`gyrostab.kernels.allan.blocks` is several times faster and handles all other cases; both fill the
same heads and tails.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL

__all__ = ["single_blocks", "valid_intervals"]

# Reassociation lets the inner loop run on vectors; NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(**INNER)
def _valid_rate(starts, stops, k):  # type: ignore[no-untyped-def]
    """List intervals of m whose 2k samples are present; a run of samples [s, e) has angles s..e."""
    keep = 0
    begin = np.empty(starts.size, np.int64)
    end = np.empty(starts.size, np.int64)
    for r in range(starts.size):
        if stops[r] - starts[r] >= 2 * k:
            begin[keep] = starts[r]
            end[keep] = stops[r] - 2 * k + 1
            keep += 1
    return begin[:keep], end[:keep]


@njit(**INNER)
def _valid_angle(starts, stops, k):  # type: ignore[no-untyped-def]
    """Intervals of m whose three angles m, m + k, m + 2k are all present (the paper's test)."""
    begin = np.empty(3 * starts.size + 1, np.int64)
    end = np.empty(3 * starts.size + 1, np.int64)
    keep = 0
    i = j = h = 0
    m = 0
    while i < starts.size and j < starts.size and h < starts.size:
        low = max(m, starts[i], starts[j] - k, starts[h] - 2 * k, 0)
        high = min(stops[i], stops[j] - k, stops[h] - 2 * k)
        if low < high:
            begin[keep] = low
            end[keep] = high
            keep += 1
        m = max(m, high)
        if stops[i] <= m:
            i += 1
        if j < starts.size and stops[j] - k <= m:
            j += 1
        if h < starts.size and stops[h] - 2 * k <= m:
            h += 1
    return begin[:keep], end[:keep]


@njit(**INNER)
def valid_intervals(starts, stops, k, angle):  # type: ignore[no-untyped-def]
    """List the intervals [begin, end) of m of the valid second differences, from runs."""
    if angle:
        return _valid_angle(starts, stops, k)
    return _valid_rate(starts, stops, k)


@njit(fastmath=_FAST, **INNER)
def _sum_squares(theta, a, b, k):  # type: ignore[no-untyped-def]
    """Sum of squared second differences over ``a <= m < b``."""
    # Three slices: with theta[m + k] the signed index costs a wraparound test that blocks
    # vectorisation.
    first = theta[a:b]
    middle = theta[a + k : b + k]
    last = theta[a + 2 * k : b + 2 * k]
    total = 0.0
    for i in range(first.size):
        d = last[i] - 2.0 * middle[i] + first[i]
        total += d * d
    return total


@njit(**INNER)
def _differences_two(high, low, a, b, k, out):  # type: ignore[no-untyped-def]
    """Compute second differences of an angle held as two doubles, without reassociation."""
    h0, h1, h2 = high[a:b], high[a + k : b + k], high[a + 2 * k : b + 2 * k]
    l0, l1, l2 = low[a:b], low[a + k : b + k], low[a + 2 * k : b + 2 * k]
    for i in range(h0.size):
        out[i] = ((h2[i] - h1[i]) - (h1[i] - h0[i])) + ((l2[i] - l1[i]) - (l1[i] - l0[i]))


@njit(fastmath=_FAST, **INNER)
def _square_sum(values):  # type: ignore[no-untyped-def]
    """Sum of squares."""
    total = 0.0
    for i in range(values.size):
        total += values[i] * values[i]
    return total


@njit(**INNER)
def _energy_two(high, low, a, b, k):  # type: ignore[no-untyped-def]
    """`_sum_squares` for an angle held as two doubles."""
    buffer = np.empty(min(b - a, 2048))
    total = 0.0
    for begin in range(a, b, 2048):
        part = buffer[: min(2048, b - begin)]
        _differences_two(high, low, begin, begin + part.size, k, part)
        total += _square_sum(part)
    return total


@njit(**INNER)
def _add_part(high, low, begin, end, near, a, b, k, shift, sums, counts):  # type: ignore[no-untyped-def]
    """Add the valid terms in ``a <= m < b``; interval `near` is the first that ends after a."""
    up = (1 << shift) - 1
    for v in range(near, begin.size):
        if begin[v] >= b:
            break
        first = (max(begin[v], a) + up) >> shift
        last = (min(end[v], b) + up) >> shift
        if last > first:
            counts[0] += last - first
            if low.size > 0:
                sums[0] += _energy_two(high, low, first, last, k >> shift)
            else:
                sums[0] += _sum_squares(high, first, last, k >> shift)


@njit(**KERNEL)
def single_blocks(  # type: ignore[no-untyped-def]
    high, low, places, starts, stops, angle, step, ks, shifts, head_lengths, whole, n_windows
):
    """Sum heads and tails as `grouped_blocks`; `low` is the remainder of `high`, or empty."""
    n_blocks = n_windows + whole[0]
    heads, tails = np.zeros((n_blocks, ks.size)), np.zeros((n_blocks, ks.size))
    head_counts, tail_counts = np.zeros((n_blocks, ks.size)), np.zeros((n_blocks, ks.size))
    for i in range(ks.size):
        begin, end = valid_intervals(starts, stops, ks[i], angle)
        theta, rest = high[places[i] :], low[places[i] :]
        last = n_windows + whole[i] - 1
        near = 0
        for block in range(last + 1):
            a = block * step
            b = a + head_lengths[i]
            while near < end.size and end[near] <= a:
                near += 1
            _add_part(
                theta,
                rest,
                begin,
                end,
                near,
                a,
                b,
                ks[i],
                shifts[i],
                heads[block, i : i + 1],
                head_counts[block, i : i + 1],
            )
            if whole[i] > 0 and block < last:
                _add_part(
                    theta,
                    rest,
                    begin,
                    end,
                    near,
                    b,
                    a + step,
                    ks[i],
                    shifts[i],
                    tails[block, i : i + 1],
                    tail_counts[block, i : i + 1],
                )
    return heads, tails, head_counts, tail_counts
