"""Two baseline detectors: an Allan plot of the whole record, and correlation with channels.

Sub-threshold effects show in neither the Allan plot nor the raw trace.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from scipy import special

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.blindtest.generator import noise as floor
from gyrostab.blindtest.generator.noise import white_level
from gyrostab.blindtest.generator.scenario import AXES, HiddenEffect, Scenario

#: Level of both detectors.
LEVEL = 0.01

#: Name of a detector that draws a random number.
RANDOM = "random number"

#: A longer record is analysed from block means, and its short times from a part.
_LONG_RECORD_SAMPLES = 50_000
_BLOCK_SAMPLES = 32
_PART_SAMPLES = 20_000
_BLOCK_S = 10.0  # length of the blocks that are correlated with channels [s]
#: Separation d' below which an effect is invisible in a trace.
MAX_SEPARATION = 0.1
_NULLS = 50  # records of noise, for the band of the Allan plot


def octaves(size: int) -> list[int]:
    """List the averaging factors 1, 2, 4 ... up to a tenth of a record of `size` samples.

    Examples
    --------
    >>> octaves(100)
    [1, 2, 4, 8]
    """
    largest = max(1, size // 10)
    return [2**k for k in range(largest.bit_length())]


def allan_variance(values: Floats, factors: list[int], *, counts: Ints | None = None) -> Floats:
    """Compute the overlapping Allan variance [(deg/h)2] of rates (time,) with NaN.

    Averaging times are `factors` [samples]. Clusters must be half full; the variance is NaN where
    no pair is. If the values are means, `counts` are their numbers of samples.
    """
    present = np.isfinite(values)
    weight = present.astype(np.int64) if counts is None else counts * present
    full = 1 if counts is None else int(counts.max())
    filled = np.where(present, values - values[present].mean(), 0.0) * weight
    total = np.concatenate([[0.0], np.cumsum(filled)])
    count = np.concatenate([[0], np.cumsum(weight)])
    out = []
    for k in factors:
        number = (count[k:] - count[:-k]).astype(float)
        mean = (total[k:] - total[:-k]) / np.maximum(number, 1)
        good = 2 * number >= k * full
        is_valid = good[k:] & good[:-k]
        step = mean[k:] - mean[:-k]
        out.append(0.5 * float((step[is_valid] ** 2).mean()) if is_valid.any() else math.nan)
    return np.asarray(out)


def _block_means(values: Floats) -> tuple[Floats, Ints]:
    """Average blocks of `_BLOCK_SAMPLES`; return the means and the samples present in each."""
    cut = values[: values.size // _BLOCK_SAMPLES * _BLOCK_SAMPLES].reshape(-1, _BLOCK_SAMPLES)
    counts = np.isfinite(cut).sum(axis=1)
    means = np.where(counts > 0, np.nansum(cut, axis=1) / np.maximum(counts, 1), np.nan)
    return means, counts


def log_allan(values: Floats) -> Floats:
    """Compute the log Allan variance of rates at `octaves`, long times from block means."""
    factors = octaves(values.size)
    if values.size <= _LONG_RECORD_SAMPLES:
        return np.asarray(np.log(allan_variance(values, factors)))
    means, counts = _block_means(values)
    fine = allan_variance(values, [k for k in factors if k <= _BLOCK_SAMPLES])
    coarse = allan_variance(
        means, [k // _BLOCK_SAMPLES for k in factors if k > _BLOCK_SAMPLES], counts=counts
    )
    return np.asarray(np.log(np.concatenate([fine, coarse])))


def _draw_null(
    rng: np.random.Generator, missing: Bools, noise: dict[str, float], rate: float, flicker: str
) -> Floats:
    size = missing.size
    record = floor.white_level(noise["N"]) * math.sqrt(rate) * rng.standard_normal(size) + 7.0
    record += floor.flicker(rng, size, b=noise["B"], rate=rate, method=flicker) + floor.random_walk(
        rng, size, k=noise["K"], rate=rate
    )
    record = floor.quantize_angle(record, q=noise.get("Q", 0.0), rate=rate)
    record[missing] = np.nan
    return record


def _draw_null_curves(
    rng: np.random.Generator,
    missing: Bools,
    noise: dict[str, float],
    rate: float,
    flicker: str,
    nulls: int,
) -> tuple[Floats, Floats]:
    """Draw log Allan variances (null, factor), and the ratio of the record's scatter to theirs.

    For a long record, short times come from nulls of a part, long times from nulls of means.
    """
    factors = octaves(missing.size)
    if missing.size <= _LONG_RECORD_SAMPLES:
        rows = [log_allan(_draw_null(rng, missing, noise, rate, flicker)) for _ in range(nulls)]
        return np.stack(rows), np.ones(len(factors))
    short = [k for k in factors if k <= _BLOCK_SAMPLES]
    middle = (missing.size - _PART_SAMPLES) // 2
    part = (
        missing[middle : middle + _PART_SAMPLES]
        if not missing[middle : middle + _PART_SAMPLES].all()
        else missing[:_PART_SAMPLES]
    )
    _, counts = _block_means(np.where(missing, np.nan, 0.0))
    fewer = np.sqrt(_BLOCK_SAMPLES / np.maximum(counts, 1)) - 1
    rows = []
    for _ in range(nulls):
        fine = np.log(allan_variance(_draw_null(rng, part, noise, rate, flicker), short))
        means = _draw_null(rng, counts == 0, noise | {"Q": 0.0}, rate / _BLOCK_SAMPLES, "spectrum")
        means += (
            floor.white_level(noise["N"])
            * math.sqrt(rate / _BLOCK_SAMPLES)
            * np.sqrt((1 + fewer) ** 2 - 1)
            * rng.standard_normal(counts.size)
        )
        coarse = np.log(
            allan_variance(
                means, [k // _BLOCK_SAMPLES for k in factors if k > _BLOCK_SAMPLES], counts=counts
            )
        )
        rows.append(np.concatenate([fine, coarse]))
    smaller = math.sqrt(float((~part).sum()) / float((~missing).sum()))
    return np.stack(rows), np.where(np.array(factors) <= _BLOCK_SAMPLES, smaller, 1.0)


def allan_band(
    *,
    noise: dict[str, float],
    rate: float,
    missing: Bools,
    rng: np.random.Generator,
    nulls: int = 60,
    flicker: str = "spectrum",
) -> dict[str, Any]:
    """Compute the 99 % band of the log Allan variance of noise alone with missing samples (time,).

    `noise` holds the true N, B, K, Q of the axis, and `flicker` is the method of `floor.flicker`.
    Return ``keep`` (`octaves` with a variance), ``mean`` and ``sd`` of the log variance there, and
    ``limit``, the 99 % quantile of the largest ``abs(z)``.
    """
    logs, scatter_of_whole = _draw_null_curves(rng, missing, noise, rate, flicker, nulls)
    keep = np.isfinite(logs).all(axis=0)
    logs = logs[:, keep]
    mean, sd = logs.mean(axis=0), logs.std(axis=0, ddof=1) * scatter_of_whole[keep]
    tied = np.corrcoef(logs, rowvar=False).reshape(mean.size, mean.size)
    values, vectors = np.linalg.eigh(0.98 * tied + 0.02 * np.eye(mean.size))
    normal = rng.standard_normal((20_000, mean.size)) @ (vectors * np.sqrt(np.maximum(values, 0))).T
    # the moments are estimated from few records
    scatter = np.sqrt(rng.chisquare(nulls - 1, (20_000, 1)) / (nulls - 1))
    spread = math.sqrt(1 + 1 / nulls)
    return {
        "keep": keep,
        "mean": mean,
        "sd": sd,
        "limit": float(np.quantile((np.abs(normal) / scatter).max(axis=1), 1 - LEVEL) * spread),
    }


def band_excess(values: Floats, band: dict[str, Any]) -> float:
    """Compute the largest deviation of the Allan variance from an `allan_band` [sigma]."""
    z = (log_allan(values)[band["keep"]] - band["mean"]) / band["sd"]
    return float(np.nanmax(np.abs(z)))


def allan_detector(
    record: Floats, truth: dict[str, Any], *, rng: np.random.Generator, nulls: int = 60
) -> float:
    """Compute how far the Allan deviation of any axis is outside its band of noise [sigma].

    The record (axis, time) [deg/h] is NaN where lost. Its true noise is known from the truth of the
    case. Above 0, the record differs from noise at 1 %.
    """
    axes = len(truth["noise"])
    beyond = []
    for row, noise in zip(record, truth["noise"].values(), strict=True):
        band = allan_band(
            noise=noise,
            rate=truth["sampling_rate_hz"],
            missing=np.isnan(row),
            rng=rng,
            nulls=nulls,
            flicker=truth["flicker"],
        )
        beyond.append(band_excess(row, band) - _shared_limit(band["limit"], axes))
    return max(beyond)


def _shared_limit(limit: float, axes: int) -> float:
    """Convert the 1 % limit of one axis to that of all `axes`, by the tail of a normal deviate."""
    tail = 2 * float(special.ndtr(-limit)) / axes
    return float(-special.ndtri(tail / 2))


def block_series(log: xr.Dataset, length: int) -> tuple[Floats, Floats, Ints]:
    """Compute block means and block log-variances (axis, block), and the samples present in each.

    An incomplete last block is left out. Blocks that are less than a quarter full count as empty.
    """
    record = np.asarray(log["rate"].values)
    number = record.shape[1] // length
    cut = record[:, : number * length].reshape(record.shape[0], number, length)
    count = np.isfinite(cut).sum(axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(cut, axis=2) / count
        power = np.log(np.nansum((cut - mean[:, :, None]) ** 2, axis=2) / (count - 1))
    return mean, power, np.where(count > max(2, length // 4), count, 0)


def channel_means(log: xr.Dataset, length: int, number: int) -> dict[str, Floats]:
    """Average each channel of a log over `number` blocks of `length` samples of the gyro."""
    out = {}
    for name, variable in log.data_vars.items():
        if variable.dims not in (("time",), (f"time_{name}",)):
            continue
        values = np.asarray(variable.values, dtype=float)
        rate_ratio = values.size / log.sizes["time"]
        edges = np.minimum((np.arange(number) * length * rate_ratio).astype(int), values.size - 1)
        out[str(name)] = np.add.reduceat(values, edges) / np.diff(np.append(edges, values.size))
    return out


def channel_detector(log: xr.Dataset) -> float:
    """Compute how clearly block means or variances correlate with any channel [nats].

    Above 0, the smallest p-value of all pairs is below 1 % over their number. The blocks are
    assumed to be independent.
    """
    length = round(_BLOCK_S * float(log.attrs["sampling_rate_hz"]))
    means, powers, counts = block_series(log, length)
    pairs = [
        _correlation_p(series[present > 0], driver[present > 0])
        for driver in channel_means(log, length, means.shape[1]).values()
        for statistic in (means, powers)
        for series, present in zip(statistic, counts, strict=True)
    ]
    p_values = [p for p in pairs if math.isfinite(p)]
    return math.log(LEVEL / len(p_values) / max(min(p_values), 1e-300)) if p_values else -math.inf


def _correlation_p(x: Floats, y: Floats) -> float:
    good = np.isfinite(x) & np.isfinite(y)
    n = int(good.sum())
    if n < 5 or np.ptp(x[good]) == 0 or np.ptp(y[good]) == 0:
        return math.nan
    r = float(np.corrcoef(x[good], y[good])[0, 1])
    return float(special.erfc(abs(math.atanh(min(abs(r), 1 - 1e-12))) * math.sqrt((n - 3) / 2)))


def trace_visibility(scenario: Scenario, effect: HiddenEffect) -> dict[str, float]:
    """Compute the separation d' of samples and of 1 s means with and without an effect.

    For a mean, d' is its rms over the standard deviation of the noise; for a noise effect, the
    change of the log variance over root 2. Both grow with the root of the samples averaged, and are
    those of the worst axis.
    """
    sample = second = 0.0
    every = max(1, round(scenario.rate))
    for i, noise in enumerate(scenario.noise):
        level = white_level(noise["N"])
        if effect.mean is not None and np.any(effect.mean[i]):
            present = ~scenario.missing
            values = effect.mean[i] - effect.mean[i][present].mean()
            means = values[: values.size // every * every].reshape(-1, every).mean(axis=1)
            sample = max(sample, float(values[present].std()) / (level * math.sqrt(scenario.rate)))
            second = max(second, float(means.std()) / level)
        change = 0.0
        if effect.variance is not None:
            logs = np.log(effect.variance[i])
            change = float((logs - logs.mean()).std())
        if effect.extra is not None:
            power = float((effect.extra[i] ** 2).mean()) / (level**2 * scenario.rate)
            busy = 1.0 if effect.active is None else max(float(effect.active.mean()), 1e-6)
            change = max(change, math.log1p(power / busy))
        sample = max(sample, change / math.sqrt(2))
        second = max(second, change / math.sqrt(2) * math.sqrt(every))
    return {"sample": sample, "second": second}


def find_visibility(
    scenario: Scenario, effects: Sequence[HiddenEffect], record: Floats, *, rng: np.random.Generator
) -> dict[str, Any]:
    """Test whether the effects of a record (axis, time) are sub-threshold.

    Return ``sub_threshold``, ``sample`` and ``second`` (the largest d', see `trace_visibility`),
    and ``allan`` (the largest deviation over its 99 % limit, per axis).
    """
    visible = [trace_visibility(scenario, effect) for effect in effects]
    worst = {key: max((d[key] for d in visible), default=0.0) for key in ("sample", "second")}
    if max(worst.values()) >= MAX_SEPARATION:
        return {"sub_threshold": False, **worst, "allan": {}}
    touched = {axis for effect in effects for axis in effect.axes}
    allan: dict[str, float] = {}
    for axis, row, noise in zip(AXES, record, scenario.noise, strict=True):
        if axis not in touched:
            continue
        band = allan_band(
            noise=noise,
            rate=scenario.rate,
            missing=np.isnan(row),
            rng=rng,
            nulls=_NULLS,
            flicker=scenario.flicker,
        )
        allan[axis] = band_excess(row, band) / band["limit"]
        if allan[axis] >= 1:
            break
    return {
        "sub_threshold": bool(all(value < 1 for value in allan.values())),
        **worst,
        "allan": allan,
    }
