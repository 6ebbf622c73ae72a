"""Improved fast DAVAR by two-part block sums: every second difference once, additions only.

Windows start on multiples of the step S and hold ``L = W - 2k + 1`` second differences of the
angle. Per block of S samples and per averaging factor k two sums are kept: the *head*, the first
``L mod S`` terms, and the *tail*, the rest. A window is then a number of whole blocks plus one
head, exactly. Nothing is subtracted, so a shock does not affect later sums, as it does in a
recursion (Wang et al., Sensors 16 (2016), Eq. 19).

The angle is integrated anew for each unit of work from the rate less a constant: the Allan variance
does not depend on a constant rate, and a short integral keeps its precision on a rotating tool.
Where even the short integral is too large for double precision (a shock of 10^6 sigma) the angle is
kept as a sum of two doubles.

Missing samples never enter the loops: valid terms are intervals between gaps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from gyrostab.arrays import Ints
from gyrostab.kernels.allan.integrate import TILE, integrate_tile
from gyrostab.kernels.allan.plain_sums import CONSECUTIVE_LAGS, MAX_LAGS
from gyrostab.kernels.compiled import INNER, KERNEL

try:
    from gyrostab.kernels.allan.vectors import split_sums
except ImportError:  # without llvmlite, or where numba has moved what the vectors are built with
    from gyrostab.kernels.allan.plain_sums import split_sums

# Points that a group of averaging factors goes through before the next one does: so few that they
# stay in the second-level cache, so many
# that the processor can foresee where the loops of short blocks end.
_STRETCH_POINTS = 65536


class Cut(NamedTuple):
    """How windows and their terms are cut into blocks."""

    step: int  # samples of a block
    ks: Ints  # (n_tau,): averaging factors
    head_lengths: Ints  # (n_tau,): terms of a head
    whole_blocks: Ints  # (n_tau,): blocks of a window, not rising
    n_windows: int  # windows: there are ``n_windows + whole_blocks[0]`` blocks


def group_factors(ks: Ints) -> Ints:
    """Group the averaging factors that share one pass over the angle: first of each, and the end.

    A group has at most `MAX_LAGS` of them, or `CONSECUTIVE_LAGS` that follow each other.
    """
    first: list[int] = []
    at, end = 0, ks.size
    while (
        at + CONSECUTIVE_LAGS <= end
        and ks[at + CONSECUTIVE_LAGS - 1] - ks[at] == CONSECUTIVE_LAGS - 1
    ):
        first.append(at)
        at += CONSECUTIVE_LAGS
    first.extend(range(at, end, MAX_LAGS))
    if (end - at) % MAX_LAGS == 1 and end - at > MAX_LAGS:
        first[-1] -= 1  # two and a few rather than one alone
    return np.array([*first, end])


@njit(**INNER)
def _limit_terms(i, count, first, high, stop, block, cut, splits, sizes):  # type: ignore[no-untyped-def]
    """Count the terms of head, and of head and tail, of `count` factors from number i on."""
    step, ks, head_lengths, whole_blocks, n_windows = cut
    a = block * step
    largest = 0
    for q in range(count):
        split = a + head_lengths[i + q]
        last = n_windows + whole_blocks[i + q] - 1
        end = split if block == last or whole_blocks[i + q] == 0 else a + step
        end = min(end, high, stop - 2 * ks[i + q]) - first
        sizes[q] = end if end > 0 and block <= last else 0
        splits[q] = min(sizes[q], max(0, split - first))
        largest = max(largest, sizes[q])
    return largest


@njit(**INNER)
def _add_stretch(  # type: ignore[no-untyped-def]
    flat, base, starts, stops, begin, end, tile, cut, groups, first_runs, splits, sizes, out
):
    """Add the terms of the blocks from `begin` to `end`, from sample `tile` of each block on.

    At most `_STRETCH_POINTS` samples of each block are used; `first_runs` holds the first runs in
    reach.
    """
    step, ks = cut.step, cut.ks
    heads, tails = out[0].reshape(-1), out[1].reshape(-1)
    # No slice of an array and no new array in these loops: each costs as much as a hundred terms.
    for g in range(groups.size - 1):
        i = groups[g]
        count = groups[g + 1] - i
        for block in range(begin, end):
            low = block * step + tile
            high = min(low + _STRETCH_POINTS, (block + 1) * step)
            while first_runs[g] < stops.size and stops[first_runs[g]] - 2 * ks[i] <= low:
                first_runs[g] += 1
            for r in range(first_runs[g], stops.size):
                if starts[r] >= high:
                    break
                first = max(low, starts[r])
                if _limit_terms(i, count, first, high, stops[r], block, cut, splits, sizes):
                    place, row = first - base, block * ks.size + i
                    split_sums(flat, place, count, ks, i, splits, sizes, heads, tails, row)
                    if out.shape[0] > 2:
                        for q in range(count):
                            out[2, block, i + q] += splits[q]
                            out[3, block, i + q] += sizes[q] - splits[q]


@njit(**INNER)
def _move_to_front(flat, by, held):  # type: ignore[no-untyped-def]
    """Move the points from `by` to `held` to the beginning of `flat`."""
    for m in range(held - by):
        flat[m] = flat[m + by]


def held_points(n_points: int, step: int, ks: Ints) -> int:
    """Find how many points of the angle `grouped_blocks` keeps: twice the reach of its terms."""
    return min(4 * int(ks[-1]) + 2 * max(step, _STRETCH_POINTS) + TILE + 1, n_points)


@njit(**KERNEL)
def grouped_blocks(x, offset, flat, capacity, starts, stops, cut, groups, out):  # type: ignore[no-untyped-def]
    """Sum heads and tails of every block and averaging factor, and count their terms.

    The angle is integrated as the blocks need it, and only as much of it is held as fits in the
    cache.

    Parameters
    ----------
    x : ndarray (n,)
        Rates, or empty if `flat` already holds the angle.
    offset : float
        Subtracted from each rate.
    flat, capacity : float64, int
        Buffer for `capacity` points of the angle (see `held_points`), of `padded_size` elements.
    starts, stops : int64 (n_runs,)
        Runs of present points of the angle, one more each than of present rates.
    cut : Cut
        Blocks.
    groups : int64 (n_groups + 1,)
        Result of `group_factors`.
    out : float64 (2 or 4, n_blocks, n_tau)
        Overwritten.

    Returns
    -------
    float
        Largest magnitude of the angle that was integrated.
    """
    n_blocks, step, ks = out.shape[1], cut.step, cut.ks
    first_runs, ends = np.zeros(groups.size, np.int64), stops - 1
    splits, sizes = np.empty(CONSECUTIVE_LAGS, np.int64), np.empty(CONSECUTIVE_LAGS, np.int64)
    together = max(1, _STRETCH_POINTS // step)
    base = done = run = np.int64(0)
    total = largest = 0.0
    if x.size > 0:
        flat[0] = 0.0
    for begin in range(0, n_blocks, together):
        end = min(begin + together, n_blocks)
        out[:, begin:end] = 0.0
        for tile in range(0, step, _STRETCH_POINTS):
            first = begin * step + tile
            needed = min((end - 1) * step + min(tile + _STRETCH_POINTS, step) + 2 * ks[-1], x.size)
            while done < needed:
                b = min(done + TILE, x.size)
                if b + 1 - base > capacity:
                    _move_to_front(flat, first - base, done + 1 - base)
                    base = first
                total, reached, run = integrate_tile(
                    x, offset, starts, ends, done, b, total, run, flat[done - base : b + 1 - base]
                )
                largest = max(largest, reached)
                done = b
            _add_stretch(
                flat, base, starts, stops, begin, end, tile, cut, groups, first_runs, splits, sizes,
                out,
            )  # fmt: skip
    return largest


@njit(**INNER)
def _sum_windows(heads, tails, length, first, stop, out):  # type: ignore[no-untyped-def]
    """Add windows of `length` whole blocks and one head, for the columns from `first` to `stop`."""
    n = out.shape[0]
    suffix = np.empty((length, stop - first))
    prefix = np.empty(stop - first)
    for begin in range(0, n, length):
        for b in range(length - 1, -1, -1):
            row, head, tail = suffix[b], heads[begin + b, first:stop], tails[begin + b, first:stop]
            next_row = suffix[min(b + 1, length - 1)]
            for i in range(row.size):
                row[i] = head[i] + tail[i] if b == length - 1 else next_row[i] + (head[i] + tail[i])
        prefix[:] = 0.0
        for j in range(begin, min(begin + length, n)):
            row, head, result = suffix[j - begin], heads[j + length, first:stop], out[j, first:stop]
            for i in range(prefix.size):
                result[i] = row[i] + prefix[i] + head[i]
            tail = tails[j + length, first:stop]
            for i in range(prefix.size):
                prefix[i] += head[i] + tail[i]


@njit(**KERNEL)
def windows_from_blocks(heads, tails, whole_blocks, out):  # type: ignore[no-untyped-def]
    """Add blocks ``j .. j + whole_blocks[i] - 1`` and the head of the next, by additions only."""
    first = np.int64(0)
    while first < whole_blocks.size:
        stop = first + 1
        while stop < whole_blocks.size and whole_blocks[stop] == whole_blocks[first]:
            stop += 1
        if whole_blocks[first] > 0:
            _sum_windows(heads, tails, whole_blocks[first], first, stop, out)
        else:
            for j in range(out.shape[0]):
                for i in range(first, stop):
                    out[j, i] = heads[j, i]
        first = stop
