"""Sample counts of null records: outliers, repeats, zeros and extremes by chance."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import ndtr

from gyrostab.diagnose.reduce.outliers import (
    EXPECTED_FALSE_OUTLIERS,
    probability_all_zero,
    zeros_beyond_chance,
)
from gyrostab.diagnose.reduce.zero_bin import truncated_axes

__all__ = ["COARSE_STEP_SIGMA", "null_counts"]

Array = NDArray[np.float64]
_ITERATIONS = 20  # of an iteration that halves its error
#: Standard deviations in a quantization step from which the values have few levels. Design choice.
COARSE_STEP_SIGMA = 1.5


def null_counts(
    blocks: xr.Dataset, sd: Array, count: int, rng: np.random.Generator
) -> dict[str, NDArray[np.int64]]:
    """Draw outliers, repeats, extremes and zeros of Gaussian noise on the quantization grid.

    Parameters
    ----------
    blocks : xarray.Dataset
        The recording, for its blocks, gaps and quantization grids.
    sd : ndarray, shape (axis, 2)
        Standard deviations of a sample and of a difference of neighbours [degree hour-1].

    Returns
    -------
    dict of str to ndarray of int, shape (record, axis, block)
    """
    samples = blocks["samples"].values.astype(np.int64)
    adjacent = blocks["adjacent"].values.astype(np.int64)
    mean = _interpolate_means(blocks["mean"].values)
    repeat, zero = np.zeros(samples.shape), np.zeros(samples.shape)
    truncated = truncated_axes(blocks)
    for axis, step in enumerate(blocks["quantization_step"].values):
        if step > 0.0:
            repeat[axis], zero[axis] = _grid_probabilities(
                mean[axis], float(step), sd[axis], truncated=bool(truncated[axis])
            )
        if not blocks["zeros"].values[axis].any():
            zero[axis] = 0.0
        both_zero = zero[axis] ** 2 / (2.0 if truncated[axis] else 1.0)  # the bin holds two steps
        repeat[axis] = np.maximum(repeat[axis] - both_zero, 0.0)
    size = (count, *samples.shape)
    zeros = rng.binomial(samples, np.broadcast_to(zero, size))
    filled = _filled_zeros(blocks, zeros, samples, rng)
    return {
        "outliers": rng.poisson(
            np.broadcast_to(
                EXPECTED_FALSE_OUTLIERS
                * samples
                / np.maximum(samples.sum(axis=1, keepdims=True), 1),
                size,
            )
        ),
        "repeats": rng.binomial(adjacent, np.broadcast_to(repeat, size)),
        "zeros": zeros,
        "stuck": zeros - filled,
        "filled": filled,
        "extremes": _draw_extremes(blocks, sd, samples, count, rng),
    }


def _filled_zeros(
    blocks: xr.Dataset,
    zeros: NDArray[np.int64],
    samples: NDArray[np.int64],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Return the zeros (record, axis, block) that look filled because they coincide by chance."""
    subset = blocks["axes_at_once"].values.astype(bool)
    number = blocks["at_once"].values.astype(np.int64)
    share = zeros / np.maximum(samples, 1)
    if len(samples) == 1:
        coinciding = rng.binomial(zeros, 1.0 - (1.0 - share) ** 2)  # zeros next to another one
    elif not zeros.any():
        coinciding = np.zeros_like(zeros)
    else:
        at_once = rng.binomial(number, probability_all_zero(share, subset))
        coinciding = np.minimum(np.einsum("sa,rsb->rab", subset.astype(np.int64), at_once), zeros)
    return zeros_beyond_chance(coinciding, zeros, samples, subset, number)


def _interpolate_means(mean: Array) -> Array:
    """Interpolate missing means; 0 on an axis without any."""
    out, block = np.zeros_like(mean), np.arange(mean.shape[1])
    for row, values in enumerate(mean):
        good = np.isfinite(values)
        if good.any():
            out[row] = np.interp(block, block[good], values[good])
    return out


def _grid_probabilities(
    mean: Array, step: float, sd: Array, *, truncated: bool = False
) -> tuple[Array, Array]:
    """Return the probabilities of a repeat (in any bin) and of a zero, by block."""
    inner = float(np.sqrt(max(sd[0] ** 2 - step**2 / 12.0, (0.05 * step) ** 2)))
    centre = (_before_truncation(mean, step, inner) if truncated else mean)[:, None]
    reach = int(np.ceil(6.0 * inner / step)) + 1

    def chance(level: Array) -> Array:
        return np.asarray(
            ndtr((level + step / 2.0 - centre) / inner)
            - ndtr((level - step / 2.0 - centre) / inner)
        )

    zero = (
        chance(np.array([-0.5, 0.5]) * step).sum(axis=1) if truncated else chance(np.zeros(1))[:, 0]
    )
    if step < COARSE_STEP_SIGMA * inner:
        return np.full(mean.size, min(step / (np.sqrt(2.0 * np.pi) * float(sd[1])), 1.0)), zero
    levels = (np.round(centre / step) + np.arange(-reach, reach + 1)) * step
    return np.asarray((chance(levels) ** 2).sum(axis=1)), zero


def _before_truncation(mean: Array, step: float, scatter: float) -> Array:
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
