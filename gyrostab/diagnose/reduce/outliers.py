"""Sample counts that a spectrum does not show: outliers, exact zeros, and the quantization step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from gyrostab.arrays import Array, Bools, Floats, Ints
from gyrostab.kernels.samples.outliers import HISTOGRAM, departures, histogram_edge, peaks

#: Expected number of false outliers of an axis in a record of Gaussian noise. Design choice.
EXPECTED_FALSE_OUTLIERS = 0.02
_MIN_OUTLIER_SIGMA = 4.0  # deviations of the block; lower peaks are not stored; design choice
_LEVEL_LOG_SCATTERS = np.linspace(0.0, 0.6, 61)  # tried scatters of log noise level within blocks
#: Deviations between which departures show a fluctuating noise level but few outliers. Design
#: choice.
_TAIL_RANGE_SIGMA = (2.5, 3.7)
_MIN_STEP_ERRORS = 64.0  # rounding errors in the smallest quantization step; design choice
_MAX_OFF_GRID_SHARE = 0.01  # of the values, off a coarse quantization grid; design choice
_STEP_ERROR_SHARE = 1e-3  # of the step, from rounding errors of the values; design choice
_SPIKE_SHARE = 0.1  # of the values, where spikes may be as common as grid values; design choice
_NEIGHBOUR_BLOCKS = 2  # on either side, that enter the deviation of a block; design choice
_NOISIER_NEIGHBOUR_RATIO = 1.5  # of deviations, from which a noisier neighbour counts
NORMAL_MEDIAN_ABS = 0.6745  # median of |x| of a standard normal variable


class Peaks(NamedTuple):
    """Samples of an axis that may be outliers, from `gyrostab.kernels.samples.outliers.peaks`."""

    block: Ints  # (peak,)
    size: Floats  # (peak,): departure from the neighbours
    level: Floats  # (peak,): standard deviation of the noise right before or after it


def find_peaks(values: Floats, histogram: NDArray[np.uint32]) -> Peaks:
    """Find the peaks of some blocks (block, sample) of an axis that may be outliers.

    The histogram (block, `HISTOGRAM`) of departures by size is updated.

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal((50, 200))
    >>> x[7, 100] += 30.0
    >>> found = find_peaks(x, np.zeros((50, HISTOGRAM), np.uint32))
    >>> int(found.block[found.size.argmax()]), float(found.size.max().round())
    (7, 29.0)
    """
    departure = np.empty_like(values)
    departures(values, departure, histogram)
    deviation = _deviation_from_median(histogram.astype(np.int64))
    return Peaks(*peaks(values, departure, deviation, _MIN_OUTLIER_SIGMA))


def outlier_limit(samples: float) -> float:
    """Return the limit [standard deviations], at least 4, with `EXPECTED_FALSE_OUTLIERS` beyond.

    Examples
    --------
    >>> round(outlier_limit(18_000), 2), round(outlier_limit(8_640_000), 2)
    (4.87, 5.97)
    """
    return float(
        max(-ndtri(EXPECTED_FALSE_OUTLIERS / (2.0 * max(samples, 1.0))), _MIN_OUTLIER_SIGMA)
    )


def count_histogram_outliers(
    histogram: NDArray[np.uint32], peaks: Sequence[Sequence[Peaks]]
) -> tuple[Ints, Ints]:
    """Return the number of outliers, and their number with those beyond twice the limit thrice.

    The limit is the number of standard deviations of the departures that Gaussian noise as long as
    the record exceeds `EXPECTED_FALSE_OUTLIERS` times. The deviation is from the median: the larger
    of that of the block and of that of the block with two neighbours on either side. It is that of
    the noisier adjacent block where this is larger by half, because the noise may have risen within
    the block. It is at least a tenth of the record's, and at least that of the noise right before
    or after the sample. If departures of 2.5 to 3.7 deviations are more frequent than in Gaussian
    noise, the noise level fluctuates faster than that can follow. The limit is then the one that a
    log-normal level with the same surplus exceeds `EXPECTED_FALSE_OUTLIERS` times.

    The histogram is (axis, block, `HISTOGRAM`); the peaks of each axis have block indices of the
    record. Both counts are (axis, block).

    Examples
    --------
    >>> x = np.random.default_rng(1).standard_normal((50, 200))
    >>> x[7, 100] += 30.0
    >>> x[9, 100] += 7.0
    >>> histogram = np.zeros((1, 50, HISTOGRAM), np.uint32)
    >>> peaks = [[find_peaks(x, histogram[0])]]
    >>> outlier_count, outliers = count_histogram_outliers(histogram, peaks)
    >>> outlier_count[0, [7, 9]], outliers[0, [7, 9]], int(outlier_count.sum())
    (array([1, 1]), array([3, 1]), 2)
    """
    sums = np.pad(np.cumsum(histogram, axis=1, dtype=np.int64), ((0, 0), (1, 0), (0, 0)))
    block = np.arange(histogram.shape[1])
    first = np.maximum(block - _NEIGHBOUR_BLOCKS, 0)
    nearby = sums[:, np.minimum(block + _NEIGHBOUR_BLOCKS + 1, block.size)] - sums[:, first]
    narrow, wide = _deviation_from_median(np.diff(sums, axis=1)), _deviation_from_median(nearby)
    adjacent = np.pad(narrow, ((0, 0), (1, 1)))
    adjacent = np.maximum(adjacent[:, :-2], adjacent[:, 2:])
    usual = np.maximum(np.maximum(narrow, wide), 0.1 * _deviation_from_median(sums[:, -1:]))
    scale = np.where(adjacent > _NOISIER_NEIGHBOUR_RATIO * usual, adjacent, usual)
    outlier_count, outliers = np.zeros((2, *scale.shape), np.int64)
    for axis, batches in enumerate(peaks):
        limit = _fluctuating_level_limit(histogram[axis], scale[axis])
        for batch_peaks in batches:
            departure = batch_peaks.size / np.maximum(
                scale[axis, batch_peaks.block], batch_peaks.level
            )
            np.add.at(outlier_count[axis], batch_peaks.block, departure > limit)
            np.add.at(
                outliers[axis],
                batch_peaks.block,
                np.where(departure > 2.0 * limit, 3, 1) * (departure > limit),
            )
    return outlier_count, outliers


def _fluctuating_level_limit(histogram: NDArray[np.uint32], scale: Floats) -> float:
    """Return the limit in deviations of an axis whose noise level may fluctuate within blocks."""
    total = float(histogram.sum())
    limit = outlier_limit(total)
    low, high = _TAIL_RANGE_SIGMA
    expected_share = 2.0 * (ndtr(-low) - ndtr(-high))
    surplus = _count_between(histogram, scale, low, high) / max(total * expected_share, 1e-300)
    place, weight = np.polynomial.hermite_e.hermegauss(31)
    weight = weight / weight.sum()
    level = np.exp(_LEVEL_LOG_SCATTERS[:, None] * place)
    surplus_ratio = 2.0 * ((ndtr(-low / level) - ndtr(-high / level)) @ weight) / expected_share
    level = np.exp(np.interp(surplus, surplus_ratio, _LEVEL_LOG_SCATTERS) * place)
    tried_limits = np.geomspace(limit, 3.0 * limit, 200)
    beyond = np.log(2.0 * (ndtr(-tried_limits[:, None] / level) @ weight))
    return float(np.interp(-np.log(2.0 * ndtr(-limit)), -beyond, tried_limits))


def _count_between(histogram: NDArray[np.uint32], scale: Floats, low: float, high: float) -> float:
    """Count departures from `low` to `high` deviations; a split bin is shared as if normal."""
    edges = (
        np.concatenate([[0.0], histogram_edge(np.arange(1, HISTOGRAM + 1))])
        / np.where(scale > 0.0, scale, np.inf)[:, None]
    )
    tail = ndtr(-edges)
    inside = ndtr(-np.clip(edges, low, high))
    bin_probability = tail[:, :-1] - tail[:, 1:]
    share = np.divide(
        inside[:, :-1] - inside[:, 1:],
        bin_probability,
        out=np.zeros_like(bin_probability),
        where=bin_probability > 0.0,
    )
    return float((histogram * share).sum())


def _deviation_from_median(histogram: Ints) -> Floats:
    """Return the standard deviation from the median, without zeros, which held samples cause."""
    total = np.cumsum(histogram[..., 1:], axis=-1)
    half = total[..., -1] / 2.0
    number = np.argmax(total >= np.maximum(half, 1)[..., None], axis=-1)
    inside = np.take_along_axis(histogram, number[..., None] + 1, axis=-1)[..., 0]
    below = np.take_along_axis(total, number[..., None], axis=-1)[..., 0] - inside
    share = np.divide(half - below, inside, out=np.ones(half.shape), where=inside > 0)
    return np.asarray(
        np.where(total[..., -1] > 0, histogram_edge(number + 1 + share) / NORMAL_MEDIAN_ABS, 0.0)
    )


def simultaneous_zeros(values: Floats) -> Ints:
    """Count exact zeros that all axes have at once; on a single axis, zeros in runs.

    Lost samples that were filled with zeros look like this. A loop that sticks at zero does so in
    each axis separately, whenever its rate passes zero. The count of values (axis, block, sample)
    is (axis, block).

    Examples
    --------
    >>> simultaneous_zeros(np.array([[[0.0, 0.0, 0.0, 1.0]], [[0.0, 2.0, np.nan, 0.0]]]))
    array([[1],
           [1]])
    >>> simultaneous_zeros(np.array([[[0.0, 0.0, 1.0, 0.0]]]))
    array([[2]])
    """
    zero = values == 0.0
    if not zero.any():
        return np.zeros(zero.shape[:2], np.int64)
    if len(zero) == 1:
        pair = zero[..., 1:] & zero[..., :-1]
        is_lost = zero & (
            np.pad(pair, ((0, 0), (0, 0), (1, 0))) | np.pad(pair, ((0, 0), (0, 0), (0, 1)))
        )
    else:
        gone = np.isnan(values)
        is_lost = zero & (zero | gone).all(axis=0) & (zero.sum(axis=0) > 1)
    return np.asarray(is_lost.sum(axis=-1))


def simultaneous_samples(present: Bools) -> dict[tuple[bool, ...], Ints]:
    """Count the samples of each block that two or more axes have at once, by set of axes.

    Returned for each set of axes is the number (block,) of instants at which exactly these have a
    sample, from presence (axis, block, sample).

    Examples
    --------
    >>> present = [[[True, True, True]], [[True, False, True]], [[True, True, False]]]
    >>> for axes, number in simultaneous_samples(np.array(present)).items():
    ...     print(axes, number)
    (True, False, True) [1]
    (True, True, False) [1]
    (True, True, True) [1]
    """
    axes = len(present)
    code = (present * (1 << np.arange(axes, dtype=np.int64))[:, None, None]).sum(axis=0)
    number_by_set = {
        tuple(bool(bits >> axis & 1) for axis in range(axes)): np.count_nonzero(code == bits, -1)
        for bits in np.unique(code).tolist()
    }
    return {
        axis_set: number_by_set[axis_set] for axis_set in sorted(number_by_set) if sum(axis_set) > 1
    }


def zeros_beyond_chance(
    together: Array, zeros: Array, samples: Array, subset: Bools, at_once: Array
) -> Ints:
    """Subtract the zeros that independent axes, or a single axis, have at once by chance.

    Zeros of `simultaneous_zeros`, all zeros, and samples are by (..., axis, block). A subset of the
    axes (subset, axis) has samples at once as often as `at_once` (subset, block).

    Examples
    --------
    >>> both = np.array([[True, True]])
    >>> together, zeros, samples = np.array([[[30], [30]], [[40], [50]], [[100], [100]]])
    >>> zeros_beyond_chance(together, zeros, samples, both, np.array([[100]]))
    array([[10],
           [10]])
    """
    share = zeros / np.maximum(samples, 1)
    if zeros.shape[-2] == 1:
        chance = zeros * (1.0 - (1.0 - share) ** 2)
    else:
        all_zero = probability_all_zero(share, subset)
        chance = np.einsum("sa,...sb->...ab", subset, all_zero * at_once)
    return np.asarray(np.maximum(together - np.rint(chance), 0), np.int64)


def probability_all_zero(share: Floats, subset: Bools) -> Floats:
    """Return the probability (..., subset, block) that all axes of a subset are zero at once.

    The shares of zeros are (..., axis, block).
    """
    return np.asarray(np.where(subset[..., None], share[..., None, :, :], 1.0).prod(axis=-2))


def quantization_step(values: Floats) -> float:
    """Find the quantization step of values with any offset; 0 if there is none, or it is too fine.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal(5000)
    >>> grid = np.round(noise / 0.3) * 0.3
    >>> quantization_step(noise), round(quantization_step(grid + 0.1), 9)
    (0.0, 0.3)
    >>> round(quantization_step(np.append(grid, [17.77, -23.91])), 9)  # two spikes off the grid
    0.3
    """
    finite = values[np.isfinite(values)]
    if finite.size < 32:
        return 0.0
    levels, times = np.unique(finite, return_counts=True)
    size = float(np.abs(levels).max())
    frequent, without_spikes = (
        _frequent_levels(levels, times, rare) for rare in (_MAX_OFF_GRID_SHARE, _SPIKE_SHARE)
    )
    level_sets = [frequent, without_spikes] if frequent.size else [levels]
    for kept_levels in (level_set for level_set in level_sets if level_set.size):
        # as written in single and in double precision; numbers of the former repeat on any grid
        # that is coarser than their last digit, and are on a finer one the closer they are to 0
        for resolution, is_double in ((2.0**-23, False), (2.0**-52, True)):
            fine = 8.0 * resolution * size
            distances = np.diff(kept_levels)
            distances = distances[distances > fine]
            if distances.size == 1 < kept_levels.size - 1:
                continue  # the resolution hides all distances but a jump
            if distances.size and (is_double or kept_levels.size <= 0.8 * finite.size):
                step = _common_divisor(distances, fine)
                if (
                    step > 0.0
                    and (not is_double or _is_step_of_large_values(kept_levels, step, fine))
                    and (
                        kept_levels is levels
                        or _off_grid_share(levels, times, step, fine) <= _MAX_OFF_GRID_SHARE
                    )
                ):
                    return step
    return 0.0


def _frequent_levels(levels: Floats, times: Ints, rare: float) -> Floats:
    """Drop the rarest levels, `rare` of the values, as spikes; empty if the rest has no grid."""
    order = np.argsort(times, kind="stable")
    common = np.sort(order[np.cumsum(times[order]) > rare * times.sum()])
    return levels[common] if common.size and times[common].min() > 1 else levels[:0]


def _is_step_of_large_values(levels: Floats, step: float, fine: float) -> bool:
    """Return whether the larger half of the values has this step, as on an even grid."""
    distances = np.diff(levels[np.abs(levels) >= np.median(np.abs(levels))])
    large_step = _common_divisor(distances[distances > fine], fine)
    return abs(large_step - step) <= _STEP_ERROR_SHARE * step


def _off_grid_share(levels: Floats, times: Ints, step: float, fine: float) -> float:
    """Return the share of values off the grid of this step through the most common value."""
    departure = np.abs(levels - levels[times.argmax()]) / step
    step_count = np.round(departure)
    off = np.abs(departure - step_count) * step > 2.0 * fine * (1.0 + step_count)
    return float(times[off].sum() / times.sum())


def _common_divisor(distances: Floats, fine: float) -> float:
    """Return the largest common divisor of distances with `fine` errors; 0 if there is none."""
    step = float(distances.min())
    while step > _MIN_STEP_ERRORS * fine:
        step_count = np.round(distances / step)
        # Farther distances may be off by their number times the error of the step.
        nearby = step_count < step / (16.0 * fine)
        remainder = np.abs(distances - step_count * step)
        wrong = nearby & (remainder > 2.0 * fine * (1.0 + step_count))
        if 2 * np.count_nonzero(nearby) < distances.size:  # by chance a few have a divisor
            return 0.0
        if not wrong.any():
            return float(distances[nearby].sum() / step_count[nearby].sum())
        step = float(remainder[wrong].min())
    return 0.0
