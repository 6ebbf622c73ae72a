"""What effects that change each sample for itself do to the scatter of normal noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]
_NORMAL = ndtri((np.arange(1001) + 0.5) / 1001)  # equally likely values
_NORMAL /= _NORMAL.std()
_MAX_MEANS = 200  # of blocks, or of equal groups of blocks with similar means; limits time
_ROUNDS = 100  # of a fixed-point iteration; limits time
_MIN_SHARE = 1e-3  # of a variance that is left; a power of zero has no likelihood


class PassedNoise(NamedTuple):
    """Normal noise before an effect, and what the effect leaves of it."""

    mean: Array  # (block,): before the effect
    variance: float  # before the effect
    share: Array  # (block,): of the variance that is left
    gain: float  # of slow changes of the rate


def undo_transfer(
    transfer: Callable[[Array], Any], mean: Array, variance: float, *, known: bool = False
) -> PassedNoise:
    """Find the normal noise that has these block means and this variance after an effect.

    Parameters
    ----------
    transfer : callable
        The output of the effect for each rate.
    mean : ndarray, shape (block,)
        Means after the effect.
    variance : float
        Variance of the samples about their means, after the effect or, if `known`, before it.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(0.7, 1.5, 1_000_000)
    >>> passed = undo_transfer(np.trunc, np.array([np.trunc(x).mean()]), np.trunc(x).var())
    >>> passed.mean.round(2), round(passed.variance, 2)
    (array([0.7]), 2.24)
    """
    finite = np.isfinite(mean)
    order = np.argsort(np.where(finite, mean, 0.0), kind="stable")
    groups = np.array_split(order, min(_MAX_MEANS, mean.size))
    after = np.array([np.nan_to_num(mean[group]).mean() for group in groups])
    weight = np.array([group.size for group in groups], np.float64) / mean.size
    before, square = after.copy(), max(variance, 1e-300)
    for _ in range(_ROUNDS):
        noise = np.sqrt(square) * _NORMAL
        passed = transfer(before[:, None] + noise)
        spread = passed.var(axis=1)
        gain = (passed * noise).mean(axis=1) / square
        before += after - passed.mean(axis=1)
        if not known:
            left = float(weight @ spread) / square
            square *= np.clip(variance / max(left * square, 1e-300), 0.5, 2.0)
    share = np.empty(mean.size)
    moved = np.empty(mean.size)
    for number, group in enumerate(groups):
        share[group] = max(spread[number] / square, _MIN_SHARE)
        moved[group] = before[number] - after[number]
    return PassedNoise(mean + moved, float(square), share, float(weight @ gain))
