"""Regression of correlated series on lagged drivers, over a family of noise laws.

The series are means over overlapping windows, averaged into blocks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array
from scipy.special import stdtr, stdtrit

from gyrostab.arrays import Floats, Ints

#: Correlation times of the slow part [share of the record], and its spectral density against the
#: white part's at one cycle per record.
_TIMES = (0.03, 0.1, 0.3, 1.0, 10.0)
_RATIOS = (1.0, 4.0, 16.0, 64.0, 1e3, 1e4, 1e6)
# Prior weights: the correlation time times a power of the ratio for each slow law, so that a short
# memory or a weak slow part must show itself in the data, and this for white noise alone. Chosen
# for p-values below 5 % in 5 to 8 % of records with a weak random walk, which is the hardest case:
# docs/temperature.md.
_RATIO_POWER = 0.5
_WHITE_PRIOR = 50.0
_TAIL = 60  # smallest of the simulated p-values, from which the law of still smaller ones is taken
_STEEPEST = 1.5  # power of the share against the p-value in the tail, at most


class Laws(NamedTuple):
    """Noise laws of some blocks with nuisance columns: covariance factors and whitening."""

    factor: Floats  # (law, n, n)
    whiten: Floats  # (law, n, n)
    log_det: Floats
    prior: Floats
    freedom: int


class LagFit(NamedTuple):
    """Slopes by (noise law, series, lag), with the log weights of the laws."""

    slope: Floats
    stderr: Floats
    log_weight: Floats
    log_without: Floats  # (law, series)
    freedom: int


def noise_laws(mean: Any, time: Floats, length: float, share: Floats) -> Laws:
    """Make the noise laws of blocks of windows, with their prior weights.

    White noise alone, and white noise with a slow part: an Ornstein-Uhlenbeck process, which is a
    random walk when its correlation time is longer than the record. Mixtures of several look like
    flicker noise.

    Parameters
    ----------
    mean : sparse (n, n_windows)
        Result of `average_windows`.
    time, length, share : float64 (n_windows,), float, float64 (n_windows,)
        Centres [s], length [s], and share of samples present: see `white_covariance`.

    Returns
    -------
    Laws
        Without nuisance columns (see `project_out`).
    """
    record = float(np.ptp(mean @ time)) or 1.0
    white = white_covariance(mean, time, length, share)
    density = float(np.mean(np.diag(white))) / white.shape[0]
    family, prior = [white], [_WHITE_PRIOR]
    for memory in _TIMES:
        slow = slow_covariance(mean, time, length, memory * record)
        slow *= density * (1.0 + (2.0 * np.pi * memory) ** 2) / (2.0 * memory)
        family += [white + ratio * slow for ratio in _RATIOS]
        prior += [memory * ratio**_RATIO_POWER for ratio in _RATIOS]
    return decompose(family, np.log(prior))


def decompose(family: list[Floats], prior: Floats) -> Laws:
    """Factor covariances (n, n), each with the logarithm of its prior weight."""
    factor, n = np.linalg.cholesky(np.array(family)), family[0].shape[0]
    whiten = np.array(
        [
            solve_triangular(triangle, np.eye(n), lower=True, check_finite=False)
            for triangle in factor
        ]
    )
    log_det = 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return Laws(factor, whiten, log_det, np.asarray(prior), n - 1)


def project_out(laws: Laws, nuisance: Floats) -> Laws:
    """Add nuisance columns (n, p) to the noise laws; whitened series are orthogonal to them."""
    q, r = np.linalg.qr(laws.whiten @ nuisance)
    free = laws.whiten - q @ (np.swapaxes(q, 1, 2) @ laws.whiten)
    log_h = 2.0 * np.log(np.abs(np.diagonal(r, axis1=1, axis2=2))).sum(axis=1)
    freedom = nuisance.shape[0] - nuisance.shape[1] - 1
    return Laws(laws.factor, free, laws.log_det + log_h, laws.prior, freedom)


def fit_lags(laws: Laws, series: Floats, driver: Floats) -> LagFit:
    """Fit the slope of every series on the driver at every lag, under every noise law.

    Parameters
    ----------
    series, driver : float64 (n, n_series), (n, n_lags)
        Columns.

    Returns
    -------
    LagFit
        By (law, series, lag); ``log_weight`` is the restricted log likelihood with the slope in the
        model, ``log_without`` that without it.
    """
    n = series.shape[0]
    flat = laws.whiten.reshape(-1, n)  # one large product is faster than one for each law
    y = (flat @ series).reshape(-1, n, series.shape[1])
    x = (flat @ driver).reshape(-1, n, driver.shape[1])
    xx = np.maximum((x * x).sum(axis=1), 1e-30)[:, None, :]
    yy = (y * y).sum(axis=1)[:, :, None]
    xy = np.swapaxes(y, 1, 2) @ x
    residual = np.maximum(yy - xy**2 / xx, 1e-12 * yy + 1e-30)
    const = (laws.prior - 0.5 * laws.log_det)[:, None, None]
    weight = const - 0.5 * (np.log(xx) + laws.freedom * np.log(residual / n))
    without = const[:, :, 0] - 0.5 * (laws.freedom + 1) * np.log(yy[:, :, 0] / n + 1e-30)
    return LagFit(xy / xx, np.sqrt(residual / laws.freedom / xx), weight, without, laws.freedom)


def weights(fit: LagFit) -> Floats:
    """Compute the weights of the laws, (law, series, lag), with a sum of one."""
    raw = np.exp(fit.log_weight - fit.log_weight.max(axis=0))
    return np.asarray(raw / raw.sum(axis=0))


def null_weights(fit: LagFit, series: int) -> Floats:
    """Compute the weights of the laws if nothing follows the driver."""
    raw = np.exp(fit.log_without[:, series] - fit.log_without[:, series].max())
    return np.asarray(raw / raw.sum())


def mixture(fit: LagFit) -> tuple[Floats, Floats]:
    """Average the slope by (series, lag) over the noise laws: mean and standard deviation."""
    weight = weights(fit)
    mean = (weight * fit.slope).sum(axis=0)
    return mean, np.sqrt((weight * (fit.stderr**2 + (fit.slope - mean) ** 2)).sum(axis=0))


def p_values(fit: LagFit) -> Floats:
    """Compute two-sided p-values of the slopes from Student's law: see `calibrated`."""
    mean, spread = mixture(fit)
    return np.asarray(2.0 * stdtr(fit.freedom, -np.abs(mean / spread)))


