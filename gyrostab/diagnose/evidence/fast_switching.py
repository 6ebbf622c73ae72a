"""Evidence of a bias that switches between two levels within blocks.

If the bias switches several times per block, block means show no levels, but means over sub-blocks
(sixteenths of a block) may. These are less well calibrated, because the noise spectrum between both
lengths was not calibrated with means. The noise therefore has a free white level here, and two
levels must also beat normal noise of any spectrum, which includes Gauss-Markov noise of the same
second-order statistics, and lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.evidence.products import WIDTHS, marginalise, mean_products, scale_columns
from gyrostab.diagnose.evidence.telegraph import (
    DRIFT_WAVES,
    TelegraphCourses,
    course_evidence,
    drift_waves,
    simulated_courses,
    telegraph_courses,
)
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.periodogram import (
    band_edges,
    band_powers,
    gap_spectra,
    ordinates,
    taper,
)
from gyrostab.physics.phase import lorentz_density

_AR_ORDERS = (0, 1, 2, 4, 8, 16, 32)  # of the autoregression that approximates any spectrum
_MAX_MEANS = 12_000  # in the search of a course; sub-blocks are merged beyond; limits time
_PARTS_PER_SUB_BLOCK = 64  # each on one level; design choice
_SURROGATE_RECORDS = 16  # limits time
_MIN_SAMPLE_SHARE = 0.5  # of a mean that must be present; design choice
_MIN_WHITE_RATIO = 1e-4  # lowest white variance / expected one; design choice
_NORMAL_SQUARE_MEDIAN = 0.455  # median of the square of a standard normal variable
_WHITE_LEVEL_STEP = 1.15  # factor between tried white levels; design choice
_MAX_PERIODS_PER_SUB_BLOCK = 0.4  # of a wave that sub-blocks resolve; just below Nyquist
_BLOCKS_AT_ONCE = 500  # limits memory
# Quantiles of the means that start the levels; excursions may be rare.
_START_QUANTILES = (
    (0.05, 0.95),
    (0.25, 0.75),
    (0.25, 0.99),
    (0.01, 0.75),
    (0.5, 0.999),
    (0.001, 0.5),
)


@dataclass(frozen=True)
class SwitchingEvidence:
    """Evidence of a bias that switches between two levels within blocks."""

    #: Lower bound of the log Bayes factor against noise; -inf with fewer than `min_switches`
    #: switches, or if normal noise of any spectrum comes within `two_level_nats`.
    evidence_nats: float
    share: Floats  # (block, sub_block): share of each sub-block on the upper level
    times: Floats  # (2,): mean times on the lower and on the upper level [s]
    switch_count: float  # expected number
    #: Two levels beat white noise with a random walk, but the sub-blocks do not have two levels.
    refuted: bool = False


class _SubBlockMeans(NamedTuple):
    """Means over sub-blocks of an axis, in their order."""

    values: Floats  # (mean,): 0 where missing [degree hour-1]
    variance: Floats  # (mean,): expected white variance, 1 where missing
    present: Bools  # (mean,)
    given: Floats  # (mean, column): columns of effects in the model
    step: float  # length [s]
    merged: int  # sub-blocks in each
    block_count: int


def switching_evidence(
    data: xr.Dataset,
    baseline: xr.Dataset,
    *,
    axis: str,
    given: Floats | None = None,
    settings: Settings = DEFAULTS,
) -> SwitchingEvidence | None:
    """Compute the evidence of two levels in means over sub-blocks; None with too few of them.

    The given columns (block, sub_block, column) of effects are in the model in both cases.
    """
    if "record" in data.dims:
        return None
    means = _sub_block_means(data, baseline, axis, given)
    measured = means.values[means.present]
    if measured.size < 10.0 * settings.min_switches or np.ptp(measured) == 0.0:
        return None
    axis_baseline = baseline.sel(axis=axis)
    first, second = (
        _fit_two_levels(means, drift_waves(means.present.size, count), axis_baseline, settings)
        for count in DRIFT_WAVES
    )
    best = second if second.evidence_nats > first.evidence_nats else first
    return replace(best, refuted=first.refuted and second.refuted)


def _fit_two_levels(
    means: _SubBlockMeans, drift: Floats, baseline: xr.Dataset, settings: Settings
) -> SwitchingEvidence:
    """Compute the evidence of two levels with the columns of a drift (mean, column) in the model.

    Half of the prior probability is that of another drift.
    """
    courses = telegraph_courses(
        means.values[:, None],
        means.variance,
        means.present,
        np.concatenate([drift, means.given], axis=1),
        starts=_START_QUANTILES,
        min_scatter=_MIN_WHITE_RATIO,
        parts=_PARTS_PER_SUB_BLOCK,
    )
    evidence_nats, beyond_normal_nats = _course_evidence(courses, means, baseline)
    evidence_nats -= np.log(2.0)
    levels_found = courses.switch_count[0] >= settings.min_switches and evidence_nats > 0.0
    similar = levels_found and _is_like_two_levels(courses, means, settings)
    is_switching = similar and beyond_normal_nats > settings.two_level_nats
    refuted = (
        levels_found
        and evidence_nats > settings.refuting_nats
        and (not similar or beyond_normal_nats < -settings.refuting_nats)
    )
    share = courses.share[0].reshape(means.block_count, -1)
    return SwitchingEvidence(
        evidence_nats if is_switching else -np.inf,
        np.repeat(share, means.merged, axis=1),
        courses.times[0] * means.step,
        float(courses.switch_count[0]),
        bool(refuted),
    )


def _is_like_two_levels(
    courses: TelegraphCourses, means: _SubBlockMeans, settings: Settings
) -> bool:
    """Return whether the bias is between its levels as rarely as a switching bias.

    Fast enough switches also fit more levels, or a wave, but then many neighbouring sub-blocks have
    equal shares.
    """
    log, share = simulated_courses(
        courses,
        means.variance,
        means.present,
        parts=_PARTS_PER_SUB_BLOCK,
        count=_SURROGATE_RECORDS,
        rng=np.random.default_rng(0),
    )
    similar = _count_equal_neighbours(share, settings.active_share)
    return bool(
        courses.log[0]
        > log.mean()
        - settings.excess_sigma * log.std()
        - settings.misfit_nats * float(courses.switch_count[0])
        and _count_equal_neighbours(courses.share, settings.active_share)[0]
        < similar.mean() + settings.excess_sigma * max(float(similar.std()), 1.0)
    )


def _count_equal_neighbours(share: Floats, min_share: float) -> Floats:
    """Count neighbouring sub-blocks (record,) with equal shares, between the levels."""
    between = (share > min_share) & (share < 1.0 - min_share)
    is_equal = np.abs(np.diff(share, axis=1)) < min_share
    return np.asarray((between[:, 1:] & between[:, :-1] & is_equal).sum(axis=1))


def _sub_block_means(
    data: xr.Dataset, baseline: xr.Dataset, axis: str, given: Floats | None
) -> _SubBlockMeans:
    """Return means over sub-blocks, several of which are merged in long records."""
    axis_data, axis_baseline = data.sel(axis=axis), baseline.sel(axis=axis)
    samples = axis_data["sub_block_samples"].values.astype(np.float64)
    block_count = len(samples)
    merged = 1
    while samples.size // merged > _MAX_MEANS and merged < samples.shape[1]:
        merged *= 2
    sums = np.where(samples > 0, np.nan_to_num(axis_data["sub_block_mean"].values) * samples, 0.0)
    count, total = (part.reshape(block_count, -1, merged).sum(axis=2) for part in (samples, sums))
    enough = (count >= _MIN_SAMPLE_SHARE * max(np.median(count), 1.0)) & np.isfinite(
        axis_data["mean"].values
    )[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        values = total / count - axis_baseline["known_mean"].values[:, None]
        variance = (axis_baseline["mean_variance"].values * axis_data["samples"].values)[
            :, None
        ] / count
    present = (enough & np.isfinite(values) & np.isfinite(variance)).ravel()
    if given is not None:
        parts = np.nan_to_num(given).reshape(block_count, -1, merged, given.shape[2])
        given = parts.mean(axis=2).reshape(-1, given.shape[2])
    return _SubBlockMeans(
        np.where(present, values.ravel(), 0.0),
        np.where(present, variance.ravel(), 1.0),
        present,
        scale_columns(given, present.size),
        float(data.attrs["block_s"]) / count.shape[1],
        merged,
        block_count,
    )


def _course_evidence(
    courses: TelegraphCourses, means: _SubBlockMeans, baseline: xr.Dataset
) -> tuple[float, float]:
    """Return evidence over white noise with a walk, and over noise of any spectrum [nats]."""
    K, B, prior = _slow_noise_grid(baseline)
    columns = np.concatenate([courses.share.T, means.given], axis=1)
    values, present = means.values[:, None], means.present
    logs = []
    scales = _white_levels(courses, means)
    for scale in scales:
        variance = means.variance * scale
        plain = mean_products(
            values, columns, variance=variance, step=means.step, K=K, B=B, present=present
        )
        wide = np.diag(np.maximum(np.diagonal(plain.gram[0])[1:], 1e-300)) / WIDTHS[-1] ** 2
        scatter = float(courses.spread[0] @ np.where(present, 1.0 / variance, 0.0))
        usual = courses.share[0][present]
        unit = float(((usual - usual.mean()) ** 2 / variance[present]).sum())
        marginal = marginalise(plain, means.given.shape[1], wide)
        logs.append(course_evidence(marginal, 0, scatter, prior, unit=unit))
    none, two = (np.logaddexp.reduce(logs, axis=0) - np.log(scales.size)).tolist()
    two -= float(courses.cost[0])
    return two - none, two - _normal_log_likelihood(means)


def _normal_log_likelihood(means: _SubBlockMeans) -> float:
    """Return the log likelihood of normal noise of any spectrum, in units of `course_evidence`.

    The spectrum is autoregressive; each coefficient costs half the logarithm of the number of data
    (Schwarz, 1978, doi:10.1214/aos/1176344136).
    """
    values, present = means.values, means.present
    columns_given = np.concatenate([np.ones((present.size, 1)), means.given], axis=1)
    size, *_ = np.linalg.lstsq(columns_given[present], values[present], rcond=None)
    y = np.where(present, values - columns_given @ size, 0.0)
    n = int(present.sum())
    constant = 0.5 * np.log(np.median(means.variance[present]) / n)  # evidence of a free constant
    best = -np.inf
    for order in (order for order in _AR_ORDERS if order < n / 10):
        lags = np.empty((y.size, order))
        for lag in range(1, order + 1):
            lags[:, lag - 1] = np.roll(y, lag)
        usable = present & np.all([np.roll(present, lag) for lag in range(order + 1)], axis=0)
        usable[:order] = False
        used, unpredicted = int(usable.sum()), present & ~usable
        if used < n / 2:
            continue
        factor, *_ = np.linalg.lstsq(lags[usable], y[usable], rcond=None)
        log = -0.5 * used * (1.0 + np.log(np.mean((y[usable] - lags[usable] @ factor) ** 2)))
        if unpredicted.any():
            log -= 0.5 * unpredicted.sum() * (1.0 + np.log(np.mean(y[unpredicted] ** 2)))
        best = max(best, float(log) - 0.5 * order * np.log(n))
    return float(best + constant)


def _slow_noise_grid(baseline: xr.Dataset) -> tuple[Floats, Floats, Floats]:
    """Return the grid's random walks without flicker, the least flicker without walk, and weights.

    Their probabilities are those before calibration, because the calibrated noise may be mostly
    switching.
    """
    K, B, free = (baseline[f"grid_{name}"].values for name in ("K", "B", "prior"))
    min_flicker = np.min(B, where=B > 0.0, initial=np.inf)
    chosen = (B == 0.0) | ((K == 0.0) & (min_flicker == B))
    return K[chosen], B[chosen], free[chosen] - np.logaddexp.reduce(free[chosen])


def _white_levels(courses: TelegraphCourses, means: _SubBlockMeans) -> Floats:
    """Return relative white levels to try; some from differences of neighbours."""
    pair_present = means.present[1:] & means.present[:-1]
    pair_variance = (means.variance[1:] + means.variance[:-1])[pair_present]
    steps = np.array([1.0 / _WHITE_LEVEL_STEP, 1.0, _WHITE_LEVEL_STEP])
    ratios = [1.0, 2.0, 4.0]
    for residual in (means.values, means.values - courses.step[0] * courses.share[0]):
        square = np.diff(residual)[pair_present] ** 2 / pair_variance
        ratios += [
            float(np.mean(square)),
            *(float(np.median(square)) / _NORMAL_SQUARE_MEDIAN * steps),
        ]
    return np.unique(np.maximum(ratios, 1e-12))


def switching_powers(share: Floats, low: float, high: float, size: int, rate: float) -> Floats:
    """Compute the band powers within blocks of a bias of two levels, for a step of one.

    Frequencies that sub-blocks resolve have the power of the course; higher ones that of switches
    at random times, as many as in each block. The share is that of each sub-block (block,
    sub_block) on the upper level; `low` and `high` are the mean times on both levels [s]. The
    result is the two-sided density (block, band) [Hz-1].

    Examples
    --------
    >>> share = np.repeat([[0.0, 1.0], [1.0, 1.0]], 8, axis=1)
    >>> switching_powers(share, 20.0, 20.0, 200, 10.0).round(2)[:, 0] > 1.0
    array([ True, False])
    """
    weights, edges = taper(size), band_edges(size)
    expected, _, _ = gap_spectra(np.ones((1, size), bool), weights)
    out = np.empty((len(share), edges.size - 1))
    for first in range(0, len(share), _BLOCKS_AT_ONCE):
        wave = _course_by_sample(share, slice(first, first + _BLOCKS_AT_ONCE), size)
        wave -= wave.mean(axis=1, keepdims=True)
        spectra = np.fft.rfft(wave * weights, axis=1)[:, 1 : ordinates(size) + 1]
        place = np.zeros(len(spectra), np.int64)
        out[first : first + len(spectra)] = band_powers(
            spectra, spectra, expected, place, edges, rate
        ).real
    frequency = (edges[:-1] + edges[1:] - 1) / 2.0 * rate / size
    moves = np.abs(np.diff(share.ravel(), prepend=share[0, 0])).reshape(share.shape).sum(axis=1)
    memory = low * high / (low + high)
    usual = low * high / (low + high) ** 2 * lorentz_density(frequency, memory, rate)
    beyond = moves[:, None] / max(float(moves.mean()), 1e-300) * usual
    return np.where(
        frequency < _MAX_PERIODS_PER_SUB_BLOCK * rate * share.shape[1] / size, out, beyond
    )


def _course_by_sample(share: Floats, chosen_blocks: slice, size: int) -> Floats:
    """Return the course of some blocks by sample; it meets the levels at both sub-block ends."""
    pieces = share.shape[1]
    flat = np.clip(share.ravel(), 0.0, 1.0)
    ends = np.concatenate([flat[:1], (flat[1:] + flat[:-1]) / 2.0, flat[-1:]]) > 0.5
    starts_upper, ends_upper = (
        result.reshape(share.shape)[chosen_blocks] for result in (ends[:-1], ends[1:])
    )
    upper_share = flat.reshape(share.shape)[chosen_blocks]
    outer = starts_upper & ends_upper
    long = np.where(outer, 1.0 - upper_share, upper_share)
    begin = np.where(
        starts_upper == ends_upper, 0.5 - long / 2.0, np.where(starts_upper, 0.0, 1.0 - long)
    )
    place = np.arange(size + 1) / size * pieces
    which = np.minimum(place[:-1].astype(np.int64), pieces - 1)
    low, high = place[:-1] - which, place[1:] - which
    start, stop = begin[:, which], (begin + long)[:, which]
    inside = np.maximum(np.minimum(high, stop) - np.maximum(low, start), 0.0) / (high - low)
    return np.asarray(np.where(outer[:, which], 1.0 - inside, inside))
