"""Small dense linear algebra: Cholesky factors, and least squares with coefficients that cannot be negative.

The non-negative solution is exact: of five terms there are at most 31 subsets, and all are tried.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["cholesky", "solve_lower", "solve_nonnegative", "solve_subset", "solve_upper"]


@njit(nogil=True, cache=True)
def cholesky(matrix, n):  # type: ignore[no-untyped-def]
    """Lower factor in place of the leading n x n block; False when it is not positive definite."""
    for j in range(n):
        for i in range(j, n):
            total = matrix[i, j]
            for p in range(j):
                total -= matrix[i, p] * matrix[j, p]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[j, j] = np.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    return True


@njit(nogil=True, cache=True)
def solve_lower(factor, n, vector):  # type: ignore[no-untyped-def]
    """Solve ``factor x = vector`` in place."""
    for i in range(n):
        total = vector[i]
        for p in range(i):
            total -= factor[i, p] * vector[p]
        vector[i] = total / factor[i, i]


@njit(nogil=True, cache=True)
def solve_upper(factor, n, vector):  # type: ignore[no-untyped-def]
    """Solve ``factor^T x = vector`` in place."""
    for i in range(n - 1, -1, -1):
        total = vector[i]
        for p in range(i + 1, n):
            total -= factor[p, i] * vector[p]
        vector[i] = total / factor[i, i]


@njit(nogil=True, cache=True)
def solve_subset(normal, right, subset, solution):  # type: ignore[no-untyped-def]
    """Solve the normal equations for the terms in the bit set `subset`; False when they cannot be told apart."""
    members = np.empty(right.size, np.int64)
    n = 0
    for a in range(right.size):
        if subset >> a & 1:
            members[n] = a
            n += 1
    factor = np.empty((n, n))
    vector = np.empty(n)
    for i in range(n):
        vector[i] = right[members[i]]
        for j in range(n):
            factor[i, j] = normal[members[i], members[j]]
        factor[i, i] *= 1.0 + 1e-12
    if not cholesky(factor, n):
        return False
    solve_lower(factor, n, vector)
    solve_upper(factor, n, vector)
    solution[:] = 0.0
    for i in range(n):
        solution[members[i]] = vector[i]
    return True


@njit(nogil=True, cache=True)
def solve_nonnegative(normal, right, allowed, solution):  # type: ignore[no-untyped-def]
    """Minimise ``s^T normal s - 2 right^T s`` over ``s >= 0``; returns the bit set of the terms above zero.

    Parameters
    ----------
    normal : float64 (n, n); right : float64 (n,)
        Normal equations.
    allowed : int
        Bit set of the terms that may be used.
    solution : float64 (n,)
        Overwritten with the minimiser.
    """
    n = right.size
    scale = np.empty(n)
    scaled = np.empty((n, n))
    scaled_right = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(normal[i, i]) if normal[i, i] > 0.0 else 0.0
    for i in range(n):
        scaled_right[i] = right[i] * scale[i]
        for j in range(n):
            scaled[i, j] = normal[i, j] * scale[i] * scale[j]
    best = 0.0
    chosen = 0
    trial = np.empty(n)
    solution[:] = 0.0
    for subset in range(1, 1 << n):
        if subset & ~allowed or not solve_subset(scaled, scaled_right, subset, trial):
            continue
        gain = 0.0
        feasible = True
        for i in range(n):
            feasible = feasible and trial[i] >= 0.0
            gain += trial[i] * scaled_right[i]
        if feasible and gain > best:
            best = gain
            chosen = subset
            for i in range(n):
                solution[i] = trial[i] * scale[i]
    return chosen
