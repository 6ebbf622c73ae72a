"""Block sums interval by interval, for angles that need two doubles or that have gaps.

`gyrostab.kernels.allan.blocks` is several times faster and handles all other cases; both fill the
same heads and tails.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL, REORDER


@njit(**INNER)
def _valid_runs(starts, stops, span):  # type: ignore[no-untyped-def]
    """List the intervals of m whose `span` samples from m on are present."""
    keep = 0
    begin = np.empty(starts.size, np.int64)
    end = np.empty(starts.size, np.int64)
    for r in range(starts.size):
        if stops[r] - starts[r] >= span:
            begin[keep] = starts[r]
            end[keep] = stops[r] - span + 1
            keep += 1
    return begin[:keep], end[:keep]


@njit(**INNER)
def _intersect_runs(begin, end, starts, stops, shift):  # type: ignore[no-untyped-def]
    """Intersect intervals with runs that are moved down by `shift`."""
    low = np.empty(begin.size + starts.size, np.int64)
    high = np.empty(begin.size + starts.size, np.int64)
    i = j = keep = 0
    while i < begin.size and j < starts.size:
        first, last = max(begin[i], starts[j] - shift), min(end[i], stops[j] - shift)
        if first < last:
            low[keep], high[keep] = first, last
            keep += 1
        if end[i] < stops[j] - shift:
            i += 1
        else:
            j += 1
    return low[:keep], high[:keep]


@njit(**INNER)
def valid_intervals(starts, stops, k, span, points):  # type: ignore[no-untyped-def]
    """List the intervals [begin, end) of m of the valid differences, from runs of samples.

    Either `span` samples from m on must be present or, with `points`, only that many at distances
    of k: the angles of an angle log (the paper's test).
    """
    if points == 0:
        return _valid_runs(starts, stops, span)
    begin, end = starts.copy(), stops.copy()
    for i in range(1, points):
        begin, end = _intersect_runs(begin, end, starts, stops, i * k)
    return begin, end


@njit(fastmath=REORDER, **INNER)
def _sum_squares(theta, a, b, k, order):  # type: ignore[no-untyped-def]
    """Sum of squared second or third differences over ``a <= m < b``."""
    # Three slices: with theta[m + k] the signed index costs a wraparound test that blocks
    # vectorisation.
    first = theta[a:b]
    middle = theta[a + k : b + k]
    last = theta[a + 2 * k : b + 2 * k]
    total = 0.0
    if order == 3:
        beyond = theta[a + 3 * k : b + 3 * k]
        for i in range(first.size):
            d = (beyond[i] - first[i]) - 3.0 * (last[i] - middle[i])
            total += d * d
        return total
    for i in range(first.size):
        d = last[i] - 2.0 * middle[i] + first[i]
        total += d * d
    return total


@njit(**INNER)
def _form_difference(first, middle, last, beyond, order):  # type: ignore[no-untyped-def]
    """Second or third difference, without reassociation."""
    if order == 3:
        return (beyond - first) - 3.0 * (last - middle)
    return (last - middle) - (middle - first)


@njit(**INNER)
def _differences_two(high, low, a, b, k, order, out):  # type: ignore[no-untyped-def]
    """Compute differences of an angle held as two doubles."""
    c, d = a + 2 * k, a + order * k
    h0, h1, h2, h3 = high[a:b], high[a + k :], high[c:], high[d:]
    l0, l1, l2, l3 = low[a:b], low[a + k :], low[c:], low[d:]
    for i in range(h0.size):
        high_part = _form_difference(h0[i], h1[i], h2[i], h3[i], order)
        out[i] = high_part + _form_difference(l0[i], l1[i], l2[i], l3[i], order)


@njit(fastmath=REORDER, **INNER)
def _square_sum(values):  # type: ignore[no-untyped-def]
    """Sum of squares."""
    total = 0.0
    for i in range(values.size):
        total += values[i] * values[i]
    return total


@njit(**INNER)
def _energy_two(high, low, a, b, k, order):  # type: ignore[no-untyped-def]
    """`_sum_squares` for an angle held as two doubles."""
    buffer = np.empty(min(b - a, 2048))
    total = 0.0
    for begin in range(a, b, 2048):
        part = buffer[: min(2048, b - begin)]
        _differences_two(high, low, begin, begin + part.size, k, order, part)
        total += _square_sum(part)
    return total


@njit(**INNER)
def _sum_part(high, low, begin, end, first_interval, a, b, k, order):  # type: ignore[no-untyped-def]
    """Sum and count the valid terms in ``a <= m < b``; `first_interval` ends first after a."""
    total, count = 0.0, 0
    for v in range(first_interval, begin.size):
        if begin[v] >= b:
            break
        first, last = max(begin[v], a), min(end[v], b)
        if last > first:
            count += last - first
            if low.size > 0:
                total += _energy_two(high, low, first, last, k, order)
            else:
                total += _sum_squares(high, first, last, k, order)
    return total, count


@njit(**KERNEL)
def single_blocks(high, low, starts, stops, order, spans, points, cut):  # type: ignore[no-untyped-def]
    """Sum heads and tails as `grouped_blocks`; `low` is the remainder of `high`, or empty.

    `order` is that of the differences; `spans` (n_tau,) and `points` as for `valid_intervals`.
    """
    step, ks, head_lengths, whole_blocks, n_windows = cut
    out = np.zeros((4, n_windows + whole_blocks[0], ks.size))
    for i in range(ks.size):
        begin, end = valid_intervals(starts, stops, ks[i], spans[i], points)
        last = n_windows + whole_blocks[i] - 1
        first_interval = 0
        for block in range(last + 1):
            edges = (block * step, block * step + head_lengths[i], (block + 1) * step)
            while first_interval < end.size and end[first_interval] <= edges[0]:
                first_interval += 1
            for half in range(2 if whole_blocks[i] > 0 and block < last else 1):
                out[half, block, i], out[2 + half, block, i] = _sum_part(
                    high, low, begin, end, first_interval, edges[half], edges[half + 1], ks[i],
                    order,
                )  # fmt: skip
    return out
