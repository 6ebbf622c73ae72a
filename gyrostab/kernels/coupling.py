"""Regression of correlated series on lagged drivers: blocks of overlapping windows, a family of noise laws, generalised least squares."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, solve_triangular
from scipy.sparse import csr_array
from scipy.special import stdtr, stdtrit

__all__ = ["LagFit", "averages", "fit_lags", "noise_family", "p_values", "search_factor", "slope_interval", "weights", "whiten"]

Array = NDArray[np.float64]

#: Correlation times of the slow part [share of the record], and its variance within the record against the white part.
_TIMES = (0.03, 0.1, 0.3, 1.0, 10.0)
_RATIOS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1e3, 1e4)
_WHITE_PRIOR = 0.1  # a slow law counts as much beforehand as its correlation time is long: short memory must show itself in the data


class LagFit(NamedTuple):
    """Slopes by (noise law, series, lag), with what is needed to weigh the laws."""

    slope: Array
    stderr: Array
    log_weight: Array
    freedom: int


def averages(block: NDArray[np.int64], time: Array, length: float, share: Array) -> tuple[Any, Array, Array]:
    """Average windows into blocks, and say how the white noise of the blocks is correlated.

    Parameters
    ----------
    block : int64 (n,)
        Number of the block of each window, from 0 without a hole.
    time, length : float64 (n,), float
        Centres and length of the windows [s]. Two windows share white noise as far as they overlap.
    share : float64 (n,)
        Share of the samples that a window holds; its white variance goes with the inverse.

    Returns
    -------
    mean : sparse (n_blocks, n)
        Matrix that averages.
    centre : float64 (n_blocks,)
        Mean time of the windows of each block [s].
    white : float64 (n_blocks, n_blocks)
        Covariance of the blocks when the noise is white with unit variance in a full window.
    """
    n, count = time.size, int(block[-1]) + 1
    sizes = np.bincount(block, minlength=count)
    mean = csr_array((1.0 / sizes[block], (block, np.arange(n))), shape=(count, n))
    last = np.searchsorted(time, time + length, side="left")
    rows = np.repeat(np.arange(n), last - np.arange(n))
    columns = np.arange(rows.size) - np.repeat(np.cumsum(last - np.arange(n)) - last, last - np.arange(n))
    overlap = (1.0 - (time[columns] - time[rows]) / length) / np.sqrt(share[rows] * share[columns])
    upper = csr_array((overlap, (rows, columns)), shape=(n, n))
    half = (mean @ upper @ mean.T).toarray()
    white = half + half.T - (mean @ csr_array((1.0 / share, (np.arange(n), np.arange(n))), shape=(n, n)) @ mean.T).toarray()
    return mean, np.asarray(mean @ time), white


def noise_family(centre: Array, white: Array) -> tuple[list[Array], Array]:
    """Covariances of the blocks under the noise laws that are weighed, and the logarithm of the weight each has beforehand.

    White noise alone, and white noise with a slow part: an Ornstein-Uhlenbeck process, which is a random walk when its
    correlation time is longer than the record. Mixtures of several look like flicker noise.
    """
    record = float(centre[-1] - centre[0]) or 1.0
    distance = np.abs(centre[:, None] - centre[None, :]) / record
    level = float(np.mean(np.diag(white)))
    family, prior = [white], [_WHITE_PRIOR]
    for length in _TIMES:
        slow = level / min(1.0, length) * np.exp(-distance / length)
        family += [white + ratio * slow for ratio in _RATIOS]
        prior += [length] * len(_RATIOS)
    return family, np.log(prior)


def whiten(covariance: Array, *columns: Array) -> tuple[float, list[Array]]:
    """Log determinant of a covariance, and columns multiplied by the inverse of its Cholesky factor."""
    factor, _ = cho_factor(covariance, lower=True, check_finite=False)
    both = solve_triangular(factor, np.concatenate(columns, axis=1), lower=True, check_finite=False)
    return 2.0 * float(np.log(np.diag(factor)).sum()), np.split(both, np.cumsum([column.shape[1] for column in columns])[:-1], axis=1)


def fit_lags(family: list[Array], prior: Array, nuisance: Array, series: Array, driver: Array) -> tuple[LagFit, list[Array]]:
    """Slope of every series on the driver at every lag, beside the nuisance columns, under every noise law.

    Parameters
    ----------
    family : list of float64 (n, n)
        Covariances.
    prior : float64 (n_laws,)
        Logarithm of the weight of each law beforehand.
    nuisance, series, driver : float64 (n, p), (n, n_series), (n, n_lags)
        Columns.

    Returns
    -------
    LagFit
        By (law, series, lag); ``log_weight`` is the restricted log likelihood with the slope in the model.
    list of float64 (n, n_lags)
        Whitened driver of every law, orthogonal to the nuisance, each of unit length.
    """
    n, freedom = series.shape[0], series.shape[0] - nuisance.shape[1] - 1
    shape = (len(family), series.shape[1], driver.shape[1])
    slope, error, weight, units = np.empty(shape), np.empty(shape), np.empty(shape), []
    for law, covariance in enumerate(family):
        log_det, (h, y, x) = whiten(covariance, nuisance, series, driver)
        q, r = np.linalg.qr(h)
        y, x = y - q @ (q.T @ y), x - q @ (q.T @ x)
        xx = np.maximum((x * x).sum(axis=0), 1e-300)
        xy, yy = y.T @ x, (y * y).sum(axis=0)[:, None]
        rest = np.maximum(yy - xy**2 / xx, 1e-12 * yy + 1e-300)
        slope[law], error[law] = xy / xx, np.sqrt(rest / freedom / xx)
        log_h = 2.0 * np.log(np.abs(np.diag(r))).sum()
        weight[law] = prior[law] - 0.5 * (log_det + log_h + np.log(xx) + freedom * np.log(rest / n))
        units.append(x / np.sqrt(xx))
    return LagFit(slope, error, weight, freedom), units


def weights(fit: LagFit) -> Array:
    """Weight of every law, (law, series, lag), one in sum."""
    raw = np.exp(fit.log_weight - fit.log_weight.max(axis=0))
    return np.asarray(raw / raw.sum(axis=0))


def p_values(fit: LagFit) -> Array:
    """Two-sided p-values of the slopes by (series, lag), averaged over the noise laws by their weights without the driver.

    Weights with the driver would favour, in a search, the laws under which the chosen lag does best.
    """
    t = fit.slope / fit.stderr
    raw = fit.log_weight - 0.5 * fit.freedom * np.log1p(t**2 / fit.freedom)
    weight = np.exp(raw - raw.max(axis=0))
    return np.asarray((weight * 2.0 * stdtr(fit.freedom, -np.abs(t))).sum(axis=0) / weight.sum(axis=0))


def slope_interval(fit: LagFit, series: int, lag: int, level: float) -> tuple[float, float, float, float]:
    """Slope, standard error and interval of one entry under the mixture of the noise laws."""
    weight, slope, error = weights(fit)[:, series, lag], fit.slope[:, series, lag], fit.stderr[:, series, lag]
    mean = float(weight @ slope)
    spread = float(np.sqrt(weight @ (error**2 + (slope - mean) ** 2)))
    tail = 0.5 * (1.0 - level)
    ends = []
    for target in (tail, 1.0 - tail):
        guess = slope + error * stdtrit(fit.freedom, target)
        low, high = float(guess.min()), float(guess.max())
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if weight @ stdtr(fit.freedom, (middle - slope) / error) < target else (low, middle)
        ends.append(0.5 * (low + high))
    return mean, spread, ends[0], ends[1]


def search_factor(unit: Array, noise: Array, freedom: int) -> float:
    """How many independent tests the search over lags is worth, from the largest of the t-values that noise alone gives.

    Parameters
    ----------
    unit : float64 (n, n_lags)
        Whitened driver of unit length.
    noise : float64 (n, n_draws)
        Independent normal numbers.
    freedom : int
        Degrees of freedom of the t-values.

    Returns
    -------
    float
        From 1 (all lags tell the same) to the number of lags.

    Examples
    --------
    >>> draws = np.random.default_rng(1).normal(size=(50, 2000))
    >>> column = np.ones((50, 1)) / 50**0.5
    >>> round(search_factor(np.hstack([column, column]), draws, 48))
    1
    """
    if unit.shape[1] == 1:
        return 1.0
    share = (unit.T @ noise) ** 2 / (noise * noise).sum(axis=0)
    largest = np.sqrt(share / np.maximum(1.0 - share, 1e-12) * freedom).max(axis=0)
    single = 2.0 * stdtr(freedom, -float(np.quantile(largest, 0.95)))
    return float(np.clip(np.log(0.95) / np.log1p(-single), 1.0, unit.shape[1]))
