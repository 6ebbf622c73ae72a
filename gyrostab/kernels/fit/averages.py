"""Average over the submodels of one window: estimates and the law of their scatter.

The weight of a submodel (`gyrostab.kernels.fit.submodels`) is its Gaussian likelihood, zero if one
of its estimates is not positive. For the estimate of one term, its own sign is free, and a negative
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

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.fit.submodels import (
    SETS,
    find_separations,
    fit_set,
    mix_products,
    scale_window,
)

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


@njit(**INNER)
def _weigh_sets(a, room):  # type: ignore[no-untyped-def]
    """Write the weights of the sets in the mean and in the variance of a term; whether any has one.

    Zero without the term.
    """
    best = positive = -np.inf
    for index in range(1, SETS):
        cost = 0.0
        weight = room.likelihood[index] if index >> a & 1 else -np.inf
        for b in range(4):
            if index >> b & 1 and b != a:
                cost += room.penalties[index, b]
        room.weights[index, 0] = weight - cost
        room.weights[index, 1] = weight if cost == 0.0 else -np.inf
        best = max(best, room.weights[index, 0])
        positive = max(positive, room.weights[index, 1])
    for index in range(1, SETS):
        room.weights[index, 0] = math.exp(room.weights[index, 0] - best)
        room.weights[index, 1] = math.exp(room.weights[index, 1] - positive)
    return positive > -np.inf


@njit(**INNER)
def _best_likelihood(a, has_term, room):  # type: ignore[no-untyped-def]
    """Find the largest likelihood of the feasible sets with the term `a`, or without it."""
    best = -np.inf
    for index in range(1, SETS):
        if (index >> a & 1) == has_term:
            best = max(best, room.feasible[index])
    return best


@njit(**INNER)
def _average_estimates(a, column, room):  # type: ignore[no-untyped-def]
    """Average the estimates of a term with one of the weights: mean, and variance between sets."""
    total = mean = square = 0.0
    for index in range(1, SETS):
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
    for index in range(1, SETS):
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
    for index in range(1, SETS):
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
    for index in range(1, SETS):
        best = max(best, room.feasible[index])
    total = mean = square = 0.0
    for index in range(1, SETS):
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
    allowed = scale_window(allowed, room)
    base, members = np.zeros(5), np.empty(4, np.int64)
    base[4] = trend_square
    for a in range(4):
        start[a] = start[a] * room.scale[a] if allowed >> a & 1 else 0.0
        base[4] -= room.trend[a] * start[a]
    base[4] = max(base[4], 0.0)
    for index in range(1, SETS):
        room.likelihood[index] = room.feasible[index] = -np.inf
        if not index & ~allowed:
            fit_set(members, index, start, base[4], room)
    _average_sets(room, base, result)
    mix_products(room.products, base, room.covariance)
    for a in range(4):
        if allowed >> a & 1:
            result[0, a] = base[a] / room.scale[a]
            _judge_term(a, base, low_sigma, room, result)
    find_separations(allowed, members, room, result)
    if allowed >> 4 & 1:
        result[0, 4] = max(trend_square - result[3, 4], 0.0)
        result[_LAW, 4] = trend_square
        result[1, 4] = result[5, 4] = 0.0
        _repeat_law(np.int64(4), result)
        result[10, 4] = 1.0
