"""Sample counts of null records: outliers, repeats, zeros and extremes by chance."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import ndtr

from gyrostab.diagnose.predict.windows import fill_linearly
from gyrostab.diagnose.reduce.outliers import (
    EXPECTED_FALSE_OUTLIERS,
    probability_all_zero,
    zeros_beyond_chance,
)
from gyrostab.diagnose.reduce.zero_bin import truncated_axes

Array = NDArray[np.float64]
_ITERATIONS = 20  # of an iteration that halves its error
#: Standard deviations in a quantization step from which the values have few levels. Design choice.
COARSE_STEP_SIGMA = 1.5
_FINE_STEP = 0.3  # over the scatter of differences; the next term is 3e-5 of the probability there
_QUADRATURE_NODES = 12  # over a bin: exact to 1e-6 up to 4 standard deviations of a step
_MAX_LEVELS = 400  # on either side of the mean; more than any step above `_FINE_STEP` needs
_MAX_CORRELATION = 0.9999
#: Error of the expected share of repeats and zeros: noise is not exactly normal, and its scatter
#: varies within a block. Design choice.
_CHANCE_ERROR_SHARE = 0.03


def null_counts(
    blocks: xr.Dataset, sd: Array, count: int, rng: np.random.Generator
) -> dict[str, NDArray[np.int64]]:
    """Draw outliers, repeats, extremes and zeros of Gaussian noise on the quantization grid.

    Repeats and zeros (record, axis, block) follow from the scatter of each block, and from the
    correlation of neighbouring samples that its band powers give. The standard deviations (axis, 2)
    are of a sample and of a difference of neighbours [degree hour-1].
    """
    samples = blocks["samples"].values.astype(np.int64)
    adjacent = blocks["adjacent"].values.astype(np.int64)
    mean = [np.nan_to_num(fill_linearly(row)) for row in blocks["mean"].values]
    scatter, correlation = _neighbour_statistics(blocks, sd)
    truncated = truncated_axes(blocks)
    nothing = np.zeros(samples.shape[1])
    chances = [
        _grid_chance(mean[axis], float(step), scatter[axis], correlation[axis], truncated[axis])
        if step > 0.0
        else (nothing, nothing, nothing)
        for axis, step in enumerate(blocks["quantization_step"].values)
    ]
    has_zeros = blocks["zeros"].values.any(axis=1, keepdims=True)
    zero, zero_again, repeat = (np.stack(part) for part in zip(*chances, strict=True))
    size = (count, *samples.shape)
    outliers = EXPECTED_FALSE_OUTLIERS * samples / np.maximum(samples.sum(axis=1, keepdims=True), 1)
    # an error of the probabilities is common to all blocks of an axis
    error = 1.0 + _CHANCE_ERROR_SHARE * rng.standard_normal((count, len(samples), 1))
    zeros = rng.binomial(samples, np.clip(np.where(has_zeros, zero, 0.0) * error, 0.0, 1.0))
    filled = _filled_zeros(blocks, zeros, samples, zero_again, rng)
    return {
        "outliers": rng.poisson(np.broadcast_to(outliers, size)),
        "repeats": rng.binomial(adjacent, np.clip(repeat * error, 0.0, 1.0)),
        "zeros": zeros,
        "stuck": zeros - filled,
        "filled": filled,
        "extremes": _draw_extremes(blocks, sd, samples, count, rng),
    }


def _neighbour_statistics(blocks: xr.Dataset, sd: Array) -> tuple[Array, Array]:
    """Measure the scatter of the samples of each block, and the correlation of neighbours.

    Both (axis, block) are interpolated over blocks with losses or outliers. The standard deviations
    are as in `null_counts`, for axes without measured powers.
    """
    rate = float(blocks.attrs["sampling_rate_hz"])
    low, high = blocks["band_low"].values, blocks["band_high"].values
    cosine = np.cos(2.0 * np.pi * blocks["line_frequency"].values / rate)
    lines = np.nan_to_num(blocks["line_power"].values).mean(axis=1)
    band = np.searchsorted(high, blocks["line_frequency"].values).clip(0, high.size - 1)
    scatter, correlation = np.empty((2, *blocks["power"].shape[:2]))
    for axis, power in enumerate(blocks["power"].values):
        total = np.bincount(band, weights=lines[axis], minlength=high.size)
        shape = np.bincount(band, weights=lines[axis] * cosine, minlength=high.size)
        centre = np.cos(np.pi * (low + high) / rate)
        in_band = np.divide(shape, total, out=centre, where=total > 0.0)
        variance = 2.0 * power @ (high - low)
        lagged = 2.0 * power @ ((high - low) * in_band)
        good = np.isfinite(variance) & (variance > 0.0)
        typical = good & (blocks["outliers"].values[axis] == 0)
        good = typical if typical.any() else good
        if good.any():
            scatter[axis] = np.sqrt(fill_linearly(np.where(good, variance, np.nan)))
            with np.errstate(divide="ignore", invalid="ignore"):
                correlation[axis] = fill_linearly(np.where(good, lagged / variance, np.nan))
        else:
            scatter[axis] = sd[axis, 0]
            correlation[axis] = 1.0 - 0.5 * (sd[axis, 1] / sd[axis, 0]) ** 2
    return scatter, np.clip(correlation, -_MAX_CORRELATION, _MAX_CORRELATION)


def _filled_zeros(
    blocks: xr.Dataset,
    zeros: NDArray[np.int64],
    samples: NDArray[np.int64],
    zero_again: Array,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Return the zeros (record, axis, block) that look filled because they coincide by chance.

    On a single axis these are zeros next to another one, whose probability is `zero_again`.
    """
    subset = blocks["axes_at_once"].values.astype(bool)
    number = blocks["at_once"].values.astype(np.int64)
    share = zeros / np.maximum(samples, 1)
    if len(samples) == 1:
        # rare ones come in pairs, and rare zeros alone exclude each other: variance 2 z p (1 - p)^2
        chance = 1.0 - (1.0 - zero_again) ** 2
        scatter = np.sqrt(2.0 * zeros * chance) * (1.0 - chance)
        drawn = np.rint(zeros * chance + scatter * rng.standard_normal(zeros.shape))
        coinciding = np.clip(drawn, 0, zeros).astype(np.int64)
    elif not zeros.any():
        coinciding = np.zeros_like(zeros)
    else:
        at_once = rng.binomial(number, probability_all_zero(share, subset))
        coinciding = np.minimum(np.einsum("sa,rsb->rab", subset.astype(np.int64), at_once), zeros)
    return zeros_beyond_chance(coinciding, zeros, samples, subset, number)


