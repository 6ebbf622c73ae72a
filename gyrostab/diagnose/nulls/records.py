"""Null records: block statistics of noise alone, with the recording's gaps, channels and blocks.

Every statistic is drawn from its distribution in Gaussian noise, with coefficients from the
calibration posterior. Hundreds of records therefore take seconds, and include the calibration
error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.stats import trim_mean

from gyrostab.arrays import Complexes, Floats
from gyrostab.diagnose.baseline.expected_statistics import line_columns, sum_noise, white_variance
from gyrostab.diagnose.evidence.sample_counts import kurtosis_moments
from gyrostab.diagnose.evidence.spectral_lines import interpolate_bands
from gyrostab.diagnose.evidence.wandering import expected_processes
from gyrostab.diagnose.nulls.shared_noise import SharedNoise, draw_shared_spectra, find_shared_noise
from gyrostab.diagnose.predict.linear_model import unspread_share
from gyrostab.diagnose.reduce.schema import pair_indices
from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.diagnose.statistics.base import NullDraw
from gyrostab.diagnose.statistics.cross_spectrum import draw_coherency
from gyrostab.diagnose.statistics.sample_counts import COARSE_STEP_SIGMA
from gyrostab.kernels.random.stochastic import (
    brownian_means,
    flicker_means,
    flicker_times,
    ornstein_uhlenbeck_means,
)
from gyrostab.kernels.spectra.periodogram import band_covariance, taper
from gyrostab.units import HOUR

#: Null records up to this size stay in memory; larger ones are drawn again on each pass.
MAX_KEPT_NULL_BYTES = 3e8
#: Band powers of the null records that are drawn and scored together; bounds the memory.
MAX_BATCH_POWER_BYTES = 3.2e7
#: Fewer records in a batch would spend the time on the loop around them.
MIN_BATCH_RECORDS = 25
_RECORDS_PER_CHUNK = 25  # limits memory
_KURTOSIS_SAMPLES = 10**6  # simulated sample by sample; limits time
#: Share of the blocks on either side, whose kurtosis may be that of outliers. Design choice: for
#: normal values, such a mean has 0.95 of the efficiency of the plain one.
_TRIMMED = 0.1
_MAX_BANDS_APART = 4  # of bands that the taper correlates
_MIN_BAND_CORRELATION = 0.003  # smaller ones are neglected
_MAX_COMMON_SHARE = 0.9  # of the scatter of a band that may be common with others
# Least power of a band without its lines, over that with them. Design choice.
_MIN_SHARE_WITHOUT_LINES = 0.01


class _NullSetup(NamedTuple):
    """Quantities common to all null records, as arrays (axis, block, ...)."""

    blocks: xr.Dataset
    baseline: xr.Dataset
    #: Shapes of the gamma parts that each band has in common with the first, second, ... above it.
    ties: list[Floats]
    effect_ratio: Floats  # expected power divided by that of the noise alone
    #: (axis, 2): standard deviations of a sample and of a difference of neighbours.
    sample_sd: Floats
    #: (axis, 1): excess kurtosis of a block, minus that of white Gaussian noise.
    kurtosis_shift: Floats
    kurtosis_scatter: Floats  # (axis, 1): its scatter, divided by that of white noise
    shared: SharedNoise | None  # noise common to axes


def null_records(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    *,
    count: int = 400,
    rng: np.random.Generator,
    chunk: int = _RECORDS_PER_CHUNK,
) -> Iterator[xr.Dataset]:
    """Draw block statistics with nothing but the noise (and known effects) of the baseline.

    Random variables have a leading dimension ``record``. The same state of the generator gives the
    same records for the same `chunk`.

    Examples
    --------
    >>> from gyrostab.diagnose.baseline.calibrate import calibrate_noise
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.simulate import simulate
    >>> blocks = reduce_log(simulate({"noise": {"N": 0.003}}, duration="1h", rate=10.0))
    >>> baseline, rng = calibrate_noise(blocks), np.random.default_rng(1)
    >>> nulls = list(null_records(blocks, baseline, count=40, rng=rng))
    >>> [one.sizes["record"] for one in nulls], nulls[0]["power"].dims
    ([25, 15], ('record', 'axis', 'block', 'band'))
    """
    setup = _prepare_nulls(blocks, baseline, rng)
    for first in range(0, count, chunk):
        yield _draw_records(setup, min(chunk, count - first), rng)


def repeatable_null_records(
    blocks: xr.Dataset, baseline: xr.Dataset, count: int, seed: int
) -> Callable[[], Iterable[xr.Dataset]]:
    """Return a function that gives the same null records on each call.

    Small ones are kept in memory; large ones are drawn again.
    """
    power_bytes = blocks["power"].size * 8
    batch = int(np.clip(MAX_BATCH_POWER_BYTES / power_bytes, MIN_BATCH_RECORDS, count))

    def draw() -> Iterable[xr.Dataset]:
        rng = np.random.default_rng(seed)
        return null_records(blocks, baseline, count=count, rng=rng, chunk=batch)

    # with lines and cross-spectra, a null record takes about three times as much as its powers
    is_large = count * power_bytes * 3 > MAX_KEPT_NULL_BYTES
    return draw if is_large else cache(lambda: list(draw()))


def _prepare_nulls(
    blocks: xr.Dataset, baseline: xr.Dataset, rng: np.random.Generator
) -> _NullSetup:
    noise = sum_noise(baseline["columns"].values, baseline["square"].values)
    effect_ratio = baseline["spectrum"].values / noise
    lines = line_columns(blocks)
    rate = float(blocks.attrs["sampling_rate_hz"])
    half_difference = 1.0 - np.cos(2.0 * np.pi * blocks["line_frequency"].values / rate)
    sample_sd = []
    density = lines * baseline["square"].values[:, None]  # (axis, line, term)
    if "line_noise" in baseline:  # a filter leaves no rounding apart
        density = np.stack([np.zeros(density.shape[:2]), baseline["line_noise"].values], axis=-1)
    for total in density.sum(axis=-1):
        variances = total.mean() * rate, 2.0 * ((total * half_difference).mean() * rate)
        sample_sd.append(np.sqrt(variances))
    if "broad_peaks" in baseline:
        density = np.concatenate([density, baseline["broad_peaks"].values[..., None]], axis=-1)
    kurtosis = np.array(
        [
            _kurtosis_excess(blocks, axis_density, recorded[np.isfinite(recorded)], rng)
            for axis_density, recorded in zip(density, blocks["kurtosis"].values, strict=True)
        ]
    )
    ties = _common_shapes(baseline["shape_alone"].values, int(blocks.attrs["block_samples"]))
    shared = find_shared_noise(blocks, baseline)
    return _NullSetup(
        blocks,
        baseline,
        ties,
        effect_ratio,
        np.array(sample_sd),
        kurtosis_shift=kurtosis[:, :1],
        kurtosis_scatter=kurtosis[:, 1:],
        shared=shared,
    )


def _common_shapes(shape: Floats, size: int) -> list[Floats]:
    """Return the shapes (axis, block, band) of the gamma parts common to neighbouring bands.

    The taper causes them. Negligible ones, of high bands and those far above, are left out.
    """
    covariance = band_covariance(size)
    safe = np.where(np.isfinite(shape) & (shape > 0.0), shape, 0.0)
    ties = []
    for apart in range(1, min(_MAX_BANDS_APART, safe.shape[-1] - 1) + 1):
        tie = safe[..., :-apart] * safe[..., apart:] * np.diagonal(covariance, apart)
        correlation = np.sqrt(np.diagonal(covariance, apart) * tie)
        correlated = np.flatnonzero(
            (correlation > _MIN_BAND_CORRELATION).reshape(-1, correlation.shape[-1]).any(axis=0)
        )
        ties.append(tie[..., : correlated.max(initial=-1) + 1])
    total = np.zeros_like(safe)
    for low, high, tie in _pairs_of_bands(total, ties):
        low += tie
        high += tie
    factor = np.divide(
        _MAX_COMMON_SHARE * safe,
        total,
        out=np.ones_like(safe),
        where=total > _MAX_COMMON_SHARE * safe,
    )
    return [tie * np.minimum(low, high) for low, high, tie in _pairs_of_bands(factor, ties)]


def _pairs_of_bands(
    values: Floats, ties: Sequence[Floats]
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield the lower and the upper band of each tie as array slices, with the tie."""
    for apart, tie in enumerate(ties, start=1):
        yield values[..., : tie.shape[-1]], values[..., apart : apart + tie.shape[-1]], tie


