"""Score of variance fluctuation: powers that scatter more than their degrees of freedom allow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.diagnose.reduce.schema import pair_indices
from gyrostab.diagnose.statistics.base import Region, Statistic
from gyrostab.diagnose.statistics.mismatch_wording import axes_text, length_text, taus_text
from gyrostab.diagnose.statistics.power import LEVEL_COLUMNS
from gyrostab.diagnose.statistics.scores import (
    BlockWindows,
    cube_root_score,
    statistic_dataset,
    sum_over_windows,
    window_set,
)
from gyrostab.wording import format_rounded

#: Lengths of the windows [blocks]; the record as a whole is one more.
LENGTHS = (20, 80)
#: Blocks whose powers are averaged before their scatter is judged.
SPANS = (1, 2, 4, 8, 16, 32, 64)
_MIN_AVERAGES = 6  # for a meaningful scatter; design choice
_BAND_GROUPS = 4  # of neighbouring bands; design choice
_MIN_FREQUENCY_LINES = 3.5  # lower bands show a mean that moves within blocks rather than noise
#: Largest deviation that one average contributes: the Allan variance judges single noisy blocks.
_MAX_AVERAGE_SIGMA = 4.0


class VarianceFluctuation(Statistic):
    """Variance fluctuation: powers that scatter more than their degrees of freedom allow."""

    name = "variance_fluctuation"
    view = "davar"
    is_ratio = True

    def score(self, blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
        r"""Score the scatter of the band powers over time against that of steady noise.

        The ratios of the powers of a block to the expected ones, averaged over bands and over 1, 2,
        4 ... blocks, are the levels :math:`y_j`. In steady noise each is gamma-distributed with a
        known shape :math:`w_j`, and the statistic of a window of J of them is

        .. math::

            Q = \sum_j w_j (y_j - \bar y)^2 / \bar y^2, \quad
            \bar y = \sum_j w_j y_j / \sum_j w_j,

        about :math:`J - 1`, with a variance of :math:`2 (J - 1) + 6 \sum_j 1 / w_j` or a little
        less (`scatter_moments` has both exactly). Noise whose log power varies by v rms from one
        average to the next raises Q by :math:`v^2 \sum_j w_j`. It is therefore z standard
        deviations above steady noise if :math:`v^2 = z \sqrt{2 (J - 1)} / \sum_j w_j`: for white
        noise in 100 blocks of 200 samples (w = 93 each) five, if v = 9 %. Averages over k blocks
        have a variance smaller by the root of k, and lose variations faster than about 3 k blocks.

        Each span has a column for each band, each quarter of the bands, all bands, and each band
        against its own mean; the lowest bands are left out, because a moving mean shows in them.
        ``ratio`` is the scatter relative to steady noise, ``estimate`` the variation of the power,
        rms over mean. Several axes have a row of all together, the mean of their levels, because
        axes often fluctuate together. None for too short a record.
        """
        block_count, block = blocks.sizes["block"], float(blocks.attrs["block_s"])
        spans = [span for span in SPANS if block_count // span >= _MIN_AVERAGES]
        low, high = (blocks[name].values for name in ("band_low", "band_high"))
        used = low * block >= _MIN_FREQUENCY_LINES
        if not spans or not used.any():
            return None
        members = _band_groups(int(used.sum()))
        levels, rows = _relative_levels(blocks, baseline, used, members)
        windows = window_set(block_count, LENGTHS)
        single = int(used.sum())
        scores = [
            [_score_scatter(*of_rows, windows, span, single=single) for span in spans]
            for of_rows in levels
        ]
        z, ratio, variation = np.concatenate(
            [np.concatenate(of_spans, axis=-1) for of_spans in scores], axis=-3
        )
        f_low = np.append([low[used][group].min() for group in members], low[used][0])
        f_high = np.append([high[used][group].max() for group in members], high[used][-1])
        return statistic_dataset(
            blocks,
            rows=rows,
            windows=windows,
            columns={
                "quantity": np.repeat(
                    [f"variance {span * block:g} s" for span in spans], f_low.size
                ),
                "tau_min_s": np.tile(0.5 / f_high, len(spans)),
                "tau_max_s": np.tile(0.5 / f_low, len(spans)),
            },
            z=z,
            ratio=ratio,
            estimate=variation,
            one_sided=True,
        )

    def prepare(
        self, blocks: xr.Dataset, baseline: xr.Dataset, regions: Sequence[Region]
    ) -> xr.Dataset:
        """Scale the powers where the noise level differs: that is reported already."""
        spans = [
            (region["axes"].split(), float(region["begin"]), float(region["end"]))
            for region in regions
            if region["quantity"] in LEVEL_COLUMNS
        ]
        return scale_to_expected(blocks, baseline, spans)

    def describe(self, region: Mapping[str, Any], when: str) -> str:
        pace = length_text(float(region["quantity"].split()[1]))
        estimate = region.get("estimate", np.nan)
        size = f" by {format_rounded(100.0 * estimate)} % (rms)" if np.isfinite(estimate) else ""
        return (
            f"The noise level of {axes_text(region['axes'])} fluctuates {when}: at "
            f"{taus_text(region)} its power changes{size} from one stretch of {pace} to another, "
            f"which is {region['ratio']:.3g} times the scatter of steady noise"
        )


def scale_to_expected(
    blocks: xr.Dataset, baseline: xr.Dataset, spans: Sequence[tuple[Sequence[str], float, float]]
) -> xr.Dataset:
    """Scale the powers in some intervals to the expected mean, when their levels are known.

    The first two and the last two blocks of an interval are scaled separately, because the level
    may change within them. A span has names of axes, begin, and end [s since the start].
    """
    if not spans:
        return blocks
    power, spectrum = (variable.values for variable in (blocks["power"], baseline["spectrum"]))
    shape, power = blocks["shape"].values, power.copy()
    for axes, begin, end in spans:
        inside = np.flatnonzero(
            (blocks["begin"].values >= begin - 1e-6) & (blocks["end"].values <= end + 1e-6)
        )
        pieces = np.split(inside, [1, 2, -2, -1] if inside.size > 4 else range(1, inside.size))
        rows = np.flatnonzero(np.isin(blocks["axis"].values.astype(str), list(axes)))
        for row, block_count in product(rows, pieces):
            ratio = power[row, block_count] / spectrum[row, block_count]
            weight = np.nan_to_num(shape[row, block_count])
            weight = np.where(np.isfinite(ratio), weight, 0.0)
            with np.errstate(invalid="ignore", divide="ignore"):
                power[row, block_count] /= (np.nan_to_num(ratio) * weight).sum(axis=0) / weight.sum(
                    axis=0
                )
    return blocks.assign(power=(("axis", "block", "band"), power, blocks["power"].attrs))


def scatter_moments(count: Floats, total: Floats, inverse: Floats) -> tuple[Floats, Floats]:
    """Return mean and variance of the scatter of gamma-distributed levels relative to their mean.

    Exact for levels of one scale: their mean is then independent of their ratios (Lukacs 1955), so
    that the moments of Q are those of the sum of squares divided by those of the mean. The
    arguments are the number of levels, the sum of their shapes, and the sum of the inverse shapes.

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


