"""Noise whose strength goes up and down: powers that scatter more than their degrees of freedom allow."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    over_windows,
    statistic_dataset,
    values_of,
    window_set,
)

__all__ = ["LENGTHS", "SPANS", "levelled", "scatter_moments", "score"]

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (20, 80)
#: Blocks whose powers are averaged before their scatter is judged.
SPANS = (1, 2, 4, 8, 16, 32, 64)
_FEWEST = 6  # averages; with fewer a scatter is no number to judge by
_GROUPS = 4  # of neighbouring bands
_LOW = 3.5  # ordinates: below, a mean that moves inside of a block is seen rather than noise
# standard deviations that one average counts for: a single loud block is for the Allan variance to
# judge
_MOST = 4.0


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    r"""Score the scatter of the band powers in time about their own mean, whatever that is, against what steady noise has.

    The powers of a block over the expected ones, averaged over bands and over 1, 2, 4 ... blocks,
    are the levels :math:`y_j`. In steady noise each is gamma-distributed with a shape :math:`w_j`
    that is known, and the statistic of a window of J of them is

    .. math:: Q = \sum_j w_j (y_j - \bar y)^2 / \bar y^2, \qquad \bar y = \sum_j w_j y_j / \sum_j w_j,

    about :math:`J - 1`, with a variance of :math:`2 (J - 1) + 6 \sum_j 1 / w_j` or a little less
    (`scatter_moments` has both exactly). Noise whose log power swings by v rms from one average to
    the next raises Q by :math:`v^2 \sum_j w_j`. So it stands out by z standard deviations where
    :math:`v^2 = z \sqrt{2 (J - 1)} / \sum_j w_j`: white noise in 100 blocks of 200 samples (w = 93
    each) by five where v = 9 %. Averages over k blocks have a variance that is less by the root of
    k, and lose what goes faster than some 3 k.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects: the levels are relative to its
        spectrum.

    Returns
    -------
    xarray.Dataset or None
        None where the record is too short. A column for each span and each band, each quarter of
        the bands, all bands, and each band against its own mean. ``ratio`` is the scatter over that
        of steady noise, ``estimate`` how far the power swings, rms over mean. Several axes have a
        row of all together: the mean of their levels, for what makes noise swell is often common to
        them.

    Notes
    -----
    Of the lowest bands a moving mean takes hold; they are left out.
    """
    block_count, block = blocks.sizes["block"], float(blocks.attrs["block_s"])
    spans = [span for span in SPANS if block_count // span >= _FEWEST]
    low, high = (blocks[name].values for name in ("band_low", "band_high"))
    used = low * block >= _LOW
    if not spans or not used.any():
        return None
    members = _members(int(used.sum()))
    level, weight, rows = _levels(blocks, baseline, used, members)
    windows = window_set(block_count, LENGTHS)
    found = [_scatter(level, weight, windows, span, single=int(used.sum())) for span in spans]
    z, ratio, swing = (np.concatenate([one[place] for one in found], axis=-1) for place in range(3))
    f_low = np.append([low[used][one].min() for one in members], low[used][0])
    f_high = np.append([high[used][one].max() for one in members], high[used][-1])
    return statistic_dataset(
        "davar",
        blocks,
        rows=rows,
        windows=windows,
        columns={
            "what": np.repeat([f"restless {span * block:g} s" for span in spans], f_low.size),
            "tau_min_s": np.tile(0.5 / f_high, len(spans)),
            "tau_max_s": np.tile(0.5 / f_low, len(spans)),
        },
        z=z,
        ratio=ratio,
        estimate=swing,
        one_sided=True,
    )


def levelled(
    blocks: xr.Dataset, baseline: xr.Dataset, spans: Sequence[tuple[Sequence[str], float, float]]
) -> xr.Dataset:
    """The recording with the powers of some stretches brought to the expected mean: their levels are told already.

    The first and the last two blocks of a stretch are so each by itself, for the level may have
    changed within them.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        A recording, and what the simulation expects.
    spans : sequence of (axes, begin, end)
        Names of axes, and times [s since the start].
    """
    if not spans:
        return blocks
    power, spectrum = (
        one.transpose("axis", "block", "band").values
        for one in (blocks["power"], baseline["spectrum"])
    )
    shape, power = blocks["shape"].transpose("axis", "block", "band").values, power.copy()
    for axes, begin, end in spans:
        inside = np.flatnonzero(
            (blocks["begin"].values >= begin - 1e-6) & (blocks["end"].values <= end + 1e-6)
        )
        pieces = np.split(inside, [1, 2, -2, -1] if inside.size > 4 else range(1, inside.size))
        rows = np.flatnonzero(np.isin(blocks["axis"].values.astype(str), list(axes)))
        for row, block_count in product(rows, pieces):
            ratio, weight = (
                power[row, block_count] / spectrum[row, block_count],
                np.nan_to_num(shape[row, block_count]),
            )
            weight = np.where(np.isfinite(ratio), weight, 0.0)
            with np.errstate(invalid="ignore", divide="ignore"):
                power[row, block_count] /= (np.nan_to_num(ratio) * weight).sum(axis=0) / weight.sum(
                    axis=0
                )
    return blocks.assign(power=(("axis", "block", "band"), power, blocks["power"].attrs))


def scatter_moments(count: Array, total: Array, inverse: Array) -> tuple[Array, Array]:
    """Mean and variance of the scatter of gamma-distributed levels about their own mean, relative to it.

    Exact where the levels have one scale: their mean is then independent of their ratios (Lukacs
    1955), so that the moments of Q are those of the sum of squares over those of the mean.

    Parameters
    ----------
    count, total, inverse : ndarray
        Number of levels, sum of their shapes, and sum of the inverses of these.

    Examples
    --------
    >>> mean, variance = scatter_moments(np.array(10.0), np.array(10 * 50.0), np.array(10 / 50.0))
    >>> mean.round(3), variance.round(2)
    (np.float64(8.982), np.float64(18.11))
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        free = count - 1.0
        square = 2.0 * free + 6.0 * (inverse - (2.0 * count - 1.0) / total) + free**2
        mean = free / (1.0 + 1.0 / total)
        return mean, square / (
            (1.0 + 1.0 / total) * (1.0 + 2.0 / total) * (1.0 + 3.0 / total)
        ) - mean**2


