"""From samples to the angle: runs of present samples, and the integral over them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.arrays import Array, Ints
from gyrostab.kernels.allan.plain_sums import LANES, MAX_LAGS
from gyrostab.kernels.compiled import INNER, KERNEL

#: Samples that are integrated and measured while they are in the cache.
TILE = 4096
# Largest angle, relative to the median change between samples, for which one double suffices: cells
# are then wrong by 2e-11 at most, and a bias that drifts by ten times the noise within a unit of
# work does not need two doubles.
_PLAIN = 1e7


def present_runs(x: Array) -> tuple[Ints, Ints]:
    """Find first and one-past-last index of every run of finite samples."""
    present = np.isfinite(x)
    edges = np.flatnonzero(present[1:] != present[:-1]) + 1
    if present[0]:
        edges = np.append(0, edges)
    if present[-1]:
        edges = np.append(edges, x.size)
    return edges[::2].copy(), edges[1::2].copy()


@njit(**INNER)
def _integrate_run(x, offset, total, theta):  # type: ignore[no-untyped-def]
    """``theta[i] = total + sum(x[: i + 1] - offset)`` of an unbroken run; returns the last."""
    # Four at a time: one addition instead of four in the chain from sample to sample.
    unrolled_size = x.size - x.size % 4
    for i in range(0, unrolled_size, 4):
        a, b, c, d = x[i] - offset, x[i + 1] - offset, x[i + 2] - offset, x[i + 3] - offset
        ab = a + b
        theta[i] = total + a
        theta[i + 1] = total + ab
        theta[i + 2] = total + (ab + c)
        total += ab + (c + d)
        theta[i + 3] = total
    for i in range(unrolled_size, x.size):
        total += x[i] - offset
        theta[i] = total
    return total


@njit(**INNER)
def _find_largest(theta):  # type: ignore[no-untyped-def]
    """Find the largest magnitude; without sign, doubles are ordered as their bits."""
    bits = theta.view(np.int64)
    largest = np.zeros(1, np.int64)
    for i in range(bits.size):
        largest[0] = max(largest[0], bits[i] & 0x7FFFFFFFFFFFFFFF)
    return largest.view(np.float64)[0]


@njit(**INNER)
def integrate_tile(x, offset, starts, stops, a, b, total, run, theta):  # type: ignore[no-untyped-def]
    """Integrate ``x - offset`` from a to b over the runs from number `run` on; gaps add nothing.

    Returns the last angle, the largest magnitude, and the first run that ends after b.
    """
    m = a
    while m < b:
        if run < starts.size and starts[run] <= m:
            end = min(stops[run], b)
            total = _integrate_run(x[m:end], offset, total, theta[m + 1 - a : end + 1 - a])
            if end == stops[run]:
                run += 1
        else:
            end = min(starts[run], b) if run < starts.size else b
            theta[m + 1 - a : end + 1 - a] = total
        m = end
    return total, _find_largest(theta[1 : b + 1 - a]), run


@njit(**KERNEL)
def integrate(x, offset, starts, stops, theta):  # type: ignore[no-untyped-def]
    """Integrate ``x - offset`` over the runs of present samples; returns the largest magnitude."""
    theta[0] = 0.0
    total = 0.0
    largest = 0.0
    run = np.int64(0)
    for a in range(0, x.size, TILE):
        b = min(a + TILE, x.size)
        total, reached, run = integrate_tile(
            x, offset, starts, stops, a, b, total, run, theta[a : b + 1]
        )
        largest = max(largest, reached)
    return largest


@njit(**KERNEL)
def sum_two(high, low):  # type: ignore[no-untyped-def]
    """Replace numbers of two doubles by the sums of those before them, the last by that of all."""
    total = 0.0
    remainder = 0.0
    for i in range(high.size):
        value, small = high[i], low[i]
        high[i], low[i] = total, remainder
        new = total + value
        part = new - total
        remainder += ((total - (new - part)) + (value - part)) + small
        total = new


@njit(**KERNEL)
def integrate_two(x, offset, starts, stops, high, low):  # type: ignore[no-untyped-def]
    """Integrate to about 32 digits as a sum of two doubles (two-sum of Knuth)."""
    high[:] = 0.0
    low[:] = 0.0
    for r in range(starts.size):
        for i in range(starts[r], stops[r]):
            value = x[i] - offset
            part = value - x[i]
            high[i] = value
            low[i] = (x[i] - (value - part)) - (offset + part)
    sum_two(high, low)


@njit(**KERNEL)
def align_two(high, low):  # type: ignore[no-untyped-def]
    """Round `high` to a grid that keeps its third differences exact; `low` takes the rest.

    With ``max(|high|) < 2**e``, the grid is ``2**(e - 50)``: a third difference is below
    ``8 * 2**e``, thus a whole number of at most 53 bits in units of the grid.
    """
    # The spacing of the doubles near this number is that of the grid.
    shift = math.ldexp(6.0, math.frexp(_find_largest(high))[1])
    for i in range(high.size):
        rounded = (high[i] + shift) - shift
        low[i] += high[i] - rounded
        high[i] = rounded


def needs_two_doubles(largest: float, x: NDArray[np.generic]) -> bool:
    """Check whether an angle as large as `largest` costs too many digits of the noise of `x`."""
    stride = max(1, x.size // 1000)
    before = x[: x.size - 1 : stride].astype(np.float64)
    after = x[1::stride][: before.size].astype(np.float64)
    with np.errstate(invalid="ignore"):
        change = np.abs(after - before)
    change = change[np.isfinite(change)]
    return bool(change.size > 0 and largest > _PLAIN * np.median(change))


def padded_size(n_points: int, ks: Ints) -> int:
    """Find the size of an array for `n_points` and what `split_sums` reads and ignores behind them.

    `gyrostab.kernels.allan.vectors.split_sums` reads as far with the longest of its lags as with
    the shortest.
    """
    shortest = np.concatenate([np.repeat(ks[:1], MAX_LAGS - 1), ks])[: ks.size]
    return n_points + 2 * int((ks - shortest).max()) + 2 * LANES
