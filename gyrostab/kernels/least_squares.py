"""Generalised non-negative least squares of Allan variances, one small problem per window.

The Allan variance is linear in the squared coefficients, so a window is ``y = X s + e`` with ``s >= 0``. Overlapping
estimates at neighbouring averaging factors share data; the covariance of e follows from the noise itself
(`gyrostab.kernels.covariance`), so it is taken from the fit and iterated.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.mixture import (
    DATA,
    LANES,
    PRODUCTS,
    combine_products,
    covariance_rows,
    degrees_of_freedom,
    observe,
    root_squares,
    variance_parts,
)
from gyrostab.kernels.nonnegative import REORDER, back_substitute, eliminate, solve_nonnegative, solve_subset

__all__ = ["FIT_FIELDS", "fit_windows", "identify_noise"]

#: Rows of the per-term result of `fit_windows`.
FIT_FIELDS = ("square", "square_stderr", "free", "variance_null", "variance_linear", "variance_square", "separation")


@njit(**INNER)
def _quick(system, weight, factor, normal, right, allowed, squares):  # type: ignore[no-untyped-def]
    """Non-negative fit with a diagonal covariance, ``y^2`` over the degrees of freedom of white noise.

    No noise falls faster than quantization noise does. A cell that lies below the fall from a shorter averaging time
    is low by chance, and must not count for as much as its own square would have it.
    """
    normal[:] = 0.0
    right[:] = 0.0
    level = 0.0
    for i in range(weight.size):
        y = system[i, DATA]
        if y == 0.0:
            continue
        level = max(level, y / system[i, 0])
        w = weight[i] * factor[i] / (level * system[i, 0]) ** 2
        for a in range(5):
            right[a] += w * system[i, a] * y
            for b in range(5):
                normal[a, b] += w * system[i, a] * system[i, b]
    return solve_nonnegative(normal, right, allowed, squares, np.int64(0))


@njit(**KERNEL)
def identify_noise(avar, white, quantization, ramp, factor, columns, weight, to_samples, pairs, ramps):  # type: ignore[no-untyped-def]
    """Degrees of freedom of each cell with the noise mixture identified by a quick fit of the window.

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
    n_tau = avar.shape[1]
    out = np.full(avar.shape, np.nan)
    diagonal = np.empty((n_tau, PRODUCTS))
    for i in range(n_tau):
        table = 0
        for a in range(4):
            for b in range(a, 5):
                diagonal[i, table] = ramps[a, i] if b == 4 else pairs[a, b, i] * (1.0 if a == b else 2.0)
                table += 1
    squares = np.empty(5)
    system, seen, inverse = np.empty((n_tau, LANES)), np.empty((6, n_tau)), np.empty(n_tau)
    normal, right = np.empty((5, 5)), np.empty(5)
    for w in range(avar.shape[0]):
        if observe(avar[w], white[w], quantization[w], ramp[w], factor[w], columns, to_samples, system, seen, inverse):
            _quick(system, weight, factor[w], normal, right, np.int64(31), squares)
            degrees_of_freedom(squares, avar[w], white[w], quantization[w], ramp[w], factor[w], columns, to_samples, diagonal, out[w])
            for i in range(n_tau):
                if system[i, DATA] == 0.0:
                    out[w, i] = np.nan
    return out


@njit(**INNER)
def _without(a, squares, system, first, last, trial):  # type: ignore[no-untyped-def]
    """The noise if term `a` were not there and the neighbour most like it had made the same Allan variance instead.

    A ramp or a flicker floor is claimed only against a random walk that would reach as high at the longest averaging
    time, quantization against angle random walk at the shortest.
    """
    for b in range(squares.size):
        trial[b] = squares[b]
    trial[a] = 0.0
    cell, stand_in = last, -1
    if a == 0:
        cell, stand_in = first, 1
    elif a == 2 or a == 4:
        stand_in = 3
    if stand_in >= 0:
        trial[stand_in] += squares[a] * system[cell, a] / system[cell, stand_in]


