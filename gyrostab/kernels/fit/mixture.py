"""Eight windows as mixtures of noise terms: response of each cell, and covariance of the cells.

All arrays are arrays of `gyrostab.kernels.fit.eights`, with one window in each place. A cell that
is missing, or that pads the averaging factors, has neither noise nor signal (all zeros), so that
every window has the same shape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.fit.lanes import eights, number, put, root, take, take_four, where_above

#: Products of the four stochastic terms with each other and with a ramp, which does not scatter
#: alone: (a, b) for a in 0..3 and b in a..4.
PRODUCTS = 14
#: Column of the data behind those of the five terms in a system of equations.
DATA = 5
#: Columns of such a system.
WIDTH = 6
#: Row of `seen` that holds the unit of each term.
_SEEN = (0, 1, 3, 4, 5)
#: Number of the product of two terms among the tables.
_TABLE = ((0, 1, 2, 3, 4), (1, 5, 6, 7, 8), (2, 6, 9, 10, 11), (3, 7, 10, 12, 13))


class Curves(NamedTuple):
    """Allan variances (n_windows, n_tau), NaN where missing, and what the gaps do to them.

    Responses of N, Q and R, and the share of degrees of freedom left: (n_windows, n_tau), or
    (1, n_tau) where all windows have the same.
    """

    avar: Floats
    white: Floats
    quantization: Floats
    ramp: Floats
    factor: Floats


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
def observe(curves, w, size, trend, columns, to_samples, place, cells):  # type: ignore[no-untyped-def]
    """Describe the first `size` cells of window w in one place; returns how many are valid.

    Design matrix and data, both less the part of the squared trend of the window, go to
    ``cells.system`` (row ``6 cell + column``). `trend` is the variance of the trend per squared
    coefficient (0 to 3), the squared trend (4), and 0 if the product of ramp and noise is removed
    from the cells, else 1 (5). What a unit of each squared coefficient is in sample units, as the
    cell sees it through the gaps, goes to ``cells.responses`` (``6 cell + row``), the Allan
    variance to ``cells.avar``, the reciprocal of `factor` to ``cells.inverse``. What the gaps add
    to quantization noise comes from the ends of many runs spread over each cluster, so it scatters
    like white noise and is counted there (row 2), the most of it in ``cells.excess``.
    """
    system, responses = cells.system, cells.responses
    row = min(w, curves.white.shape[0] - 1)
    avar, white, quantization = curves.avar[w, :size], curves.white[row], curves.quantization[row]
    ramp, factor = curves.ramp[row], curves.factor[row]
    n = 0
    cells.excess[0, place] = 0.0
    for i in range(cells.inverse.shape[0]):
        is_valid = i < avar.size and np.isfinite(avar[i]) and avar[i] > 0.0 and factor[i] > 0.0
        cells.inverse[i, place] = 1.0
        cells.avar[i, place] = 0.0
        for column in range(WIDTH * i, WIDTH * i + WIDTH):
            system[column, place] = responses[column, place] = 0.0
        if not is_valid:
            continue
        at = WIDTH * i
        for a in range(5):
            system[at + a, place] = columns[i, a]
        system[at, place] *= quantization[i]
        system[at + 1, place] *= white[i]
        system[at + 4, place] *= ramp[i]
        for a in range(4):
            system[at + a, place] -= system[at + 4, place] * trend[a]
        system[at + DATA, place] = avar[i] - system[at + 4, place] * trend[4]
        cells.avar[i, place] = avar[i]
        responses[at, place] = min(quantization[i], 1.0) * to_samples[0]
        responses[at + 1, place] = white[i] * to_samples[1]
        responses[at + 2, place] = (
            max(quantization[i] - 1.0, 0.0) * columns[i, 0] / columns[i, 1] * to_samples[1]
        )
        responses[at + 3, place] = to_samples[2]
        responses[at + 4, place] = to_samples[3]
        responses[at + 5, place] = trend[5] * ramp[i] * to_samples[4]
        cells.inverse[i, place] = 1.0 / factor[i]
        cells.excess[0, place] = max(cells.excess[0, place], responses[at + 2, place])
        n += 1
    return n


@njit(**INNER)
def describe_gaps(columns, to_samples, diagonal, cells):  # type: ignore[no-untyped-def]
    """Describe what gaps add to the scatter of quantization noise, per squared coefficient.

    In place of the errors that cancel within a run, every gap adds the difference of the errors at
    its ends. The sample of these jumps is the same at all averaging times, and their mean square
    scatters as that of `(quantization - 1) weight` normal variables, for `weight` degrees of
    freedom of white noise: its standard deviation goes to ``cells.jumps``. Clusters are compared at
    intervals that lose no white noise, but that leave fewer independent errors: the variance that
    this adds to single cells goes to ``cells.thinned``.
    """
    for i in range(columns.shape[0]):
        white_jump = columns[i, 0] / columns[i, 1] * to_samples[1] * diagonal[5, i]
        put(cells.jumps, i, root(take(cells.responses, WIDTH * i + 2) * white_jump))
        own = take(cells.responses, WIDTH * i)
        thinned = own * own * diagonal[14, i] * take(cells.inverse, i)
        white = take(cells.responses, WIDTH * i + 1)  # above that of unbroken runs for clusters
        put(cells.thinned, i, where_above(white, to_samples[1], thinned, 0.0))


@njit(**INNER)
def add_gaps(cells, quantization, out, width):  # type: ignore[no-untyped-def]
    """Add the scatter of `describe_gaps` to `covariance_rows`, for a squared coefficient of Q."""
    square = quantization * quantization
    for i in range(cells.inverse.shape[0]):
        at, jump = width * i, square * take(cells.jumps, i)
        put(out, at + i, take(out, at + i) + square * take(cells.thinned, i))
        for j in range(i, cells.inverse.shape[0]):
            put(out, at + j, take(out, at + j) + jump * take(cells.jumps, j))


@njit(**INNER)
def _compress_gaps(cells, rows, out):  # type: ignore[no-untyped-def]
    """Add the scatter of `describe_gaps` to the product of Q with itself in four weighted sums."""
    sums = eights(np.int64(4))
    for i in range(cells.inverse.shape[0]):
        entry, jump, thinned = 0, take(cells.jumps, i), take(cells.thinned, i)
        for c in range(4):
            row = take(rows, 4 * i + c)
            put(sums, c, take(sums, c) + row * jump)
            for d in range(c, 4):
                put(out, entry, take(out, entry) + thinned * row * take(rows, 4 * i + d))
                entry += 1
    entry = 0
    for c in range(4):
        for d in range(c, 4):
            put(out, entry, take(out, entry) + take(sums, c) * take(sums, d))
            entry += 1


@njit(**INNER)
def root_units(responses, units):  # type: ignore[no-untyped-def]
    """Compute the roots of unit squared coefficients in sample units: row ``5 cell + term``."""
    for i in range(responses.shape[0] // 6):
        for a in range(5):
            put(units, 5 * i + a, root(take(responses, 6 * i + _SEEN[a])))


@njit(**INNER)
def root_squares(squares, responses, units, roots):  # type: ignore[no-untyped-def]
    """Compute the roots of the squared coefficients in sample units: row ``5 cell + term``."""
    s0, s1 = take(squares, 0), take(squares, 1)
    r0 = root(s0)
    r2 = root(take(squares, 2))
    r3 = root(take(squares, 3))
    r4 = root(take(squares, 4))
    for i in range(responses.shape[0] // 6):
        put(roots, 5 * i, r0 * take(units, 5 * i))
        white = s1 * take(responses, 6 * i + 1) + s0 * take(responses, 6 * i + 2)
        put(roots, 5 * i + 1, root(white))
        put(roots, 5 * i + 2, r2 * take(units, 5 * i + 2))
        put(roots, 5 * i + 3, r3 * take(units, 5 * i + 3))
        put(roots, 5 * i + 4, r4 * take(units, 5 * i + 4))


@njit(**INNER)
def sum_products(tables, at, a0, a1, a2, a3, a4):  # type: ignore[no-untyped-def]
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
            total = sum_products(tables, PRODUCTS * (i * n + j), *_multiply_roots(roots, i, j))
            put(out, width * i + j, total * _find_share(inverse, i, j))


@njit(**INNER)
def _add_products(rows, first, second, inverse, tables, table, factor, scaled, out, at):  # type: ignore[no-untyped-def]
    """Add ``factor A C A^T`` to ten rows of `out`, for the part C of one product of two terms.

    `rows` holds the four rows of A (row ``4 cell + row``), `first` and `second` the roots of the
    two terms (row ``cell``).
    """
    n = inverse.shape[0]
    for i in range(n):
        root_product = take(first, i) * take(second, i)
        for c in range(4):
            put(scaled, 4 * i + c, take(rows, 4 * i + c) * root_product)
    for i in range(n):
        diagonal = 0.5 * number(tables, PRODUCTS * (i * n + i) + table) * take(inverse, i)
        s0, s1, s2, s3 = take_four(scaled, 4 * i, np.int64(1))
        a0, a1, a2, a3 = diagonal * s0, diagonal * s1, diagonal * s2, diagonal * s3
        for j in range(i + 1, n):
            share = number(tables, PRODUCTS * (i * n + j) + table) * _find_share(inverse, i, j)
            a0 = a0 + share * take(scaled, 4 * j)
            a1 = a1 + share * take(scaled, 4 * j + 1)
            a2 = a2 + share * take(scaled, 4 * j + 2)
            a3 = a3 + share * take(scaled, 4 * j + 3)
        s0, s1, s2, s3 = factor * s0, factor * s1, factor * s2, factor * s3
        put(out, at, take(out, at) + 2.0 * s0 * a0)
        put(out, at + 1, take(out, at + 1) + s0 * a1 + s1 * a0)
        put(out, at + 2, take(out, at + 2) + s0 * a2 + s2 * a0)
        put(out, at + 3, take(out, at + 3) + s0 * a3 + s3 * a0)
        put(out, at + 4, take(out, at + 4) + 2.0 * s1 * a1)
        put(out, at + 5, take(out, at + 5) + s1 * a2 + s2 * a1)
        put(out, at + 6, take(out, at + 6) + s1 * a3 + s3 * a1)
        put(out, at + 7, take(out, at + 7) + 2.0 * s2 * a2)
        put(out, at + 8, take(out, at + 8) + s2 * a3 + s3 * a2)
        put(out, at + 9, take(out, at + 9) + 2.0 * s3 * a3)


@njit(**INNER)
def compress_products(cells, rows, units, tables, has_excess, out):  # type: ignore[no-untyped-def]
    """Compute ``A C_ab A^T`` for every product (a, b) of terms of the covariance C of the cells.

    A has four weighted sums of the cells (`rows`, row ``4 cell + row``). The result goes to `out`
    (row ``10 product + entry``, entries in the order of the upper triangle). `units` is that of
    `root_units`; `has_excess`: gaps add to quantization noise what counts as white, see `observe`.
    """
    responses, inverse = cells.responses, cells.inverse
    n = inverse.shape[0]
    roots, scaled = eights(6 * n), eights(4 * n)
    for i in range(n):
        for a in range(5):
            put(roots, n * a + i, take(units, 5 * i + a))
        put(roots, n * 5 + i, root(take(responses, WIDTH * i + 2)))
    for row in range(10 * PRODUCTS):
        put(out, row, 0.0)
    for a in range(4):
        for b in range(a, 5):
            table = _TABLE[a][b]
            first, second = roots[n * a : n * a + n], roots[n * b : n * b + n]
            _add_products(rows, first, second, inverse, tables, table, 1.0, scaled, out, 10 * table)
    if not has_excess:
        return
    _compress_gaps(cells, rows, out)
    excess = roots[n * 5 : n * 6]
    square_table, at = np.int64(_TABLE[1][1]), np.int64(0)
    _add_products(rows, excess, excess, inverse, tables, square_table, 1.0, scaled, out, at)
    for b in range(5):
        table, factor = _TABLE[1][b], 2.0 if b == 1 else 1.0
        second = roots[n * b : n * b + n]
        _add_products(rows, excess, second, inverse, tables, table, factor, scaled, out, 10 * b)
