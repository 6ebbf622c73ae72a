"""Eight windows as mixtures of noise terms: response of each cell, and covariance of the cells.

All arrays are arrays of `gyrostab.kernels.fit.eights`, with one window in each place. A cell that
is missing, or that pads the averaging factors, has neither noise nor signal (all zeros), so that
every window has the same shape.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.fit.lanes import number, put, root, take, where_above

__all__ = [
    "DATA",
    "PRODUCTS",
    "WIDTH",
    "combine_products",
    "covariance_rows",
    "degrees_of_freedom",
    "observe",
    "root_squares",
    "root_units",
    "variance_parts",
]

#: Products of the four stochastic terms with each other and with a ramp, which does not scatter
#: alone: (a, b) for a in 0..3 and b in a..4.
PRODUCTS = 14
#: Column of the data behind those of the five terms in a system of equations.
DATA = 5
#: Columns of such a system.
WIDTH = 6
#: Row of `seen` that holds the unit of each term.
_SEEN = (0, 1, 3, 4, 5)
#: Number of the product of two terms among the tables; that of a ramp with itself, which there is
#: not, gives any.
_TABLE = (
    (0, 1, 2, 3, 4),
    (1, 5, 6, 7, 8),
    (2, 6, 9, 10, 11),
    (3, 7, 10, 12, 13),
    (4, 8, 11, 13, 13),
)


@njit(**INNER)
def combine_products(pairs, ramps, n, tables):  # type: ignore[no-untyped-def]
    """Combine the products of terms for the upper triangle of cells, flat (n, n, `PRODUCTS`)."""
    for i in range(pairs.shape[2]):
        for j in range(i, pairs.shape[2]):
            table = PRODUCTS * (i * n + j)
            for a in range(4):
                for b in range(a, 5):
                    tables[table] = (
                        ramps[a, i, j] if b == 4 else pairs[a, b, i, j] * (1.0 if a == b else 2.0)
                    )
                    table += 1


@njit(**INNER)
def observe(  # type: ignore[no-untyped-def]
    avar,
    white,
    quantization,
    ramp,
    factor,
    columns,
    to_samples,
    place,
    system,
    seen,
    inverse,
    facts,
):
    """Describe the cells of a window in one place; returns how many are valid.

    Design matrix and data go to `system` (row ``6 cell + column``); what a unit of each squared
    coefficient is in sample units, as the cell sees it through the gaps, to `seen` (``6 cell +
    row``); the reciprocal of `factor` to `inverse`. What the gaps add to quantization noise comes
    from the ends of many runs spread over each cluster, so it scatters like white noise and is
    counted there (row 2). To `facts` go the columns of Q over N at the shortest valid averaging
    time (row 0), of B over K (2) and of R over K (4) at the longest, and the most that gaps add to
    quantization noise (5).
    """
    n, last = 0, 0
    for fact in range(6):
        facts[fact, place] = 0.0
    for i in range(inverse.shape[0]):
        here = i < avar.size and np.isfinite(avar[i]) and avar[i] > 0.0 and factor[i] > 0.0
        inverse[i, place] = 1.0
        for row in range(WIDTH * i, WIDTH * i + WIDTH):
            system[row, place] = seen[row, place] = 0.0
        if not here:
            continue
        at = WIDTH * i
        for a in range(5):
            system[at + a, place] = columns[i, a]
        system[at, place] *= quantization[i]
        system[at + 1, place] *= white[i]
        system[at + 4, place] *= ramp[i]
        system[at + DATA, place] = avar[i]
        seen[at, place] = min(quantization[i], 1.0) * to_samples[0]
        seen[at + 1, place] = white[i] * to_samples[1]
        seen[at + 2, place] = (
            max(quantization[i] - 1.0, 0.0) * columns[i, 0] / columns[i, 1] * to_samples[1]
        )
        seen[at + 3, place] = to_samples[2]
        seen[at + 4, place] = to_samples[3]
        seen[at + 5, place] = ramp[i] * to_samples[4]
        inverse[i, place] = 1.0 / factor[i]
        facts[5, place] = max(facts[5, place], seen[at + 2, place])
        if n == 0:
            facts[0, place] = system[at, place] / system[at + 1, place]
        n, last = n + 1, at
    if n > 0:
        facts[2, place] = system[last + 2, place] / system[last + 3, place]
        facts[4, place] = system[last + 4, place] / system[last + 3, place]
    return n


@njit(**INNER)
def root_units(seen, units):  # type: ignore[no-untyped-def]
    """Compute the roots of unit squared coefficients in sample units: row ``5 cell + term``."""
    for i in range(seen.shape[0] // 6):
        for a in range(5):
            put(units, 5 * i + a, root(take(seen, 6 * i + _SEEN[a])))


@njit(**INNER)
def root_squares(squares, seen, units, roots):  # type: ignore[no-untyped-def]
    """Compute the roots of the squared coefficients in sample units: row ``5 cell + term``."""
    s0, s1 = take(squares, 0), take(squares, 1)
    r0, r2, r3, r4 = (
        root(s0),
        root(take(squares, 2)),
        root(take(squares, 3)),
        root(take(squares, 4)),
    )
    for i in range(seen.shape[0] // 6):
        put(roots, 5 * i, r0 * take(units, 5 * i))
        put(roots, 5 * i + 1, root(s1 * take(seen, 6 * i + 1) + s0 * take(seen, 6 * i + 2)))
        put(roots, 5 * i + 2, r2 * take(units, 5 * i + 2))
        put(roots, 5 * i + 3, r3 * take(units, 5 * i + 3))
        put(roots, 5 * i + 4, r4 * take(units, 5 * i + 4))


@njit(**INNER)
def _sum_products(tables, at, a0, a1, a2, a3, a4):  # type: ignore[no-untyped-def]
    """Compute the covariance of two cells without their share of degrees of freedom."""
    first = (
        a0 * number(tables, at)
        + a1 * number(tables, at + 1)
        + a2 * number(tables, at + 2)
        + a3 * number(tables, at + 3)
    )
    second = (
        a1 * number(tables, at + 5)
        + a2 * number(tables, at + 6)
        + a3 * number(tables, at + 7)
        + a4 * number(tables, at + 8)
    )
    third = (
        a2 * number(tables, at + 9) + a3 * number(tables, at + 10) + a4 * number(tables, at + 11)
    )
    fourth = a3 * number(tables, at + 12) + a4 * number(tables, at + 13)
    return a0 * (first + a4 * number(tables, at + 4)) + a1 * second + a2 * third + a3 * fourth


@njit(**INNER)
def _multiply_roots(roots, i, j):  # type: ignore[no-untyped-def]
    """Multiply the roots of two cells, term by term."""
    return (
        take(roots, 5 * i) * take(roots, 5 * j),
        take(roots, 5 * i + 1) * take(roots, 5 * j + 1),
        take(roots, 5 * i + 2) * take(roots, 5 * j + 2),
        take(roots, 5 * i + 3) * take(roots, 5 * j + 3),
        take(roots, 5 * i + 4) * take(roots, 5 * j + 4),
    )


@njit(**INNER)
def _find_share(inverse, i, j):  # type: ignore[no-untyped-def]
    """Find the share of two cells: the poorer one uses a part of what the richer one uses."""
    own, other = take(inverse, i), take(inverse, j)
    return where_above(own, other, other, own)


@njit(**INNER)
def covariance_rows(roots, inverse, tables, out, width):  # type: ignore[no-untyped-def]
    """Covariance of the cells, on and above the diagonal of `out`, row ``width i + j``."""
    n = inverse.shape[0]
    for i in range(n):
        for j in range(i, n):
            total = _sum_products(tables, PRODUCTS * (i * n + j), *_multiply_roots(roots, i, j))
            put(out, width * i + j, total * _find_share(inverse, i, j))


@njit(**INNER)
def variance_parts(roots, term, units, inverse, tables, weights, out):  # type: ignore[no-untyped-def]
    """Expand the variance of a weighted sum of cells in the squared coefficient of `term`.

    `roots` are those of the noise without the term, `units` those of `root_units`. To the rows of
    `out` go the variance without the term, its growth per unit, and per unit squared.
    """
    n, table = inverse.shape[0], _TABLE[term]
    t0, t1, t2, t3, t4, itself = table[0], table[1], table[2], table[3], table[4], table[term]
    null = take(weights, 0) * 0.0
    linear, square = null, null
    for i in range(n):
        unit, factor = take(units, 5 * i + term), take(weights, i)
        for j in range(i, n):
            at = PRODUCTS * (i * n + j)
            a0, a1, a2, a3, a4 = _multiply_roots(roots, i, j)
            weight = (
                factor * take(weights, j) * _find_share(inverse, i, j) * (1.0 if i == j else 2.0)
            )
            null = null + _sum_products(tables, at, a0, a1, a2, a3, a4) * weight
            step = unit * take(units, 5 * j + term)
            line = (
                a0 * number(tables, at + t0)
                + a1 * number(tables, at + t1)
                + a2 * number(tables, at + t2)
            )
            linear = (
                linear
                + (line + a3 * number(tables, at + t3) + a4 * number(tables, at + t4))
                * step
                * weight
            )
            square = square + step * step * number(tables, at + itself) * weight
    put(out, 0, null)
    put(out, 1, linear)
    put(out, 2, square * (0.0 if term == 4 else 1.0))


@njit(**INNER)
def degrees_of_freedom(  # type: ignore[no-untyped-def]
    squares, avar, white, quantization, ramp, factor, columns, to_samples, diagonal, out
):
    """Compute the degrees of freedom of each finite cell, ``2 mean^2 / variance``."""
    amounts = np.empty(5)
    for i in range(avar.size):
        if not np.isfinite(avar[i]):
            continue
        mean = squares[0] * quantization[i] * columns[i, 0] + squares[1] * white[i] * columns[i, 1]
        for a in range(2, 5):
            share = ramp[i] if a == 4 else 1.0
            mean += squares[a] * share * columns[i, a]
            amounts[a] = squares[a] * share * to_samples[a]
        excess = max(quantization[i] - 1.0, 0.0) * columns[i, 0] / columns[i, 1]
        amounts[0] = squares[0] * min(quantization[i], 1.0) * to_samples[0]
        amounts[1] = (squares[1] * white[i] + squares[0] * excess) * to_samples[1]
        variance = 0.0
        table = 0
        for a in range(4):
            for b in range(a, 5):
                variance += amounts[a] * amounts[b] * diagonal[i, table]
                table += 1
        out[i] = 2.0 * mean * mean / variance * factor[i] if variance > 0.0 else 0.0