@njit(**INNER)
def _growth(a, squares, system, seen, inverse, tables, root, weights, part, trial, result):  # type: ignore[no-untyped-def]
    """Variance of the estimate of term `a` as a polynomial in its square: rows 3, 4 and 5 of `result`."""
    first, last = 0, seen.shape[1] - 1
    while system[first, DATA] == 0.0:
        first += 1
    while system[last, DATA] == 0.0:
        last -= 1
    _without(a, squares, system, first, last, trial)
    parts = np.empty(3)
    excess = 0.0
    for i in range(seen.shape[1]):
        excess = max(excess, seen[2, i])
    if a > 1 or (a == 1 and trial[0] == 0.0) or excess == 0.0:
        trial[a] = 1.0
        root_squares(trial, seen, root)
        variance_parts(root, a, inverse, tables, weights, part, parts)
        for p in range(3):
            result[3 + p, a] = parts[p]
        return
    # quantization noise that counts as white (see observe) makes the terms one; the growth is that of the first unit
    root_squares(trial, seen, root)
    variance_parts(root, np.int64(-1), inverse, tables, weights, part, parts)
    result[3, a] = parts[0]
    trial[a] = 1.0
    root_squares(trial, seen, root)
    variance_parts(root, np.int64(-1), inverse, tables, weights, part, parts)
    both = parts[0]
    for b in range(5):
        trial[b] = 1.0 if a == b else 0.0
    root_squares(trial, seen, root)
    variance_parts(root, np.int64(-1), inverse, tables, weights, part, parts)
    result[5, a] = parts[0]
    result[4, a] = both - result[3, a] - parts[0]


@njit(fastmath=REORDER, **INNER)
def _normal_equations(system, normal, right):  # type: ignore[no-untyped-def]
    """Normal matrix and right-hand side from whitened columns and data."""
    normal[:] = 0.0
    right[:] = 0.0
    for i in range(system.shape[0]):
        for a in range(5):
            right[a] += system[i, a] * system[i, DATA]
            for b in range(5):
                normal[a, b] += system[i, a] * system[i, b]


@njit(**INNER)
def _whiten(root, inverse, tables, system, whole, whitened):  # type: ignore[no-untyped-def]
    """Whitened columns and data; False when the covariance is hopeless. `whole` keeps the factor of the covariance."""
    n = root.shape[1]
    jitter = 1e-7  # the sums over lags are good to about this; a strong ramp may need more
    while jitter < 1.0:
        covariance_rows(root, inverse, tables, whole)
        for i in range(n):
            if system[i, DATA] == 0.0:
                whole[i, i] = 1.0
            else:  # the second part keeps a window without any noise solvable
                whole[i, i] += jitter * whole[i, i] + 1e-16 * system[i, DATA] ** 2
            for a in range(LANES):
                whole[i, n + a] = system[i, a]
        if eliminate(whole):
            for i in range(n):
                for a in range(LANES):
                    whitened[i, a] = whole[i, n + a]
            return True
        jitter *= 10.0
    return False


@njit(**INNER)
def _estimate(a, chosen, allowed, normal, right, squares, row, work, members, result):  # type: ignore[no-untyped-def]
    """Estimate of one term, free of sign beside the chosen ones; its weights on the right-hand sides to `row`.

    Returns False when the term cannot be told from the chosen ones.
    """
    scale, unit, scaled, scratch = work[0], work[1], work[2:7], work[7:12]
    for b in range(5):
        scale[b] = 1.0 / np.sqrt(normal[b, b]) if normal[b, b] > 0.0 else 0.0
        unit[b] = scale[b] if a == b else 0.0
    for b in range(5):
        for c in range(5):
            scaled[b, c] = normal[b, c] * scale[b] * scale[c]
    result[6, a] = 0.0
    if not solve_subset(scaled, unit, chosen | 1 << a, row, scratch, members):
        return False
    if solve_subset(scaled, unit, allowed, row, scratch, members):
        result[6, a] = 1.0 / max(row[a] * scale[a] * normal[a, a], 1.0)
    solve_subset(scaled, unit, chosen | 1 << a, row, scratch, members)
    result[0, a] = squares[a]
    result[2, a] = 0.0
    for b in range(5):  # row a of the inverse normal matrix: the estimator is the sum of row[b] right[b]
        row[b] *= scale[b]
        result[2, a] += row[b] * right[b]
    result[1, a] = np.sqrt(max(row[a], 0.0))
    return True


