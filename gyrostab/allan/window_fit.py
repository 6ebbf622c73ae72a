"""Fit of windows on plain arrays: estimates, standard errors, limits, and what is observed."""

from __future__ import annotations

from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from scipy.special import gammaincc, gammaincinv

from gyrostab.allan.variance import variance_columns, white_freedoms
from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.kernels.allan.clusters import cluster_strides
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.compile_ahead import await_compilation
from gyrostab.kernels.fit.averages import FIT_FIELDS
from gyrostab.kernels.fit.covariance import STOCHASTIC, product_tables
from gyrostab.kernels.fit.freedoms import combine_diagonal
from gyrostab.kernels.fit.least_squares import fit_windows
from gyrostab.kernels.fit.limits import cell_limits, estimate_bounds
from gyrostab.kernels.fit.mixture import Curves
from gyrostab.kernels.fit.submodels import make_submodels
from gyrostab.kernels.fit.trend import TrendTables, detrend_tables
from gyrostab.noise import NORMAL_95, TERMS, sample_squares
from gyrostab.units import HOUR

#: One-sided normal quantiles: 95 % for limits, 99 % for an observed term; two-sided 99 %, for the
#: sign of a ramp is unknown.
_LIMIT_SIGMA, _OBSERVED_SIGMA, _RAMP_SIGMA = 1.6449, 2.3263, 2.5758
#: Parts of the variance of an estimate, by the power of the square: `estimate_bounds`.
_POWERS = ("null", "linear", "square")
#: Probability of a misfit by chance below which the model does not fit a window.
_MISFIT_PROBABILITY = 1e-3
#: Ratio of the averaging times, from the longest down, that bound the terms (except Q) of a window
#: that the model does not fit.
_LIMIT_SPAN = 10.0
#: Degrees of freedom above which the limit of a cell takes them as infinite.
_MAX_FREEDOM = 1e6
#: Smallest share of the column of a term that the other terms must not reproduce.
_MIN_SEPARATION = 1e-4


def is_described(chi2: Any, dof: Any) -> Any:
    """Test whether the sum of the fitted terms describes a window.

    Parameters
    ----------
    chi2, dof : array_like
        ``fit_chi2`` and ``fit_dof`` of a product [1].

    Returns
    -------
    ndarray of bool
        False where noise that the terms describe would exceed `chi2` in fewer than one window of
        1000; True without degrees of freedom.

    Examples
    --------
    >>> is_described([20.0, 900.0, np.nan], [16.0, 16.0, 0.0])
    array([ True, False,  True])
    """
    chi2 = np.nan_to_num(np.asarray(chi2, np.float64))
    dof = np.nan_to_num(np.asarray(dof, np.float64))
    return ~((dof > 0) & (gammaincc(np.maximum(dof, 1.0) / 2.0, chi2 / 2.0) < _MISFIT_PROBABILITY))


class FitTables:
    """Tables that all windows of a surface share."""

    def __init__(self, ks: Ints, rate: float, window: int, variance: str = "avar"):
        self.columns = variance_columns(variance, ks, rate)
        self.to_samples = sample_squares(rate)
        self.pairs, self.ramps = product_tables(window, ks, variance=variance)
        diagonal = np.einsum("abii->abi", self.pairs)
        ramps = np.einsum("aii->ai", self.ramps)
        self.diagonal = combine_diagonal(diagonal, ramps, cluster_strides(window, ks))
        self._detrend = partial(
            detrend_tables, window, ks, self.pairs, self.ramps, summed=VARIANCES[variance].summed
        )
        self._rate = rate
        self.weight = white_freedoms(variance, window, ks, diagonal)
        term_variance = np.einsum("aaii,a->ai", self.pairs, self.to_samples[:STOCHASTIC] ** 2)
        #: Degrees of freedom of a cell in which a term is alone, (term, tau); a ramp alone does not
        #: scatter.
        self.own_dof = np.vstack(
            [2.0 * self.columns.T[:STOCHASTIC] ** 2 / term_variance, np.full(ks.size, np.inf)]
        )
        self.ks = ks.astype(np.float64)
        self.quantile = quantile_curve(0.05)

    @cached_property
    def trend(self) -> TrendTables:
        """Tables of the variances less their trend, which only a fit of R needs."""
        return self._detrend()

    @property
    def trend_variance(self) -> Floats:
        """Variance of the trend of a window per squared coefficient [degree2 hour-4]."""
        return self.trend.variance * self.to_samples[:STOCHASTIC] * (self._rate * HOUR) ** 2


