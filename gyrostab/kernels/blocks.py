"""Improved fast DAVAR by two-part block sums: every second difference once, additions only.

Windows start on multiples of the step S and hold ``L = W - 2k + 1`` second differences of the angle. Per block of S
samples and per averaging factor k two sums are kept: the *head*, the first ``L mod S`` terms, and the *tail*, the
rest. A window is then a number of whole blocks plus one head, for every window and exactly. Nothing is subtracted, so
a shock does not stay behind in the sums as it does in a recursion (Wang et al., Sensors 16 (2016), Eq. 19).

The angle is integrated anew for each unit of work from the rate less a constant: the Allan variance is blind to a
constant rate, and a short integral keeps its digits on a rotating tool. Where even the short integral is too large for
double precision (a shock of 10^6 sigma) the angle is kept as a sum of two doubles.

Missing samples never enter the loops: valid terms are intervals between gaps.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["integrate", "integrate_two", "needs_two_doubles", "present_runs", "slide", "strict_sums", "valid_intervals"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Reassociation lets the inner loop run on vectors; NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(nogil=True, cache=True)
def present_runs(present):  # type: ignore[no-untyped-def]
    """First and one-past-last index of every run of True in `present`, shape (n,): two int64 arrays."""
    n = present.size
    count = 0
    for i in range(n):
        if present[i] and (i == 0 or not present[i - 1]):
            count += 1
    starts = np.empty(count, np.int64)
    stops = np.empty(count, np.int64)
    run = -1
    for i in range(n):
        if present[i]:
            if i == 0 or not present[i - 1]:
                run += 1
                starts[run] = i
            stops[run] = i + 1
    return starts, stops


@njit(nogil=True, cache=True)
def integrate(x, present, offset):  # type: ignore[no-untyped-def]
    """Angle ``theta[m] = sum(x[:m] - offset)`` over present samples, shape (n + 1,); missing samples add nothing."""
    theta = np.empty(x.size + 1)
    theta[0] = 0.0
    total = 0.0
    for i in range(x.size):
        if present[i]:
            total += x[i] - offset
        theta[i + 1] = total
    return theta


@njit(nogil=True, cache=True)
def integrate_two(x, present, offset):  # type: ignore[no-untyped-def]
    """The same integral as a sum of two doubles, to about 32 digits (two-sum of Knuth): values and remainders."""
    high = np.empty(x.size + 1)
    low = np.empty(x.size + 1)
    total = 0.0
    rest = 0.0
    high[0] = 0.0
    low[0] = 0.0
    for i in range(x.size):
        if present[i]:
            value = x[i] - offset
            new = total + value
            part = new - total
            rest += (total - (new - part)) + (value - part)
            total = new
        high[i + 1] = total
        low[i + 1] = rest
    return high, low


@njit(nogil=True, cache=True)
def needs_two_doubles(theta, x, present):  # type: ignore[no-untyped-def]
    """Whether `theta` is so large against the sample-to-sample noise of `x` that doubles lose digits of the result."""
    largest = 0.0
    for i in range(theta.size):
        largest = max(largest, abs(theta[i]))
    stride = max(1, x.size // 1000)
    steps = np.empty(x.size // stride + 1)
    count = 0
    for i in range(0, x.size - 1, stride):
        if present[i] and present[i + 1]:
            steps[count] = abs(x[i + 1] - x[i])
            count += 1
    if count == 0:
        return False
    return largest > 1e4 * np.median(steps[:count])


@njit(nogil=True, cache=True, fastmath=_FAST)
def _energy(theta, a, b, k):  # type: ignore[no-untyped-def]
    """Sum of squared second differences over ``a <= m < b``."""
    # Three slices: with theta[m + k] the signed index costs a wraparound test that blocks vectorisation.
    first = theta[a:b]
    middle = theta[a + k : b + k]
    last = theta[a + 2 * k : b + 2 * k]
    total = 0.0
    for i in range(first.size):
        d = last[i] - 2.0 * middle[i] + first[i]
        total += d * d
    return total


@njit(nogil=True, cache=True)
def _differences_two(high, low, a, b, k, out):  # type: ignore[no-untyped-def]
    """Second differences of an angle held as two doubles; no reassociation, the large parts cancel exactly or nearly so."""
    h0, h1, h2 = high[a:b], high[a + k : b + k], high[a + 2 * k : b + 2 * k]
    l0, l1, l2 = low[a:b], low[a + k : b + k], low[a + 2 * k : b + 2 * k]
    for i in range(h0.size):
        out[i] = ((h2[i] - h1[i]) - (h1[i] - h0[i])) + ((l2[i] - l1[i]) - (l1[i] - l0[i]))


@njit(nogil=True, cache=True, fastmath=_FAST)
def _square(values):  # type: ignore[no-untyped-def]
    """Sum of squares."""
    total = 0.0
    for i in range(values.size):
        total += values[i] * values[i]
    return total


@njit(nogil=True, cache=True)
def _energy_two(high, low, a, b, k):  # type: ignore[no-untyped-def]
    """`_energy` for an angle held as two doubles."""
    buffer = np.empty(min(b - a, 2048))
    total = 0.0
    for begin in range(a, b, 2048):
        part = buffer[: min(2048, b - begin)]
        _differences_two(high, low, begin, begin + part.size, k, part)
        total += _square(part)
    return total


@njit(nogil=True, cache=True)
def _valid_rate(starts, stops, k):  # type: ignore[no-untyped-def]
    """Intervals of m whose 2k samples are all present; a run of samples [s, e) has the angles s..e."""
    keep = 0
    begin = np.empty(starts.size, np.int64)
    end = np.empty(starts.size, np.int64)
    for r in range(starts.size):
        if stops[r] - starts[r] >= 2 * k:
            begin[keep] = starts[r]
            end[keep] = stops[r] - 2 * k + 1
            keep += 1
    return begin[:keep], end[:keep]


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
def valid_intervals(starts, stops, k, angle):  # type: ignore[no-untyped-def]
    """Intervals [begin, end) of m of the valid second differences, from the runs of present samples (or angles)."""
    if angle:
        return _valid_angle(starts, stops, k)
    return _valid_rate(starts, stops, k)


@njit(nogil=True, cache=True)
def _thinned(theta, shifts):  # type: ignore[no-untyped-def]
    """``theta[::2**shift]`` for every shift (not falling), end to end in one array, and where each begins and ends."""
    begin = np.zeros(shifts.size, np.int64)
    end = np.zeros(shifts.size, np.int64)
    flat = np.empty(2 * theta.size + 64)
    flat[: theta.size] = theta
    end[0] = theta.size
    shift = 0
    a, b = 0, theta.size
    for i in range(shifts.size):
        while shift < shifts[i]:
            size = (b - a + 1) // 2
            for j in range(size):
                flat[b + j] = flat[a + 2 * j]
            a, b = b, b + size
            shift += 1
        begin[i], end[i] = a, b
    return flat, begin, end


@njit(nogil=True, cache=True)
def _part(high, low, two, begin, end, near, a, b, k, shift):  # type: ignore[no-untyped-def]
    """Sum and number of the valid terms in ``a <= m < b``; interval number `near` is the first that ends after a."""
    total = 0.0
    count = 0
    for v in range(near, begin.size):
        if begin[v] >= b:
            break
        first = (max(begin[v], a) + (1 << shift) - 1) >> shift
        last = (min(end[v], b) + (1 << shift) - 1) >> shift
        if last > first:
            count += last - first
            if two:
                total += _energy_two(high, low, first, last, k >> shift)
            else:
                total += _energy(high, first, last, k >> shift)
    return total, count


@njit(nogil=True, cache=True)
def slide(values, length, n_windows, out):  # type: ignore[no-untyped-def]
    """``out[j] = sum(values[j : j + length])`` with additions only (two running sums per group of `length`)."""
    if length == 0:
        out[:n_windows] = 0
        return
    n = n_windows + length - 1
    suffix = values[:n].copy()
    prefix = values[:n].copy()
    for i in range(n - 2, -1, -1):
        if (i + 1) % length != 0:
            suffix[i] += suffix[i + 1]
    for i in range(1, n):
        if i % length != 0:
            prefix[i] += prefix[i - 1]
    for j in range(n_windows):
        last = j + length - 1
        out[j] = suffix[j] if j % length == 0 else suffix[j] + prefix[last]


@njit(nogil=True, cache=True)
def _combine(heads, tails, head_counts, tail_counts, window, step, n_windows, ks, shifts):  # type: ignore[no-untyped-def]
    """Windows from blocks: sums, counts and gap-free counts, shape (n_windows, n_tau) each."""
    sums = np.empty((n_windows, ks.size))
    counts = np.empty((n_windows, ks.size), np.int64)
    full = np.empty((n_windows, ks.size), np.int64)
    column = np.empty(n_windows)
    column_counts = np.empty(n_windows, np.int64)
    for i in range(ks.size):
        length = window - 2 * ks[i] + 1
        whole = length // step
        slide(heads[i] + tails[i], whole, n_windows, column)
        slide(head_counts[i] + tail_counts[i], whole, n_windows, column_counts)
        for j in range(n_windows):
            first = j * step
            sums[j, i] = column[j] + heads[i, j + whole]
            counts[j, i] = column_counts[j] + head_counts[i, j + whole]
            up = (1 << shifts[i]) - 1
            full[j, i] = ((first + length + up) >> shifts[i]) - ((first + up) >> shifts[i])
    return sums, counts, full


@njit(nogil=True, cache=True)
def strict_sums(high, low, two, starts, stops, angle, window, step, n_windows, ks, shifts):  # type: ignore[no-untyped-def]
    """Sums of squared second differences of every window and averaging factor.

    Parameters
    ----------
    high, low : float64 (n + 1,)
        Angle of the unit and its rounding remainder; window j starts at point ``j * step``.
    two : bool
        Use `low` as well.
    starts, stops : int64 (n_runs,)
        Runs of present samples, or of present angles where `angle` is true.
    window, step, n_windows : int
        Window and step in samples, number of windows of the unit.
    ks, shifts : int64 (n_tau,)
        Averaging factors, and the power of two that thins the second differences: m runs over multiples of
        ``2**shift``, which divides k; not falling.

    Returns
    -------
    sums : float64 (n_windows, n_tau)
        Sum of squares [square of the unit of the angle].
    counts, full : int64 (n_windows, n_tau)
        Terms used, and terms of a window without gaps.
    """
    n_tau = ks.size
    whole = (window - 2 * ks + 1) // step
    n_blocks = n_windows + whole.max()
    heads = np.zeros((n_tau, n_blocks))
    tails = np.zeros((n_tau, n_blocks))
    head_counts = np.zeros((n_tau, n_blocks), np.int64)
    tail_counts = np.zeros((n_tau, n_blocks), np.int64)
    flat, first, last = _thinned(high, shifts)
    flat_low = _thinned(low, shifts)[0] if two else flat
    intervals = [valid_intervals(starts, stops, k, angle) for k in ks]
    passed = np.zeros(n_tau, np.int64)
    # Tiles of blocks outside, averaging factors inside: the stretch of theta in use stays in the cache.
    tile = max(1, 8192 // step)
    for tile_begin in range(0, n_blocks, tile):
        for i in range(n_tau):
            length = window - 2 * ks[i] + 1
            head_length = length - whole[i] * step
            begin, end = intervals[i]
            theta, rest = flat[first[i] : last[i]], flat_low[first[i] : last[i]]
            for block in range(tile_begin, min(tile_begin + tile, n_windows + whole[i])):
                a = block * step
                while passed[i] < end.size and end[passed[i]] <= a:
                    passed[i] += 1
                heads[i, block], head_counts[i, block] = _part(
                    theta, rest, two, begin, end, passed[i], a, a + head_length, ks[i], shifts[i]
                )
                if whole[i] > 0 and block < n_windows + whole[i] - 1:
                    tails[i, block], tail_counts[i, block] = _part(
                        theta, rest, two, begin, end, passed[i], a + head_length, a + step, ks[i], shifts[i]
                    )
    return _combine(heads, tails, head_counts, tail_counts, window, step, n_windows, ks, shifts)