@njit(**INNER)
def _iterate(system, seen, inverse, tables, allowed, chosen, squares, root, whole, whitened, normal, right):  # type: ignore[no-untyped-def]
    """Refit `squares` until the covariance is that of the fitted noise; returns the terms above zero, -1 where it is hopeless."""
    previous = np.empty(5)
    for _ in range(6):
        for a in range(5):
            previous[a] = squares[a]
        root_squares(squares, seen, root)
        if not _whiten(root, inverse, tables, system, whole, whitened):
            return -1
        _normal_equations(whitened, normal, right)
        chosen = solve_nonnegative(normal, right, allowed, squares, chosen)
        moved = False
        for a in range(5):
            moved = moved or abs(squares[a] - previous[a]) > 1e-4 * previous[a]
        if not moved:
            break
    return chosen


@njit(**INNER)
def _judge(chosen, allowed, squares, system, seen, inverse, tables, root, whole, whitened, normal, right, work, result):  # type: ignore[no-untyped-def]
    """Estimates of all terms with their errors, separations and growing variances; returns chi-square."""
    n = seen.shape[1]
    row, part, weights, scratch, members = np.empty(5), work[0], work[1], np.empty((12, 5)), np.empty(5, np.int64)
    for a in range(5):
        if not allowed >> a & 1 or not _estimate(a, chosen, allowed, normal, right, squares, row, scratch, members, result):
            continue
        for i in range(n):
            weights[i] = 0.0
            for b in range(5):
                weights[i] += row[b] * whitened[i, b]
        back_substitute(whole, weights)  # estimator as weights on the cells
        _growth(a, squares, system, seen, inverse, tables, root, weights, part, row, result)
    chi2 = 0.0
    for i in range(n):
        misfit = whitened[i, DATA]
        for a in range(5):
            misfit -= squares[a] * whitened[i, a]
        chi2 += misfit * misfit
    return chi2


@njit(**KERNEL)
def fit_windows(avar, white, quantization, ramp, gap_factor, columns, to_samples, pairs, ramps, weight, allowed):  # type: ignore[no-untyped-def]
    """Fit every window.

    Parameters
    ----------
    avar, white, quantization, ramp, gap_factor : float64 (n_windows, n_tau)
        Cells [degree2 hour-2], NaN where there is none, and what the gaps do to them.
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
        Rows as `FIT_FIELDS`: squared coefficient; its standard error; its estimate free of sign; variance of that
        estimate without the term, growth per unit of the square, per unit of its square; separation, the share of the
        column that the other terms cannot imitate.
    misfit : float64 (n_windows, 2)
        Chi-square and degrees of freedom.
    dof : float64 (n_windows, n_tau)
        Equivalent degrees of freedom of the cells under the fitted noise.
    """
    n_windows, n_tau = avar.shape
    size = (n_tau + LANES - 1) // LANES * LANES
    tables = np.zeros((size, PRODUCTS, size))
    combine_products(pairs, ramps, tables)
    diagonal = np.empty((n_tau, PRODUCTS))
    for i in range(n_tau):
        for table in range(PRODUCTS):
            diagonal[i, table] = tables[i, table, i]
    result = np.full((n_windows, len(FIT_FIELDS), 5), np.nan)
    misfit = np.full((n_windows, 2), np.nan)
    dof = np.full((n_windows, n_tau), np.nan)
    system, whitened, whole = np.empty((size, LANES)), np.empty((size, LANES)), np.empty((size, size + LANES))
    seen, root, inverse, work = np.empty((6, size)), np.empty((5, size)), np.empty(size), np.empty((2, size))
    normal, right, squares = np.empty((5, 5)), np.empty(5), np.empty(5)
    for w in range(n_windows):
        n = observe(avar[w], white[w], quantization[w], ramp[w], gap_factor[w], columns, to_samples, system, seen, inverse)
        misfit[w, 1] = 0.0
        if n == 0:
            continue
        chosen = _quick(system, weight, gap_factor[w], normal, right, allowed, squares)
        chosen = _iterate(system, seen, inverse, tables, allowed, chosen, squares, root, whole, whitened, normal, right)
        if chosen < 0:
            continue
        misfit[w, 0] = _judge(
            chosen, allowed, squares, system, seen, inverse, tables, root, whole, whitened, normal, right, work, result[w]
        )
        misfit[w, 1] = n
        for a in range(5):
            misfit[w, 1] -= (chosen & allowed) >> a & 1
            squares[a] = result[w, 0, a] if np.isfinite(result[w, 0, a]) else 0.0
        degrees_of_freedom(squares, avar[w], white[w], quantization[w], ramp[w], gap_factor[w], columns, to_samples, diagonal, dof[w])
    return result, misfit, dof
