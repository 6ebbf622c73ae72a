"""Band limit of a sensor: the effect of its filters on the Allan variance of white noise.

The angle of white noise behind a filter is a random walk with short memory. For averaging times
longer than the memory of the filter, the variance of its increments is ``N^2 (tau - c)``, and the
Allan variance

    avar(tau) = N^2 / tau (1 - 3 c / (2 tau)),   c = sum |t| r(t) / sum r(t),

where r is the autocorrelation of the filtered noise. This holds for any filter; c is the time
constant of a first-order low-pass, and a third of the length of a moving average. The squared
coefficient N^2 describes the noise without the filter. It follows from the Allan variance as a sum
over increments, ``(4 D(tau) - D(2 tau)) / (2 tau^2)``.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.special import gammaincc

from gyrostab.allan.window_fit import FitTables, run_kernel
from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.fit.averages import FIT_FIELDS

#: Largest number of windows that are averaged. More of them would find departures from the five
#: terms that no window shows.
_MAX_WINDOWS = 24
#: Probability of the misfit of unfiltered noise below which a filter is sought, and of that of
#: filtered noise from which on the averaging times are described.
_NULL_PROBABILITY, _MIN_PROBABILITY = 1e-3, 1e-2
#: Smallest ratio of longest to shortest averaging time: over a decade, the Allan variances of
#: neighbouring terms diverge by a factor of ten.
_MIN_TAU_RATIO = 10.0
#: Shortest averaging time to fit over the first that is described: what remains of the memory there
#: hides in the scatter, but biases N by up to 4 % (docs/statistics.md).
_MEMORY_MARGIN = 1.5
#: Largest ratio of time constant to shortest averaging time: 1/2 for the mean of two samples, the
#: shortest moving average, and less for longer ones.
_MAX_TIME_CONSTANT = 0.6
#: Steps of the search for the time constant; each goes on around the best of these values.
_GRID_POINTS, _GRID_STEPS = 25, 3
#: Distance of the time constants that give the curvature of chi-square, over the shortest averaging
#: time: within one to three standard errors of the time constant in records of 2 to 24 windows.
_CURVATURE_STEP = 0.02
#: A filter removes power at every frequency. Measured over unfiltered Allan variance at the
#: shortest averaging time, at most, and anywhere below the band limit, at most: a spectral line or
#: resets of a feedback loop exceed the latter.
_MAX_SHORTEST_RATIO, _MAX_RATIO = 0.9, 1.05
#: Least share of what a first-order low-pass removes at the shortest averaging time: white noise
#: that changes its level seems to lack a little power at all short averaging times.
_MIN_REMOVED_SHARE = 0.5
#: Largest ratio of a window's Allan variance to the median at any averaging time: one above it has
#: motion.
_MAX_WINDOW_RATIO = 10.0
_N_BIT, _Q_BIT = 2, 1


class BandLimit(NamedTuple):
    """Averaging times that a fit uses, and the filter that it takes into account."""

    tau_min: float  # shortest averaging time to fit [s]
    #: Time constant of the first-order low-pass with the same effect on longer averaging times [s];
    #: 0 without a filter.
    time_constant: float
    white_error: float = 0.0  # relative standard error of N by that of the time constant


def choose_windows(count: int, window: int, step: int) -> Ints:
    """Choose windows that do not overlap, at most 24, spread over the record.

    Examples
    --------
    >>> choose_windows(31, window=100, step=10)
    array([ 0, 10, 20, 30])
    """
    apart = 1 + (count - 1) // -(-window // step)
    number = min(_MAX_WINDOWS, apart)
    return np.unique(np.linspace(0, count - 1, number).round().astype(np.int64))


def filter_response(tau: Floats, time_constant: float | Floats) -> Floats:
    """Compute the share of the Allan variance of white noise that a filter leaves.

    Examples
    --------
    >>> filter_response(np.array([0.1, 1.0]), 0.02)
    array([0.7 , 0.97])
    """
    return np.asarray(1.0 - 1.5 * time_constant / tau)


def low_pass_response(tau: float, time_constant: float) -> float:
    """Compute the share of the Allan variance of white noise that a first-order low-pass leaves.

    At any averaging time; `filter_response` is its limit for long ones.

    Examples
    --------
    >>> round(low_pass_response(10.0, 1.0), 4), round(low_pass_response(0.01, 1.0), 6)
    (0.85, 3.3e-05)
    """
    ratio = tau / time_constant if time_constant > 0.0 else np.inf
    shares = [1.0 - np.exp(-ratio), 1.0 - np.exp(-2.0 * ratio)]
    return float(1.0 - (2.0 * shares[0] - 0.5 * shares[1]) / ratio)


def limit_response(product: xr.Dataset, tau: Floats) -> Floats:
    """Compute the share of the Allan variance of white noise that the filter leaves, of a product.

    Parameters
    ----------
    product : xarray.Dataset
        Product of `gyrostab.fit_noise`, or one of its axes.
    tau : ndarray (n_tau,)
        Averaging times [s].

    Returns
    -------
    ndarray (axis, n_tau) or (n_tau,)
        NaN below the band limit; 1 for a product of an earlier version.
    """
    if "fit_tau_min" not in product:
        return np.ones(tau.shape)
    tau_min, constant = (
        product[name].values[..., None] for name in ("fit_tau_min", "filter_time_constant")
    )
    hidden = (tau < tau_min * (1 - 1e-9)) & (constant > 0)
    return np.where(hidden, np.nan, filter_response(tau, constant))


def find_band_limit(
    tau: Floats,
    cells: Sequence[Floats],
    trend: Floats,
    trend_responses: Floats,
    *,
    allowed: int,
    tables: FitTables,
) -> BandLimit:
    """Find the band limit of an axis from windows that do not overlap.

    Each window is divided by its variance at the shortest averaging time and averaged: a sum of the
    five terms remains one. Where the terms describe this average, there is no limit. Otherwise the
    shortest averaging time is sought from which N (behind a filter), B and K describe it. It is the
    band limit if the Allan variance below lacks power against that without the filter, and nowhere
    exceeds it.

    Parameters
    ----------
    tau : ndarray (n_tau,)
        Averaging times [s].
    cells : sequence of ndarray (n_windows, n_tau)
        Allan variance, NaN where missing, responses of N, Q and R, and gap factor.
    trend : ndarray (n_windows,); trend_responses : ndarray (n_windows, 4)
        Trend of the windows, and the responses of its variance to gaps.
    allowed : int
        Set of the terms to fit; without N there is no limit.
    tables : FitTables
        Tables of the fit.

    Returns
    -------
    BandLimit
        The time constant is rounded to three digits.
    """
    unlimited = BandLimit(float(tau[0]), 0.0)
    mean = _average_windows(tau, cells, trend, trend_responses, tables)
    if mean is None or not allowed & _N_BIT:
        return unlimited
    if not mean.fit(0, np.zeros(1), allowed)[2] < _NULL_PROBABILITY:
        return unlimited
    last = tau[-1] / _MIN_TAU_RATIO
    for shortest in tau[tau * _MEMORY_MARGIN <= last]:
        start = int(np.searchsorted(tau, shortest * _MEMORY_MARGIN * (1 - 1e-9)))
        first = int(np.searchsorted(tau, shortest))
        if not _fit_constant(mean, first, allowed)[2] >= _MIN_PROBABILITY:
            continue
        constant, squares, probability = _fit_constant(mean, start, allowed)
        if probability >= _MIN_PROBABILITY:
            unfiltered = tables.columns[:start, 1:4] @ squares[1:4] * mean.rows[1][:start]
            ratio = mean.rows[0][:start] / unfiltered
            removed = 1.0 - low_pass_response(tau[0], constant)
            lacks_power = ratio[0] < min(_MAX_SHORTEST_RATIO, 1.0 - _MIN_REMOVED_SHARE * removed)
            if not lacks_power or np.nanmax(ratio) > _MAX_RATIO:
                return unlimited
            error = _find_white_error(mean, start, constant, allowed)
            return BandLimit(float(tau[start]), *map(_round_number, (constant, error)))
    return unlimited


def _round_number(value: float) -> float:
    return float(f"{value:.3g}")


class _Mean(NamedTuple):
    """Average of windows: the rows of a window, trend and its responses, number of windows."""

    tau: Floats
    rows: list[Floats]
    trend: float
    responses: Floats
    windows: int
    tables: FitTables

    def fit_each(self, start: int, constants: Floats, terms: int) -> tuple[Floats, Floats, Floats]:
        """Fit from a position on: squares, chi-square and degrees of freedom of each constant."""
        rows = [np.tile(values, (constants.size, 1)) for values in self.rows]
        rows[0][:, :start] = np.nan
        rows[1] *= filter_response(self.tau, constants[:, None])
        responses = np.tile(self.responses, (constants.size, 1))
        trend = np.full(constants.size, self.trend)
        result, misfit, _ = run_kernel(rows, trend, responses, 0.0 * trend, self.tables, terms)
        squares = result[:, FIT_FIELDS.index("square")]
        return squares, misfit[:, 0] * self.windows, misfit[:, 1]

    def fit(self, start: int, constants: Floats, terms: int) -> tuple[int, Floats, float]:
        """Fit from a position on: best constant, squares, probability of its misfit.

        The probability is NaN without degrees of freedom.
        """
        squares, chi2, dof = self.fit_each(start, constants, terms)
        best = int(np.argmin(np.where(np.isfinite(chi2) & (dof > 0), chi2, np.inf)))
        probability = gammaincc(dof[best] / 2.0, chi2[best] / 2.0) if dof[best] > 0 else np.nan
        return best, np.nan_to_num(squares[best]), float(probability)


def _average_windows(
    tau: Floats, cells: Sequence[Floats], trend: Floats, responses: Floats, tables: FitTables
) -> _Mean | None:
    """Average windows without motion, each divided by its variance at the shortest tau."""
    level = cells[0][:, 0]
    used = np.flatnonzero(np.isfinite(level) & (level > 0))
    shape = cells[0][used] / level[used, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # averaging times without any cell
        usual = np.nanmedian(shape, axis=0) if used.size else shape
    still = ~(shape > _MAX_WINDOW_RATIO * usual).any(axis=1)
    used, shape = used[still], shape[still]
    if not used.size:
        return None
    present = np.isfinite(shape)
    count = present.sum(axis=0)
    rows = [
        np.where(present, values, 0.0).sum(axis=0) / np.maximum(count, 1)
        for values in (shape, *(values[used] for values in cells[1:]))
    ]
    rows[0][count == 0] = np.nan
    rows[4] *= count / used.size
    slope = np.sqrt(np.mean(trend[used] ** 2 / level[used]))
    return _Mean(tau, rows, float(slope), responses[used].mean(axis=0), used.size, tables)


def _find_white_error(mean: _Mean, start: int, constant: float, allowed: int) -> float:
    """Compute the relative standard error of N by that of the time constant.

    The variance of the constant is twice the reciprocal of the second derivative of chi-square.
    """
    step = _CURVATURE_STEP * mean.tau[start]
    constants = constant + step * np.array([-1.0, 0.0, 1.0])
    squares, chi2, _ = mean.fit_each(start, constants, allowed & ~_Q_BIT)
    curvature = (chi2[0] - 2.0 * chi2[1] + chi2[2]) / step**2
    slope = np.log(squares[2, 1] / squares[0, 1]) / (2.0 * step)
    return float(0.5 * abs(slope) * np.sqrt(2.0 / curvature)) if curvature > 0 else 0.0


def _fit_constant(mean: _Mean, start: int, allowed: int) -> tuple[float, Floats, float]:
    """Fit the time constant of a filter from a position on, without Q."""
    low, highest = 0.0, _MAX_TIME_CONSTANT * mean.tau[start]
    high = highest
    for _ in range(_GRID_STEPS):
        constants = np.linspace(low, high, _GRID_POINTS)
        best, squares, probability = mean.fit(start, constants, allowed & ~_Q_BIT)
        reach = 2.0 * (constants[1] - constants[0])
        low, high = max(constants[best] - reach, 0.0), min(constants[best] + reach, highest)
    return float(constants[best]), squares, probability