def simulate_p_values(
    laws: Laws, driver: Floats, weight: Floats, draws: int = 300, seed: int = 20
) -> Floats:
    """Simulate p-values by (draw, lag) of noise without coupling, under the weighted laws.

    Parameters
    ----------
    driver : float64 (n, n_lags)
        Columns.
    weight : float64 (n_laws,)
        Weights of the laws in the draws.
    draws, seed : int
        Number of draws, and seed.

    Returns
    -------
    float64 (draws, n_lags)
        P-values, as from `p_values`.
    """
    normal = np.random.default_rng(seed).normal(size=(driver.shape[0], draws))
    law = np.searchsorted(
        np.cumsum(weight), (np.arange(draws) + 0.5) / draws * weight.sum() * (1.0 - 1e-12)
    )
    made = np.concatenate(
        [laws.factor[number] @ normal[:, law == number] for number in np.unique(law)], axis=1
    )
    # single precision takes half the time, and is enough for a share
    short = laws._replace(
        whiten=laws.whiten.astype(np.float32), log_det=laws.log_det.astype(np.float32)
    )
    short = short._replace(prior=laws.prior.astype(np.float32))
    return p_values(fit_lags(short, made.astype(np.float32), driver.astype(np.float32)))


def calibrated(p: float, chance: Floats) -> float:
    """Find the share of simulated noise with at most this p-value; small ones by a power law."""
    p = max(p, 1e-300)
    values, shares, edge, power = _describe_chance(chance)
    if p < edge[0]:
        return float(edge[1] * (p / edge[0]) ** power)
    return float(np.interp(p, values, shares))


def uncalibrated(share: float, chance: Floats) -> float:
    """Find the p-value below which this share of simulated noise lies: inverse of `calibrated`."""
    values, shares, edge, power = _describe_chance(chance)
    if share < edge[1]:
        return float(edge[0] * (share / edge[1]) ** (1.0 / power))
    return float(np.interp(share, shares, values))


