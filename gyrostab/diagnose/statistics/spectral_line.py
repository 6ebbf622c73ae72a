"""Lines that stand out of the spectrum around them."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.spectral_lines import expected_lines
from gyrostab.diagnose.statistics.scores import (
    Array,
    Windows,
    cube_root_score,
    over_windows,
    statistic_dataset,
    values_of,
)

__all__ = ["score"]

_NEAR = 2  # lines on either side that a line leaks into
_AROUND = 40  # lines on either side that tell the level


def score(blocks: xr.Dataset, baseline: xr.Dataset) -> xr.Dataset | None:
    """Score every line of the full-resolution spectrum, in parts of the record and in the whole, against its surroundings.

    Parameters
    ----------
    blocks, baseline : xarray.Dataset
        Recording or null records, and what the simulation expects: its spectrum gives the slope of
        the surroundings, their level is the recording's own.

    Returns
    -------
    xarray.Dataset or None
        None without lines. ``estimate`` is the amplitude of a sine that would raise the line so far
        [degree hour-1].
    """
    if "line_power" not in blocks:
        return None
    power, weight = (
        values_of(blocks, "line_power", "axis", "part", "line"),
        values_of(blocks, "line_weight", "axis", "part"),
    )
    frequency = blocks["line_frequency"].values
    windows = _parts(blocks)
    expected = expected_lines(baseline, frequency)[:, None, :]
    flat = power / expected
    there = np.isfinite(flat) & (weight > 0)[..., None]
    each = np.where(there, weight[..., None], 0.0)
    flat = np.where(there, flat, 0.0) * each
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = flat.sum(axis=-2, keepdims=True)
        count = np.concatenate([each, each.sum(axis=-2, keepdims=True)], axis=-2)
        flat = np.concatenate([flat, whole], axis=-2) / count
        count = count * _evenness(blocks, windows)
        around = _surroundings(flat)
        ratio = flat / around
    # a sum over lines, which only a recording needs
    excess = _near(flat - around) * expected if flat.ndim == 3 else np.zeros(1)
    z = cube_root_score(ratio, count / (1.0 + 1.0 / (2.0 * _AROUND)))
    half = 0.371 / frequency  # where the Allan variance of a sine is largest
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


def _parts(blocks: xr.Dataset) -> Windows:
    """Blocks of the equal parts of the record, and of the whole last."""
    components, block_count = blocks.sizes["part"], blocks.sizes["block"]
    edge = -(
        -np.arange(components + 1) * block_count // components
    )  # as the blocks were shared out when the log was read
    return Windows(
        np.append(edge[:-1], 0), np.append(np.maximum(edge[1:], edge[:-1] + 1), block_count)
    )


def _evenness(blocks: xr.Dataset, windows: Windows) -> Array:
    """Blocks that a mean is as good as, over those in it, by window and line: one loud block among quiet ones scatters as one alone."""
    power, shape = (values_of(blocks, name, "axis", "block", "band") for name in ("power", "shape"))
    there = np.isfinite(power) & (shape > 0)
    power, one = np.where(there, power, 0.0), there.astype(float)
    square = np.where(there, power**2 * shape / (1.0 + shape), 0.0)
    count, first, second = (over_windows(component, windows) for component in (one, power, square))
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.where(second > 0, first**2 / (count * second), 1.0)
    bands, lines = np.log(blocks["frequency"].values), np.log(blocks["line_frequency"].values)
    place = np.clip(np.searchsorted(bands, lines), 1, bands.size - 1)
    share = np.clip((lines - bands[place - 1]) / (bands[place] - bands[place - 1]), 0.0, 1.0)
    even = np.minimum(even, 1.0)
    return np.asarray(even[..., place - 1] * (1.0 - share) + even[..., place] * share)


def _near(excess: Array) -> Array:
    """Sum over a line and those it leaks into; of a sine, a quarter of the squared amplitude times the block."""
    n = excess.shape[-1]
    total = np.concatenate([np.zeros((*excess.shape[:-1], 1)), np.cumsum(excess, axis=-1)], axis=-1)
    place = np.arange(n)
    return np.asarray(
        total[..., np.minimum(place + _NEAR + 1, n)] - total[..., np.maximum(place - _NEAR, 0)]
    )


def _surroundings(flat: Array) -> Array:
    """Mean of the lines around each, without those next to it; nearer the ends, of as many from within."""
    n = flat.shape[-1]
    total = np.concatenate([np.zeros((*flat.shape[:-1], 1)), np.cumsum(flat, axis=-1)], axis=-1)
    place = np.arange(n)
    wide = min(2 * _AROUND + 2 * _NEAR + 1, n)
    low = np.clip(place - wide // 2, 0, n - wide)
    near_low, near_high = np.maximum(place - _NEAR, 0), np.minimum(place + _NEAR + 1, n)
    inner = total[..., near_high] - total[..., near_low]
    outer = total[..., low + wide] - total[..., low]
    return np.asarray((outer - inner) / np.maximum(wide - (near_high - near_low), 1))
