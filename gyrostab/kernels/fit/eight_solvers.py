"""Linear algebra of eight small problems at once: elimination, non-negative least squares.

Matrices and vectors are arrays of `gyrostab.kernels.fit.lanes`; element (i, j) of a matrix of w
columns is row ``w i + j``. A set of terms is one row per term: above one half in the places whose
problem has the term. What `gyrostab.kernels.regression.nonnegative` does for one problem is done
here for eight that differ in their sets.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.fit.lanes import put, root, take, take_four, where_above

#: Terms at most, of which a problem has a set.
_TERMS = 5


@njit(**INNER)
def _finish_pivot(system, width, p, end, ok):  # type: ignore[no-untyped-def]
    """Scale row p of a group of four that ends before `end`, and subtract it from those below."""
    pivot = take(system, width * p + p)
    put(ok, 0, where_above(pivot, 0.0, take(ok, 0), 0.0))
    inverse = 1.0 / root(where_above(pivot, 0.0, pivot, 1.0))
    for j in range(width * p + p, width * p + width):
        put(system, j, take(system, j) * inverse)
    for i in range(p + 1, end):
        share = take(system, width * p + i)
        for j in range(i, width):
            put(
                system,
                width * i + j,
                take(system, width * i + j) - share * take(system, width * p + j),
            )


@njit(**INNER)
def eliminate(system, n, width, ok):  # type: ignore[no-untyped-def]
    """Replace ``[C | Y]`` by ``[U | U^-T Y]`` where ``C = U^T U``.

    Parameters
    ----------
    system : eights (n * width,)
        The upper triangle of C, n a multiple of 4, followed by the right-hand sides. Four rows at a
        time are subtracted from four of those below, so that each of these is read and written once
        for the four.
    ok : eights (1,)
        One where C was positive definite, zero where the result is undefined.
    """
    put(ok, 0, 1.0)
    for k in range(0, n, 4):
        for p in range(k, k + 4):
            _finish_pivot(system, width, p, k + 4, ok)
        for i in range(k + 4, n, 2):
            above, below = width * i, width * i + width
            a, b, c, d = take_four(system, width * k + i, width)
            e, f, g, h = take_four(system, width * k + i + 1, width)
            for j in range(i, width):
                s, t, u, v = take_four(system, width * k + j, width)
                put(system, above + j, take(system, above + j) - a * s - b * t - c * u - d * v)
                put(system, below + j, take(system, below + j) - e * s - f * t - g * u - h * v)


@njit(**INNER)
def back_substitute(system, n, width):  # type: ignore[no-untyped-def]
    """Replace the first five right-hand sides Y of an eliminated U by ``U^-1 Y``."""
    for i in range(n - 1, -1, -1):
        at = width * i
        target = at + n
        a, b, c, d = take_four(system, target, np.int64(1))
        e = take(system, target + 4)
        for j in range(i + 1, n):
            share, right = take(system, at + j), width * j + n
            a = a - share * take(system, right)
            b = b - share * take(system, right + 1)
            c = c - share * take(system, right + 2)
            d = d - share * take(system, right + 3)
            e = e - share * take(system, right + 4)
        inverse = 1.0 / take(system, at + i)
        put(system, target, a * inverse)
        put(system, target + 1, b * inverse)
        put(system, target + 2, c * inverse)
        put(system, target + 3, d * inverse)
        put(system, target + 4, e * inverse)


@njit(**INNER)
def scale_equations(normal, scale, scaled):  # type: ignore[no-untyped-def]
    """Scale the normal matrix to a unit diagonal, with the factors in `scale`."""
    for i in range(_TERMS):
        diagonal = take(normal, 6 * i)
        put(scale, i, where_above(diagonal, 0.0, 1.0 / root(diagonal), 0.0))
    for i in range(_TERMS):
        for j in range(_TERMS):
            put(scaled, 5 * i + j, take(normal, 5 * i + j) * take(scale, i) * take(scale, j))


@njit(**INNER)
def solve_terms(scaled, right, terms, solution, work):  # type: ignore[no-untyped-def]
    """Solve the normal equations for a set of terms in each place; 1 where solvable, else 0.

    Parameters
    ----------
    scaled : eights (25,); right : eights (5,)
        Normal equations.
    terms : eights (5,)
        Sets of terms, ones and zeros.
    solution : eights (5,)
        Overwritten, with zero for the terms outside the set.
    work : eights (25,)
        Scratch.
    """
    ok = take(terms, 0) * 0.0 + 1.0
    # Cholesky factor, its diagonal inverted, and forward solution, row by row
    for i in range(_TERMS):
        member = take(terms, i)
        # a term outside the set stands alone
        pivot = take(scaled, 6 * i) * (1.0 + 1e-12) * member + (1.0 - member)
        total = take(right, i) * member
        for j in range(i):
            share = take(scaled, 5 * i + j) * member * take(terms, j)
            for p in range(j):
                share = share - take(work, 5 * i + p) * take(work, 5 * j + p)
            share = share * take(work, 6 * j)
            put(work, 5 * i + j, share)
            pivot = pivot - share * share
            total = total - share * take(solution, j)
        ok = where_above(pivot, 0.0, ok, 0.0)
        inverse = 1.0 / root(where_above(pivot, 0.0, pivot, 1.0))
        put(work, 6 * i, inverse)
        put(solution, i, total * inverse)
    for i in range(_TERMS - 1, -1, -1):
        total = take(solution, i)
        for p in range(i + 1, _TERMS):
            total = total - take(work, 5 * p + i) * take(solution, p)
        put(solution, i, total * take(work, 6 * i))
    return ok


@njit(**INNER)
def solve_nonnegative_eights(normal, right, allowed, terms, squares, room):  # type: ignore[no-untyped-def]
    """Minimise ``s^T normal s - 2 right^T s`` over ``s >= 0`` in each place, by all subsets.

    Parameters
    ----------
    normal : eights (25,); right : eights (5,)
        Normal equations.
    allowed : int
        Bit set of the terms that may be used, in every place.
    terms : eights (5,)
        Overwritten with the terms above zero.
    squares : eights (5,)
        Overwritten with the minimiser.
    room : eights (75,)
        Scratch.
    """
    scaled, work, scale, scaled_right = room[:25], room[25:50], room[50:55], room[55:60]
    solution, trial, tried = room[60:65], room[65:70], room[70:75]
    scale_equations(normal, scale, scaled)
    best = take(scale, 0) * 0.0
    for i in range(_TERMS):
        put(scaled_right, i, take(right, i) * take(scale, i))
        put(terms, i, 0.0)
        put(solution, i, 0.0)
    for subset in range(1, 1 << _TERMS):
        if subset & ~allowed:
            continue
        for i in range(_TERMS):
            put(tried, i, 1.0 if subset >> i & 1 else 0.0)
        feasible = solve_terms(scaled, scaled_right, tried, trial, work)
        gain = best * 0.0
        for i in range(_TERMS):
            feasible = where_above(0.0, take(trial, i), 0.0, feasible)
            gain = gain + take(trial, i) * take(scaled_right, i)
        gain = where_above(feasible, 0.5, gain, 0.0)
        for i in range(_TERMS):
            put(terms, i, where_above(gain, best, take(tried, i), take(terms, i)))
            put(solution, i, where_above(gain, best, take(trial, i), take(solution, i)))
        best = where_above(gain, best, gain, best)
    for i in range(_TERMS):
        put(squares, i, take(solution, i) * take(scale, i))