def quantile_curve(level: float) -> tuple[Floats, Floats]:
    """Tabulate the quantile q at `level` of chi-square per degree of freedom nu.

    Returns ln nu and ``nu ln q`` for `chi_square_quantile`. A step of 0.005 in ln nu leaves a
    relative error of q below 1e-5.
    """
    # from here on the quantile is above zero
    least = 0.01 * np.log(level) / np.log(0.05)
    nodes = np.arange(np.log(least), np.log(2.0 * _MAX_FREEDOM), 0.005)
    freedom = np.exp(nodes)
    return nodes, freedom * np.log(gammaincinv(freedom / 2.0, level) * 2.0 / freedom)


@lru_cache(maxsize=4)
def fit_tables(ks: tuple[int, ...], rate: float, window: int, variance: str = "avar") -> FitTables:
    """Make the tables once for all parts of a record."""
    return FitTables(np.array(ks, dtype=np.int64), rate, window, variance)


def fit_block(
    flat: list[Floats],
    trend: Floats,
    responses: Floats,
    exact: Floats,
    tables: FitTables,
    *,
    white_error: Floats,
    allowed: int,
    observed_only: bool,
) -> Floats:
    """Fit windows: coefficients, errors, limits, observability, chi2, dof and edf as columns.

    `responses` (n_windows, 4) is the variance of the trend under Q, N, B and K, as a share of that
    without gaps. `exact` is 1 where the product of ramp and noise is removed from the cells, else
    0; `white_error` is the relative error of N that a window does not show.
    """
    result, misfit, dof = run_kernel(flat, trend, responses, exact, tables, allowed)
    field = {name: result[:, i] for i, name in enumerate(FIT_FIELDS)}
    for name in ("variance_square", "low_square"):
        field[name][:, TERMS.index("N")] += (2.0 * white_error) ** 2
    fails = _widen_misfits(field, misfit)
    square = field["square"]
    with np.errstate(invalid="ignore", divide="ignore"):
        visible = np.isfinite(square) & (field["separation"] > _MIN_SEPARATION)
        observed = visible & (field["free"] > 0) & _exceed_chance(field) & ~fails[:, None]
        value = np.sqrt(np.where(observed, field["free"], square))
        stderr, limit = _bound_estimates(field, value)
        limit[fails] = _limit_of_curve(
            [cell[fails] for cell in flat], square[fails], dof[fails], tables
        )
        has_limit = visible & np.isfinite(limit) & ~(observed & observed_only)
        upper = np.where(has_limit, np.sqrt(limit), np.nan)
    reported = observed if observed_only else visible
    stderr = np.where(reported, stderr, np.nan)
    value = np.where(reported, value, np.nan)
    observable = np.where(observed, 2.0, np.where(np.isfinite(upper), 1.0, 0.0))
    return np.concatenate([value, stderr, upper, observable, misfit, dof], axis=1)


def run_kernel(
    flat: list[Floats],
    trend: Floats,
    responses: Floats,
    exact: Floats,
    tables: FitTables,
    allowed: int,
) -> tuple[Floats, Floats, Floats]:
    """Run `fit_windows`, less the trend if a ramp is allowed; other terms are NaN."""
    trends = np.zeros((trend.size, STOCHASTIC + 2))
    pairs, ramps = tables.pairs, tables.ramps
    if allowed >> STOCHASTIC & 1:
        pairs, ramps = tables.trend.pairs, tables.trend.ramps
        trends[:, :STOCHASTIC] = tables.trend_variance * responses
        trends[:, STOCHASTIC] = trend**2
        trends[:, STOCHASTIC + 1] = 1.0 - exact
        trends = np.nan_to_num(trends)
    noise = allowed if allowed & 15 else allowed | 1 << TERMS.index("N")  # for a ramp alone
    await_compilation()
    shared = (tables.columns, tables.to_samples, pairs, ramps, tables.diagonal, tables.weight)
    result, misfit, dof = fit_windows(
        Curves(*flat), trends, *shared, noise, NORMAL_95, make_submodels()
    )
    result[..., [not allowed >> a & 1 for a in range(len(TERMS))]] = np.nan
    return result, misfit, dof


def _exceed_chance(field: dict[str, Floats]) -> Bools:
    """Find the terms that noise without them exceeds in 1 % of windows, at most 3 %.

    The likelihood ratio of the best submodels with and without the term must exceed chance, for a
    ramp the trend of the window.
    """
    exceeds = field["likelihood_ratio"] > _OBSERVED_SIGMA**2
    exceeds[:, 4] = np.sqrt(field["free"][:, 4]) > _RAMP_SIGMA * _trend_error(field, _RAMP_SIGMA)
    return np.asarray(exceeds)


