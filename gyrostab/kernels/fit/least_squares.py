"""Generalised non-negative least squares of Allan variances, one small problem per window.

The Allan variance is linear in the squared coefficients, so a window is ``y = X s + e`` with ``s >=
0``. Overlapping estimates at neighbouring averaging factors share data; the covariance of e follows
from the noise itself (`gyrostab.kernels.fit.covariance`), so it is taken from the fit and iterated.
Eight windows are fitted at once (`gyrostab.kernels.fit.lanes`); the fit of a window does not
depend on the others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.fit.eight_solvers import (
    back_substitute,
    eliminate,
    scale_equations,
    solve_nonnegative_eights,
    solve_terms,
)
from gyrostab.kernels.fit.lanes import PLACES, eights, put, root, take, where_above
from gyrostab.kernels.fit.mixture import (
    DATA,
    PRODUCTS,
    WIDTH,
    combine_products,
    covariance_rows,
    degrees_of_freedom,
    observe,
    root_squares,
    root_units,
    variance_parts,
)

__all__ = ["FIT_FIELDS", "fit_windows", "identify_noise"]

#: Rows of the per-term result of `fit_windows`.
FIT_FIELDS = (
    "square",
    "square_stderr",
    "free",
    "variance_null",
    "variance_linear",
    "variance_square",
    "separation",
)


class _Cells(NamedTuple):
    """What `observe` says of eight windows."""

    system: NDArray[np.float64]
    seen: NDArray[np.float64]
    inverse: NDArray[np.float64]
    facts: NDArray[np.float64]


class _Fit(NamedTuple):
    """Eight fits: squared coefficients, positive terms, and the squares behind the covariance."""

    squares: NDArray[np.float64]
    terms: NDArray[np.float64]
    basis: NDArray[np.float64]
    #: Whether a fit still moves (row 0), was hopeless (1); its jitter (2), whether its covariance
    #: was positive definite (3).
    state: NDArray[np.float64]


class _Room(NamedTuple):
    """Matrices and scratch of eight fits."""

    units: NDArray[np.float64]
    roots: NDArray[np.float64]
    whole: NDArray[np.float64]
    normal: NDArray[np.float64]
    right: NDArray[np.float64]
    scratch: NDArray[np.float64]
    weights: NDArray[np.float64]


@njit(**INNER)
def _make_cells(size):  # type: ignore[no-untyped-def]
    return _Cells(eights(WIDTH * size), eights(WIDTH * size), eights(size), eights(6))


@njit(**INNER)
def _make_room(size):  # type: ignore[no-untyped-def]
    units, roots, whole = eights(5 * size), eights(5 * size), eights(size * (size + WIDTH))
    return _Room(units, roots, whole, eights(25), eights(5), eights(75), eights(size))


@njit(**INNER)
def _fit_diagonal(cells, weight, allowed, normal, right, fit, scratch):  # type: ignore[no-untyped-def]
    """Fit with a diagonal covariance, ``y^2`` over the degrees of freedom of white noise.

    No noise falls faster than quantization noise. A cell below that fall from a shorter averaging
    time is low by chance, and must not get the weight that its square implies.
    """
    system, inverse, terms = cells.system, cells.inverse, fit.terms
    for row in range(25):
        put(normal, row, 0.0)
    for a in range(5):
        put(right, a, 0.0)
        put(terms, a, 0.0)
    level = take(inverse, 0) * 0.0
    for i in range(weight.size):
        y, first = take(system, WIDTH * i + DATA), take(system, WIDTH * i)
        fall = where_above(y, 0.0, y / first, 0.0)
        level = where_above(fall, level, fall, level)
        expected = level * first
        w = where_above(y, 0.0, weight[i] / (take(inverse, i) * expected * expected), 0.0)
        _add_equation(system, WIDTH * i, w, normal, right)
    _mirror_triangle(normal)
    solve_nonnegative_eights(normal, right, allowed, terms, fit.squares, scratch)


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
def identify_noise(  # type: ignore[no-untyped-def]
    avar, white, quantization, ramp, factor, columns, weight, to_samples, pairs, ramps
):
    """Compute the degrees of freedom of each cell from a quick fit of the noise of the window.

    Parameters
    ----------
    avar, white, quantization, ramp, factor : float64 (n_windows, n_tau)
        Cells and what the gaps do to them.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    weight : float64 (n_tau,)
        Degrees of freedom for white noise, the weights of the quick fit.
    to_samples : float64 (5,)
        Squared coefficient to sample units (rate per sample, interval 1).
    pairs : float64 (4, 4, n_tau); ramps : float64 (4, n_tau)
        `diagonal_products`.

    Returns
    -------
    float64 (n_windows, n_tau)
    """
    n_windows, n_tau = avar.shape
    out = np.full(avar.shape, np.nan)
    diagonal = np.empty((n_tau, PRODUCTS))
    for i in range(n_tau):
        table = 0
        for a in range(4):
            for b in range(a, 5):
                diagonal[i, table] = (
                    ramps[a, i] if b == 4 else pairs[a, b, i] * (1.0 if a == b else 2.0)
                )
                table += 1
    cells, fit = _make_cells(n_tau), _Fit(eights(5), eights(5), eights(5), eights(4))
    normal, right, scratch, squares = eights(25), eights(5), eights(75), np.empty(5)
    for start in range(0, n_windows, PLACES):
        _observe_eight(
            start,
            avar,
            white,
            quantization,
            ramp,
            factor,
            columns,
            to_samples,
            cells,
            np.empty(PLACES, np.int64),
        )
        _fit_diagonal(cells, weight, np.int64(31), normal, right, fit, scratch)
        for w in range(start, min(start + PLACES, n_windows)):
            for a in range(5):
                squares[a] = fit.squares[a, w - start]
            degrees_of_freedom(
                squares,
                avar[w],
                white[w],
                quantization[w],
                ramp[w],
                factor[w],
                columns,
                to_samples,
                diagonal,
                out[w],
            )
            for i in range(n_tau):
                if cells.system[WIDTH * i + DATA, w - start] == 0.0:
                    out[w, i] = np.nan
    return out


@njit(**INNER)
def _observe_eight(  # type: ignore[no-untyped-def]
    start, avar, white, quantization, ramp, factor, columns, to_samples, cells, valid
):
    """Describe the windows from number `start` on, and count their valid cells in `valid`."""
    system, seen, inverse, facts = cells
    for place in range(PLACES):
        w = min(start + place, avar.shape[0] - 1)
        end = avar.shape[1] if start + place < avar.shape[0] else 0
        valid[place] = observe(
            avar[w, :end],
            white[w],
            quantization[w],
            ramp[w],
            factor[w],
            columns,
            to_samples,
            place,
            system,
            seen,
            inverse,
            facts,
        )


@njit(**INNER)
def _factor_covariance(cells, fit, room, tables):  # type: ignore[no-untyped-def]
    """Eliminate the covariance of the noise `fit.basis` with columns and data; sets `fit.state`."""
    system, inverse, whole, state = cells.system, cells.inverse, room.whole, fit.state
    n = inverse.shape[0]
    width = n + WIDTH
    put(state, 2, 1e-7)  # the sums over lags are good to about this; a strong ramp may need more
    root_squares(fit.basis, cells.seen, room.units, room.roots)
    again = True
    while again:
        covariance_rows(room.roots, inverse, tables, whole, width)
        jitter = take(state, 2)
        for i in range(n):
            at, y = width * i, take(system, WIDTH * i + DATA)
            own = take(whole, at + i)  # the second part keeps a window without any noise solvable
            put(whole, at + i, where_above(y, 0.0, own + jitter * own + 1e-16 * y * y, 1.0))
            for a in range(WIDTH):
                put(whole, at + n + a, take(system, WIDTH * i + a))
        eliminate(whole, n, width, state[3:4])
        again = False
        for place in range(PLACES):
            if state[3, place] < 0.5 and state[1, place] < 0.5:
                state[2, place] *= 10.0
                if state[2, place] < 1.0:
                    again = True
                else:
                    state[1, place] = 1.0


@njit(**INNER)
def _normal_equations(whole, n, normal, right):  # type: ignore[no-untyped-def]
    """Form normal matrix and right-hand side from the eliminated covariance, columns and data."""
    for row in range(25):
        put(normal, row, 0.0)
    for a in range(5):
        put(right, a, 0.0)
    one = take(whole, 0) * 0.0 + 1.0
    for i in range(n):
        _add_equation(whole, (n + WIDTH) * i + n, one, normal, right)
    _mirror_triangle(normal)


@njit(**INNER)
def _refit_windows(allowed, cells, fit, room, tables):  # type: ignore[no-untyped-def]
    """Refit until the covariance is that of the fitted noise; converged fits keep their numbers."""
    squares, terms, basis, state, trial, tried = (
        fit.squares,
        fit.terms,
        fit.basis,
        fit.state,
        eights(5),
        eights(5),
    )
    n = cells.inverse.shape[0]
    put(state, 0, 1.0)
    put(state, 1, 0.0)
    for _ in range(6):
        moves = take(state, 0)
        for a in range(5):
            put(basis, a, where_above(moves, 0.5, take(squares, a), take(basis, a)))
            put(tried, a, take(terms, a))
        _factor_covariance(cells, fit, room, tables)
        _normal_equations(room.whole, n, room.normal, room.right)
        solve_nonnegative_eights(room.normal, room.right, allowed, tried, trial, room.scratch)
        moved = moves * 0.0
        for a in range(5):
            put(squares, a, where_above(moves, 0.5, take(trial, a), take(squares, a)))
            put(terms, a, where_above(moves, 0.5, take(tried, a), take(terms, a)))
            old, step = take(basis, a), take(squares, a) - take(basis, a)
            moved = where_above(where_above(step, 0.0, step, 0.0 - step), 1e-4 * old, moves, moved)
        put(state, 0, where_above(take(state, 1), 0.5, 0.0, moved))
        if not _has_positive(state, np.int64(0)):
            break


@njit(**INNER)
def _has_positive(rows, row):  # type: ignore[no-untyped-def]
    """Whether one of the eight numbers of a row is above zero."""
    found = False
    for place in range(PLACES):
        found = found or rows[row, place] > 0.0
    return found


@njit(**INNER)
def _estimate_term(a, allowed, squares, terms, normal, right, scratch, row, found):  # type: ignore[no-untyped-def]
    """Estimate one term without the non-negativity constraint, with the chosen terms.

    All results are NaN, and the separation is zero, if the other terms reproduce the term.
    """
    scaled, work, scale, unit, tried = (
        scratch[:25],
        scratch[25:50],
        scratch[50:55],
        scratch[55:60],
        scratch[60:65],
    )
    scale_equations(normal, scale, scaled)
    for b in range(5):
        put(unit, b, take(scale, b) if a == b else take(scale, b) * 0.0)
        put(tried, b, 1.0 if allowed >> b & 1 else 0.0)
    apart = solve_terms(scaled, unit, tried, row, work)
    share = take(row, a) * take(scale, a) * take(normal, 6 * a)
    separation = where_above(apart, 0.5, 1.0 / where_above(share, 1.0, share, 1.0), 0.0)
    for b in range(5):
        put(tried, b, take(terms, b))
    put(tried, a, 1.0)
    apart = solve_terms(scaled, unit, tried, row, work)
    free = apart * 0.0
    for b in range(
        5
    ):  # row a of the inverse normal matrix: the estimator is the sum of row[b] right[b]
        put(row, b, take(row, b) * take(scale, b))
        free = free + take(row, b) * take(right, b)
    variance = take(row, a)
    put(found, 5 * 0 + a, where_above(apart, 0.5, take(squares, a), np.nan))
    put(
        found,
        5 * 1 + a,
        where_above(apart, 0.5, root(where_above(variance, 0.0, variance, 0.0)), np.nan),
    )
    put(found, 5 * 2 + a, where_above(apart, 0.5, free, np.nan))
    put(found, 5 * 6 + a, where_above(apart, 0.5, separation, 0.0))
    return apart


@njit(**INNER)
def _remove_term(a, squares, facts, trial):  # type: ignore[no-untyped-def]
    """Replace term `a` by its neighbour, at the same Allan variance.

    A ramp or flicker noise counts as observed only against a random walk that is as high at the
    longest averaging time, quantization against angle random walk at the shortest.
    """
    for b in range(5):
        put(trial, b, take(squares, b))
    put(trial, a, 0.0)
    if a == 0 or a == 2 or a == 4:
        stand_in = 1 if a == 0 else 3
        put(trial, stand_in, take(trial, stand_in) + take(squares, a) * take(facts, a))


@njit(**INNER)
def _variance_growth(a, apart, cells, fit, room, tables, found):  # type: ignore[no-untyped-def]
    """Expand the variance of the estimate of term `a` in its square, to rows 3 to 5 of `found`."""
    seen, inverse, units, roots, weights = (
        cells.seen,
        cells.inverse,
        room.units,
        room.roots,
        room.weights,
    )
    trial, parts = room.scratch[:5], room.scratch[5:8]
    _remove_term(a, fit.squares, cells.facts, trial)
    root_squares(trial, seen, units, roots)
    variance_parts(roots, a, units, inverse, tables, weights, parts)
    if a < 2 and _has_positive(cells.facts, np.int64(5)):
        _joint_growth(a, trial, cells, room, tables, parts)
    for part in range(3):
        put(found, 5 * (3 + part) + a, where_above(apart, 0.5, take(parts, part), np.nan))


@njit(**INNER)
def _joint_growth(a, trial, cells, room, tables, parts):  # type: ignore[no-untyped-def]
    """Treat quantization noise that counts as white (see `observe`) as one term with the noise."""
    seen, roots, spread = cells.seen, room.roots, room.scratch[8:11]
    joint = take(cells.facts, 5)
    if a == 1:
        joint = where_above(take(trial, 0), 0.0, joint, 0.0)
    null = take(parts, 0)
    put(trial, a, 1.0)
    root_squares(trial, seen, room.units, roots)
    variance_parts(roots, a, room.units, cells.inverse, tables, room.weights, spread)
    both = take(spread, 0)
    for b in range(5):
        put(trial, b, 1.0 if a == b else 0.0)
    root_squares(trial, seen, room.units, roots)
    variance_parts(roots, a, room.units, cells.inverse, tables, room.weights, spread)
    alone = take(spread, 0)
    put(parts, 1, where_above(joint, 0.0, both - null - alone, take(parts, 1)))
    put(parts, 2, where_above(joint, 0.0, alone, take(parts, 2)))


@njit(**INNER)
def _judge_terms(allowed, cells, fit, room, tables, found, row, chi2):  # type: ignore[no-untyped-def]
    """Estimate all terms with errors, separations and variance growth; returns chi-square."""
    whole, weights, squares = room.whole, room.weights, fit.squares
    n = cells.inverse.shape[0]
    width = n + WIDTH
    total = take(squares, 0) * 0.0
    for i in range(n):
        at = width * i + n
        misfit = take(whole, at + DATA)
        for a in range(5):
            misfit = misfit - take(squares, a) * take(whole, at + a)
        total = total + misfit * misfit
    put(chi2, 0, total)
    back_substitute(whole, n, width)
    for a in range(5):
        if not allowed >> a & 1:
            continue
        apart = _estimate_term(
            a, allowed, squares, fit.terms, room.normal, room.right, room.scratch, row, found
        )
        for i in range(n):  # estimator as weights on the cells
            weight = take(row, 0) * take(whole, width * i + n)
            for b in range(1, 5):
                weight = weight + take(row, b) * take(whole, width * i + n + b)
            put(weights, i, weight)
        _variance_growth(a, apart, cells, fit, room, tables, found)


@njit(**KERNEL)
def fit_windows(  # type: ignore[no-untyped-def]
    avar, white, quantization, ramp, gap_factor, columns, to_samples, pairs, ramps, weight, allowed
):
    """Fit every window.

    Parameters
    ----------
    avar, white, quantization, ramp, gap_factor : float64 (n_windows, n_tau)
        Cells [degree2 hour-2], NaN where missing, and their responses to the gaps.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    to_samples : float64 (5,)
        Squared coefficient to sample units.
    pairs : float64 (4, 4, n_tau, n_tau); ramps : float64 (4, n_tau, n_tau)
        `product_tables`.
    weight : float64 (n_tau,)
        Degrees of freedom for white noise, the weights of the first pass.
    allowed : int
        Bit set of the terms to fit.

    Returns
    -------
    result : float64 (n_windows, 7, 5)
        Rows as `FIT_FIELDS`: squared coefficient; its standard error; its estimate free of sign;
        variance of that estimate without the term, growth per unit of the square, per unit of its
        square; separation, the share of the column that the other terms cannot reproduce.
    misfit : float64 (n_windows, 2)
        Chi-square and degrees of freedom.
    dof : float64 (n_windows, n_tau)
        Equivalent degrees of freedom of the cells under the fitted noise.
    """
    n_windows, n_tau = avar.shape
    size = (n_tau + 3) // 4 * 4
    tables = np.zeros(size * size * PRODUCTS)
    combine_products(pairs, ramps, size, tables)
    diagonal = np.empty((n_tau, PRODUCTS))
    for i in range(n_tau):
        for table in range(PRODUCTS):
            diagonal[i, table] = tables[PRODUCTS * (i * size + i) + table]
    result = np.full((n_windows, len(FIT_FIELDS), 5), np.nan)
    misfit = np.full((n_windows, 2), np.nan)
    dof = np.full((n_windows, n_tau), np.nan)
    cells, fit, room = (
        _make_cells(size),
        _Fit(eights(5), eights(5), eights(5), eights(4)),
        _make_room(size),
    )
    found, row, chi2, squares, valid = (
        eights(5 * len(FIT_FIELDS)),
        eights(5),
        eights(1),
        np.empty(5),
        np.empty(PLACES, np.int64),
    )
    for start in range(0, n_windows, PLACES):
        _observe_eight(
            start, avar, white, quantization, ramp, gap_factor, columns, to_samples, cells, valid
        )
        root_units(cells.seen, room.units)
        _fit_diagonal(cells, weight, allowed, room.normal, room.right, fit, room.scratch)
        _refit_windows(allowed, cells, fit, room, tables)
        _judge_terms(allowed, cells, fit, room, tables, found, row, chi2)
        for w in range(start, min(start + PLACES, n_windows)):
            place = w - start
            misfit[w, 1] = 0.0
            if valid[place] == 0 or fit.state[1, place] > 0.5:
                continue
            _write_window(
                allowed, valid[place], place, found, fit, chi2, result[w], misfit[w], squares
            )
            degrees_of_freedom(
                squares,
                avar[w],
                white[w],
                quantization[w],
                ramp[w],
                gap_factor[w],
                columns,
                to_samples,
                diagonal,
                dof[w],
            )
    return result, misfit, dof


@njit(**INNER)
def _write_window(allowed, valid, place, found, fit, chi2, result, misfit, squares):  # type: ignore[no-untyped-def]
    """Write the numbers of one window, and its squared coefficients (zero if none) to `squares`."""
    misfit[0], misfit[1] = chi2[0, place], valid
    for a in range(5):
        squares[a] = 0.0
        if not allowed >> a & 1:
            continue
        for field in range(len(FIT_FIELDS)):
            result[field, a] = found[5 * field + a, place]
        if fit.terms[a, place] > 0.5:
            misfit[1] -= 1.0
        if np.isfinite(result[0, a]):
            squares[a] = result[0, a]