def _members(bands: int) -> list[NDArray[np.int64]]:
    """Bands of each column: one, a quarter of them, all."""
    each = [np.array([band]) for band in range(bands)]
    return [
        *each,
        *(
            component
            for component in np.array_split(np.arange(bands), _GROUPS)
            if component.size > 1
        ),
        np.arange(bands),
    ]


def _levels(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    used: NDArray[np.bool_],
    members: list[NDArray[np.int64]],
) -> tuple[Array, Array, list[str]]:
    """Level over that of the record and its shape by (record), row, block, group of bands; and the axes of each row."""
    power, spectrum = (
        values_of(blocks, "power", "axis", "block", "band"),
        values_of(baseline, "spectrum", "axis", "block", "band"),
    )
    shape = values_of(blocks, "shape", "axis", "block", "band")[..., used]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (power / spectrum)[..., used]
        there = np.isfinite(ratio) & (shape > 0)
        each = np.where(there, shape, 0.0)
        ratio = ratio * _tamed(np.where(there, ratio, 0.0), each)
        weight = np.stack([each[..., one].sum(axis=-1) for one in members], axis=-1)
        total = np.stack(
            [np.where(there, ratio * each, 0.0)[..., one].sum(axis=-1) for one in members], axis=-1
        )
        level = total / weight
        level = level / _middle(level, weight)
    axes = [str(axis) for axis in blocks["axis"].values]
    level = np.nan_to_num(level)
    if len(axes) == 1:
        return level, weight, axes
    together = weight.sum(axis=-3, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.nan_to_num((level * weight).sum(axis=-3, keepdims=True) / together)
    together = together / _alike(blocks, used, members, weight)
    return (
        np.concatenate([level, mean], axis=-3),
        np.concatenate([weight, together], axis=-3),
        [*axes, " ".join(axes)],
    )


def _tamed(ratio: Array, shape: Array) -> Array:
    """Factor by (record), axis, block, 1 that brings a loud block down to what one may count for, in all its bands alike."""
    weight = shape.sum(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = (ratio * shape).sum(axis=-1, keepdims=True) / weight
        return np.asarray(
            np.nan_to_num(
                np.minimum(_middle(level, weight) * (1.0 + _MOST / np.sqrt(weight)) / level, 1.0),
                nan=1.0,
            )
        )


def _alike(
    blocks: xr.Dataset, used: NDArray[np.bool_], members: list[NDArray[np.int64]], weight: Array
) -> Array:
    """Factor on the variance of the mean over the axes by (record), 1, 1, group: powers of axes scatter alike where these are coherent."""
    if "cross" not in blocks:
        return np.ones(1)
    axes = [str(axis) for axis in blocks["axis"].values]
    one, other = (
        [axes.index(str(axis)) for axis in blocks[name].values] for name in ("first", "second")
    )
    power = np.nan_to_num(values_of(blocks, "power", "axis", "block", "band")[..., used])
    cross = np.nan_to_num(values_of(blocks, "cross", "pair", "block", "band")[..., used])
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = np.abs(cross.sum(axis=-2)) ** 2 / (
            power[..., one, :, :].sum(axis=-2) * power[..., other, :, :].sum(axis=-2)
        )
    squared = np.minimum(np.nan_to_num(squared), 1.0)
    mean = np.stack([squared[..., component].mean(axis=-1) for component in members], axis=-1)
    share = weight.sum(axis=-2)
    pairs = 2.0 * (np.sqrt(share[..., one, :] * share[..., other, :]) * mean).sum(axis=-2)
    return np.asarray(1.0 + np.nan_to_num(pairs / share.sum(axis=-2)))[..., None, None, :]


def _middle(level: Array, weight: Array) -> Array:
    """Mean of each course of levels as its median has it, which a few loud blocks do not move."""
    there = weight > 0
    usual = np.where(there, weight, 0.0).sum(axis=-2, keepdims=True) / np.maximum(
        there.sum(axis=-2, keepdims=True), 1
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            _median(np.where(there, level, np.nan))
            / (1.0 - 1.0 / (9.0 * np.maximum(usual, 0.5))) ** 3
        )


def _median(values: Array) -> Array:
    """Median over the last dimension but one, of what is there."""
    ordered = np.sort(values, axis=-2)
    count = np.isfinite(ordered).sum(axis=-2, keepdims=True)
    low, high = (
        np.take_along_axis(ordered, np.maximum(place, 0), axis=-2)
        for place in ((count - 1) // 2, count // 2)
    )
    return np.asarray((low + high) / 2.0)


def _scatter(
    level: Array, weight: Array, windows: Windows, span: int, *, single: int
) -> tuple[Array, Array, Array]:
    """Score, ratio and swing by (record), row, window, column for averages over `span` blocks; the bands alone come first."""
    count = level.shape[-2] // span
    shape = np.broadcast_to(weight, level.shape)[..., : count * span, :].reshape(
        *level.shape[:-2], count, span, -1
    )
    total = shape.sum(axis=-2)
    with np.errstate(divide="ignore", invalid="ignore"):
        average = (level[..., : count * span, :].reshape(shape.shape) * shape).sum(axis=-2) / total
        middle = _middle(average, total)
        average = np.clip(average, None, middle * (1.0 + _MOST / np.sqrt(total)))
        there = total > 0
        inverse = np.where(there, 1.0 / total, 0.0)
    average = np.where(there, average, 0.0)
    begin = np.minimum(
        -(-windows.first // span), count
    )  # what is left of the record behind the last average has none
    inside = Windows(begin, np.maximum(windows.stop // span, begin))
    first, square = over_windows(total * average, inside), over_windows(total * average**2, inside)
    number, weights = over_windows(there.astype(float), inside), over_windows(total, inside)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (square - first**2 / weights) / (first / weights) ** 2
    mean, variance = scatter_moments(number, weights, over_windows(inverse, inside))
    enough = (number >= _FEWEST) & (weights > 0)
    components = [
        np.where(enough, np.nan_to_num(component), 0.0)[..., :single].sum(axis=-1, keepdims=True)
        for component in (found, mean, variance, weights)
    ]
    found, mean, variance, weights = (
        np.concatenate(pair, axis=-1)
        for pair in zip((found, mean, variance, weights), components, strict=True)
    )
    enough = np.concatenate([enough, enough[..., :single].any(axis=-1, keepdims=True)], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(enough, found / mean, np.nan)
        swing = np.sqrt(np.maximum(found - mean, 0.0) / weights)
        return np.where(enough, cube_root_score(ratio, mean**2 / variance), np.nan), ratio, swing
