"""Estimate the sizes of lines and anomalous samples from line spectra and sample counts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import brentq
from scipy.special import gammaincinv, ndtr, ndtri

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.predict.average_sizes import Size
from gyrostab.diagnose.reduce.outliers import outlier_limit
from gyrostab.diagnose.reduce.schema import axis_values, weighted_mean
from gyrostab.diagnose.settings import INTERVAL_TAILS, Settings
from gyrostab.noise import NORMAL_95
from gyrostab.units import HOUR

#: Standard deviation of the difference of white noise and the median of its eight neighbours, in
#: standard deviations of the noise.
MEDIAN_DEPARTURE_SIGMA = 1.08
VARIANCE_TOLERANCE_SHARE = 0.2  # by which chance may raise the variance of a single block
_MIN_LIMITED = 2  # samples at an end of the range that is a limit
_ROUNDS = 30  # of a fixed-point iteration; a width is within 2e-7 of that of 300
MIN_CLEAN_BLOCKS = 5  # without an outlier, that determine the noise level


def estimate_from_counts(
    effect: str,
    mark: str,
    axis: str,
    blocks: xr.Dataset,
    count_evidence: CountEvidence,
    settings: Settings,
) -> dict[str, Size]:
    """Estimate the parameters of an effect on the sample distribution."""
    on_axis = blocks.sel(axis=axis)
    samples = max(float(on_axis["samples"].sum()), 1.0)
    rate = float(blocks.attrs["sampling_rate_hz"])
    hours = samples / rate / HOUR
    if mark == "lattice":
        return {"step": (float(on_axis["quantization_step"]), 0.0)}
    row = [str(name) for name in blocks["axis"].values].index(axis)
    usual = float(count_evidence.of[mark][0][row].sum()) if mark in count_evidence.of else 0.0
    if effect == "spikes":
        count = max(float(on_axis["outlier_count"].where(on_axis[mark] > 0).sum()), 1.0)
        return _size_spikes(count, hours, _estimate_outliers(blocks, axis), settings)
    if effect == "held_samples":
        if not float(on_axis["quantization_step"]) > 0.0:
            usual = 0.0  # without a quantization grid chance repeats no sample
        count = max(float(on_axis[mark].sum()) - usual, 1.0)
        runs = _held_runs(blocks, axis, mark, usual)
        # of a geometric law, whose standard deviation is its mean
        length = max(count / runs, 1.0) / rate
        low, high = _poisson_interval(runs)
        return {
            "per_hour": (runs / hours, math.sqrt(runs) / hours, low / hours, high / hours),
            "length": (
                length,
                length / math.sqrt(runs),
                max(length * runs / high, 1.0 / rate),
                length * runs / low,
            ),
        }
    if effect == "clipping":
        # standard deviation of the samples about their block means [degree hour-1]
        spread = math.sqrt(float(on_axis["variance"].median()))
        return {"limit": _size_range(on_axis, spread, samples)}
    if effect == "dead_zone" and has_empty_zone(blocks, axis):
        width, error = (float(on_axis[name]) for name in ("zone_width", "zone_width_stderr"))
        # the least of many samples beyond the zone is that far from its edge, by an exponential law
        return {"width": (width, error, width + error * math.log(INTERVAL_TAILS[0]), width)}
    if effect == "dead_zone":
        samples_of, means, variances = (
            axis_values(blocks, name, axis).astype(np.float64)
            for name in ("samples", "mean", "variance")
        )
        good = np.isfinite(means) & (samples_of > 0.0)
        centre = float(np.nan_to_num(on_axis["zone_centre"]))
        variance = float(weighted_mean(variances, samples_of)[0])
        law = samples_of[good], means[good] - centre, variance
        count = max(float(on_axis[mark].sum()) - usual, 1.0)
        low, high = (end - usual for end in _poisson_interval(count + usual))
        width, narrow, wide = (_zone_width(number / samples, *law) for number in (count, low, high))
        return {"width": (width, (wide - narrow) / (2.0 * NORMAL_95), narrow, wide)}
    return {}


def _zone_width(stuck: float, samples: Floats, away: Floats, variance: float) -> float:
    """Return the half-width of a zone at which this share of the samples sticks.

    Outside the zone, the rate is reduced by its width. `samples` are those of each block, `away`
    the block means from the centre of the zone, and `variance` that of the samples about them. The
    samples of a block are normal without the zone; `away` and `variance` give their laws.

    Examples
    --------
    >>> true_rate = np.linspace(-2.0, 2.0, 50)[:, None]
    >>> rate = true_rate + np.random.default_rng(1).standard_normal((50, 9000))
    >>> rate -= np.clip(rate, -0.5, 0.5)
    >>> means, count = rate.mean(axis=1), np.full(50, 9000)
    >>> round(_zone_width((rate == 0.0).mean(), count, means, rate.var(axis=1).mean()), 2)
    0.5
    """
    weight = samples / samples.sum()

    def fit_noise(edge: float) -> tuple[float, float]:
        """Return the scatter of the noise and the share that sticks, for a width of `edge`."""
        rate = np.linspace(-edge - 6.0, edge + 6.0, 2001)  # [in the scatter], as `edge`
        above, below = rate - edge, -rate - edge
        share = ndtr(edge - rate) - ndtr(-edge - rate)
        mean = above * ndtr(above) + _normal_density(above)
        mean -= below * ndtr(below) + _normal_density(below)
        square = (1.0 + above**2) * ndtr(above) + above * _normal_density(above)
        square += (1.0 + below**2) * ndtr(below) + below * _normal_density(below)
        scatter = math.sqrt(variance)
        for _ in range(_ROUNDS):
            place = np.interp(away / scatter, mean, rate)
            left = float(weight @ np.interp(place, rate, square - mean**2))
            scatter = math.sqrt(variance / max(left, 1e-12))
        return scatter, float(weight @ np.interp(place, rate, share))

    narrow, wide = 1e-9, 6.0  # all samples stick in a zone of 6 standard deviations
    if stuck >= fit_noise(wide)[1]:
        edge = wide
    else:
        edge = float(brentq(lambda edge: fit_noise(edge)[1] - max(stuck, 0.0), narrow, wide))
    return edge * fit_noise(edge)[0]


def has_empty_zone(blocks: xr.Dataset, axis: str) -> bool:
    """Return whether an axis shows no rates next to those at which it sticks near zero."""
    return bool(np.isfinite(blocks["zone_width"].sel(axis=axis)))


def centre_of_range(blocks: xr.Dataset) -> float:
    """Return the middle of the range of an axis, or the end that one sample alone reaches.

    Noise reached such an end: the limit at the other one is that far from it.
    """
    ends, counts = blocks["range_end"].values, blocks["range_end_samples"].values
    return float(ends[counts.argmin()] if counts.min() < _MIN_LIMITED else ends.mean())


def _size_range(blocks: xr.Dataset, spread: float, samples: float) -> tuple[float, ...]:
    """Return the distance of a limit from the centre of the range, exact with both limits.

    With one, the other may be just beyond the end of the record, by an exponential law as for the
    largest of so many samples.
    """
    lowest, highest = blocks["range_end"].values.tolist()
    half = 0.5 * (highest - lowest)
    centre = centre_of_range(blocks)
    limit = max(highest - centre, centre - lowest)
    if limit == half:
        return limit, 0.0, limit, limit
    beyond = spread / -float(ndtri(1.0 / (samples + 1.0)))
    high = limit - beyond * math.log(INTERVAL_TAILS[0])
    return limit, (high - half) / (2.0 * NORMAL_95), half, high


def _size_spikes(
    count: float, hours: float, outliers: tuple[float, float, float] | None, settings: Settings
) -> dict[str, Size]:
    """Return how often outliers occur, and their size, with intervals of positive quantities.

    The number is the count of outliers divided by the share of a normal law that is seen. Their
    true law is unknown: the logarithm of that share has an error of half its size, so that the
    interval begins where all outliers are seen.
    """
    low, high = _poisson_interval(count)
    relative = 1.0 / math.sqrt(count)
    if outliers is None:  # no block was steady enough to have a kurtosis
        return {"per_hour": (count / hours, relative * count / hours, low / hours, high / hours)}
    seen_share, size, many = outliers
    law = max(settings.outlier_law_error, -0.5 * math.log(seen_share))
    often, doubt = count / seen_share / hours, math.hypot(1.0 / math.sqrt(2.0 * many), law)
    return {
        "per_hour": (
            often,
            often * math.hypot(relative, law),
            often * math.exp(-math.hypot(math.log(count / low), NORMAL_95 * law)),
            often * math.exp(math.hypot(math.log(high / count), NORMAL_95 * law)),
        ),
        "size": (
            size,
            size * doubt,
            size * math.exp(-NORMAL_95 * doubt),
            size * math.exp(NORMAL_95 * doubt),
        ),
    }


def _normal_density(x: Any) -> Any:
    return np.exp(-(x**2) / 2.0) / math.sqrt(2.0 * math.pi)


def _poisson_interval(count: float) -> tuple[float, float]:
    """Return the exact 95 % interval of the mean of a Poisson law (Garwood, 1936)."""
    lower_tail, upper_tail = INTERVAL_TAILS
    return float(gammaincinv(count, lower_tail)), float(gammaincinv(count + 1.0, upper_tail))


def are_simultaneous(
    axes: tuple[str, str], mark: str, blocks: xr.Dataset, count_evidence: CountEvidence
) -> bool:
    """Return whether two axes hold samples at the same instants.

    At the same instants, the numbers of held samples agree in every block, except for those by
    chance. At independent instants, their difference has the variance of both together. If losses
    become frequent on both axes at the same time, this changes the variance over the blocks, but
    not that of the difference: it is then that of as many losses at random instants. The limit is
    half of the smaller one.
    """
    rows = [[str(name) for name in blocks["axis"].values].index(axis) for axis in axes]
    samples, counts = (blocks[name].values[rows].astype(np.float64) for name in ("samples", mark))
    usual = count_evidence.of[mark][0][rows] if mark in count_evidence.of else np.zeros_like(counts)
    is_common = (samples > 0.0).all(axis=0)
    if not is_common.any():
        return False
    held, chance = (counts - usual)[:, is_common], usual - usual**2 / np.maximum(samples, 1.0)
    by_chance = chance[:, is_common].sum(axis=1)
    count = np.maximum(held.sum(axis=1), 1.0)
    runs = [_held_runs(blocks, axis, mark, float(usual[n].sum())) for n, axis in enumerate(axes)]
    separate = np.minimum(is_common.sum() * held.var(axis=1) - by_chance, count**2 / runs).sum()
    difference = is_common.sum() * np.var(held[0] - held[1]) - by_chance.sum()
    return bool(difference < 0.5 * separate)


def _held_runs(blocks: xr.Dataset, axis: str, mark: str, usual: float) -> float:
    """Return how often samples were held: runs of repeats, less those of the quantization grid."""
    totals = {
        name: float(blocks[name].sel(axis=axis).sum())
        for name in ("adjacent", "repeats", "repeat_runs", "zeros", "zero_runs", "filled")
    }
    if mark == "filled":
        return max(totals["zero_runs"] * totals["filled"] / max(totals["zeros"], 1.0), 1.0)
    return max(totals["repeat_runs"] - usual * (1.0 - usual / max(totals["adjacent"], 1.0)), 1.0)


def _estimate_outliers(blocks: xr.Dataset, axis: str) -> tuple[float, float, float] | None:
    """Return the share of outliers seen, their rms size [degree hour-1], and their number.

    For a block of n samples of standard deviation s with m outliers of mean square u s^2, and a = m
    u / n, the fourth moment divided by the squared second one is about (3 + 6 a + a^2 n / m) / (1 +
    a)^2, which is solved for a. Only the larger outliers of a normal law are seen, and the standard
    deviation of the law is taken to be at least the smallest one seen: below that, the number of
    those not seen is undetermined.
    """
    count, excess, samples = (
        axis_values(blocks, name, axis).astype(np.float64)
        for name in ("outlier_count", "kurtosis", "samples")
    )
    good = (count > 0.0) & np.isfinite(excess) & (excess > 0.0)
    single = good & (count == 1.0)  # several in a block differ in size
    good = single if single.any() else good
    if not good.any():
        return None
    many = count[good]
    # without noise, after removal of the block mean
    max_excess = samples[good] / (many * (1.0 - many / samples[good])) - 3.0
    tails = np.minimum(excess[good] + 3.0, (1.0 - 1e-4) * max_excess)
    half, margin = tails - 3.0, max_excess - tails
    share = (half + np.sqrt(half**2 + margin * half)) / margin
    variance = axis_values(blocks, "variance", axis)
    # most blocks may have spikes: the median of all is not that of the noise
    clean = (count == 0.0) & (variance > 0.0)
    is_enough = clean.sum() >= MIN_CLEAN_BLOCKS
    usual = float(np.median(variance[clean] if is_enough else variance[good] / (1.0 + share)))
    share = np.where(
        many > 1.0,
        np.fmin(share, np.maximum(variance[good] / usual - 1.0, 0.0) + VARIANCE_TOLERANCE_SHARE),
        share,
    )
    square = float((share * samples[good]).sum() / many.sum())
    limit = MEDIAN_DEPARTURE_SIGMA * outlier_limit(float(samples.sum()))
    ends = np.geomspace(1.0, 1e-4, 400)  # the least size that is seen / the rms size
    seen_squares = (limit / ends) ** 2 * (1.0 + ends * _normal_density(ends) / ndtr(-ends))
    size = limit / float(np.interp(square, seen_squares, ends))
    return float(2.0 * ndtr(-limit / size)), size * math.sqrt(usual), float(many.sum())
