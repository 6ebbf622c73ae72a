"""Estimate the constant rate of each axis, and undo a truncation of the values towards zero."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.windows import predict_effect
from gyrostab.diagnose.reduce.schema import weighted_mean
from gyrostab.physics.base import Effect
from gyrostab.physics.logger import RateQuantization
from gyrostab.units import HOUR

Array = NDArray[np.float64]
_ROUNDS = 200  # of a fixed-point iteration that halves its error in about one
_MAX_LEVELS = 4000  # of a truncated normal law, beyond which it is as good as continuous


def constant_rates(
    blocks: xr.Dataset, effects: Sequence[Effect], turning: str = ""
) -> dict[str, float]:
    """Return the rate that a simulation adds on each axis to have the mean of the recording.

    Where values are rounded, clipped or stuck at zero depends on the constant rate, which the
    comparison leaves free otherwise.

    Parameters
    ----------
    effects : sequence of Effect
        All of the model, with their sizes.
    turning : str
        Axis that feels the channel ``rotation_rate``, if any.

    Returns
    -------
    dict of str to float
        By axis [degree hour-1]; 0 without a block mean.
    """
    axes = tuple(str(axis) for axis in blocks["axis"].values)
    rate = blocks["mean"].values.copy()
    for effect in effects:
        effect_axes = tuple(axis for axis in axes if not effect.axes or axis in effect.axes)
        rows = [axes.index(axis) for axis in effect_axes]
        for name, design in predict_effect(effect, blocks, effect_axes).mean.items():
            sizes = effect.expand_to_axes(name, effect_axes)
            rate[rows] -= sizes[:, None] * np.atleast_2d(design)
    if turning in axes and "channel_rotation_rate" in blocks:
        rate[axes.index(turning)] -= HOUR * blocks["channel_rotation_rate"].values
    means, _ = weighted_mean(rate, blocks["samples"].values, axis=1)
    for row, step in _truncated_rows(axes, effects):
        recorded, variance = _moments_of_axis(blocks, row)
        means[row] += _undo_truncation(recorded, variance, step)[0] - recorded
    return dict(zip(axes, means.tolist(), strict=True))


def noise_lost_by_truncation(blocks: xr.Dataset, effects: Sequence[Effect]) -> dict[str, float]:
    """Return the variance of the noise that values cut off towards zero lack, by axis.

    Rounding adds the square of the step over 12 to the variance, which is taken out of the noise.
    Truncation towards zero moves all values inwards, and may reduce the variance.
    """
    axes = tuple(str(axis) for axis in blocks["axis"].values)
    out = {}
    for row, step in _truncated_rows(axes, effects):
        mean, variance = _moments_of_axis(blocks, row)
        variance_before = _undo_truncation(mean, variance, step)[1]
        out[axes[row]] = variance_before - (variance - step**2 / 12.0)
    return out


def _moments_of_axis(blocks: xr.Dataset, row: int) -> tuple[float, float]:
    """Return the mean of the record, and the variance of the samples about their block means."""
    mean, variance = (
        weighted_mean(blocks[name].values[row], blocks["samples"].values[row])[0]
        for name in ("mean", "variance")
    )
    return float(mean), float(variance)


def _truncated_rows(axes: tuple[str, ...], effects: Sequence[Effect]) -> list[tuple[int, float]]:
    """Return rows and steps of the axes whose values are cut off towards zero."""
    return [
        (row, effect.step)
        for effect in effects
        if isinstance(effect, RateQuantization) and effect.mode == "zero" and effect.step > 0.0
        for row, axis in enumerate(axes)
        if not effect.axes or axis in effect.axes
    ]


def _undo_truncation(mean: float, variance: float, step: float) -> tuple[float, float]:
    """Return mean and variance of the normal law that has these after truncation towards zero.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(0.7, 1.5, 1_000_000)
    >>> mean, variance = np.trunc(x).mean(), np.trunc(x).var()
    >>> moments = (mean, variance, *_undo_truncation(mean, variance, 1.0))
    >>> [round(float(moment), 2) for moment in moments]
    [0.52, 1.43, 0.7, 2.24]
    """
    from scipy.special import ndtr

    target, spread = mean / step, variance / step**2
    centre, square = target, max(spread, 1e-3)
    reach = abs(target) + 12.0 * (np.sqrt(square) + 1.0)
    if reach > _MAX_LEVELS:  # half a step towards zero, as far as it keeps its sign
        return mean + 0.5 * step * float(np.sign(mean)), variance - step**2 / 12.0
    level = np.arange(-np.ceil(reach), np.ceil(reach) + 1.0)
    low, high = level - (level <= 0.0), level + (level >= 0.0)
    for _ in range(_ROUNDS):
        sigma = np.sqrt(square)
        share = ndtr((high - centre) / sigma) - ndtr((low - centre) / sigma)
        level_mean = float(share @ level)
        level_variance = float(share @ (level - level_mean) ** 2)
        centre += target - level_mean
        square = max(square + spread - level_variance, 1e-3)
    return centre * step, square * step**2
