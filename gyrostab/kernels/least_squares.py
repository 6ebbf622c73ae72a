"""Generalised non-negative least squares of Allan variances, one small problem per window.

The Allan variance is linear in the squared coefficients, so a window is ``y = X s + e`` with ``s >= 0``. Overlapping
estimates at neighbouring averaging factors share data; the covariance of e follows from the noise itself
(`gyrostab.kernels.covariance`), so it is taken from the fit and iterated.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.nonnegative import cholesky, solve_lower, solve_nonnegative, solve_subset, solve_upper

__all__ = ["FIT_FIELDS", "degrees_of_freedom", "fit_window", "fit_windows", "identify_noise"]

#: Rows of the per-term result of `fit_windows`.
FIT_FIELDS = ("square", "square_stderr", "free", "variance_null", "variance_linear", "variance_square", "separation")


@njit(nogil=True, cache=True)
def _take(values, index, n):  # type: ignore[no-untyped-def]
    """``values[index[:n]]``, which numba compiles ten times slower."""
    out = np.empty(n)
    for i in range(n):
        out[i] = values[index[i]]
    return out


@njit(nogil=True, cache=True)
def _columns(columns, white, quantization, index, n):  # type: ignore[no-untyped-def]
    """Design matrix of the valid cells, with the responses to white and quantization noise seen through the gaps."""
    design = np.empty((n, columns.shape[1]))
    for i in range(n):
        for a in range(columns.shape[1]):
            response = quantization[index[i]] if a == 0 else (white[index[i]] if a == 1 else 1.0)
            design[i, a] = columns[index[i], a] * response
    return design


@njit(nogil=True, cache=True)
def _amounts(squares, to_samples, columns, white, quantization, out):  # type: ignore[no-untyped-def]
    """Squared coefficients of the stochastic terms in sample units, as one cell sees them through the gaps.

    What the gaps add to quantization noise comes from the ends of many runs spread over each cluster, so it scatters
    like white noise and is counted there.
    """
    excess = max(quantization - 1.0, 0.0) * columns[0] / columns[1]
    out[0] = squares[0] * min(quantization, 1.0) * to_samples[0]
    out[1] = (squares[1] * white + squares[0] * excess) * to_samples[1]
    out[2] = squares[2] * to_samples[2]
    out[3] = squares[3] * to_samples[3]


@njit(nogil=True, cache=True)
def _covariance(squares, to_samples, columns, white, quantization, factor, pairs, ramps, index, n, out):  # type: ignore[no-untyped-def]
    """Covariance of the valid cells for squared coefficients `squares`; `out` (n, n) is overwritten."""
    root = np.empty((4, n))
    amounts = np.empty(4)
    for i in range(n):
        cell = index[i]
        _amounts(squares, to_samples, columns[cell], white[cell], quantization[cell], amounts)
        for a in range(4):
            root[a, i] = np.sqrt(max(amounts[a], 0.0))
    ramp = max(squares[4], 0.0) * to_samples[4]
    for i in range(n):
        for j in range(i + 1):
            p, q = index[i], index[j]
            total = 0.0
            for a in range(4):
                amplitude = root[a, i] * root[a, j]
                if amplitude == 0.0:
                    continue
                total += ramp * amplitude * ramps[a, p, q]
                for b in range(4):
                    total += amplitude * root[b, i] * root[b, j] * pairs[a, b, p, q]
            total /= max(factor[p], factor[q])  # the poorer cell uses a part of what the richer one uses
            out[i, j] = total
            out[j, i] = total


@njit(nogil=True, cache=True)
def _quick(y, weight, factor, index, design, allowed, squares):  # type: ignore[no-untyped-def]
    """Non-negative fit with a diagonal covariance, ``y^2`` over the degrees of freedom of white noise."""
    terms = design.shape[1]
    normal = np.zeros((terms, terms))
    right = np.zeros(terms)
    for i in range(y.size):
        w = weight[index[i]] * factor[index[i]] / (y[i] * y[i])
        for a in range(terms):
            right[a] += w * design[i, a] * y[i]
            for b in range(terms):
                normal[a, b] += w * design[i, a] * design[i, b]
    return solve_nonnegative(normal, right, allowed, squares)


@njit(nogil=True, cache=True)
def _valid(avar, factor, index):  # type: ignore[no-untyped-def]
    n = 0
    for i in range(avar.size):
        if np.isfinite(avar[i]) and avar[i] > 0.0 and factor[i] > 0.0:
            index[n] = i
            n += 1
    return n


@njit(nogil=True, cache=True)
def degrees_of_freedom(squares, to_samples, columns, white, quantization, factor, pairs, ramps):  # type: ignore[no-untyped-def]
    """Equivalent degrees of freedom of each cell under a mixture of noises, ``2 mean^2 / variance``.

    Parameters
    ----------
    squares : float64 (5,)
        Squared coefficients.
    to_samples : float64 (5,)
        Squared coefficient to sample units (rate per sample, interval 1).
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    white, quantization, factor : float64 (n_tau,)
        Responses seen through the gaps, and degrees of freedom left as a share.
    pairs : float64 (4, 4, n_tau); ramps : float64 (4, n_tau)
        Diagonals of `pair_products` and `ramp_products`.
    """
    n_tau = columns.shape[0]
    out = np.zeros(n_tau)
    amounts = np.empty(4)
    for i in range(n_tau):
        mean = 0.0
        for a in range(5):
            response = quantization[i] if a == 0 else (white[i] if a == 1 else 1.0)
            mean += squares[a] * response * columns[i, a]
        variance = 0.0
        _amounts(squares, to_samples, columns[i], white[i], quantization[i], amounts)
        for a in range(4):
            variance += amounts[a] * squares[4] * to_samples[4] * ramps[a, i]
            for b in range(4):
                variance += amounts[a] * amounts[b] * pairs[a, b, i]
        if variance > 0.0:
            out[i] = 2.0 * mean * mean / variance * factor[i]
    return out


@njit(nogil=True, cache=True)
def identify_noise(avar, white, quantization, factor, columns, weight, to_samples, pairs, ramps):  # type: ignore[no-untyped-def]
    """Degrees of freedom of each cell with the noise mixture identified by a quick fit of the window.

    Parameters
    ----------
    avar, white, quantization, factor : float64 (n_windows, n_tau)
        Cells and what the gaps do to them.
    columns, to_samples, pairs, ramps
        As in `degrees_of_freedom`.
    weight : float64 (n_tau,)
        Degrees of freedom for white noise, the weights of the quick fit.

    Returns
    -------
    float64 (n_windows, n_tau)
    """
    out = np.full(avar.shape, np.nan)
    squares = np.empty(5)
    index = np.empty(avar.shape[1], np.int64)
    for w in range(avar.shape[0]):
        n = _valid(avar[w], factor[w], index)
        if n == 0:
            continue
        design = _columns(columns, white[w], quantization[w], index, n)
        _quick(_take(avar[w], index, n), weight, factor[w], index, design, 31, squares)
        dof = degrees_of_freedom(squares, to_samples, columns, white[w], quantization[w], factor[w], pairs, ramps)
        for i in range(n):
            out[w, index[i]] = dof[index[i]]
    return out


@njit(nogil=True, cache=True)
def _normal_equations(y, design, factor, n):  # type: ignore[no-untyped-def]
    """Whiten with the Cholesky factor of the covariance: normal matrix, right-hand side and whitened data."""
    terms = design.shape[1]
    whitened = np.empty((terms, n))
    data = y.copy()
    solve_lower(factor, n, data)
    for a in range(terms):
        for i in range(n):
            whitened[a, i] = design[i, a]
        solve_lower(factor, n, whitened[a])
    normal = np.empty((terms, terms))
    right = np.empty(terms)
    for a in range(terms):
        right[a] = 0.0
        for i in range(n):
            right[a] += whitened[a, i] * data[i]
        for b in range(terms):
            normal[a, b] = 0.0
            for i in range(n):
                normal[a, b] += whitened[a, i] * whitened[b, i]
    return normal, right, whitened, data


@njit(nogil=True, cache=True)
def _term(a, chosen, allowed, normal, right, whitened, factor, squares, spread, result):  # type: ignore[no-untyped-def]
    """Estimate of one term, free of sign beside the chosen ones, and how its variance grows with the term itself."""
    terms, n = whitened.shape
    subset = chosen | 1 << a
    unit = np.zeros(terms)
    unit[a] = 1.0
    scale = np.empty(terms)
    for b in range(terms):
        scale[b] = 1.0 / np.sqrt(normal[b, b]) if normal[b, b] > 0.0 else 0.0
    scaled = np.empty((terms, terms))
    for b in range(terms):
        unit[b] *= scale[b]
        for c in range(terms):
            scaled[b, c] = normal[b, c] * scale[b] * scale[c]
    row = np.empty(terms)
    if not solve_subset(scaled, unit, subset, row):
        result[6, a] = 0.0
        return
    result[0, a] = squares[a]
    result[2, a] = 0.0
    weights = np.zeros(n)
    for b in range(terms):
        row[b] *= scale[b]  # row a of the inverse normal matrix: the estimator is the sum of row[b] right[b]
        result[2, a] += row[b] * right[b]
        for i in range(n):
            weights[i] += row[b] * whitened[b, i]
    result[1, a] = np.sqrt(max(row[a], 0.0))
    solve_upper(factor, n, weights)  # estimator as weights on the cells
    for p in range(3):  # spread[0]: covariance without the term; [1]: growth with it; [2]: its own square
        total = 0.0
        for i in range(n):
            for j in range(n):
                total += weights[i] * weights[j] * spread[p, i, j]
        result[3 + p, a] = total
    if solve_subset(scaled, unit, allowed, row):
        result[6, a] = 1.0 / max(row[a] * scale[a] * normal[a, a], 1.0)
    else:
        result[6, a] = 0.0


@njit(nogil=True, cache=True)
def _without(a, squares, design, trial):  # type: ignore[no-untyped-def]
    """The noise if term `a` were not there and the neighbour most like it had made the same Allan variance instead.

    A ramp or a flicker floor is claimed only against a random walk that would reach as high at the longest averaging
    time, quantization against angle random walk at the shortest.
    """
    for b in range(squares.size):
        trial[b] = squares[b]
    trial[a] = 0.0
    cell, stand_in = design.shape[0] - 1, -1
    if a == 0:
        cell, stand_in = 0, 1
    elif a == 2 or a == 4:
        stand_in = 3
    if stand_in >= 0:
        trial[stand_in] += squares[a] * design[cell, a] / design[cell, stand_in]


@njit(nogil=True, cache=True)
def _spread(a, squares, design, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, n, spread):  # type: ignore[no-untyped-def]
    """Covariance of the cells as a polynomial in the squared coefficient of term `a`: constant, linear and square parts."""
    trial = np.empty(squares.size)
    _without(a, squares, design, trial)
    _covariance(trial, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, n, spread[0])
    trial[a] = 1.0
    _covariance(trial, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, n, spread[1])
    trial[:] = 0.0
    trial[a] = 1.0
    _covariance(trial, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, n, spread[2])
    for i in range(n):
        for j in range(n):
            spread[1, i, j] -= spread[0, i, j] + spread[2, i, j]


@njit(nogil=True, cache=True)
def _factorise(squares, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, data, factor):  # type: ignore[no-untyped-def]
    """Cholesky factor of the covariance of the valid cells; False when it is hopeless."""
    n = data.size
    jitter = 1e-7  # the sums over lags are good to about this; a strong ramp may need more
    while jitter < 1.0:
        _covariance(squares, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, n, factor)
        for i in range(n):  # the second part keeps a window without any noise solvable
            factor[i, i] += jitter * factor[i, i] + 1e-16 * data[i] * data[i]
        if cholesky(factor, n):
            return True
        jitter *= 10.0
    return False


@njit(nogil=True, cache=True)
def fit_window(y, white, quantization, gap_factor, columns, to_samples, pairs, ramps, weight, allowed, result):  # type: ignore[no-untyped-def]
    """Fit one window; returns chi-square, degrees of freedom and the number of usable cells (arguments as `fit_windows`)."""
    index = np.empty(y.size, np.int64)
    n = _valid(y, gap_factor, index)
    terms = columns.shape[1]
    result[:] = np.nan
    if n == 0:
        return np.nan, 0, 0
    data = _take(y, index, n)
    design = _columns(columns, white, quantization, index, n)
    squares = np.zeros(terms)
    chosen = _quick(data, weight, gap_factor, index, design, allowed, squares)
    factor = np.empty((n, n))
    normal = np.zeros((terms, terms))
    right = np.zeros(terms)
    whitened = np.zeros((terms, n))
    rest = data
    for _ in range(6):
        previous = squares.copy()
        if not _factorise(squares, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, data, factor):
            return np.nan, 0, n
        normal, right, whitened, rest = _normal_equations(data, design, factor, n)
        chosen = solve_nonnegative(normal, right, allowed, squares)
        moved = False
        for a in range(terms):
            moved = moved or abs(squares[a] - previous[a]) > 1e-4 * previous[a]
        if not moved:
            break
    used = 0
    spread = np.empty((3, n, n))
    for a in range(terms):
        if allowed >> a & 1:
            used += chosen >> a & 1
            _spread(a, squares, design, to_samples, columns, white, quantization, gap_factor, pairs, ramps, index, n, spread)
            _term(a, chosen, allowed, normal, right, whitened, factor, squares, spread, result)
    chi2 = 0.0
    for i in range(n):
        misfit = rest[i]
        for a in range(terms):
            misfit -= squares[a] * whitened[a, i]
        chi2 += misfit * misfit
    return chi2, n - used, n


@njit(nogil=True, cache=True)
def fit_windows(avar, white, quantization, gap_factor, columns, to_samples, pairs, ramps, weight, allowed):  # type: ignore[no-untyped-def]
    """Fit every window.

    Parameters
    ----------
    avar, white, quantization, gap_factor : float64 (n_windows, n_tau)
        Cells [degree2 hour-2], NaN where there is none, and what the gaps do to them.
    columns : float64 (n_tau, 5)
        Allan variance per squared coefficient.
    to_samples : float64 (5,)
        Squared coefficient to sample units.
    pairs : float64 (4, 4, n_tau, n_tau); ramps : float64 (4, n_tau, n_tau)
        `pair_products` and `ramp_products`.
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
    result = np.empty((n_windows, len(FIT_FIELDS), columns.shape[1]))
    misfit = np.empty((n_windows, 2))
    dof = np.full((n_windows, n_tau), np.nan)
    diagonal = np.empty((4, 4, n_tau))
    ramp_diagonal = np.empty((4, n_tau))
    for i in range(n_tau):
        for a in range(4):
            ramp_diagonal[a, i] = ramps[a, i, i]
            for b in range(4):
                diagonal[a, b, i] = pairs[a, b, i, i]
    squares = np.empty(columns.shape[1])
    for w in range(n_windows):
        chi2, freedom, n = fit_window(
            avar[w], white[w], quantization[w], gap_factor[w], columns, to_samples, pairs, ramps, weight, allowed, result[w]
        )
        misfit[w, 0], misfit[w, 1] = chi2, freedom
        if n == 0 or not np.isfinite(chi2):
            continue
        for a in range(columns.shape[1]):
            squares[a] = result[w, 0, a] if np.isfinite(result[w, 0, a]) else 0.0
        cells = degrees_of_freedom(squares, to_samples, columns, white[w], quantization[w], gap_factor[w], diagonal, ramp_diagonal)
        for i in range(n_tau):
            if np.isfinite(avar[w, i]):
                dof[w, i] = cells[i]
    return result, misfit, dof
