"""Generalised non-negative least squares of Allan variances, one small problem per window.

The Allan variance is linear in the squared coefficients, so a window is ``y = X s + e`` with ``s >=
0``. Overlapping estimates at neighbouring averaging factors share data; the covariance of e follows
from the noise itself (`gyrostab.kernels.fit.covariance`), so it is taken from the fit and iterated.
A ramp is removed first, by the trend of the window (`gyrostab.kernels.fit.trend`). Eight windows
are fitted at once (`gyrostab.kernels.fit.lanes`); the fit of a window does not depend on the
others. The result is averaged over submodels, window by window (`gyrostab.kernels.fit.submodels`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.fit.averages import FIT_FIELDS, average_submodels
from gyrostab.kernels.fit.eight_solvers import back_substitute, eliminate, solve_nonnegative_eights
from gyrostab.kernels.fit.freedoms import degrees_of_freedom
from gyrostab.kernels.fit.lanes import PLACES, eights, put, take, where_above
from gyrostab.kernels.fit.mixture import (
    DATA,
    PRODUCTS,
    WIDTH,
    add_gaps,
    combine_products,
    compress_products,
    covariance_rows,
    describe_gaps,
    observe,
    root_squares,
    root_units,
)

#: Sizes as numpy integers: numba compiles `eights` again for each literal.
_ONE, _STOCHASTIC, _TERMS, _MATRIX, _SCRATCH = (np.int64(size) for size in (1, 4, 5, 25, 75))


class _Cells(NamedTuple):
    """What `observe` and `describe_gaps` say of eight windows."""

    system: Floats
    responses: Floats
    inverse: Floats
    avar: Floats
    excess: Floats
    jumps: Floats
    thinned: Floats
    #: Variance of the trend per squared coefficient (rows 0 to 3), and the squared trend (4).
    trend: Floats


class _Fit(NamedTuple):
    """Eight fits: squared coefficients, sets of positive terms, normal equations, and scratch."""

    squares: Floats
    terms: Floats
    normal: Floats
    right: Floats
    scratch: Floats


@njit(**INNER)
def _make_cells(size):  # type: ignore[no-untyped-def]
    return _Cells(
        eights(WIDTH * size), eights(WIDTH * size), eights(size), eights(size), eights(_ONE),
        eights(size), eights(size), eights(_TERMS),
    )  # fmt: skip


@njit(**INNER)
def _make_fit():  # type: ignore[no-untyped-def]
    return _Fit(eights(_TERMS), eights(_TERMS), eights(_MATRIX), eights(_TERMS), eights(_SCRATCH))


@njit(**INNER)
def _fit_diagonal(cells, weight, allowed, fit):  # type: ignore[no-untyped-def]
    """Fit with a diagonal covariance, ``y^2`` divided by the degrees of freedom of white noise.

    No noise falls faster than quantization noise. A cell below that fall from a shorter averaging
    time is low by chance, and must not get the weight that its square implies.
    """
    system, inverse, (squares, terms, normal, right, scratch) = cells.system, cells.inverse, fit
    for row in range(25):
        put(normal, row, 0.0)
    for a in range(5):
        put(right, a, 0.0)
    level = take(inverse, 0) * 0.0
    for i in range(weight.size):
        y, first = take(cells.avar, i), take(system, WIDTH * i)
        fall = where_above(y, 0.0, y / first, 0.0)
        level = where_above(fall, level, fall, level)
        expected = level * first
        w = where_above(y, 0.0, weight[i] / (take(inverse, i) * expected * expected), 0.0)
        _add_equation(system, WIDTH * i, w, normal, right)
    _mirror_triangle(normal)
    solve_nonnegative_eights(normal, right, allowed, terms, squares, scratch)


@njit(**INNER)
def _add_equation(system, at, w, normal, right):  # type: ignore[no-untyped-def]
    """Add a row of columns and data with weight `w` to the upper triangle of normal equations."""
    y = take(system, at + DATA)
    for a in range(5):
        share = w * take(system, at + a)
        put(right, a, take(right, a) + share * y)
        for b in range(a, 5):
            put(normal, 5 * a + b, take(normal, 5 * a + b) + share * take(system, at + b))


@njit(**INNER)
def _mirror_triangle(normal):  # type: ignore[no-untyped-def]
    """Fill in what is below the diagonal of normal equations."""
    for a in range(5):
        for b in range(a):
            put(normal, 5 * a + b, take(normal, 5 * b + a))


@njit(**KERNEL)
def identify_noise(curves, columns, weight, to_samples):  # type: ignore[no-untyped-def]
    """Fit the noise of each window quickly, with a diagonal covariance.

    Parameters
    ----------
    curves : Curves
        Allan variances.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    weight : float64 (n_tau,)
        Degrees of freedom for white noise, the weights of the fit.
    to_samples : float64 (5,)
        Squared coefficient to sample units (rate per sample, interval 1).

    Returns
    -------
    float64 (n_windows, 5)
        Squared coefficients.
    """
    n_windows, n_tau = curves.avar.shape
    out = np.empty((n_windows, 5))
    cells, fit = _make_cells(n_tau), _make_fit()
    trend, valid = np.zeros((n_windows, 6)), np.empty(PLACES, np.int64)
    allowed = np.int64(31 if columns[0, 4] > 0.0 else 15)  # some variances do not see a ramp
    for start in range(0, n_windows, PLACES):
        _observe_eight(start, curves, columns, to_samples, cells, trend, valid)
        _fit_diagonal(cells, weight, allowed, fit)
        for w in range(start, min(start + PLACES, n_windows)):
            for a in range(5):
                out[w, a] = fit.squares[a, w - start]
    return out


@njit(**INNER)
def _observe_eight(start, curves, columns, to_samples, cells, trend, valid):  # type: ignore[no-untyped-def]
    """Describe the windows from number `start` on, and count their valid cells in `valid`."""
    for place in range(PLACES):
        w = min(start + place, curves.avar.shape[0] - 1)
        size = curves.avar.shape[1] if start + place < curves.avar.shape[0] else 0
        for row in range(5):
            cells.trend[row, place] = trend[w, row]
        valid[place] = observe(curves, w, size, trend[w], columns, to_samples, place, cells)


@njit(**INNER)
def _factor_covariance(cells, basis, state, units, roots, augmented, tables):  # type: ignore[no-untyped-def]
    """Eliminate the covariance of the noise `basis` with columns and data; sets `state`."""
    system, inverse = cells.system, cells.inverse
    n = inverse.shape[0]
    width = n + WIDTH
    put(state, 2, 1e-7)  # the sums over lags are good to about this; a strong ramp may need more
    root_squares(basis, cells.responses, units, roots)
    needs_retry = True
    while needs_retry:
        covariance_rows(roots, inverse, tables, augmented, width)
        if _has_positive(cells.excess, np.int64(0)):
            add_gaps(cells, take(basis, 0), augmented, width)
        jitter = take(state, 2)
        for i in range(n):
            at, y = width * i, take(cells.avar, i)
            diagonal = take(augmented, at + i)
            # the second part keeps a window without any noise solvable
            raised = diagonal + jitter * diagonal + 1e-16 * y * y
            put(augmented, at + i, where_above(y, 0.0, raised, 1.0))
            for a in range(WIDTH):
                put(augmented, at + n + a, take(system, WIDTH * i + a))
        eliminate(augmented, n, width, state[3:4])
        needs_retry = False
        for place in range(PLACES):
            if state[3, place] < 0.5 and state[1, place] < 0.5:
                state[2, place] *= 10.0
                if state[2, place] < 1.0:
                    needs_retry = True
                else:
                    state[1, place] = 1.0


@njit(**INNER)
def _normal_equations(augmented, n, normal, right):  # type: ignore[no-untyped-def]
    """Form normal matrix and right-hand side from the eliminated covariance, columns and data."""
    for row in range(25):
        put(normal, row, 0.0)
    for a in range(5):
        put(right, a, 0.0)
    weight = take(augmented, 0) * 0.0 + 1.0
    for i in range(n):
        _add_equation(augmented, (n + WIDTH) * i + n, weight, normal, right)
    _mirror_triangle(normal)


@njit(**INNER)
def _refit_windows(allowed, cells, fit, units, augmented, tables):  # type: ignore[no-untyped-def]
    """Refit until the covariance is that of the fitted noise; converged fits keep their numbers.

    Returns whether a fit still moves (row 0), was hopeless (1); its jitter (2), whether its
    covariance was positive definite (3).
    """
    squares, terms, normal, right, scratch = fit
    trial, tried, basis = eights(_TERMS), eights(_TERMS), eights(_TERMS)
    state, roots = eights(_STOCHASTIC), eights(units.shape[0])
    n = cells.inverse.shape[0]
    put(state, 0, 1.0)
    put(state, 1, 0.0)
    for _ in range(6):
        moves = take(state, 0)
        for a in range(5):
            put(basis, a, where_above(moves, 0.5, take(squares, a), take(basis, a)))
        _find_ramp(cells.trend, basis)
        _factor_covariance(cells, basis, state, units, roots, augmented, tables)
        _normal_equations(augmented, n, normal, right)
        solve_nonnegative_eights(normal, right, allowed, tried, trial, scratch)
        moved = moves * 0.0
        for a in range(4):
            put(squares, a, where_above(moves, 0.5, take(trial, a), take(squares, a)))
            put(terms, a, where_above(moves, 0.5, take(tried, a), take(terms, a)))
            old, step = take(basis, a), take(squares, a) - take(basis, a)
            moved = where_above(where_above(step, 0.0, step, 0.0 - step), 1e-4 * old, moves, moved)
        put(state, 0, where_above(take(state, 1), 0.5, 0.0, moved))
        if not _has_positive(state, np.int64(0)):
            break
    return state


@njit(**INNER)
def _find_ramp(trend, squares):  # type: ignore[no-untyped-def]
    """Write the squared trend less its variance under the other terms to row 4 of `squares`."""
    remainder = take(trend, 4)
    for a in range(4):
        remainder = remainder - take(trend, a) * take(squares, a)
    put(squares, 4, where_above(remainder, 0.0, remainder, 0.0))


@njit(**INNER)
def _has_positive(rows, row):  # type: ignore[no-untyped-def]
    """Whether one of the eight numbers of a row is above zero."""
    is_positive = False
    for place in range(PLACES):
        is_positive = is_positive or rows[row, place] > 0.0
    return is_positive


@njit(**INNER)
def _measure_misfit(squares, augmented, n, chi2):  # type: ignore[no-untyped-def]
    """Compute chi-square from the eliminated covariance, columns and data."""
    total = take(squares, 0) * 0.0
    for i in range(n):
        at = (n + WIDTH) * i + n
        misfit = take(augmented, at + DATA)
        for a in range(4):
            misfit = misfit - take(squares, a) * take(augmented, at + a)
        total = total + misfit * misfit
    put(chi2, 0, total)


@njit(**INNER)
def _reduce_windows(cells, units, augmented, tables, products):  # type: ignore[no-untyped-def]
    """Reduce the cells to four weighted sums, with the `products` of their covariance."""
    n = cells.inverse.shape[0]
    back_substitute(augmented, n, n + WIDTH)
    rows = eights(4 * n)
    for i in range(n):
        for a in range(4):
            put(rows, 4 * i + a, take(augmented, (n + WIDTH) * i + n + a))
    has_excess = _has_positive(cells.excess, np.int64(0))
    compress_products(cells, rows, units, tables, has_excess, products)


@njit(**INNER)
def _take_window(place, fit, cells, products, submodels, start):  # type: ignore[no-untyped-def]
    """Copy the reduced window in one place of the eights."""
    for a in range(4):
        start[a] = fit.squares[a, place]
        submodels.data[a] = fit.right[a, place]
        submodels.trend[a] = cells.trend[a, place]
        for b in range(4):
            submodels.normal[a, b] = fit.normal[5 * a + b, place]
    for table in range(PRODUCTS):
        for entry in range(10):
            submodels.products[table, entry] = products[10 * table + entry, place]


@njit(**KERNEL)
def fit_windows(  # type: ignore[no-untyped-def]
    curves, trend, columns, to_samples, pairs, ramps, diagonal, weight, allowed, low_sigma, room
):
    """Fit every window.

    Parameters
    ----------
    curves : Curves
        Cells [degree2 hour-2], all with the shape (n_windows, n_tau).
    trend : float64 (n_windows, 6)
        Variance of the trend of the window per squared coefficient of Q, N, B and K, and the
        squared trend [degree2 hour-4]; zeros if a ramp is not fitted. Last, 0 where the product of
        ramp and noise is removed from the cells, else 1.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    to_samples : float64 (5,)
        Squared coefficient to sample units.
    pairs : float64 (4, 4, n_tau, n_tau); ramps : float64 (4, n_tau, n_tau)
        `detrend_tables`, or `product_tables` if a ramp is not fitted.
    diagonal : float64 (15, n_tau)
        Result of `combine_diagonal`.
    weight : float64 (n_tau,)
        Degrees of freedom for white noise, the weights of the first pass.
    allowed : int
        Bit set of the terms to fit.
    low_sigma : float
        Standard errors from an estimate to the lower end of its interval.
    room : Submodels
        Result of `make_submodels`, overwritten.

    Returns
    -------
    result : float64 (n_windows, 11, 5)
        Rows as `FIT_FIELDS`, see `average_submodels`.
    misfit : float64 (n_windows, 2)
        Chi-square and degrees of freedom.
    dof : float64 (n_windows, n_tau)
        Equivalent degrees of freedom of the cells under the averaged noise.
    """
    n_windows, n_tau = curves.avar.shape
    size = (n_tau + 3) // 4 * 4
    tables = np.zeros(size * size * PRODUCTS)
    combine_products(pairs, ramps, size, tables)
    result = np.full((n_windows, len(FIT_FIELDS), 5), np.nan)
    misfit = np.full((n_windows, 2), np.nan)
    dof = np.full((n_windows, n_tau), np.nan)
    cells, fit, units = _make_cells(size), _make_fit(), eights(5 * size)
    augmented, products = eights(size * (size + WIDTH)), eights(10 * PRODUCTS)
    chi2, valid, squares = eights(_ONE), np.empty(PLACES, np.int64), np.empty(5)
    start, stochastic = np.empty(4), allowed & 15
    terms = np.ascontiguousarray(columns.T)
    for first in range(0, n_windows, PLACES):
        _observe_eight(first, curves, columns, to_samples, cells, trend, valid)
        describe_gaps(columns, to_samples, diagonal, cells)
        root_units(cells.responses, units)
        _fit_diagonal(cells, weight, stochastic, fit)
        state = _refit_windows(stochastic, cells, fit, units, augmented, tables)
        _measure_misfit(fit.squares, augmented, size, chi2)
        _reduce_windows(cells, units, augmented, tables, products)
        for w in range(first, min(first + PLACES, n_windows)):
            place = w - first
            misfit[w, 1] = 0.0
            if valid[place] == 0 or state[1, place] > 0.5:
                continue
            misfit[w, 0], misfit[w, 1] = chi2[0, place], valid[place]
            for a in range(4):
                misfit[w, 1] -= 1.0 if fit.terms[a, place] > 0.5 else 0.0
            misfit[w, 1] = max(misfit[w, 1], 0.0)  # also with more terms than cells
            _take_window(place, fit, cells, products, room, start)
            average_submodels(allowed, start, cells.trend[4, place], low_sigma, room, result[w])
            for a in range(5):
                squares[a] = result[w, 0, a] if result[w, 0, a] > 0.0 else 0.0
            degrees_of_freedom(squares, curves, w, terms, to_samples, diagonal, dof[w])
    return result, misfit, dof
