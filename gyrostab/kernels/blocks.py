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

from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.vectors import IN_A_ROW, TOGETHER, split_sums

__all__ = ["full_counts", "grouped_blocks", "groups", "windows_from_blocks"]

# Points of the angle in one pass: what several averaging factors read of them stays in the first-level cache.
_TILE = 2048
# Points whose blocks a group of averaging factors takes one after the other, so that the processor can foresee where its loops end:
# with the sums of these blocks they stay in the second-level cache.
_FORESEEN = 16384


def groups(ks: NDArray[np.int64], shifts: NDArray[np.int64]) -> NDArray[np.int64]:
    """First averaging factor of each group that goes through the angle together, and the end.

    The factors of a group have one shift; there are `TOGETHER` of them at most, or `IN_A_ROW` that follow each other.
    """
    starts = np.flatnonzero(np.diff(shifts)) + 1
    lags = ks >> shifts
    first: list[int] = []
    for at, end in zip([0, *starts], [*starts, shifts.size], strict=True):
        while at + IN_A_ROW <= end and lags[at + IN_A_ROW - 1] - lags[at] == IN_A_ROW - 1:
            first.append(at)
            at += IN_A_ROW
        first.extend(range(at, end, TOGETHER))
        if (end - at) % TOGETHER == 1 and end - at > TOGETHER:
            first[-1] -= 1  # two and a few rather than one alone
    return np.array([*first, shifts.size])


@njit(**INNER)
def _limit(i, count, first, high, stop, step, block, n_windows, ks, shifts, head_lengths, whole, splits, sizes):  # type: ignore[no-untyped-def]
    """Terms of the head and of head and tail, from `first` on, of `count` averaging factors from number i on; the most of them."""
    shift = shifts[i]
    up = (1 << shift) - 1
    a = block * step
    largest = 0
    for q in range(count):
        split = a + head_lengths[i + q]
        last = n_windows + whole[i + q] - 1
        end = split if block == last or whole[i + q] == 0 else a + step
        end = ((min(end, high, stop - 2 * ks[i + q]) + up) >> shift) - first
        sizes[q] = end if end > 0 and block <= last else 0
        splits[q] = min(sizes[q], max(0, ((split + up) >> shift) - first))
        largest = max(largest, sizes[q])
    return largest


@njit(**KERNEL)
def grouped_blocks(flat, places, starts, stops, step, ks, shifts, groups, head_lengths, whole, n_windows, out):  # type: ignore[no-untyped-def]
    """Heads and tails of every block and averaging factor, and their numbers of terms, into `out` (2 or 4, n_blocks, n_tau).

    `starts`, `stops` are runs of present points of the angle; ``flat[places[i]:]`` is the angle thinned by ``2**shifts[i]``;
    `whole` is not rising; there are ``n_windows + whole[0]`` blocks.
    """
    n_blocks = out.shape[1]
    counted = out.shape[0] > 2
    heads, tails = out[0].reshape(-1), out[1].reshape(-1)
    near = np.zeros(groups.size, np.int64)
    lags = ks >> shifts
    splits, sizes = np.empty(IN_A_ROW, np.int64), np.empty(IN_A_ROW, np.int64)
    together = max(1, _FORESEEN // step)
    # No slice of an array and no new array in these loops: each costs as much as a hundred terms.
    for begin in range(0, n_blocks, together):
        out[:, begin : begin + together] = 0.0
        for tile in range(0, step, _TILE):
            for g in range(groups.size - 1):
                i = groups[g]
                count = groups[g + 1] - i
                shift = shifts[i]
                if tile & ((_TILE << shift) - 1):
                    continue
                for block in range(begin, min(begin + together, n_blocks)):
                    low = block * step + tile
                    high = min(low + (_TILE << shift), (block + 1) * step)
                    place = block * ks.size + i
                    while near[g] < stops.size and stops[near[g]] - 2 * ks[i] <= low:
                        near[g] += 1
                    for r in range(near[g], stops.size):
                        if starts[r] >= high:
                            break
                        first = (max(low, starts[r]) + (1 << shift) - 1) >> shift
                        if _limit(i, count, first, high, stops[r], step, block, n_windows, ks, shifts, head_lengths, whole, splits, sizes):
                            split_sums(flat, places[i] + first, count, lags, i, splits, sizes, heads, tails, place)
                            if counted:
                                for q in range(count):
                                    out[2, block, i + q] += splits[q]
                                    out[3, block, i + q] += sizes[q] - splits[q]


@njit(**INNER)
def _slide(heads, tails, length, first, stop, out):  # type: ignore[no-untyped-def]
    """Windows of `length` whole blocks and one head, columns `first` to `stop`: per group of `length` windows two running sums."""
    n = out.shape[0]
    suffix = np.empty((length, stop - first))
    prefix = np.empty(stop - first)
    for begin in range(0, n, length):
        for b in range(length - 1, -1, -1):
            row, head, tail = suffix[b], heads[begin + b, first:stop], tails[begin + b, first:stop]
            before = suffix[min(b + 1, length - 1)]
            for i in range(row.size):
                row[i] = head[i] + tail[i] if b == length - 1 else before[i] + (head[i] + tail[i])
        prefix[:] = 0.0
        for j in range(begin, min(begin + length, n)):
            row, head, result = suffix[j - begin], heads[j + length, first:stop], out[j, first:stop]
            for i in range(prefix.size):
                result[i] = row[i] + prefix[i] + head[i]
            tail = tails[j + length, first:stop]
            for i in range(prefix.size):
                prefix[i] += head[i] + tail[i]


@njit(**KERNEL)
def windows_from_blocks(heads, tails, whole, out):  # type: ignore[no-untyped-def]
    """``out[j, i] = sum(heads[j : j + whole[i], i] + tails[...]) + heads[j + whole[i], i]``, additions only."""
    first = np.int64(0)
    while first < whole.size:
        stop = first + 1
        while stop < whole.size and whole[stop] == whole[first]:
            stop += 1
        if whole[first] > 0:
            _slide(heads, tails, whole[first], first, stop, out)
        else:
            for j in range(out.shape[0]):
                for i in range(first, stop):
                    out[j, i] = heads[j, i]
        first = stop


def full_counts(window: int, step: int, n_windows: int, ks: NDArray[np.int64], shifts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Terms of each window without gaps, (n_windows, n_tau)."""
    lengths = window - 2 * ks + 1
    if not shifts.any():
        return np.tile(lengths.astype(np.float64), (n_windows, 1))
    up = (1 << shifts) - 1
    first = step * np.arange(n_windows)[:, None] + up
    return (((first + lengths) >> shifts) - (first >> shifts)).astype(np.float64)
