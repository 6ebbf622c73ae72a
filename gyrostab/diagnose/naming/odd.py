"""Sizes of lines and of odd samples, from line spectra and counts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.effects.search import Tallies

__all__ = ["line_size", "mark_sizes"]

_PER_SPIKE = 3.0  # second differences that hold a spike
_LIMIT = 6.0  # standard deviations beyond which one counts as an outlier
Pair = tuple[float, float]


def line_size(reduced: xr.Dataset, axis: str, place: int) -> tuple[Pair, Pair]:
    """Amplitude [degree hour-1] and frequency [Hz] of a line, each with its error, from the power about it that is above the level."""
    from gyrostab.diagnose.gains.lines import line_skirt, local_level

    lines = reduced["line_frequency"].values
    weight = reduced["line_weight"].sel(axis=axis).values
    power = reduced["line_power"].sel(axis=axis).transpose("part", "line").values
    good = (weight > 0) & np.isfinite(power).all(axis=1)
    total = (power[good] * weight[good, None]).sum(axis=0) / weight[good].sum()
    level = local_level(total[None, None])[0, 0]
    near = line_skirt(reduced, axis, place)
    step = float(np.diff(lines[:2])[0])
    above = total[near] - level[near]
    square = 4.0 * max(float(above.sum()) * step, 0.0)
    noise = 4.0 * step * float(np.sqrt((level[near] * total[near]).sum() / weight[good].sum()))
    amplitude = math.sqrt(square)
    positive = np.maximum(above, 0.0)
    frequency = float((positive * lines[near]).sum() / max(positive.sum(), 1e-300))
    return (amplitude, noise / (2.0 * max(amplitude, math.sqrt(noise)))), (frequency, 0.5 * step)


def mark_sizes(effect: str, mark: str, axis: str, reduced: xr.Dataset, tallies: Tallies) -> dict[str, Pair]:
    """Parameters of an effect on the distribution."""
    from scipy.stats import norm

    samples = max(float(reduced["samples"].sel(axis=axis).sum()), 1.0)
    rate = float(reduced.attrs["sampling_rate_hz"])
    hours = samples / rate / 3600.0
    if mark == "lattice":
        return {"step": (float(reduced["lattice"].sel(axis=axis)), 0.0)}
    row = [str(one) for one in reduced["axis"].values].index(axis)
    usual = float(tallies.of[mark][0][row]) * reduced.sizes["block"] if mark in tallies.of else 0.0
    count = max(float(reduced[mark].sel(axis=axis).sum()) - usual, 1.0)
    spread = _spread(reduced, row)
    error = math.sqrt(count + usual)
    if effect == "spikes":
        excess = float(reduced["kurtosis"].sel(axis=axis).mean())
        if not math.isfinite(excess):  # no block was steady enough to have one
            return {"per_hour": (count / _PER_SPIKE / hours, error / _PER_SPIKE / hours)}
        seen, size = _outlier(count / samples, spread, max(excess, 1e-3))
        return {"per_hour": (count / seen / hours, error / seen / hours + 0.2 * count / seen / hours), "size": (size, 0.3 * size)}
    if effect == "held_samples":
        return {"per_hour": (count / hours, error / hours), "length": (1.0 / rate, 0.5 / rate)}
    share = min(count / samples, 0.999)
    if effect == "clipping":
        limit = spread * float(norm.isf(share / 2.0))
        slope = spread / (2.0 * float(norm.pdf(limit / spread)))
        return {"limit": (limit, slope * error / samples)}
    if effect == "dead_zone":
        width = spread * float(norm.ppf(0.5 + share / 2.0))
        return {"width": (width, spread / (2.0 * float(norm.pdf(width / spread))) * error / samples)}
    return {}


def _outlier(share: float, spread: float, excess: float) -> Pair:
    """Second differences that an outlier drives beyond the limit, on average, and its rms size, from their share and the kurtosis."""
    from scipy.special import erfc

    limit = _LIMIT * math.sqrt(6.0) * spread
    seen = _PER_SPIKE
    size = spread
    for _ in range(30):
        size = spread * (excess * seen / (3.0 * share)) ** 0.25
        seen = float(erfc(limit / (2.0 * size) / math.sqrt(2.0)) + 2.0 * erfc(limit / size / math.sqrt(2.0)))
        seen = max(seen, 0.05)
    return seen, size


def _spread(reduced: xr.Dataset, row: int) -> float:
    """Standard deviation of the samples about the means of their blocks [degree hour-1]."""
    width = (reduced["band_high"] - reduced["band_low"]).values
    power: Any = np.nanmedian((reduced["power"].values[row] * width).sum(axis=-1))
    return math.sqrt(2.0 * float(power))
