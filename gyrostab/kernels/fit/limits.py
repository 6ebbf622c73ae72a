"""Bounds of squared coefficients, from their estimates or from single cells."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL

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


@njit(**INNER)
def chi_square_quantile(freedom, quantile):  # type: ignore[no-untyped-def]
    """Interpolate the quantile of chi-square over its degrees of freedom nu, by a cubic.

    `quantile` has the first ln nu, the step of ln nu, and ``nu ln q(nu)``, which is smooth from few
    degrees of freedom to many; nu must not be above the last node but two.
    """
    start, step, curve = quantile
    if not freedom > 0.0:
        return 0.0
    position = (np.log(freedom) - start) / step
    i = min(max(int(position), 1), curve.size - 3)
    t = position - i
    if t < -1.0:  # below the table, where the quantile is below the smallest number
        return 0.0
    before, lower = curve[i - 1], curve[i]
    upper, beyond = curve[i + 1], curve[i + 2]
    value = (
        -t * (t - 1.0) * (t - 2.0) / 6.0 * before + (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0 * lower
    )
    value += -(t + 1.0) * t * (t - 2.0) / 2.0 * upper + (t + 1.0) * t * (t - 1.0) / 6.0 * beyond
    return np.exp(value / freedom)


@njit(**INNER)
def _predict_cell(columns, white, quantization, ramp, squares, per_square):  # type: ignore[no-untyped-def]
    """Compute the Allan variance of one cell under the fitted model, and `per_square`."""
    model = 0.0
    for a in range(5):
        per_square[a] = columns[a] * (
            quantization if a == 0 else white if a == 1 else ramp if a == 4 else 1.0
        )
        if squares[a] > 0.0:
            model += per_square[a] * squares[a]
    return model


@njit(**INNER)
def _cell_quantile(a, full_quantile, own_dof, share, dof, max_freedom, quantile):  # type: ignore[no-untyped-def]
    """Find the quantile of a cell with term `a` alone; `full_quantile` without gaps.

    For a ramp, the degrees of freedom of the cell are used.
    """
    if a == 4:
        return chi_square_quantile(min(own_dof, max_freedom, dof), quantile)
    if share == 1.0:
        return full_quantile
    return chi_square_quantile(min(own_dof, max_freedom), quantile)


@njit(**KERNEL)
def cell_limits(curves, squares, dof, columns, own_dof, ks, span, max_freedom, quantile):  # type: ignore[no-untyped-def]
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
    n_windows, n_tau = avar.shape
    out = np.full((n_windows, 5), np.inf)
    full_quantiles, per_square, lowest = np.empty((n_tau, 5)), np.empty(5), np.empty(5)
    for i in range(n_tau):
        for a in range(5):
            full_quantiles[i, a] = chi_square_quantile(min(own_dof[a, i], max_freedom), quantile)
    for w in range(n_windows):
        lowest[:] = np.inf
        last = n_tau - 1
        while last > 0 and not np.isfinite(avar[w, last]):
            last -= 1
        for i in range(n_tau):
            if not np.isfinite(avar[w, i]):
                continue
            model = _predict_cell(
                columns[i], white[w, i], quantization[w, i], ramp[w, i], squares[w], per_square
            )
            share = factor[w, i]
            for a in range(5):
                if ks[i] * span[a] < ks[last]:
                    continue
                # fewer degrees of freedom have a lower quantile
                best = full_quantiles[i, a] if share <= 1.0 else 1.0
                if model >= lowest[a] * best * per_square[a]:
                    continue
                lowest_share = _cell_quantile(
                    a, full_quantiles[i, a], own_dof[a, i] * share, share, dof[w, i], max_freedom,
                    quantile,
                )  # fmt: skip
                reach = 1.0 / (lowest_share * per_square[a]) if lowest_share > 0.0 else np.inf
                if model * reach < lowest[a]:
                    lowest[a] = model * reach
                    out[w, a] = avar[w, i] * reach
    return out