def _grid_chance(
    mean: Array, step: float, scatter: Array, correlation: Array, truncated: bool
) -> tuple[Array, Array, Array]:
    """Return the probabilities, by block, of correlated normal noise on a grid.

    They are those of zero, of zero again after a zero, and of a repeat at another value. The values
    before rounding are normal, and so are pairs of neighbours. A pair is in one bin with the
    integral of its normal density over the square of that bin: by Gauss-Legendre quadrature, bin by
    bin. Fine grids have many bins; the difference of neighbours then decides, with a triangular
    weight, P = s / (sqrt(2 pi) d) (1 - s^2 / (12 d^2)) for the step s and the standard deviation d
    of differences.
    """
    variance = np.maximum(scatter**2 - step**2 / 12.0, (0.05 * step) ** 2)
    # rounding errors of coarse grids are independent: the correlation is that before rounding
    inner = np.sqrt(variance)
    rho = np.clip(correlation * scatter**2 / variance, -_MAX_CORRELATION, _MAX_CORRELATION)
    centre = _before_truncation(mean, step, inner) if truncated else mean
    half_zero = step if truncated else 0.5 * step
    zero, both_zero = _chance_in_bin(-centre, half_zero, inner, rho)
    zero_again = np.divide(both_zero, zero, out=np.zeros_like(zero), where=zero > 0.0)
    difference = inner * np.sqrt(2.0 - 2.0 * rho)
    ratio = step / difference
    if (ratio < _FINE_STEP).all():
        any_bin = ratio / np.sqrt(2.0 * np.pi) * (1.0 - ratio**2 / 12.0)
        plain_zero = _chance_in_bin(-centre, 0.5 * step, inner, rho)[1]
        repeat = any_bin - plain_zero
    else:
        reach = int(min(np.ceil(6.0 * inner.max() / step) + 1, _MAX_LEVELS))
        nearest = np.round(centre / step)
        repeat = np.zeros(mean.size)
        for level in range(-reach, reach + 1):
            place = nearest + level
            pair_chance = _chance_in_bin(place * step - centre, 0.5 * step, inner, rho)[1]
            repeat += np.where(np.abs(place * step) < half_zero, 0.0, pair_chance)
    return zero, zero_again, np.clip(repeat, 0.0, 1.0)


def _chance_in_bin(
    middle: Array, half: float, scatter: Array, correlation: Array
) -> tuple[Array, Array]:
    """Return the probabilities that a sample, and a pair of neighbours, are in a bin.

    The middle of the bin is relative to the mean of the samples; `half` is half of its width.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
    value = middle[:, None] + half * nodes
    density = np.exp(-0.5 * (value / scatter[:, None]) ** 2) / np.sqrt(2.0 * np.pi)
    density *= half * weights / scatter[:, None]
    conditional_scatter = (scatter * np.sqrt(1.0 - correlation**2))[:, None]
    shift = middle[:, None] - correlation[:, None] * value
    pair_density = density * (
        ndtr((shift + half) / conditional_scatter) - ndtr((shift - half) / conditional_scatter)
    )
    chance = ndtr((middle + half) / scatter) - ndtr((middle - half) / scatter)
    return np.asarray(chance), np.asarray(pair_density.sum(axis=1))


def _before_truncation(mean: Array, step: float, scatter: Array) -> Array:
    """Return means before truncation, which shifts them by up to half a step towards zero."""
    out = mean
    for _ in range(_ITERATIONS):
        out = mean + step * (ndtr(out / scatter) - 0.5)
    return out


def _draw_extremes(
    blocks: xr.Dataset, sd: Array, samples: NDArray[np.int64], count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draw the blocks of the smallest and largest value; each is repeated on a coarse grid."""
    out = np.zeros((count, *samples.shape), np.int64)
    for axis, step in enumerate(blocks["quantization_step"].values):
        total = int(samples[axis].sum())
        if not total:
            continue
        share = samples[axis] / total
        many = np.ones((count, 2), np.int64)
        ratio = float(step) / float(sd[axis, 0])
        if ratio > 1e-3:
            edges = np.arange(8.0, 0.0, -ratio)[:, None, None] + ratio * rng.random((count, 2))
            in_bins = rng.poisson(total * (ndtr(ratio - edges) - ndtr(-edges)))
            first = np.argmax(in_bins > 0, axis=0)
            many = np.maximum(np.take_along_axis(in_bins, first[None], axis=0)[0], 1)
        out[:, axis] = rng.multinomial(many.sum(axis=1), share)
    return out
