"""Detect effects by stepwise regression on channels and change points, in fitted noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.blindtest.scoring.baseline_detectors import block_series, channel_means

_BLOCKS = 300  # in a long record
_LEAST_SAMPLES = 16  # in a block, if none is missing
_MAX_TERMS = 6  # of one series
#: Variance of the steps of the random walk between blocks, over that of the white noise of a block.
#: The noise level of noise alone is constant.
_WALK_RATIOS = (0.0, *np.geomspace(1e-5, 10.0, 13))
_LAGS = (0.02, 0.1)  # time constants of lagged channels and of decays, share of the record


def _make_terms(channels: dict[str, Floats], number: int) -> tuple[Floats, Floats]:
    """Make all terms (block, term): forms of each channel, courses in time, change points.

    The cost of a term is the logarithm of the number of terms of its sort, and that of two sorts.
    """
    time = np.arange(number) / number
    terms = [time, *(np.exp(-time / lag) for lag in _LAGS)]
    for values in channels.values():
        level = np.nan_to_num(values - np.nanmean(values))
        slope = np.gradient(level)
        terms += [level, level**2, slope, np.abs(slope)]
        terms += [_lag_values(level, lag * number) for lag in _LAGS]
    steps = np.tri(number)[:, 1:]  # each is zero before a change point
    costs = np.repeat(np.log([2.0 * len(terms), 2.0 * (number - 1)]), [len(terms), number - 1])
    return np.column_stack([*terms, steps]), costs


def _lag_values(values: Floats, blocks: float) -> Floats:
    from scipy.signal import lfilter

    keep = math.exp(-1.0 / blocks)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values, zi=[keep * values[0]])[0])


def _whiten_differences(columns: Floats, variance: Floats, walk: Floats) -> tuple[Floats, float]:
    """Whiten differences of blocks (block, column) in white noise and random walk.

    `variance` (block) is that of the white noise, `walk` (difference) that of the steps between.
    Returns the whitened differences and half the log determinant of their covariance.
    """
    from scipy.linalg import cholesky_banded, solve_banded

    covariance = np.zeros((2, walk.size))
    covariance[0] = variance[1:] + variance[:-1] + walk
    covariance[1, :-1] = -variance[1:-1]
    factor = cholesky_banded(covariance, lower=True)
    white = solve_banded((1, 0), factor, np.diff(columns, axis=0))
    return white, float(np.log(factor[0]).sum())


def _gain_of_terms(
    series: Floats, counts: Ints, terms: Floats, costs: Floats, walk_ratios: Sequence[float]
) -> float:
    """Compute the largest gain in log likelihood, less the cost, of one to `_MAX_TERMS` terms.

    The noise is white noise and a random walk. Its size, and the ratio of both, are fitted with
    each number of terms. A term costs half the logarithm of the number of blocks, and `costs`.
    """
    good = np.isfinite(series) & (counts > 0)
    at = np.flatnonzero(good)
    if at.size < 4 * _MAX_TERMS or np.ptp(series[good]) == 0.0:
        return -math.inf
    variance = counts.max() / counts[good]
    columns = np.column_stack([series, terms])[good]
    columns = columns / np.maximum(np.ptp(columns, axis=0), 1e-300)
    best = np.full(_MAX_TERMS + 1, -math.inf)
    for ratio in walk_ratios:
        white, half_determinant = _whiten_differences(columns, variance, ratio * np.diff(at))
        best = np.maximum(best, _select_terms(white, costs) - half_determinant)
    term_cost = 0.5 * math.log(at.size)
    return float((best[1:] - best[0] - term_cost * np.arange(1, _MAX_TERMS + 1)).max())


def _select_terms(white: Floats, costs: Floats) -> Floats:
    """Regress the first column on the others step by step; return log likelihood less costs."""
    residual, candidates = white[:, 0].copy(), white[:, 1:].copy()
    half = 0.5 * white.shape[0]
    size = np.einsum("ij,ij->j", candidates, candidates)
    min_size = 1e-6 * size
    value = -half * math.log(max(float(residual @ residual), 1e-300))
    values = [value]
    for _ in range(_MAX_TERMS):
        share = np.zeros(size.size)
        np.divide(
            (residual @ candidates) ** 2,
            size * (residual @ residual),
            out=share,
            where=size > min_size,
        )
        gain = -half * np.log1p(-np.minimum(share, 1.0 - 1e-12)) - costs
        chosen = int(gain.argmax())
        value += float(gain[chosen])
        values.append(value)
        direction = candidates[:, chosen] / math.sqrt(max(float(size[chosen]), 1e-300))
        residual = residual - (residual @ direction) * direction
        candidates -= np.outer(direction, direction @ candidates)
        size = np.einsum("ij,ij->j", candidates, candidates)
    return np.array(values)


def stepwise_detector(log: xr.Dataset) -> float:
    """Compute the evidence of terms in the block means and block log-variances of all axes [nats].

    Forward selection adds channels, their squares, rates and lags, courses in time, and change
    points of the level. The evidence of all series that gain is added; without a gain it is that
    of the series that lacks least.
    """
    samples = log.sizes["time"]
    length = max(_LEAST_SAMPLES, samples // _BLOCKS)
    means, powers, counts = block_series(log, length)
    number = means.shape[1]
    terms, costs = _make_terms(channel_means(log, length, number), number)
    gains = np.array(
        [
            _gain_of_terms(series, present, terms, costs, walk_ratios)
            for statistic, walk_ratios in ((means, _WALK_RATIOS), (powers, (0.0,)))
            for series, present in zip(statistic, counts, strict=True)
        ]
    )
    return float(gains[gains > 0.0].sum() if (gains > 0.0).any() else gains.max())