def _describe_chance(chance: Floats) -> tuple[Floats, Floats, tuple[float, float], float]:
    """Sort simulated p-values, with the share up to each, and fit the law of still smaller ones.

    The lower tail has the start and share that are returned, and Hill's exponent.
    """
    sample = np.sort(chance)
    count = min(_TAIL, sample.size // 2)
    edge = float(np.maximum(sample[count - 1], 1e-300))
    spread = float(np.mean(np.log(edge / np.maximum(sample[:count], 1e-300))))
    values = np.append(sample, 1.0)
    shares = np.append((np.arange(sample.size) + 1.0) / sample.size, 1.0)
    return values, shares, (edge, count / sample.size), min(1.0 / max(spread, 1e-9), _STEEPEST)


def slope_interval(
    fit: LagFit, series: int, lag: int, share: float
) -> tuple[float, float, float, float]:
    """Find slope, standard error and interval: slopes whose `p_values` are at least `share`."""
    mean, spread = (float(part[series, lag]) for part in mixture(fit))
    reach = float(stdtrit(fit.freedom, 1.0 - 0.5 * share)) * spread
    return mean, spread, mean - reach, mean + reach


def average_windows(block: Ints) -> Any:
    """Make the sparse matrix (n_blocks, n) that averages windows into blocks 0, 1, ..."""
    sizes = np.bincount(block)
    return csr_array((1.0 / sizes[block], (block, np.arange(block.size))))


def white_covariance(mean: Any, time: Floats, length: float, share: Floats) -> Floats:
    """Compute the covariance of the blocks in white noise of unit variance in a full window.

    Parameters
    ----------
    mean : sparse (n_blocks, n)
        Result of `average_windows`.
    time, length : float64 (n,), float
        Centres and length of the windows [s]; two windows share noise as far as they overlap.
    share : float64 (n,)
        Share of samples present in each window; its variance is inversely proportional.

    Returns
    -------
    float64 (n_blocks, n_blocks)
    """
    rows, columns = _find_overlaps(time, length)
    overlap = 1.0 - (time[columns] - time[rows]) / length
    return _average_pairs(mean, rows, columns, overlap / np.sqrt(share[rows] * share[columns]))


def slow_covariance(mean: Any, time: Floats, length: float, memory: float) -> Floats:
    r"""Compute the covariance of the blocks in an Ornstein-Uhlenbeck process of unit variance.

    With the autocovariance :math:`e^{-|d|/T}`, the means over two windows of length L with centres
    a distance d apart have the covariance

    .. math:: (2T/L)^2 \sinh^2(L/2T)\, e^{-d/T} - 2 (T/L)^2 (\sinh x - x),\quad x = \max(L-d, 0)/T,

    the second difference, over L, of the double integral of the autocovariance. The first part is a
    product of one factor for each window, so that its sums over blocks take time in proportion to
    the number of windows; the second is zero unless the windows overlap. A mean over windows with
    missing samples is taken as one over whole windows.

    Parameters
    ----------
    mean : sparse (n_blocks, n)
        Result of `average_windows`; the windows of a block are consecutive.
    time, length : float64 (n,), float
        Centres, in order, and length of the windows [s].
    memory : float
        Correlation time T [s].

    Returns
    -------
    float64 (n_blocks, n_blocks)
    """
    centre = np.asarray(mean @ time)
    block = np.repeat(np.arange(centre.size), np.diff(mean.indptr))
    grown = np.exp((time - centre[block]) / memory)
    ahead, behind = np.asarray(mean @ grown), np.asarray(mean @ (1.0 / grown))
    upper = np.triu(np.exp(-np.abs(np.subtract.outer(centre, centre)) / memory), 1)
    upper *= np.outer(ahead, behind)
    running_sum = np.cumsum(grown) - np.append(0.0, np.cumsum(grown))[mean.indptr[:-1]][block]
    size = np.diff(mean.indptr)
    within = (2.0 * np.asarray(mean @ (running_sum / grown)) - 1.0) / size
    distant = (2.0 * memory / length * np.sinh(0.5 * length / memory)) ** 2
    rows, columns = _find_overlaps(time, length)
    x = (length - (time[columns] - time[rows])) / memory
    shared = 2.0 * (memory / length) ** 2 * (np.sinh(x) - x)
    blocks = upper + upper.T + np.diag(within)
    return np.asarray(distant * blocks - _average_pairs(mean, rows, columns, shared))


def _find_overlaps(time: Floats, length: float) -> tuple[Ints, Ints]:
    """List the pairs of overlapping windows, the earlier first, each window with itself too."""
    first = np.arange(time.size)
    count = np.searchsorted(time, time + length, side="left") - first
    rows = np.repeat(first, count)
    return rows, rows + np.arange(rows.size) - np.repeat(np.cumsum(count) - count, count)


def _average_pairs(mean: Any, rows: Ints, columns: Ints, values: Floats) -> Floats:
    """Average a symmetric matrix, given by its upper triangle, over pairs of blocks."""
    n = mean.shape[1]
    halved = np.where(rows == columns, 0.5 * values, values)
    half = (mean @ csr_array((halved, (rows, columns)), shape=(n, n)) @ mean.T).toarray()
    return np.asarray(half + half.T)