def _trend_error(field: dict[str, Floats], sigma: float) -> Floats:
    """Compute the standard error of the trend, of which `sigma` give an interval.

    The variance v of the trend follows from the fitted noise, with a standard error w. To first
    order in ``(w / v)^2``, the quantile of a normal variable of such a variance is that of
    Student's t: ``sigma^2 v (1 + (sigma^2 + 1) / 4 (w / v)^2)``. Where the noise is hardly known,
    the 95 % upper limit ``v + 1.64 w`` is lower, and sufficient.
    """
    variance = field["variance_null"][:, 4]
    spread = np.sqrt(field["variance_linear"][:, 4])
    ratio = np.where(variance > 0, spread / variance, 0.0)
    wider = np.minimum(0.25 * (sigma**2 + 1.0) * ratio**2, _LIMIT_SIGMA * ratio)
    return np.sqrt(variance * (1.0 + wider))


def _widen_misfits(field: dict[str, Floats], misfit: Floats) -> Bools:
    """Find the windows that the model does not fit, and scale their variances by chi2 / dof."""
    chi2, dof = misfit.T
    fails = ~is_described(chi2, dof)
    wider = np.where(fails, chi2 / np.maximum(dof, 1.0), 1.0)[:, None]
    for law in ("variance", "low"):
        for power in _POWERS:
            field[f"{law}_{power}"] *= wider
    return np.asarray(fails)


def _bound_estimates(field: dict[str, Floats], value: Floats) -> tuple[Floats, Floats]:
    """Find standard errors of coefficients, and 95 % upper limits of their squares.

    Interval and limit follow from `estimate_bounds`; the lower end of an interval has another law
    unless that is above the estimate, see `gyrostab.kernels.fit.submodels`. 1.96 standard errors
    are half of the 95 % interval; where it begins at zero, they reach its upper end at least. Those
    of a ramp also reach the upper end, from a value below the trend.
    """
    scores = (NORMAL_95, -NORMAL_95, -_LIMIT_SIGMA)
    low, high, limit = _solve_bounds(field, "free", "variance", *scores)
    (lower_end,) = _solve_bounds(field, "low", "low", NORMAL_95)
    low = np.where(lower_end < field["free"], lower_end, low)
    half = 0.5 * (np.sqrt(high) - np.sqrt(low))
    half = np.where(low > 0, half, np.maximum(half, np.sqrt(high) - value))
    trend = np.sqrt(field["free"][:, 4])
    limit[:, 4] = (trend + _LIMIT_SIGMA * _trend_error(field, _LIMIT_SIGMA)) ** 2
    stderr = half / NORMAL_95
    stderr[:, 4] = _trend_error(field, NORMAL_95) + (trend - value[:, 4]) / NORMAL_95
    return stderr, limit


def _solve_bounds(field: dict[str, Floats], estimate: str, law: str, *scores: float) -> Floats:
    """Run `estimate_bounds` on one of the estimates and its law, for (score, window, term)."""
    parts = [field[name] for name in (estimate, *(f"{law}_{n}" for n in _POWERS))]
    bounds = estimate_bounds(*(np.ravel(part) for part in parts), np.array(scores))
    return np.asarray(bounds.reshape(len(scores), *parts[0].shape))


def _limit_of_curve(flat: list[Floats], square: Floats, dof: Floats, tables: FitTables) -> Floats:
    """Find the 95 % upper limit of a squared coefficient without assuming the five-term model.

    The part of a term cannot exceed the whole curve, because anything else in a cell, noise or not,
    only adds to it. A filter, or an alias that looks like filtered noise, removes power and bends
    the curve at short averaging times; therefore only the cells of the last decade are used.
    Quantization, which dominates at the shortest times, is bounded by all cells. A ramp gets the
    scatter of the noise that scatters most.
    """
    span = np.array([np.inf, *[_LIMIT_SPAN] * (len(TERMS) - 1)])
    own_dof = np.vstack([tables.own_dof[:STOCHASTIC], tables.own_dof[:STOCHASTIC].min(axis=0)])
    shared = (tables.columns, own_dof, tables.ks, span, _MAX_FREEDOM, tables.quantile)
    return np.asarray(cell_limits(Curves(*flat), np.ascontiguousarray(square), dof, *shared))
