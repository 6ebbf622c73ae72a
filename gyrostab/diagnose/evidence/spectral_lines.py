"""Lines in the spectrum: what stands out of the lines on both sides of it, in all parts of the record."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.folds import FOLDS

__all__ = ["LEAK", "expected_lines", "level_about", "line_evidence", "line_skirt", "local_level"]

Array = NDArray[Any]
#: Lines on each side that a steady line leaks into.
LEAK = 3
_NEIGHBOURS = 25  # lines on each side that tell the level
_BESIDE = 8  # lines of a stretch on either side, which a line must stand out of
_SLOWEST = 2  # lines at the low end that have no other side
_LOWEST = 1e-3  # of the median level, below which no level goes
_FALL = 3.0  # standard deviations above the level at which a skirt ends
_WIDEST = 40


def expected_lines(baseline: xr.Dataset, frequency: Array) -> Array:
    """Mean density of the baseline at frequencies [Hz], (axis, line) [degree2 hour-2 Hz-1], without steady lines that it knows."""
    spectrum = baseline["spectrum"].mean("block").transpose("axis", "band").values
    bands = np.log(baseline["frequency"].values)
    if "line_spectrum" in baseline:
        spectrum = np.maximum(spectrum - baseline["line_spectrum"].values, _LOWEST * spectrum)
    smooth = np.stack(
        [np.exp(np.interp(np.log(frequency), bands, np.log(row))) for row in spectrum]
    )
    return smooth + baseline["peaks"].values if "peaks" in baseline else smooth


def line_evidence(power: Array, weight: Array, expected: Array | None = None) -> Array:
    """Gain of a steady line on the parts of the record that were held out, less the logarithm of the number of lines.

    The level is that of the lines around, in every part for itself, and not below those next to it
    on either side: a slope or a broad hump is no line. The lowest two lines have nothing below them
    and are never taken for one.

    Parameters
    ----------
    power : ndarray, shape (record, axis, part, line)
        Mean periodograms.
    weight : ndarray, shape (axis, part)
        Independent periodograms in each mean.
    expected : ndarray, shape (axis, line), optional
        Density whose slope the level has; flat by default.

    Returns
    -------
    ndarray, shape (record, axis, line)
    """
    usable = (weight > 0) & np.isfinite(power).all(axis=(0, 3))
    share = np.where(usable, weight, 0.0)[..., None]
    slope = np.ones(power.shape[-1]) if expected is None else expected[:, None]
    clean = np.where(usable[..., None], power / slope, 1.0)
    level = level_about(clean)
    evidence_nats = np.zeros((*power.shape[:2], power.shape[-1]))
    above, precision = clean - level, share / level**2
    for number in range(FOLDS):
        held = np.arange(power.shape[2]) % FOLDS == number
        train = np.maximum(precision[:, :, ~held].sum(axis=2), 1e-300)
        square = np.maximum((above[:, :, ~held] * precision[:, :, ~held]).sum(axis=2) / train, 0.0)[
            :, :, None
        ]
        ratio, excess = clean[:, :, held] / level[:, :, held], square / level[:, :, held]
        evidence_nats += (
            share[:, held] * (ratio * excess / (1.0 + excess) - np.log1p(excess))
        ).sum(axis=2)
    evidence_nats[..., :_SLOWEST] = -np.inf
    return np.asarray(evidence_nats - np.log(power.shape[3]))


def level_about(power: Array) -> Array:
    """Level of the lines around each, (..., line), and not below the stretch of lines on either side of its own."""
    count = power.shape[-1]
    level = local_level(power)
    level = np.maximum(level, _LOWEST * np.median(level, axis=-1, keepdims=True))
    stretches = count // _BESIDE
    if stretches < 3:
        return level
    medians = np.median(
        power[..., : stretches * _BESIDE].reshape(*power.shape[:-1], stretches, _BESIDE), axis=-1
    )
    own = np.minimum(np.arange(count) // _BESIDE, stretches - 1)
    right = medians[..., np.minimum(own + 1, stretches - 1)]
    left = medians[..., np.maximum(own - 1, 0)]
    below = np.cumsum(power[..., :_BESIDE], axis=-1) / np.arange(
        1, _BESIDE + 1
    )  # the first stretch has only its own lowest lines
    left[..., :_BESIDE] = below[..., np.maximum(np.arange(_BESIDE) - LEAK, 0)]
    left[..., :_SLOWEST] = 0.0
    last = own == stretches - 1
    right[..., last] = 0.0
    return np.asarray(np.maximum(level, np.maximum(left, right)))


def local_level(total: Array) -> Array:
    """Medians over stretches of lines, and straight lines between their middles."""
    count = total.shape[-1]
    ends = np.linspace(0, count, max(1, count // (2 * _NEIGHBOURS)) + 1).astype(int)
    medians = np.stack(
        [np.median(total[..., low:high], axis=-1) for low, high in pairwise(ends)], axis=-1
    )
    middle = (ends[1:] + ends[:-1] - 1) / 2.0
    place = np.clip(
        np.interp(np.arange(count), middle, np.arange(middle.size)), 0.0, middle.size - 1.0
    )
    low = np.minimum(place.astype(int), max(middle.size - 2, 0))
    high = np.minimum(low + 1, middle.size - 1)
    return np.asarray(medians[..., low] + (place - low) * (medians[..., high] - medians[..., low]))


def line_skirt(blocks: xr.Dataset, axis: str, place: int) -> NDArray[np.bool_]:
    """Lines that belong to the one at `place`: those it leaks into, and on both sides as far as the power has not come down to the level.

    A line whose phase wanders is wider than the leakage; what stands on its slopes is no other
    line.
    """
    weight = blocks["line_weight"].sel(axis=axis).values
    power = blocks["line_power"].sel(axis=axis).transpose("part", "line").values
    good = (weight > 0) & np.isfinite(power).all(axis=1)
    total = (power[good] * weight[good, None]).sum(axis=0) / max(float(weight[good].sum()), 1e-300)
    limit = local_level(total[None])[0] * (
        1.0 + _FALL / np.sqrt(max(float(weight[good].sum()), 1.0))
    )
    mine = np.abs(np.arange(total.size) - place) <= LEAK
    for step in (-1, 1):
        at = place + step
        while 0 <= at < total.size and abs(at - place) <= _WIDEST and total[at] > limit[at]:
            mine[at] = True
            at += step
    return np.asarray(mine)
