"""What values tell beside their spectrum: how many jump out, and the lattice that they stand on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.kernels.periodogram import HISTOGRAM, histogram_edge

__all__ = ["count_outliers", "lattice_step"]

Array = NDArray[np.float64]
_SIGMA = 6.0
_CLEAR = 64.0  # a lattice is as many times coarser than the last digit
_NEAR = 2  # blocks on either side that help to tell a block's own noise
_MEDIAN = 0.6745  # of the absolute value of a standard normal number


def count_outliers(histogram: NDArray[np.uint32], *, sigma: float = _SIGMA) -> NDArray[np.int64]:
    """Second differences beyond `sigma` robust standard deviations.

    The deviation is from the median: the larger of the block's own and of that which it has together with two neighbours on either
    side, and at least a tenth of the record's.

    Parameters
    ----------
    histogram : ndarray, shape (axis, block, `HISTOGRAM`)
        Number of second differences by size.
    sigma : float
        Limit; it is moved up to the next edge of a bin, by 19 % at most.

    Returns
    -------
    ndarray of int64, shape (axis, block)

    Examples
    --------
    >>> from gyrostab.kernels.periodogram import block_samples
    >>> x = np.random.default_rng(1).standard_normal((50, 200))
    >>> x[7, 100] += 30.0
    >>> histogram = np.zeros((1, 50, HISTOGRAM), np.uint32)
    >>> block_samples(x, np.empty_like(x), np.empty((50, 5)), np.empty((50, 5), np.int64), histogram[0])
    >>> counts = count_outliers(histogram)
    >>> int(counts[0, 7]), int(counts.sum())
    (3, 3)
    """
    sums = np.concatenate([np.zeros_like(histogram[:, :1], dtype=np.int64), np.cumsum(histogram, axis=1, dtype=np.int64)], axis=1)
    blocks = np.arange(histogram.shape[1])
    near = sums[:, np.minimum(blocks + _NEAR + 1, blocks.size)] - sums[:, np.maximum(blocks - _NEAR, 0)]
    scale = np.maximum(np.maximum(_deviation(near), _deviation(np.diff(sums, axis=1))), 0.1 * _deviation(sums[:, -1:]))
    edges = np.concatenate([[0.0], histogram_edge(np.arange(1, HISTOGRAM))])
    first = np.searchsorted(edges, sigma * scale)  # the first bin that lies wholly above
    above = np.concatenate([np.cumsum(histogram[..., ::-1], axis=-1, dtype=np.int64)[..., ::-1], np.zeros((*scale.shape, 1), np.int64)], -1)
    return np.asarray(np.where(scale > 0, np.take_along_axis(above, first[..., None], axis=-1)[..., 0], 0))


def _deviation(histogram: NDArray[np.int64]) -> Array:
    """Standard deviation from the median of those that are not 0, which held samples make."""
    total = np.cumsum(histogram[..., 1:], axis=-1)
    wanted = total[..., -1] / 2.0
    number = np.argmax(total >= np.maximum(wanted, 1)[..., None], axis=-1)
    inside = np.take_along_axis(histogram, number[..., None] + 1, axis=-1)[..., 0]
    before = np.take_along_axis(total, number[..., None], axis=-1)[..., 0] - inside
    share = np.divide(wanted - before, inside, out=np.ones(wanted.shape), where=inside > 0)
    return np.asarray(np.where(total[..., -1] > 0, histogram_edge(number + 1 + share) / _MEDIAN, 0.0))


def lattice_step(values: Array) -> float:
    """Step of the lattice that values stand on, whatever its offset; 0 when there is none, or when it is too fine to matter.

    Parameters
    ----------
    values : ndarray
        Some thousand values; NaN is passed over.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal(5000)
    >>> lattice_step(noise), round(lattice_step(np.round(noise / 0.3) * 0.3 + 0.1), 9)
    (0.0, 0.3)
    """
    finite = values[np.isfinite(values)]
    if finite.size < 32:
        return 0.0
    levels = np.unique(finite)
    size = float(np.abs(levels).max())
    for resolution in (2.0**-23, 2.0**-52):  # as written in single and in double precision
        fine = 8.0 * resolution * size
        apart = np.diff(levels)
        apart = apart[apart > fine]
        if 0 < apart.size <= 0.8 * finite.size:
            step = _common(apart, fine)
            if step > 0.0:
                return step
    return 0.0


def _common(apart: Array, fine: float) -> float:
    """Largest number of which all distances are multiples, but for `fine` errors; 0 when there is none well above these."""
    step = float(apart.min())
    while step > _CLEAR * fine:
        whole = np.round(apart / step)
        near = whole < step / (16.0 * fine)  # farther ones may be off by their number times the error of the step
        rest = np.abs(apart - whole * step)
        wrong = near & (rest > 2.0 * fine * (1.0 + whole))
        if not near.any():
            return 0.0
        if not wrong.any():
            return float(apart[near].sum() / whole[near].sum())
        step = float(rest[wrong].min())
    return 0.0
