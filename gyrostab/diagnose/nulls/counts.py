"""Odd samples of null records: how many outliers, repeats, zeros and extremes each block has by chance."""

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

__all__ = ["COARSE", "null_counts"]

Array = NDArray[np.float64]
_TURNS = 20  # of an iteration that halves its error
COARSE = 1.5  # standard deviations: a lattice step from which on the values are few levels


def null_counts(
    blocks: xr.Dataset, sd: Array, count: int, rng: np.random.Generator
) -> dict[str, NDArray[np.int64]]:
    """Outliers, repeats, extremes and zeros as Gaussian noise on the lattice has them.

    Parameters
    ----------
    blocks : xarray.Dataset
        The recording, whose blocks, gaps and lattices are taken.
    sd : ndarray, shape (axis, 2)
        Standard deviation of a sample, and of the difference of two neighbours [degree hour-1].
    count : int
        Records.
    rng : numpy.random.Generator

    Returns
    -------
    dict of str to ndarray of int, shape (record, axis, block)
    """
    samples = blocks["samples"].transpose("axis", "block").values.astype(np.int64)
    adjacent = blocks["adjacent"].transpose("axis", "block").values.astype(np.int64)
    mean = _filled(blocks["mean"].transpose("axis", "block").values)
    repeat, zero = np.zeros(samples.shape), np.zeros(samples.shape)
    cut = truncated_axes(blocks)
    for axis, step in enumerate(blocks["lattice"].values):
        if step > 0.0:
            repeat[axis], zero[axis] = _lattice_chances(
                mean[axis], float(step), sd[axis], cut=bool(cut[axis])
            )
        if not blocks["zeros"].values[axis].any():
            zero[axis] = 0.0
        own = zero[axis] ** 2 / (2.0 if cut[axis] else 1.0)  # of two cells in one
        repeat[axis] = np.maximum(repeat[axis] - own, 0.0)
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
        "extremes": _extremes(blocks, sd, samples, count, rng),
    }


def _filled_zeros(
    blocks: xr.Dataset,
    zeros: NDArray[np.int64],
    samples: NDArray[np.int64],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Of so many zeros (record, axis, block) those that look like samples filled with zeros, where chance alone brings zeros together."""
    subset = blocks["axes_at_once"].transpose("subset", "axis").values.astype(bool)
    number = blocks["at_once"].transpose("subset", "block").values.astype(np.int64)
    share = zeros / np.maximum(samples, 1)
    if len(samples) == 1:
        together = rng.binomial(zeros, 1.0 - (1.0 - share) ** 2)  # a zero has another one beside it
    elif not zeros.any():
        together = np.zeros_like(zeros)
    else:
        at_once = rng.binomial(number, probability_all_zero(share, subset))
        together = np.minimum(np.einsum("sa,rsb->rab", subset.astype(np.int64), at_once), zeros)
    return zeros_beyond_chance(together, zeros, samples, subset, number)


def _filled(mean: Array) -> Array:
    """Means with those of blocks of few samples on straight lines between their neighbours; 0 where an axis has none."""
    out, block = np.zeros_like(mean), np.arange(mean.shape[1])
    for row, values in enumerate(mean):
        good = np.isfinite(values)
        if good.any():
            out[row] = np.interp(block, block[good], values[good])
    return out


def _lattice_chances(
    mean: Array, step: float, sd: Array, *, cut: bool = False
) -> tuple[Array, Array]:
    """Chance in each block that a sample equals the one before (the cell of 0 as the others), and that it is 0; `cut` off towards zero."""
    inner = float(np.sqrt(max(sd[0] ** 2 - step**2 / 12.0, (0.05 * step) ** 2)))
    centre = (_before_cut(mean, step, inner) if cut else mean)[:, None]
    reach = int(np.ceil(6.0 * inner / step)) + 1

    def chance(level: Array) -> Array:
        return np.asarray(
            ndtr((level + step / 2.0 - centre) / inner)
            - ndtr((level - step / 2.0 - centre) / inner)
        )

    zero = chance(np.array([-0.5, 0.5]) * step).sum(axis=1) if cut else chance(np.zeros(1))[:, 0]
    if step < COARSE * inner:
        return np.full(mean.size, min(step / (np.sqrt(2.0 * np.pi) * float(sd[1])), 1.0)), zero
    levels = (np.round(centre / step) + np.arange(-reach, reach + 1)) * step
    return np.asarray((chance(levels) ** 2).sum(axis=1)), zero


def _before_cut(mean: Array, step: float, scatter: float) -> Array:
    """Means of normal numbers that have these once they are cut off towards zero: by half a step on average, those on either side."""
    out = mean
    for _ in range(_TURNS):
        out = mean + step * (ndtr(out / scatter) - 0.5)
    return out


def _extremes(
    blocks: xr.Dataset, sd: Array, samples: NDArray[np.int64], count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """The smallest and the largest value, each in the blocks where it falls: once, but for a lattice that is not fine."""
    out = np.zeros((count, *samples.shape), np.int64)
    for axis, step in enumerate(blocks["lattice"].values):
        total = int(samples[axis].sum())
        if not total:
            continue
        share = samples[axis] / total
        many = np.ones((count, 2), np.int64)
        ratio = float(step) / float(sd[axis, 0])
        if ratio > 1e-3:
            edges = np.arange(8.0, 0.0, -ratio)[:, None, None] + ratio * rng.random((count, 2))
            found = rng.poisson(total * (ndtr(ratio - edges) - ndtr(-edges)))
            first = np.argmax(found > 0, axis=0)
            many = np.maximum(np.take_along_axis(found, first[None], axis=0)[0], 1)
        out[:, axis] = rng.multinomial(many.sum(axis=1), share)
    return out
