"""Submodels of one window: each set of the terms Q, N, B and K, fitted with its own covariance.

The window is reduced to ``u = A z``, four sums of its cells with ``A = X^T C^-1`` at the fitted
noise. Under squared coefficients s their mean is ``M s`` with ``M = A X``, and their covariance,
``sum_ab s_a s_b T_ab``, is known exactly. A set is fitted by least squares; its estimates may be
negative. `gyrostab.kernels.fit.averages` averages the sets.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.fit.mixture import PRODUCTS

#: Sets of four terms.
SETS = 16
#: Passes in which the covariance of a submodel is updated to that of its estimates.
_PASSES = 3


#: Arrays of `Submodels`.
_SHAPES: dict[str, int | tuple[int, ...]] = {
    "data": 4,
    "normal": (4, 4),
    "products": (PRODUCTS, 10),
    "scale": 4,
    "trend": 5,
    "covariance": 10,
    "whitener": (4, 4),
    "design": (4, 5),
    "inner": (4, 4),
    # Estimates, what negative ones cost, their weights on the data, log-likelihood of each set,
    # also -inf unless all its estimates are positive, mean and variance of the trend's variance;
    # weights of the sets in a mean and a law of scatter.
    "estimates": (SETS, 4),
    "penalties": (SETS, 4),
    "rows": (SETS, 4, 4),
    "likelihood": SETS,
    "feasible": SETS,
    "slope": (SETS, 2),
    "weights": (SETS, 2),
    "squares": 5,
    # Product of the covariance with a row on the data, and covariance of a term with the others.
    "image": 4,
    "shared": 4,
    # Quadratic form that turns a covariance of the data into a variance of a term.
    "form": 10,
}
#: The reduced window, in units in which M has a unit diagonal, and scratch.
Submodels = namedtuple("Submodels", _SHAPES)  # type: ignore[misc]


def make_submodels() -> Submodels:
    """Make the arrays of `Submodels`."""
    return Submodels(*map(np.zeros, _SHAPES.values()))


@njit(**INNER)
def mix_products(products, squares, out):  # type: ignore[no-untyped-def]
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
def fit_set(members, index, start, ramp, room):  # type: ignore[no-untyped-def]
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
        mix_products(room.products, room.squares, room.covariance)
        half = _factor_data(room)
        if not half < np.inf:
            return
        _whiten_columns(members, size, room)
        if not _solve_set(members, size, index, room):
            return
    _describe_set(members, size, index, half, room)


@njit(**INNER)
def find_separations(allowed, members, room, result):  # type: ignore[no-untyped-def]
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
def scale_window(allowed, room):  # type: ignore[no-untyped-def]
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