def _band_groups(bands: int) -> list[Ints]:
    """Return the bands of each column: one, a quarter of them, all."""
    return [
        *(np.array([band]) for band in range(bands)),
        *(group for group in np.array_split(np.arange(bands), _BAND_GROUPS) if group.size > 1),
        np.arange(bands),
    ]


@np.errstate(divide="ignore", invalid="ignore")
def _relative_levels(
    blocks: xr.Dataset, baseline: xr.Dataset, used: Bools, members: list[Ints]
) -> tuple[list[tuple[Floats, Floats]], list[str]]:
    """Return the level relative to the record, with its shape, and the axes of each row.

    By (record), row, block, group of bands: one pair for all axes, whose shapes all records have in
    common, and one for the row of several axes.
    """
    power, spectrum = blocks["power"].values, baseline["spectrum"].values
    shape = blocks["shape"].values[..., used]
    if "shape_factor" in baseline:
        shape = shape * baseline["shape_factor"].values[used]
    ratio = (power / spectrum)[..., used]
    present = np.isfinite(ratio).reshape(-1, *shape.shape).all(axis=0) & (shape > 0)
    used_shape = np.where(present, shape, 0.0)
    ratio = ratio * _limit_noisy_blocks(np.where(present, ratio, 0.0), used_shape)
    weighted = np.where(present, ratio * used_shape, 0.0)
    total, weight = (
        np.stack([values[..., group].sum(axis=-1) for group in members], axis=-1)
        for values in (weighted, used_shape)
    )
    level = total / weight
    level = level / _robust_mean(level, weight)
    axes = [str(axis) for axis in blocks["axis"].values]
    level = np.nan_to_num(level)
    if len(axes) == 1:
        return [(level, weight)], axes
    joint_weight = weight.sum(axis=-3, keepdims=True)
    mean = np.nan_to_num((level * weight).sum(axis=-3, keepdims=True) / joint_weight)
    joint_weight = joint_weight / _coherence_factor(blocks, used, members, weight)
    return [(level, weight), (mean, joint_weight)], [*axes, " ".join(axes)]


