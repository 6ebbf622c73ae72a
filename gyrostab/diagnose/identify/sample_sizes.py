"""Sizes of lines and of odd samples, from line spectra and counts."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from gyrostab.diagnose.predict.search import CountEvidence
from gyrostab.diagnose.reduce.outliers import outlier_limit
from gyrostab.units import HOUR

__all__ = ["line_size", "sample_count_sizes"]

_DEPARTURE = (
    1.08  # of white noise from the median of eight samples beside each, in its own deviations
)
_USUAL = 0.2  # of the usual variance of a block, by which that of one may be higher by chance
_CALM = 5  # blocks without an outlier that tell how loud the noise is
# of the number and the size of outliers, by which the law of their sizes may be another; at least
# half of those not seen
_LAW = 0.1
Pair = tuple[float, float]


def line_size(blocks: xr.Dataset, axis: str, place: int) -> tuple[Pair, Pair]:
    """Amplitude [degree hour-1] and frequency [Hz] of a line, each with its error, from the power about it that is above the level."""
    from gyrostab.diagnose.evidence.spectral_lines import line_skirt, local_level

    lines = blocks["line_frequency"].values
    weight = blocks["line_weight"].sel(axis=axis).values
    power = blocks["line_power"].sel(axis=axis).transpose("part", "line").values
    good = (weight > 0) & np.isfinite(power).all(axis=1)
    total = (power[good] * weight[good, None]).sum(axis=0) / weight[good].sum()
    level = local_level(total[None, None])[0, 0]
    near = line_skirt(blocks, axis, place)
    step = float(np.diff(lines[:2])[0])
    above = total[near] - level[near]
    square = 4.0 * max(float(above.sum()) * step, 0.0)
    noise = 4.0 * step * float(np.sqrt((level[near] * total[near]).sum() / weight[good].sum()))
    amplitude = math.sqrt(square)
    positive = np.maximum(above, 0.0)
    frequency = float((positive * lines[near]).sum() / max(positive.sum(), 1e-300))
    return (amplitude, noise / (2.0 * max(amplitude, math.sqrt(noise)))), (frequency, 0.5 * step)


def sample_count_sizes(
    effect: str, mark: str, axis: str, blocks: xr.Dataset, count_evidence: CountEvidence
) -> dict[str, Pair]:
    """Parameters of an effect on the distribution."""
    from scipy.stats import norm

    samples = max(float(blocks["samples"].sel(axis=axis).sum()), 1.0)
    rate = float(blocks.attrs["sampling_rate_hz"])
    hours = samples / rate / HOUR
    if mark == "lattice":
        return {"step": (float(blocks["lattice"].sel(axis=axis)), 0.0)}
    row = [str(one) for one in blocks["axis"].values].index(axis)
    usual = float(count_evidence.of[mark][0][row].sum()) if mark in count_evidence.of else 0.0
    count = max(float(blocks[mark].sel(axis=axis).sum()) - usual, 1.0)
    spread = _spread(blocks, axis)
    error = math.sqrt(count + usual)
    if effect == "spikes":
        count = max(
            float(blocks["peaks"].sel(axis=axis).where(blocks[mark].sel(axis=axis) > 0).sum()),
            1.0,
        )
        error = math.sqrt(count)
        told = _outliers(blocks, axis)
        if told is None:  # no block was steady enough to have a kurtosis
            return {"per_hour": (count / hours, error / hours)}
        seen, size, many = told
        number = count / seen
        law = max(_LAW, 0.5 * (1.0 - seen))
        doubt = math.hypot(1.0 / math.sqrt(2.0 * many), law)
        return {
            "per_hour": (number / hours, number / hours * math.hypot(1.0 / error, law)),
            "size": (size, doubt * size),
        }
    if effect == "held_samples":
        usual = (
            usual if float(blocks["lattice"].sel(axis=axis)) > 0.0 else 0.0
        )  # without a lattice chance makes none
        count = max(float(blocks[mark].sel(axis=axis).sum()) - usual, 1.0)
        runs = _held_runs(blocks, axis, mark, usual)
        length = max(count / runs, 1.0) / rate  # of a geometric law: scattered by itself
        return {
            "per_hour": (runs / hours, math.sqrt(runs) / hours),
            "length": (length, length / math.sqrt(runs)),
        }
    share = min(count / samples, 0.999)
    if effect == "clipping":
        limit = spread * float(norm.isf(share / 2.0))
        slope = spread / (2.0 * float(norm.pdf(limit / spread)))
        return {"limit": (limit, slope * error / samples)}
    if effect == "dead_zone":
        width = spread * float(norm.ppf(0.5 + share / 2.0))
        return {
            "width": (width, spread / (2.0 * float(norm.pdf(width / spread))) * error / samples)
        }
    return {}


def _held_runs(blocks: xr.Dataset, axis: str, mark: str, usual: float) -> float:
    """How often samples were held: runs of them, less those that a lattice makes by chance."""
    own = {
        name: float(blocks[name].sel(axis=axis).sum())
        for name in ("adjacent", "repeats", "repeat_runs", "zeros", "zero_runs", "filled")
    }
    if mark == "filled":
        return max(own["zero_runs"] * own["filled"] / max(own["zeros"], 1.0), 1.0)
    return max(own["repeat_runs"] - usual * (1.0 - usual / max(own["adjacent"], 1.0)), 1.0)


def _outliers(blocks: xr.Dataset, axis: str) -> tuple[float, float, float] | None:
    """Share of outliers that is seen, their rms size [degree hour-1], and outliers told by; None where nothing tells.

    Of a block of n samples of the deviation s with m outliers of the square u s^2 each, a = m u /
    n, the fourth moment over the squared second one is about (3 + 6 a + a^2 n / m) / (1 + a)^2,
    which is solved for a. Only the larger ones of a normal law are seen, whose deviation is no less
    than the least that is: below, the number of those not seen would be anything.
    """
    from scipy.stats import norm

    count, excess, samples = (
        blocks[name].sel(axis=axis).values.astype(np.float64)
        for name in ("peaks", "kurtosis", "samples")
    )
    good = (count > 0.0) & np.isfinite(excess) & (excess > 0.0)
    alone = good & (count == 1.0)  # of several in a block the sizes differ
    good = alone if alone.any() else good
    if not good.any():
        return None
    many = count[good]
    most = (
        samples[good] / (many * (1.0 - many / samples[good])) - 3.0
    )  # without noise, the mean of the block taken off
    tails = np.minimum(excess[good] + 3.0, (1.0 - 1e-4) * most)
    half, far = tails - 3.0, most - tails
    share = (half + np.sqrt(half**2 + far * half)) / far
    variance = blocks["variance"].sel(axis=axis).values
    calm = (count == 0.0) & (
        variance > 0.0
    )  # most blocks may have spikes: the median of all would not be the noise
    usual = float(
        np.median(variance[calm] if calm.sum() >= _CALM else variance[good] / (1.0 + share))
    )
    share = np.where(
        many > 1.0, np.fmin(share, np.maximum(variance[good] / usual - 1.0, 0.0) + _USUAL), share
    )
    square = float((share * samples[good]).sum() / many.sum())
    limit = _DEPARTURE * outlier_limit(float(samples.sum()))
    ends = np.geomspace(1.0, 1e-4, 400)  # the least size that is seen, over the rms size
    seen_squares = (limit / ends) ** 2 * (1.0 + ends * norm.pdf(ends) / norm.sf(ends))
    size = limit / float(np.interp(square, seen_squares, ends))
    return float(2.0 * norm.sf(limit / size)), size * math.sqrt(usual), float(many.sum())


def _spread(blocks: xr.Dataset, axis: str) -> float:
    """Standard deviation of the samples about the means of their blocks [degree hour-1]."""
    return math.sqrt(float(blocks["variance"].sel(axis=axis).median()))
