"""Score of spectral lines that exceed the spectrum around them."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.spectral_lines import expected_lines
from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    statistic_dataset,
    sum_over_windows,
    values_in_order,
)

__all__ = ["score"]

_LEAK_LINES = 2  # lines on either side that a line leaks into
_AROUND_LINES = 40  # lines on either side that define the level; design choice


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score every line of the spectrum, in parts of the record and in the whole.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and the expectation of the simulation: its spectrum defines the
        slope of the surroundings, and the recording their level.

    Returns
    -------
    xarray.Dataset or None
        None without lines. ``estimate`` is the amplitude of a sine with the same excess [degree
        hour-1].
    """
    if "line_power" not in blocks:
        return None
    power, weight = (
        values_in_order(blocks, "line_power", "axis", "part", "line"),
        values_in_order(blocks, "line_weight", "axis", "part"),
    )
    frequency = blocks["line_frequency"].values
    windows = _part_windows(blocks)
    expected = expected_lines(baseline, frequency)[:, None, :]
    flat = power / expected
    present = np.isfinite(flat) & (weight > 0)[..., None]
    used_weight = np.where(present, weight[..., None], 0.0)
    flat = np.where(present, flat, 0.0) * used_weight
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = flat.sum(axis=-2, keepdims=True)
        count = np.concatenate([used_weight, used_weight.sum(axis=-2, keepdims=True)], axis=-2)
        flat = np.concatenate([flat, whole], axis=-2) / count
        count = count * _equal_block_share(blocks, windows)
        around = _mean_around(flat)
        ratio = flat / around
    # A sum over lines, which only a recording needs.
    excess = _sum_leakage(flat - around) * expected if flat.ndim == 3 else np.zeros(1)
    z = cube_root_score(ratio, count / (1.0 + 1.0 / (2.0 * _AROUND_LINES)))
    half = 0.371 / frequency  # at which the Allan variance of a sine is largest
    return statistic_dataset(
        "spectrum",
        blocks,
        windows=windows,
        columns={"what": "line", "tau_min_s": half, "tau_max_s": half, "frequency": frequency},
        z=z,
        ratio=ratio,
        estimate=2.0 * np.sqrt(np.maximum(excess, 0.0) / float(blocks.attrs["block_s"])),
        units="degree hour-1",
        one_sided=True,
    )


def _part_windows(blocks: xr.Dataset) -> Windows:
    """Return the blocks of the equal parts of the record, and of the whole last."""
    part_count, block_count = blocks.sizes["part"], blocks.sizes["block"]
    # As the blocks were divided when the log was read.
    edge = -(-np.arange(part_count + 1) * block_count // part_count)
    return Windows(
        np.append(edge[:-1], 0), np.append(np.maximum(edge[1:], edge[:-1] + 1), block_count)
    )


def _equal_block_share(blocks: xr.Dataset, windows: Windows) -> Array:
    """Return the equivalent share of equal-power blocks in a mean, by window and line."""
    power, shape = (
        values_in_order(blocks, name, "axis", "block", "band") for name in ("power", "shape")
    )
    present = np.isfinite(power) & (shape > 0)
    power, present_count = np.where(present, power, 0.0), present.astype(float)
    square = np.where(present, power**2 * shape / (1.0 + shape), 0.0)
    count, first, second = (
        sum_over_windows(values, windows) for values in (present_count, power, square)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.where(second > 0, first**2 / (count * second), 1.0)
    bands, lines = np.log(blocks["frequency"].values), np.log(blocks["line_frequency"].values)
    place = np.clip(np.searchsorted(bands, lines), 1, bands.size - 1)
    share = np.clip((lines - bands[place - 1]) / (bands[place] - bands[place - 1]), 0.0, 1.0)
    even = np.minimum(even, 1.0)
    return np.asarray(even[..., place - 1] * (1.0 - share) + even[..., place] * share)


def _sum_leakage(excess: Array) -> Array:
    """Sum over a line and its leakage; for a sine, a quarter of squared amplitude times block."""
    n = excess.shape[-1]
    total = np.concatenate([np.zeros((*excess.shape[:-1], 1)), np.cumsum(excess, axis=-1)], axis=-1)
    place = np.arange(n)
    return np.asarray(
        total[..., np.minimum(place + _LEAK_LINES + 1, n)]
        - total[..., np.maximum(place - _LEAK_LINES, 0)]
    )


def _mean_around(flat: Array) -> Array:
    """Return the mean of the lines around each, without its leakage; one-sided near the ends."""
    n = flat.shape[-1]
    total = np.concatenate([np.zeros((*flat.shape[:-1], 1)), np.cumsum(flat, axis=-1)], axis=-1)
    place = np.arange(n)
    width = min(2 * _AROUND_LINES + 2 * _LEAK_LINES + 1, n)
    low = np.clip(place - width // 2, 0, n - width)
    near_low, near_high = np.maximum(place - _LEAK_LINES, 0), np.minimum(place + _LEAK_LINES + 1, n)
    inner = total[..., near_high] - total[..., near_low]
    outer = total[..., low + width] - total[..., low]
    return np.asarray((outer - inner) / np.maximum(width - (near_high - near_low), 1))