@np.errstate(divide="ignore", invalid="ignore")
def _limit_noisy_blocks(ratio: Floats, shape: Floats) -> Floats:
    """Return the factor (record), axis, block, 1 that limits a noisy block, equal in all bands."""
    weight = shape.sum(axis=-1, keepdims=True)
    level = (ratio * shape).sum(axis=-1, keepdims=True) / weight
    limit = _robust_mean(level, weight) * (1.0 + _MAX_AVERAGE_SIGMA / np.sqrt(weight))
    return np.asarray(np.nan_to_num(np.minimum(limit / level, 1.0), nan=1.0))


def _coherence_factor(
    blocks: xr.Dataset, used: Bools, members: list[Ints], weight: Floats
) -> Floats:
    """Return the variance factor (record), 1, 1, group of the mean over coherent axes."""
    first, second = pair_indices(blocks)
    power = np.nan_to_num(blocks["power"].values[..., used])
    cross = np.nan_to_num(blocks["cross"].values[..., used])
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = np.abs(cross.sum(axis=-2)) ** 2 / (
            power[..., first, :, :].sum(axis=-2) * power[..., second, :, :].sum(axis=-2)
        )
    squared = np.minimum(np.nan_to_num(squared), 1.0)
    mean = np.stack([squared[..., values].mean(axis=-1) for values in members], axis=-1)
    share = weight.sum(axis=-2)
    pairs = 2.0 * (np.sqrt(share[..., first, :] * share[..., second, :]) * mean).sum(axis=-2)
    return np.asarray(1.0 + np.nan_to_num(pairs / share.sum(axis=-2)))[..., None, None, :]


@np.errstate(divide="ignore", invalid="ignore")
def _robust_mean(level: Floats, weight: Floats) -> Floats:
    """Return the mean of each series of levels, from its median, robust against noisy blocks."""
    present = weight > 0
    usual = np.where(present, weight, 0.0).sum(axis=-2, keepdims=True) / np.maximum(
        present.sum(axis=-2, keepdims=True), 1
    )
    return np.asarray(
        _median_over_blocks(np.where(present, level, np.nan))
        / (1.0 - 1.0 / (9.0 * np.maximum(usual, 0.5))) ** 3
    )


def _median_over_blocks(values: Floats) -> Floats:
    """Return the median over the second last dimension, ignoring NaN."""
    ordered = np.sort(values, axis=-2)
    count = np.isfinite(ordered).sum(axis=-2, keepdims=True)
    low, high = (
        np.take_along_axis(ordered, np.maximum(place, 0), axis=-2)
        for place in ((count - 1) // 2, count // 2)
    )
    return np.asarray((low + high) / 2.0)


@np.errstate(divide="ignore", invalid="ignore")
def _score_scatter(
    level: Floats, weight: Floats, windows: BlockWindows, span: int, *, single: int
) -> tuple[Floats, Floats, Floats]:
    """Return score, ratio and variation by (record), row, window, column, for `span` blocks.

    The single bands come first.
    """
    count = level.shape[-2] // span
    level, shape = (
        values[..., : count * span, :].reshape(*values.shape[:-2], count, span, -1)
        for values in (level, weight)
    )
    total = shape.sum(axis=-2)
    average = (level * shape).sum(axis=-2) / total
    middle = _robust_mean(average, total)
    average = np.clip(average, None, middle * (1.0 + _MAX_AVERAGE_SIGMA / np.sqrt(total)))
    present = total > 0
    inverse = np.where(present, 1.0 / total, 0.0)
    average = np.where(present, average, 0.0)
    # An incomplete average at the end of the record does not count.
    begin = np.minimum(-(-windows.first // span), count)
    inside = BlockWindows(begin, np.maximum(windows.stop // span, begin))
    first = sum_over_windows(total * average, inside)
    square = sum_over_windows(total * average**2, inside)
    number = sum_over_windows(present.astype(float), inside)
    weights = sum_over_windows(total, inside)
    scatter = (square - first**2 / weights) / (first / weights) ** 2
    mean, variance = scatter_moments(number, weights, sum_over_windows(inverse, inside))
    enough = (number >= _MIN_AVERAGES) & (weights > 0)
    single_sums = [
        np.where(enough, np.nan_to_num(values), 0.0)[..., :single].sum(axis=-1, keepdims=True)
        for values in (scatter, mean, variance, weights)
    ]
    scatter, mean, variance, weights = (
        np.concatenate(pair, axis=-1)
        for pair in zip((scatter, mean, variance, weights), single_sums, strict=True)
    )
    enough = np.concatenate([enough, enough[..., :single].any(axis=-1, keepdims=True)], axis=-1)
    ratio = np.where(enough, scatter / mean, np.nan)
    variation = np.sqrt(np.maximum(scatter - mean, 0.0) / weights)
    z = np.where(enough, cube_root_score(ratio, mean**2 / variance), np.nan)
    return z, ratio, variation