def _kurtosis_excess(
    blocks: xr.Dataset, density: Floats, recorded: Floats, rng: np.random.Generator
) -> tuple[float, float]:
    """Simulate the kurtosis of full blocks of noise (line, term); return mean and scatter excess.

    Correlation widens its scatter; a resonance and the rounding of an angle change its mean. Q may
    be the rounding of an angle, which is uniform, or other noise of the angle, which is normal. The
    mean is between both, where most of the `recorded` blocks are.
    """
    size, rate = int(blocks.attrs["block_samples"]), float(blocks.attrs["sampling_rate_hz"])
    shaped = np.zeros(size // 2 + 1)
    shaped[1 : len(density) + 1] = density[:, 1:].sum(axis=1)
    record_count = int(np.clip(_KURTOSIS_SAMPLES // size, 200, 2000))
    normal = rng.standard_normal((record_count, shaped.size, 2)) @ np.array([1.0, 1j])
    values = np.fft.irfft(normal * np.sqrt(shaped * rate * size / 2.0), n=size, axis=1)
    angle_sd, shape = np.sqrt(density[:, 0].mean() * rate / 2.0), (record_count, size + 1)
    rounded, normal_angle = (
        _sample_kurtosis(values + np.diff(angle_sd * angle, axis=1))
        for angle in (np.sqrt(12.0) * rng.random(shape), rng.standard_normal(shape))
    )
    low, high, observed = (
        float(trim_mean(kurtosis, _TRIMMED)) if kurtosis.size else np.nan
        for kurtosis in (rounded, normal_angle, recorded)
    )
    is_between = recorded.size and high > low
    share = np.clip((observed - low) / (high - low), 0.0, 1.0) if is_between else 0.0
    excess = (1.0 - share) * rounded.mean() + share * normal_angle.mean()
    mean, variance, _ = kurtosis_moments(np.array(float(size)))
    return float(excess - mean), float(rounded.std() / np.sqrt(variance))


def _sample_kurtosis(values: Floats) -> Floats:
    """Return the excess kurtosis of each record (record, sample)."""
    values = values - values.mean(axis=1, keepdims=True)
    return np.asarray((values**4).mean(axis=1) / (values**2).mean(axis=1) ** 2 - 3.0)


def _draw_records(setup: _NullSetup, count: int, rng: np.random.Generator) -> xr.Dataset:
    """Draw `count` null records together; the record is the first dimension."""
    blocks, baseline = setup.blocks, setup.baseline
    axes, draws = blocks.sizes["axis"], baseline.sizes["draw"]
    chosen = rng.integers(0, draws, (count, axes))
    squares, slow = (
        baseline[name].values[np.arange(axes), chosen] for name in ("posterior", "posterior_slow")
    )
    expected = _expect_power(setup, squares, rng)
    power, cross_power, coherency = _draw_powers(setup, expected, rng)
    variables: dict[str, Any] = {
        "mean": (("axis", "block"), _draw_means(setup, squares, slow, rng)),
        "power": (("axis", "block", "band"), power),
        "line_power": (("axis", "part", "line"), _draw_lines(setup, squares, rng)),
        "kurtosis": (("axis", "block"), _draw_kurtosis(setup, count, rng)),
        "cross": (
            ("pair", "block", "band"),
            _draw_cross(setup, cross_power, coherency, rng),
        ),
    }
    draw = NullDraw(blocks, baseline, count, rng, expected, power, setup.sample_sd)
    variables |= {
        name: (tuple(map(str, blocks[name].dims)), values)
        for statistic in STATISTICS
        for name, values in statistic.null(draw).items()
    }
    for name, (_, values) in variables.items():
        if values.dtype.kind in "fc":
            values[..., np.isnan(blocks[name].values)] = np.nan
    return blocks.assign(
        {
            name: (("record", *dims), values, blocks[name].attrs)
            for name, (dims, values) in variables.items()
        }
    )


def _expect_power(setup: _NullSetup, squares: Floats, rng: np.random.Generator) -> Floats:
    """Return the expected powers (record, axis, block, band) of noise with these squares."""
    baseline = setup.baseline
    noise = np.einsum("abfn,ran->rabf", baseline["columns"].values, squares)
    expected: Floats = noise * setup.effect_ratio
    if "form_shape" in baseline:  # the form of the spectrum was measured on a simulated log
        form = baseline["form_shape"].values
        expected *= _draw_gamma(form, np.ones((len(squares), *form.shape)), rng)[:, :, None]
    return expected


def _draw_powers(
    setup: _NullSetup, expected: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats, Complexes | None]:
    """Draw band powers; also return the powers and the coherency that cross-spectra have.

    The coherency is None where axes share no noise.
    """
    baseline, count = setup.baseline, len(expected)
    coherency: Complexes | None = None
    if setup.shared is None:
        power = _draw_gamma(baseline["shape_alone"].values, expected, rng, setup.ties)
    else:
        power, coherency = draw_shared_spectra(setup.shared, count, rng)
        power *= expected
        if "cross_error" in baseline:
            error = baseline["cross_error"].values
            coherency += (
                error * (rng.standard_normal((count, *error.shape, 2)) @ np.array([1.0, 1j]))
            )[:, :, None]
    common = baseline["common"].values
    common_shape = np.full(common.shape, np.inf)
    np.divide(1.0, common, out=common_shape, where=common > 0.0)
    common_factor = _draw_gamma(common_shape, np.ones(power.shape[:3]), rng)[..., None]
    power *= common_factor
    power[..., np.isnan(setup.blocks["power"].values)] = np.nan
    return power, power if coherency is None else expected * common_factor, coherency


def _draw_gamma(
    shape: Floats, mean: Floats, rng: np.random.Generator, ties: Sequence[Floats] = ()
) -> Floats:
    """Draw gamma variables with these shapes and means; parts in `ties` are common to two bands.

    Shapes of variables of equal scale add up.
    """
    safe = np.where(np.isfinite(shape) & (shape > 0.0), shape, 1.0)
    shape_alone = safe.copy()
    for low, high, tie in _pairs_of_bands(shape_alone, ties):
        low -= tie
        high -= tie
    drawn = rng.standard_gamma(np.broadcast_to(shape_alone, mean.shape))
    for low, high, tie in _pairs_of_bands(drawn, ties):
        common_part = rng.standard_gamma(np.broadcast_to(tie, (len(mean), *tie.shape)))
        low += common_part
        high += common_part
    return np.asarray(np.where(np.isinf(shape), 1.0, drawn / safe) * mean)


def _draw_means(
    setup: _NullSetup, squares: Floats, slow: Floats, rng: np.random.Generator
) -> Floats:
    """Draw block means: white noise, random walk, flicker and the expected random processes."""
    blocks, baseline = setup.blocks, setup.baseline
    n, step = blocks.sizes["block"], float(blocks.attrs["block_s"])
    unit_variance = np.stack(
        [white_variance(blocks, unit[None]) for unit in np.eye(4)[:2]], axis=-1
    )
    usual = np.einsum("abn,an->ab", unit_variance, baseline["square"].values[:, :2])
    drawn = np.einsum("abn,ran->rab", unit_variance, squares[..., :2])
    # An axis may have neither.
    level = np.divide(
        drawn, usual, out=np.ones_like(drawn), where=np.broadcast_to(usual > 0.0, drawn.shape)
    )
    apart = np.isin(blocks["axis"].values, baseline.attrs.get("white_noise_of_means_apart", ()))
    level[:, apart] = 1.0  # the draws are of the noise of the powers
    white = np.sqrt(baseline["mean_variance"].values * level)
    times = flicker_times(1.0 / step, low=1.0 / (2.0 * np.pi * 8.0 * n * step))
    drawn = rng.standard_normal(white.shape)
    if setup.shared is not None:  # with the correlation of the lowest band
        drawn = np.einsum("bij,rjb->rib", setup.shared.white, drawn)
    total = baseline["known_mean"].values + white * drawn
    for place in np.ndindex(*white.shape[:2]):
        B2, K2 = slow[place]
        flicker, _ = flicker_means(
            rng.standard_normal((n, times.size + 1)),
            times,
            1.0 / step,
            rng.standard_normal(times.size),
        )
        processes = expected_processes(baseline, place[1])
        steps = rng.standard_normal((2, n)) * np.sqrt((K2 / HOUR + processes.walk) * step)
        walk, _ = brownian_means(steps[0], steps[1], 0.0)
        total[place] += np.sqrt(B2) * flicker + walk
        for square, memory in zip(processes.square, processes.time, strict=True):
            wander, _ = ornstein_uhlenbeck_means(
                rng.standard_normal((n, 2)), memory / step, float(rng.standard_normal())
            )
            total[place] += np.sqrt(square) * wander
        if processes.angle > 0.0:
            angle = np.sqrt(processes.angle) * rng.standard_normal(n + 1)
            total[place] += np.diff(angle) / step
    return np.asarray(total)


def _draw_lines(setup: _NullSetup, squares: Floats, rng: np.random.Generator) -> Floats:
    """Draw the mean periodograms of the parts of the record."""
    blocks, baseline = setup.blocks, setup.baseline
    weight = blocks["line_weight"].values
    part_count, n = weight.shape[1], blocks.sizes["block"]
    part_of = np.arange(n) * part_count // n
    unspread = unspread_share(blocks)
    frequency, bands = blocks["line_frequency"].values, blocks["frequency"].values
    plain = squares @ line_columns(blocks).T
    flat = plain.mean(axis=-1, keepdims=True)
    out = np.full((*plain.shape[:2], part_count, plain.shape[2]), np.nan)
    for axis, part in np.ndindex(*weight.shape):
        chosen = (part_of == part) & np.isfinite(blocks["neighbours"].values[axis])
        if not (chosen.any() and weight[axis, part] > 0.0):
            continue
        share = unspread[axis, chosen].mean()
        over = setup.effect_ratio[axis, chosen].mean(axis=0)
        if "line_spectrum" in baseline:
            columns = baseline["columns"].values[axis, chosen]
            noise = (columns @ baseline["square"].values[axis]).mean(axis=0)
            without_lines = over - baseline["line_spectrum"].values[axis] / noise
            over = np.maximum(without_lines, _MIN_SHARE_WITHOUT_LINES * over)
        effects = interpolate_bands(over[None], frequency, bands)[0]
        if "line_shape" in baseline:
            effects = effects * baseline["line_shape"].values[axis]
        out[:, axis, part] = (share * plain[:, axis] + (1.0 - share) * flat[:, axis]) * effects
        if "broad_peaks" in baseline:
            out[:, axis, part] += baseline["broad_peaks"].values[axis]
    for record in out:  # one after the other: they may have many lines
        drawn = _draw_gamma(weight[..., None], np.ones(record.shape), rng)
        record *= _correlate_lines(drawn, int(blocks.attrs["block_samples"]))
    return out


def _correlate_lines(drawn: Floats, size: int) -> Floats:
    """Correlate lines (..., line) of mean 1 as the taper does, by the squared taper's spectrum."""
    lines = drawn.shape[-1]
    correlation = np.abs(np.fft.fft(taper(size) ** 2)) ** 2
    lag = np.minimum(np.arange(lines), lines - np.arange(lines))
    transfer = np.sqrt(np.maximum(np.fft.rfft(correlation[lag] / correlation[0]).real, 0.0))
    leaked = 1.0 + np.fft.irfft(np.fft.rfft(drawn - 1.0, axis=-1) * transfer, lines, axis=-1)
    return np.asarray(np.maximum(leaked, drawn.min(axis=-1, keepdims=True)))


def _draw_cross(
    setup: _NullSetup, level: Floats, coherency: Complexes | None, rng: np.random.Generator
) -> Complexes:
    """Return cross-spectra from those relative to both levels; independent ones if None."""
    first, second = pair_indices(setup.blocks)
    size = np.sqrt(level[:, first] * level[:, second])
    if coherency is None:
        coherency = draw_coherency(setup.blocks["cross_shape"].values, size.shape, rng)
    return np.asarray(size * coherency)


def _widen_tails(score: Floats, n: Floats) -> Floats:
    """Add the tails that the kurtosis of n samples has beyond the law of Anscombe and Glynn.

    From half a million simulated blocks each of 100 to 2000 samples: once in a thousand blocks of
    200 samples it is 3.37 standard deviations below the mean, by the law 3.09.
    """
    return np.asarray(
        score
        + 0.1 / np.sqrt(n) * (score**3 - 3.0 * score)
        - np.minimum(3.2 / n, 0.017) * (score**2 - 1.0)
    )


def _draw_kurtosis(setup: _NullSetup, count: int, rng: np.random.Generator) -> Floats:
    """Draw the excess kurtosis of the noise; with few levels, that of other blocks."""
    blocks = setup.blocks
    recorded = blocks["kurtosis"].values
    samples = np.maximum(blocks["samples"].values.astype(np.float64), 20.0)
    mean, variance, a = kurtosis_moments(samples)
    noise = _widen_tails(rng.standard_normal((count, *recorded.shape)), samples)
    root = 1.0 - 2.0 / (9.0 * a) - noise * np.sqrt(2.0 / (9.0 * a))
    score = ((1.0 - 2.0 / a) / np.maximum(root, 0.1) ** 3 - 1.0) / np.sqrt(2.0 / (a - 4.0))
    out = mean + setup.kurtosis_shift + np.sqrt(variance) * setup.kurtosis_scatter * score
    for axis, step in enumerate(blocks["quantization_step"].values):
        good = recorded[axis][np.isfinite(recorded[axis])]
        if step > COARSE_STEP_SIGMA * setup.sample_sd[axis, 0] and good.size:
            out[:, axis] = rng.choice(good, out[:, axis].shape)
    return np.asarray(out)
