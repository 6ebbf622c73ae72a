"""Weighted cluster means: the Allan variance of a rate log with too many gaps for unbroken runs.

Each cluster mean uses the samples that are present; a pair of clusters with n1 and n2 samples has
the weight n1 n2, and both must be at least half full. Random walk and flicker noise are unbiased.
White and quantization noise are too high by factors that depend only on the mask. A ramp is
slightly off, because lost samples move the centres of the clusters. These responses are returned,
so that a fit can use them as its columns.

What a pair of clusters adds does not depend on the window, so pairs are summed in blocks like the
other terms (see `gyrostab.kernels.allan.blocks`). Samples and runs are counted in a mask of one bit
per sample, which stays in the cache.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.extending import intrinsic

from gyrostab.arrays import Ints
from gyrostab.kernels.allan.blocks import windows_from_blocks
from gyrostab.kernels.compiled import INNER, KERNEL, REORDER

# First terms of the pairs that are summed for the degrees of freedom, at most; where there are
# more, sections of so many.
_TERMS = 384
_SECTION = 8
# Places of the sections: spread evenly, but in step with no regular loss.
_GOLDEN = 0.6180339887498949


def cluster_strides(window: int, ks: Ints) -> Ints:
    """Choose the distance of the pairs of clusters, a power of two.

    Pairs closer than k/16 add almost no information if many of them fit the window; if 256 or fewer
    do, all are used.
    """
    largest = np.maximum(np.minimum(ks // 16, (window - 2 * ks + 1) // 256), 1)
    return np.asarray(2 ** np.floor(np.log2(largest)).astype(np.int64))


@intrinsic
def _count_ones(typing_context, word):  # type: ignore[no-untyped-def]
    """Number of bits of a word that are set."""
    return word(word), lambda context, builder, signature, args: builder.ctpop(args[0])


@njit(**KERNEL)
def pack_mask(starts, stops, n):  # type: ignore[no-untyped-def]
    """Pack the runs of present samples into a mask of 64 samples per row.

    Returns
    -------
    int64 (n // 64 + 1, 4)
        Bits of the samples present, and of those that begin a run; counts of both before this row.
    """
    mask = np.zeros((n // 64 + 1, 4), np.int64)
    bit = np.int64(1)
    for r in range(starts.size):
        first, last = starts[r] >> 6, (stops[r] - 1) >> 6
        for row in range(first, last + 1):
            word = np.int64(-1)
            if row == first:
                word &= -(bit << (starts[r] & 63))
            if row == last and stops[r] & 63:
                word &= (bit << (stops[r] & 63)) - bit
            mask[row, 0] |= word
        mask[first, 1] |= bit << (starts[r] & 63)
    for row in range(1, mask.shape[0]):
        mask[row, 2] = mask[row - 1, 2] + _count_ones(mask[row - 1, 0])
        mask[row, 3] = mask[row - 1, 3] + _count_ones(mask[row - 1, 1])
    return mask


@njit(**INNER)
def _count_before(mask, m):  # type: ignore[no-untyped-def]
    """Number of samples present before m."""
    row = np.uint64(m >> 6)
    return mask[row, 2] + _count_ones(mask[row, 0] & ((np.int64(1) << (m & 63)) - 1))


@njit(**KERNEL)
def integrate_places(starts, stops, n):  # type: ignore[no-untyped-def]
    """Integrate a ramp of one per sample over the present samples; exact up to 2^26 samples."""
    out = np.empty(n + 1)
    total, at = 0.0, np.int64(0)
    for r in range(starts.size):
        out[at : starts[r] + 1] = total
        for i in range(starts[r], stops[r]):
            total += i
            out[i + 1] = total
        at = stops[r] + 1
    out[at:] = total
    return out


@njit(**INNER)
def _add_pairs(theta, places, mask, a, b, k, stride, row):  # type: ignore[no-untyped-def]
    """Add the pairs of clusters in ``a <= m < b``: weight d^2, weight, responses, number, trend."""
    bit = np.int64(1)
    squares = weights = white = quantization = ramp = slope = 0.0
    count = 0
    for m in range((a + stride - 1) // stride * stride, b, stride):
        row0, row1, row2 = np.uint64(m >> 6), np.uint64((m + k) >> 6), np.uint64((m + 2 * k) >> 6)
        low0 = (bit << (m & 63)) - bit
        low1 = (bit << ((m + k) & 63)) - bit
        low2 = (bit << ((m + 2 * k) & 63)) - bit
        middle = mask[row1, 2] + _count_ones(mask[row1, 0] & low1)
        n1 = middle - mask[row0, 2] - _count_ones(mask[row0, 0] & low0)
        n2 = mask[row2, 2] + _count_ones(mask[row2, 0] & low2) - middle
        if 2 * n1 < k or 2 * n2 < k:
            continue
        f1, f2 = float(n1), float(n2)
        at0, at1, at2 = np.uint64(m), np.uint64(m + k), np.uint64(m + 2 * k)
        d = (theta[at2] - theta[at1]) * f1 - (
            theta[at1] - theta[at0]
        ) * f2  # n1 n2 times the difference of the means
        before, behind = places[at1] - places[at0], places[at2] - places[at1]
        apart = behind * f1 - before * f2  # and that of their centres
        # a run that a cluster cuts counts in both
        runs = mask[row1, 3] + _count_ones(mask[row1, 1] & low1)
        cut0 = mask[row0, 0] & ~mask[row0, 1] & (low0 + bit) != 0
        cut1 = mask[row1, 0] & ~mask[row1, 1] & (low1 + bit) != 0
        r1 = runs - mask[row0, 3] - _count_ones(mask[row0, 1] & low0) + cut0
        r2 = mask[row2, 3] + _count_ones(mask[row2, 1] & low2) - runs + cut1
        inverse = 1.0 / (f1 * f2)
        squares += d * d * inverse
        ramp += apart * apart * inverse
        slope += apart * d * inverse
        weights += f1 * f2
        white += f1 + f2
        quantization += 2.0 * (r1 * f2 * f2 + r2 * f1 * f1) * inverse + 2.0 * cut1
        count += 1
    row[0] += squares
    row[1] += weights
    row[2] += white
    row[3] += quantization
    row[4] += count
    row[5] += ramp
    row[6] += slope


@njit(**KERNEL)
def cluster_cells(theta, places, mask, window, step, k, stride, poor):  # type: ignore[no-untyped-def]
    """Compute the cells of the `poor` windows of one averaging factor by weighted cluster means.

    Parameters
    ----------
    theta : float64 (n + 1,)
        Integral of the rate over present samples; gaps add nothing.
    places : float64 (n + 1,)
        Result of `integrate_places`.
    mask
        Result of `pack_mask`.
    window, step, k, stride : int
        Window, step, averaging factor and distance of the pairs of clusters [samples].
    poor : bool (n_windows,)
        Windows to compute.

    Returns
    -------
    float64 (n_windows, 7)
        Weighted mean of ``(mean2 - mean1)^2 / 2`` [square of the rate's unit]; responses to unit
        white and quantization noise, relative to the gap-free laws; weight used, as a share of the
        gap-free weight; number of pairs used, 0 without pairs or if the window is not computed;
        response to a ramp; slope of the rate per sample that fits the pairs best.
    """
    length = window - 2 * k + 1
    whole_blocks = length // step
    head = length - whole_blocks * step
    n_windows = poor.size
    heads, tails = np.zeros((n_windows + whole_blocks, 7)), np.zeros((n_windows + whole_blocks, 7))
    last = -1
    for j in range(n_windows):
        if poor[j]:
            for block in range(max(last + 1, j), j + whole_blocks + 1):
                a = block * step
                _add_pairs(theta, places, mask, a, a + head, k, stride, heads[block])
                if block < n_windows + whole_blocks - 1:
                    _add_pairs(theta, places, mask, a + head, a + step, k, stride, tails[block])
            last = j + whole_blocks
    sums = np.empty((n_windows, 7))
    windows_from_blocks(heads, tails, np.full(7, whole_blocks), sums)
    out = np.zeros((n_windows, 7))
    for j in range(n_windows):
        if poor[j] and sums[j, 4] > 0.0:
            offered = (j * step + length + stride - 1) // stride - (j * step + stride - 1) // stride
            out[j, 0] = sums[j, 0] / (2.0 * sums[j, 1])
            out[j, 1] = sums[j, 2] / (2.0 * sums[j, 1]) * k
            out[j, 2] = sums[j, 3] / (2.0 * sums[j, 1]) * k * k / 3.0
            out[j, 3] = sums[j, 1] / (offered * float(k) * k)
            out[j, 4] = sums[j, 4]
            out[j, 5] = sums[j, 5] / (sums[j, 1] * float(k) * k)
            out[j, 6] = sums[j, 6] / sums[j, 5]
    return out


@njit(**INNER)
def _fill_grid(mask, begin, grid, k, places):  # type: ignore[no-untyped-def]
    """Fill the columns of `places` for m on a grid from `begin` on.

    Rows: present samples before m, m + k and m + 2k, those of the two clusters, and the reciprocal
    of the product of these two, or zero where a cluster is less than half full.
    """
    for i in range(places.shape[1]):
        m = begin + i * grid
        for side in range(3):
            places[side, i] = _count_before(mask, m + side * k)
        places[3, i] = places[1, i] - places[0, i]
        places[4, i] = places[2, i] - places[1, i]
        used = 2 * places[3, i] >= k and 2 * places[4, i] >= k
        places[5, i] = 1.0 / (places[3, i] * places[4, i]) if used else 0.0


@njit(fastmath=REORDER, **INNER)
def _sum_overlapping(places, i, first, stop):  # type: ignore[no-untyped-def]
    """Sum weight times squared covariance with term i, over terms less than k after term i.

    The clusters have n1 and n2 samples, those of the other term p1 and p2; only overlapping
    clusters share samples.
    """
    a1, a2, n1, n2 = places[1, i], places[2, i], places[3, i], places[4, i]
    b0 = places[0, first:stop]
    b1 = places[1, first:stop]
    p1 = places[3, first:stop]
    p2 = places[4, first:stop]
    inverse = places[5, first:stop]
    total = 0.0
    for j in range(inverse.size):
        shared = (a1 - b0[j]) * n2 * p2[j] + (a2 - b1[j]) * n1 * p1[j] - (b1[j] - a1) * n1 * p2[j]
        total += shared * shared * inverse[j]
    return total


@njit(fastmath=REORDER, **INNER)
def _sum_touching(places, i, first, stop):  # type: ignore[no-untyped-def]
    """Sum the same for terms k to 2k after term i, which overlap only its second cluster."""
    a2, n1 = places[2, i], places[3, i]
    b0, p2, inverse = places[0, first:stop], places[4, first:stop], places[5, first:stop]
    total = 0.0
    for j in range(inverse.size):
        shared = max(a2 - b0[j], 0.0) * n1 * p2[j]
        total += shared * shared * inverse[j]
    return total


@njit(**INNER)
def _add_section(places, lags, close, many, sums):  # type: ignore[no-untyped-def]
    """Add the pairs of terms whose first is one of the first `many`, of the mask and without gaps.

    `sums` gets the weight, the pairs, and both of a full window; `lags` are the running sums of the
    squared correlations of a full window, and `close` of them belong to clusters that overlap their
    own shifted selves.
    """
    size = places.shape[1]
    for i in range(many):
        stop = min(i + lags.size, size)
        sums[2] += 1.0
        sums[3] += 1.0 + 2.0 * lags[stop - i - 1]
        if places[5, i] == 0.0:
            continue
        weight = places[3, i] + places[4, i]
        overlap_stop = min(i + close, stop)
        sums[0] += weight
        sums[1] += weight * weight + 2.0 * places[5, i] * (
            _sum_overlapping(places, i, i + 1, overlap_stop)
            + _sum_touching(places, i, overlap_stop, stop)
        )


@njit(**INNER)
def _pair_sums(mask, begin, end, grid, k, sums):  # type: ignore[no-untyped-def]
    """Sum `_add_section` over the terms ``begin, begin + grid, ... < end``, or sections of them."""
    total = (end - begin + grid - 1) // grid
    lags = np.zeros(2 * k // grid + 1)
    for i in range(1, lags.size):
        lag = i * grid / k
        rho = 1.0 - 1.5 * lag if lag <= 1.0 else 0.5 * lag - 1.0
        lags[i] = lags[i - 1] + rho * rho
    close = (k + grid - 1) // grid
    sections = 1 if total <= _TERMS else _TERMS // _SECTION
    many = total if sections == 1 else _SECTION
    places = np.empty((6, min(total, many + lags.size - 1)))
    sums[:] = 0.0
    for section in range(sections):
        first = int((section + section * _GOLDEN % 1.0) / sections * (total - many))
        part = places[:, : min(total - first, places.shape[1])]
        _fill_grid(mask, begin + first * grid, grid, k, part)
        _add_section(part, lags, close, many, sums)


@njit(**KERNEL)
def cluster_factors(mask, has_pairs, window, step, k, stride):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of cells under white noise, relative to those without gaps.

    The pairs of terms are on a grid of k/8 to k/4, finer if few terms fit the window or all those
    on the grid are lost.

    Parameters
    ----------
    has_pairs : bool (n_windows,)
        Windows to compute.
    mask, window, step, k, stride
        As for `cluster_cells`.

    Returns
    -------
    float64 (n_windows,)
        0 where not computed.
    """
    factors = np.zeros(has_pairs.size)
    sums = np.zeros(4)
    for j in range(has_pairs.size):
        if not has_pairs[j]:
            continue
        first, end = j * step, j * step + window - 2 * k + 1
        grid = stride
        while 8 * grid <= k and 48 * grid <= end - first:
            grid *= 2
        sums[:] = 0.0
        while grid >= stride and sums[1] == 0.0:
            _pair_sums(mask, (first + stride - 1) // stride * stride, end, grid, k, sums)
            grid //= 2
        if sums[1] > 0.0:
            factors[j] = sums[0] * sums[0] / sums[1] * sums[3] / (sums[2] * sums[2])
    return factors
