"""Bounds of squared coefficients, from their estimates or from single cells."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.fit.mixture import Curves

#: Largest number of Newton steps to a bound, and the change of the score that ends them.
_STEPS, _TOLERANCE = 20, 1e-6


@njit(**INNER)
def _integrate_scatter(square, root, b, c):  # type: ignore[no-untyped-def]
    """Integrate 1 / sigma from zero to `square`, sigma^2 = root^2 + b square + c square^2."""
    if square <= 0.0:
        return square / root
    sigma = math.sqrt(root * root + b * square + c * square * square)
    rate = math.sqrt(c)
    share = 2.0 * (rate * (sigma - root) + c * square) / (2.0 * rate * root + b)
    return math.log1p(share) / rate


@njit(**INNER)
def _bound_square(estimate, a, b, c, score):  # type: ignore[no-untyped-def]
    """Find the square under which the estimate has the given normal score; zero if there is none.

    Newton steps in the integral of 1 / sigma, of which square and sigma are hyperbolic functions.
    """
    root, rate = math.sqrt(a), math.sqrt(c)
    integral = _integrate_scatter(estimate, root, b, c)
    if (estimate / root + 2.0 * integral) / 3.0 <= score:
        return 0.0
    place = max(integral - score, 0.0)
    square = 0.0
    for _ in range(_STEPS):
        half = math.sinh(0.5 * rate * place)
        cosh = math.sqrt(1.0 + half * half)
        square = 2.0 * root * half * cosh / rate + b * half * half / c
        sigma = root * (1.0 + 2.0 * half * half) + b * half * cosh / rate
        away = (estimate - square) / sigma
        value = (away + 2.0 * (integral - place)) / 3.0 - score
        slope = 1.0 + away * (b + 2.0 * c * square) / (6.0 * sigma)
        step = min(max(value / max(slope, 0.5), -place), 3.0)
        place += step
        if abs(step) < _TOLERANCE:
            break
    return square


@njit(**KERNEL)
def estimate_bounds(estimate, null, linear, square, scores):  # type: ignore[no-untyped-def]
    """Find the squared coefficients under which estimates have given normal scores.

    An estimate e is a weighted sum of squares, and scatters with ``sigma(s)^2 = a + b s + c s^2``
    around the truth s. It is therefore skewed, ever more with s. A third of ``(e - s) / sigma(s)``
    and two thirds of the integral of 1 / sigma from s to e is close to a normal variable; for a
    chi-square (a = b = 0) that is the cube root of Wilson and Hilferty to second order.

    Parameters
    ----------
    estimate, null, linear, square : float64 (n,)
        Estimates, and a, b and c. Estimates below ``-sqrt(a)`` are raised to that.
    scores : float64 (n_scores,)
        Normal scores: 1.645 for a 95 % lower limit, -1.645 for an upper limit.

    Returns
    -------
    float64 (n_scores, n)
        Zero if no positive square has the score; NaN without an estimate or its variance.

    References
    ----------
    Wilson and Hilferty, PNAS 17 (1931) 684.
    """
    out = np.full((scores.size, estimate.size), np.nan)
    for i in range(estimate.size):
        e, b, c = estimate[i], max(linear[i], 0.0), max(square[i], 1e-12)
        a = max(null[i], 1e-12 * (b * e + c * e * e))
        if a > 0.0:
            for j in range(scores.size):
                out[j, i] = _bound_square(max(e, -math.sqrt(a)), a, b, c, scores[j])
    return out


def chi_square_quantile(freedom: Floats, quantile: tuple[Floats, Floats]) -> Floats:
    """Interpolate the quantile q of chi-square per degree of freedom nu.

    `quantile` has the nodes ln nu and ``nu ln q(nu)``, which is smooth from few degrees of freedom
    to many; nu must not be above the last. Zero below the table, where q is below the smallest
    number, and without degrees of freedom.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.exp(np.interp(np.log(freedom), *quantile, left=-np.inf) / freedom)


def cell_limits(
    curves: Curves,
    squares: Floats,
    dof: Floats,
    columns: Floats,
    own_dof: Floats,
    ks: Floats,
    span: Floats,
    max_freedom: float,
    quantile: tuple[Floats, Floats],
) -> Floats:
    """Find the upper limit of each squared coefficient from one cell, at least its own part.

    The cell is the one with the lowest limit under the fitted model, so that its scatter does not
    influence the choice.

    Parameters
    ----------
    curves : Curves
        Cells, all with the shape (n_windows, n_tau).
    squares : float64 (n_windows, 5)
        Fitted squared coefficients; NaN counts as zero.
    dof : float64 (n_windows, n_tau)
        Degrees of freedom of the cells under the fitted noise.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    own_dof : float64 (5, n_tau)
        Degrees of freedom of a cell in which a term is alone; infinite for a ramp, which is bounded
        by `dof`.
    ks : float64 (n_tau,)
        Averaging factors, rising.
    span : float64 (5,)
        A cell may bound a term if the longest averaging factor of its window is at most this many
        times its own.
    max_freedom : float
        Degrees of freedom are not taken above this.
    quantile : tuple
        As in `chi_square_quantile`.

    Returns
    -------
    float64 (n_windows, 5)
        Infinite where no cell gives a limit.
    """
    avar, white, quantization, ramp, factor = curves
    ones = np.ones_like(avar)
    per_square = columns * np.stack([quantization, white, ones, ones, ramp], axis=-1)
    model = (per_square * np.fmax(squares, 0.0)[:, None]).sum(axis=-1, keepdims=True)
    freedom = np.minimum(own_dof.T * factor[..., None], max_freedom)
    freedom[..., 4] = np.minimum(freedom[..., 4], dof)
    finite = np.isfinite(avar)
    longest = np.where(finite, ks, 0.0).max(axis=1)
    usable = finite[..., None] & (ks[:, None] * span >= longest[:, None, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = 1.0 / (chi_square_quantile(freedom, quantile) * per_square)
        expected = np.where(usable & np.isfinite(reach), model * reach, np.inf)
        best = expected.argmin(axis=1, keepdims=True)
        limits = np.take_along_axis(avar[..., None] * reach, best, axis=1)
    has_limit = np.isfinite(np.take_along_axis(expected, best, axis=1))
    return np.where(has_limit, limits, np.inf)[:, 0]
