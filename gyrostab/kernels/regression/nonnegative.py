"""Non-negative least squares.

The solution is exact: of five terms there are at most 31 subsets, and all are tried.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER, KERNEL


@njit(**INNER)
def _solve_subset(normal, right, subset, solution, work, members):  # type: ignore[no-untyped-def]
    """Solve the normal equations for the terms in the bit set `subset`; False if singular.

    `solution` is zero for the other terms; `work` (n, n) and `members` (n,) are scratch.
    """
    n = 0
    for i in range(members.size):
        if subset >> i & 1:
            members[n] = i
            n += 1
    solution[:] = 0.0
    for i in range(n):  # Cholesky factor and forward solution, row by row
        for j in range(i):
            total = normal[members[i], members[j]]
            for p in range(j):
                total -= work[i, p] * work[j, p]
            work[i, j] = total / work[j, j]
        pivot = normal[members[i], members[i]] * (1.0 + 1e-12)
        total = right[members[i]]
        for p in range(i):
            pivot -= work[i, p] * work[i, p]
            total -= work[i, p] * solution[members[p]]
        if not pivot > 0.0:
            return False
        work[i, i] = np.sqrt(pivot)
        solution[members[i]] = total / work[i, i]
    for i in range(n - 1, -1, -1):
        for p in range(i + 1, n):
            solution[members[i]] -= work[p, i] * solution[members[p]]
        solution[members[i]] /= work[i, i]
    return True


@njit(**KERNEL)
def solve_nonnegative(normal, right, solution):  # type: ignore[no-untyped-def]
    """Minimise ``s^T normal s - 2 right^T s`` over ``s >= 0``.

    Parameters
    ----------
    normal : float64 (n, n); right : float64 (n,)
        Normal equations.
    solution : float64 (n,)
        Overwritten with the minimiser.
    """
    n = right.size
    room, members = np.empty((2 * n + 3, n)), np.empty(n, np.int64)
    scaled = room[:n]
    work = room[n : 2 * n]
    scale = room[2 * n]
    scaled_right = room[2 * n + 1]
    trial = room[2 * n + 2]
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(normal[i, i]) if normal[i, i] > 0.0 else 0.0
    for i in range(n):
        scaled_right[i] = right[i] * scale[i]
        for j in range(n):
            scaled[i, j] = normal[i, j] * scale[i] * scale[j]
    best = 0.0
    solution[:] = 0.0
    for subset in range(1, 1 << n):
        if not _solve_subset(scaled, scaled_right, subset, trial, work, members):
            continue
        gain = 0.0
        feasible = True
        for i in range(n):
            feasible = feasible and trial[i] >= 0.0
            gain += trial[i] * scaled_right[i]
        if feasible and gain > best:
            best = gain
            for i in range(n):
                solution[i] = trial[i] * scale[i]
