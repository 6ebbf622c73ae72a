"""Average over the submodels of one window: estimates and the law of their scatter.

The window is reduced to ``u = A z``, four sums of its cells with ``A = X^T C^-1`` at the fitted
noise. Under squared coefficients s their mean is ``M s`` with ``M = A X``, and their covariance,
``sum_ab s_a s_b T_ab``, is known exactly. Each submodel is a set of the terms Q, N, B and K, fitted
by least squares with its own covariance; its weight is its Gaussian likelihood, zero if one of its
estimates is not positive. For the estimate of one term, its own sign is free, and a negative
estimate of another, z standard errors below zero, only costs a factor exp(-z^2): others that are
never too low would bias it. To the variance between sets comes the mean of those whose other
estimates are positive.

The lower end of an interval has another law. If a term that a set lacks is there, the others get
its part and are too high, never too low; the low tail of the mixture is that of its widest sets.
For the lower end, estimate and variance are averaged over the sets whose other estimates are
positive, with the square of the variance as a further factor of the weight, and the other terms
are as high as they would be with this one at its lower end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.fit.mixture import PRODUCTS

#: Rows of the per-term result of a fit.
FIT_FIELDS = (
    "square",
    "likelihood_ratio",
    "free",
    "variance_null",
    "variance_linear",
    "variance_square",
    "low",
    "low_null",
    "low_linear",
    "low_square",
    "separation",
)
#: First rows of the law of a term, and of that for the lower end of its interval: estimate, and the
#: three parts of the variance.
_LAW, _LOW_LAW = np.int64(2), np.int64(6)
#: Columns of `Submodels.weights`: in the mean of a term, and in its variance.
_IN_MEAN, _IN_VARIANCE = np.int64(0), np.int64(1)
#: Sets of four terms.
_SETS = 16
#: Passes in which the covariance of a submodel is updated to that of its estimates.
_PASSES = 3


class Submodels(NamedTuple):
    """The reduced window, in units in which M has a unit diagonal, and scratch."""

    data: NDArray[np.float64]
    normal: NDArray[np.float64]
    products: NDArray[np.float64]
    scale: NDArray[np.float64]
    trend: NDArray[np.float64]
    covariance: NDArray[np.float64]
    whitener: NDArray[np.float64]
    design: NDArray[np.float64]
    inner: NDArray[np.float64]
    #: Estimates, what negative ones cost, their weights on the data, log-likelihood of each set,
    #: also -inf unless all its estimates are positive, mean and variance of the trend's variance;
    #: weights of the sets in a mean and a law of scatter.
    estimates: NDArray[np.float64]
    penalties: NDArray[np.float64]
    rows: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    feasible: NDArray[np.float64]
    slope: NDArray[np.float64]
    weights: NDArray[np.float64]
    squares: NDArray[np.float64]
    #: Product of the covariance with a row on the data, and covariance of a term with the others.
    image: NDArray[np.float64]
    shared: NDArray[np.float64]
    #: Quadratic form that turns a covariance of the data into a variance of a term.
    form: NDArray[np.float64]


@njit(**INNER)
def make_submodels():  # type: ignore[no-untyped-def]
    """Make the arrays of `Submodels`."""
    return Submodels(
        np.zeros(4),
        np.zeros((4, 4)),
        np.zeros((PRODUCTS, 10)),
        np.zeros(4),
        np.zeros(5),
        np.zeros(10),
        np.zeros((4, 4)),
        np.zeros((4, 5)),
        np.zeros((4, 4)),
        np.zeros((_SETS, 4)),
        np.zeros((_SETS, 4)),
        np.zeros((_SETS, 4, 4)),
        np.zeros(_SETS),
        np.zeros(_SETS),
        np.zeros((_SETS, 2)),
        np.zeros((_SETS, 2)),
        np.zeros(5),
        np.zeros(4),
        np.zeros(4),
        np.zeros(10),
    )


@njit(**INNER)
def _mix_products(products, squares, out):  # type: ignore[no-untyped-def]
    """Compute the covariance of the data under `squares` (5,): the upper triangle (10,)."""
    for entry in range(10):
        out[entry] = 0.0
    table = 0
    for a in range(4):
        for b in range(a, 5):
            amount = squares[a] * squares[b]
            if amount > 0.0:
                for entry in range(10):
                    out[entry] += amount * products[table, entry]
            table += 1


@njit(**INNER)
def _invert_factor(matrix, n):  # type: ignore[no-untyped-def]
    """Replace a matrix by the inverse of its lower Cholesky factor; returns half its log det.

    Infinite where it is not positive definite.
    """
    half = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for p in range(j):
                total -= matrix[i, p] * matrix[j, p]
            if i == j:
                if not total > 0.0:
                    return np.inf
                matrix[i, i] = math.sqrt(total)
                half += 0.5 * math.log(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(n):
        matrix[i, i] = 1.0 / matrix[i, i]
        for j in range(i):
            total = 0.0
            for p in range(j, i):
                total -= matrix[i, p] * matrix[p, j]
            matrix[i, j] = total * matrix[i, i]
    return half


@njit(**INNER)
def _factor_data(room):  # type: ignore[no-untyped-def]
    """Whiten the data: ``room.whitener`` from ``room.covariance``; returns half the log det.

    Infinite without any noise.
    """
    largest = 0.0
    entry = 0
    for i in range(4):
        for j in range(i, 4):
            room.whitener[j, i] = room.covariance[entry]
            entry += 1
        variance = room.whitener[i, i]
        largest = max(largest, variance)
        room.whitener[i, i] = variance * (1.0 + 1e-9) if variance > 0.0 else 1.0
    return _invert_factor(room.whitener, np.int64(4)) if largest > 0.0 else np.inf


@njit(**INNER)
def _invert_matrix(matrix, n):  # type: ignore[no-untyped-def]
    """Replace a matrix by its inverse; whether it is positive definite."""
    if not _invert_factor(matrix, n) < np.inf:
        return False
    for p in range(n):
        for q in range(p + 1):
            total = 0.0
            for r in range(p, n):
                total += matrix[r, p] * matrix[r, q]
            matrix[p, q] = matrix[q, p] = total
    return True


@njit(**INNER)
def _whiten_columns(members, size, room):  # type: ignore[no-untyped-def]
    """Write the whitened columns of a set to ``room.design``, with the data in the last one."""
    for i in range(4):
        for p in range(5):
            room.design[i, p] = 0.0
        for c in range(i + 1):
            share = room.whitener[i, c]
            for p in range(size):
                room.design[i, p] += share * room.normal[c, members[p]]
            room.design[i, 4] += share * room.data[c]


@njit(**INNER)
def _solve_set(members, size, index, room):  # type: ignore[no-untyped-def]
    """Solve for the estimates of a set, with their rows on the whitened data; whether solvable."""
    design, inner = room.design, room.inner
    for p in range(size):
        for q in range(p + 1):
            total = 0.0
            for i in range(4):
                total += design[i, p] * design[i, q]
            inner[p, q] = total
        inner[p, p] *= 1.0 + 1e-12
    if not _invert_matrix(inner, size):
        return False
    for p in range(size):
        estimate = 0.0
        for i in range(4):
            total = 0.0
            for q in range(size):
                total += inner[p, q] * design[i, q]
            room.rows[index, members[p], i] = total
            estimate += total * design[i, 4]
        room.estimates[index, members[p]] = estimate
        room.squares[members[p]] = max(estimate, 0.0)
    return True


@njit(**INNER)
def _describe_set(members, size, index, half, room):  # type: ignore[no-untyped-def]
    """Write likelihood, penalties, variance of the trend, and rows on the data of a set."""
    inner, is_feasible = room.inner, True
    square = mean = variance = 0.0
    for i in range(4):
        misfit = room.design[i, 4]
        for p in range(size):
            misfit -= room.design[i, p] * room.estimates[index, members[p]]
        square += misfit * misfit
    for p in range(size):
        estimate = room.estimates[index, members[p]]
        is_feasible = is_feasible and estimate > 0.0
        room.penalties[index, members[p]] = min(estimate, 0.0) ** 2 / inner[p, p]
        trend, row = room.trend[members[p]], room.rows[index, members[p]]
        mean += trend * estimate
        for q in range(size):
            variance += trend * room.trend[members[q]] * inner[p, q]
        for c in range(4):
            total = 0.0
            for i in range(c, 4):
                total += row[i] * room.whitener[i, c]
            row[c] = total
    room.likelihood[index] = -half - 0.5 * square
    room.feasible[index] = room.likelihood[index] if is_feasible else -np.inf
    room.slope[index, 0], room.slope[index, 1] = mean, variance


@njit(**INNER)
def _fit_set(members, index, start, ramp, room):  # type: ignore[no-untyped-def]
    """Fit the set of terms with number `index`; its likelihood is zero where that fails."""
    size = np.int64(0)
    room.squares[4] = ramp
    for a in range(4):
        room.squares[a] = room.estimates[index, a] = 0.0
        if index >> a & 1:
            members[size] = a
            room.squares[a] = start[a] if start[a] > 0.0 else 0.1
            size += 1
    half = 0.0
    for _ in range(_PASSES):
        _mix_products(room.products, room.squares, room.covariance)
        half = _factor_data(room)
        if not half < np.inf:
            return
        _whiten_columns(members, size, room)
        if not _solve_set(members, size, index, room):
            return
    _describe_set(members, size, index, half, room)


@njit(**INNER)
def _weigh_sets(a, room):  # type: ignore[no-untyped-def]
    """Write the weights of the sets in the mean and in the variance of a term; whether any has one.

    Zero without the term.
    """
    best = positive = -np.inf
    for index in range(1, _SETS):
        cost = 0.0
        weight = room.likelihood[index] if index >> a & 1 else -np.inf
        for b in range(4):
            if index >> b & 1 and b != a:
                cost += room.penalties[index, b]
        room.weights[index, 0] = weight - cost
        room.weights[index, 1] = weight if cost == 0.0 else -np.inf
        best = max(best, room.weights[index, 0])
        positive = max(positive, room.weights[index, 1])
    for index in range(1, _SETS):
        room.weights[index, 0] = math.exp(room.weights[index, 0] - best)
        room.weights[index, 1] = math.exp(room.weights[index, 1] - positive)
    return positive > -np.inf


@njit(**INNER)
def _best_likelihood(a, has_term, room):  # type: ignore[no-untyped-def]
    """Find the largest likelihood of the feasible sets with the term `a`, or without it."""
    best = -np.inf
    for index in range(1, _SETS):
        if (index >> a & 1) == has_term:
            best = max(best, room.feasible[index])
    return best


@njit(**INNER)
def _average_estimates(a, column, room):  # type: ignore[no-untyped-def]
    """Average the estimates of a term with one of the weights: mean, and variance between sets."""
    total = mean = square = 0.0
    for index in range(1, _SETS):
        weight, estimate = room.weights[index, column], room.estimates[index, a]
        if weight > 0.0:
            total += weight
            mean += weight * estimate
            square += weight * estimate * estimate
    mean /= total
    return mean, max(square / total - mean * mean, 0.0)


@njit(**INNER)
def _average_forms(a, room):  # type: ignore[no-untyped-def]
    """Average the quadratic form that turns a covariance of the data into a variance of a term."""
    form, total = room.form, 0.0
    for entry in range(10):
        form[entry] = 0.0
    for index in range(1, _SETS):
        weight, row = room.weights[index, 1], room.rows[index, a]
        if not weight > 0.0:
            continue
        total += weight
        entry = 0
        for c in range(4):
            for d in range(c, 4):
                form[entry] += weight * row[c] * row[d] * (1.0 if c == d else 2.0)
                entry += 1
    for entry in range(10):
        form[entry] /= total


@njit(**INNER)
def _expand_variance(a, base, room):  # type: ignore[no-untyped-def]
    """Expand the variance of a term as a polynomial in its square, others as in `base`."""
    null = linear = quadratic = 0.0
    table = np.int64(0)
    for b in range(4):
        for c in range(b, 5):
            value = 0.0
            for entry in range(10):
                value += room.form[entry] * room.products[table, entry]
            if b == a and c == a:
                quadratic = value
            elif b == a or c == a:
                linear += value * base[c if b == a else b]
            else:
                null += value * base[b] * base[c]
            table += 1
    return null, linear, quadratic


@njit(**INNER)
def _multiply_covariance(row, room):  # type: ignore[no-untyped-def]
    """Multiply ``room.covariance`` by a row on the data."""
    for c in range(4):
        room.image[c] = 0.0
    entry = 0
    for c in range(4):
        for d in range(c, 4):
            value = room.covariance[entry]
            room.image[c] += value * row[d]
            if d != c:
                room.image[d] += value * row[c]
            entry += 1


@njit(**INNER)
def _multiply_rows(row, other):  # type: ignore[no-untyped-def]
    return row[0] * other[0] + row[1] * other[1] + row[2] * other[2] + row[3] * other[3]


@njit(**INNER)
def _weigh_low_end(a, base, low_sigma, room):  # type: ignore[no-untyped-def]
    """Turn the weights in the variance of a term into those at its lower end; whether any has one.

    To ``room.squares`` go the squares with the term at its lower end: those of `base`, more where
    another term would replace a part of it.
    """
    total = mean = variance_sum = variance = 0.0
    for b in range(4):
        room.shared[b] = 0.0
    for index in range(1, _SETS):
        if not room.weights[index, 0] > 0.0:
            continue
        _multiply_covariance(room.rows[index, a], room)
        for b in range(4):
            if index >> b & 1:
                shared = _multiply_rows(room.rows[index, b], room.image)
                room.shared[b] += room.weights[index, 0] * shared
                variance = shared if b == a else variance
        room.weights[index, 1] *= variance * variance
        total += room.weights[index, 1]
        mean += room.weights[index, 1] * room.estimates[index, a]
        variance_sum += room.weights[index, 1] * variance
    if not total > 0.0:
        return False
    fall = min(max(mean / total, 0.0), low_sigma * math.sqrt(variance_sum / total))
    for b in range(4):
        room.squares[b] = base[b] + max(-room.shared[b] / room.shared[a], 0.0) * fall
    room.squares[4] = base[4]
    return True


@njit(**INNER)
def _write_law(a, column, base, room, result, row):  # type: ignore[no-untyped-def]
    """Write estimate and variance of a term under the squares `base` (5,), from a row on."""
    mean, between = _average_estimates(a, column, room)
    _average_forms(a, room)
    null, linear, quadratic = _expand_variance(a, base, room)
    scale = room.scale[a]
    result[row, a], result[row + 1, a] = mean / scale, (null + between) / scale**2
    result[row + 2, a], result[row + 3, a] = linear / scale, quadratic


@njit(**INNER)
def _repeat_law(a, result):  # type: ignore[no-untyped-def]
    """Take estimate and variance of a term for the lower end of its interval too."""
    for row in range(4):
        result[_LOW_LAW + row, a] = result[_LAW + row, a]


@njit(**INNER)
def _judge_term(a, base, low_sigma, room, result):  # type: ignore[no-untyped-def]
    """Write likelihood ratio and both laws of a term under the squares `base` (5,)."""
    if not _weigh_sets(a, room):
        return
    present, absent = _best_likelihood(a, np.int64(1), room), _best_likelihood(a, np.int64(0), room)
    result[1, a] = 2.0 * (present - absent) if present > -np.inf else 0.0
    _write_law(a, _IN_MEAN, base, room, result, _LAW)
    if _weigh_low_end(a, base, low_sigma, room):
        _write_law(a, _IN_VARIANCE, room.squares, room, result, _LOW_LAW)
    else:
        _repeat_law(a, result)


@njit(**INNER)
def _average_sets(room, base, result):  # type: ignore[no-untyped-def]
    """Average squares and variance of the trend over the feasible sets."""
    best = -np.inf
    for index in range(1, _SETS):
        best = max(best, room.feasible[index])
    total = mean = square = 0.0
    for index in range(1, _SETS):
        if room.feasible[index] > -np.inf:
            weight = math.exp(room.feasible[index] - best)
            total += weight
            for a in range(4):
                base[a] += weight * room.estimates[index, a]
            slope, variance = room.slope[index, 0], room.slope[index, 1]
            mean += weight * slope
            square += weight * (slope * slope + variance)
    if total > 0.0:
        for a in range(4):
            base[a] /= total
        mean /= total
        result[3, 4], result[4, 4] = mean, max(square / total - mean * mean, 0.0)
    else:
        result[3, 4] = result[4, 4] = 0.0


@njit(**INNER)
def _find_separations(allowed, members, room, result):  # type: ignore[no-untyped-def]
    """Find the share of the column of each term that the other terms cannot reproduce."""
    inner, size = room.inner, np.int64(0)
    for a in range(4):
        if allowed >> a & 1:
            members[size] = a
            size += 1
    for p in range(size):
        for q in range(p + 1):
            inner[p, q] = room.normal[members[p], members[q]]
        inner[p, p] *= 1.0 + 1e-12
    solvable = _invert_matrix(inner, size)
    for p in range(size):
        result[10, members[p]] = 1.0 / max(inner[p, p], 1.0) if solvable else 0.0


@njit(**INNER)
def _scale_window(allowed, room):  # type: ignore[no-untyped-def]
    """Scale the window to a normal matrix with a unit diagonal; returns the terms with a column.

    What belongs to other terms becomes zero.
    """
    for a in range(4):
        diagonal = room.normal[a, a]
        if not diagonal > 0.0:
            allowed &= ~(1 << a)
        room.scale[a] = math.sqrt(diagonal) if allowed >> a & 1 else np.inf
    table = 0
    for a in range(4):
        room.data[a] /= room.scale[a]
        for b in range(4):
            room.normal[a, b] /= room.scale[a] * room.scale[b]
        room.trend[a] /= room.scale[a]
        for b in range(a, 5):
            share = room.scale[a] * (room.scale[b] if b < 4 else 1.0)
            entry = 0
            for c in range(4):
                for d in range(c, 4):
                    room.products[table, entry] /= share * room.scale[c] * room.scale[d]
                    entry += 1
            table += 1
    return allowed


@njit(**INNER)
def average_submodels(allowed, start, trend_square, low_sigma, room, result):  # type: ignore[no-untyped-def]
    """Average one window over the submodels.

    Parameters
    ----------
    allowed : int
        Bit set of the terms; bit 4 is the ramp.
    start : float64 (4,)
        Squared coefficients of the non-negative fit, where the iterations begin; overwritten.
    trend_square : float64
        Squared trend of the window.
    low_sigma : float
        Standard errors from an estimate to the lower end of its interval.
    room : Submodels
        With ``data``, ``normal``, ``products`` and ``trend`` of the window, which are scaled here.
    result : float64 (11, 5)
        Rows as `FIT_FIELDS`: squared coefficient, averaged over all submodels; twice the log of the
        likelihood ratio of the best submodels with and without the term; average of the coefficient
        over those with the term, where it may be negative; its variance without the term, its
        growth per unit of the square, per unit of its square; average and variance again, for the
        lower end of an interval; share of the column that the other terms
        cannot reproduce. For a ramp, rows 3 and 4 are the variance of the trend under the other
        terms and the variance of that.
    """
    allowed = _scale_window(allowed, room)
    base, members = np.zeros(5), np.empty(4, np.int64)
    base[4] = trend_square
    for a in range(4):
        start[a] = start[a] * room.scale[a] if allowed >> a & 1 else 0.0
        base[4] -= room.trend[a] * start[a]
    base[4] = max(base[4], 0.0)
    for index in range(1, _SETS):
        room.likelihood[index] = room.feasible[index] = -np.inf
        if not index & ~allowed:
            _fit_set(members, index, start, base[4], room)
    _average_sets(room, base, result)
    _mix_products(room.products, base, room.covariance)
    for a in range(4):
        if allowed >> a & 1:
            result[0, a] = base[a] / room.scale[a]
            _judge_term(a, base, low_sigma, room, result)
    _find_separations(allowed, members, room, result)
    if allowed >> 4 & 1:
        result[0, 4] = max(trend_square - result[3, 4], 0.0)
        result[_LAW, 4] = trend_square
        result[1, 4] = result[5, 4] = 0.0
        _repeat_law(np.int64(4), result)
        result[10, 4] = 1.0
