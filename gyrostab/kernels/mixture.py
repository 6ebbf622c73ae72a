"""One window as a mixture of noises: what each cell sees of every term, and the covariance of the cells.

A cell that is missing, or that pads the averaging factors to a multiple of `LANES`, is one without noise and without
signal: zeros everywhere. So every window has the same shape.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import INNER
from gyrostab.kernels.nonnegative import REORDER

__all__ = [
    "DATA",
    "LANES",
    "PRODUCTS",
    "combine_products",
    "covariance_rows",
    "degrees_of_freedom",
    "observe",
    "root_squares",
    "variance_parts",
]

#: Numbers that one vector instruction may take; inner loops run over multiples of it.
LANES = 8
#: Products of the four stochastic terms with each other and with a ramp, which has no scatter of its own:
#: (a, b) for a in 0..3 and b in a..4.
PRODUCTS = 14
#: Column of the data behind those of the five terms in a system of equations.
DATA = 5


@njit(**INNER)
def combine_products(pairs, ramps, tables):  # type: ignore[no-untyped-def]
    """Rows of the products of terms on and above the diagonal, both orders of a pair added, to `tables` (n, `PRODUCTS`, n)."""
    for i in range(pairs.shape[2]):
        for j in range(i, pairs.shape[2]):
            table = 0
            for a in range(4):
                for b in range(a, 5):
                    tables[i, table, j] = ramps[a, i, j] if b == 4 else pairs[a, b, i, j] * (1.0 if a == b else 2.0)
                    table += 1


@njit(**INNER)
def observe(avar, white, quantization, ramp, factor, columns, to_samples, system, seen, inverse):  # type: ignore[no-untyped-def]
    """Describe the cells of a window; returns how many are valid.

    Design matrix and data go to `system`; what a unit of each squared coefficient is in sample units, as the cell sees it
    through the gaps, to `seen`; the reciprocal of `factor` to `inverse`. What the gaps add to quantization noise comes
    from the ends of many runs spread over each cluster, so it scatters like white noise and is counted there (row 2).
    """
    n = 0
    system[:] = 0.0
    seen[:] = 0.0
    inverse[:] = 1.0
    for i in range(avar.size):
        if not (np.isfinite(avar[i]) and avar[i] > 0.0 and factor[i] > 0.0):
            continue
        n += 1
        for a in range(5):
            system[i, a] = columns[i, a]
        system[i, 0] *= quantization[i]
        system[i, 1] *= white[i]
        system[i, 4] *= ramp[i]
        system[i, DATA] = avar[i]
        seen[0, i] = min(quantization[i], 1.0) * to_samples[0]
        seen[1, i] = white[i] * to_samples[1]
        seen[2, i] = max(quantization[i] - 1.0, 0.0) * columns[i, 0] / columns[i, 1] * to_samples[1]
        seen[3, i] = to_samples[2]
        seen[4, i] = to_samples[3]
        seen[5, i] = ramp[i] * to_samples[4]
        inverse[i] = 1.0 / factor[i]
    return n


@njit(**INNER)
def root_squares(squares, seen, root):  # type: ignore[no-untyped-def]
    """Square roots of the squared coefficients in sample units, term by term and cell by cell."""
    for i in range(root.shape[1]):
        root[0, i] = np.sqrt(squares[0] * seen[0, i])
        root[1, i] = np.sqrt(squares[1] * seen[1, i] + squares[0] * seen[2, i])
        root[2, i] = np.sqrt(squares[2] * seen[3, i])
        root[3, i] = np.sqrt(squares[3] * seen[4, i])
        root[4, i] = np.sqrt(squares[4] * seen[5, i])


@njit(fastmath=REORDER, **INNER)
def covariance_rows(root, inverse, tables, out):  # type: ignore[no-untyped-def]
    """Covariance of the cells, on and above the diagonal of `out`."""
    n = root.shape[1]
    r0, r1, r2, r3, r4 = root[0], root[1], root[2], root[3], root[4]
    for i in range(n):
        row, line, share = out[i], tables[i], inverse[i]
        p00, p01, p02, p03, p04, p11, p12 = line[0], line[1], line[2], line[3], line[4], line[5], line[6]
        p13, p14, p22, p23, p24, p33, p34 = line[7], line[8], line[9], line[10], line[11], line[12], line[13]
        s0, s1, s2, s3, s4 = r0[i], r1[i], r2[i], r3[i], r4[i]
        for j in range(np.uint64(i & -LANES), np.uint64(n)):
            a0, a1, a2, a3, a4 = s0 * r0[j], s1 * r1[j], s2 * r2[j], s3 * r3[j], s4 * r4[j]
            total = a0 * (a0 * p00[j] + a1 * p01[j] + a2 * p02[j] + a3 * p03[j] + a4 * p04[j])
            total += a1 * (a1 * p11[j] + a2 * p12[j] + a3 * p13[j] + a4 * p14[j])
            total += a2 * (a2 * p22[j] + a3 * p23[j] + a4 * p24[j]) + a3 * (a3 * p33[j] + a4 * p34[j])
            row[j] = total * min(share, inverse[j])  # the poorer cell uses a part of what the richer one uses


@njit(fastmath=REORDER, **INNER)
def variance_parts(root, term, inverse, tables, weights, part, out):  # type: ignore[no-untyped-def]
    """Variance of the cells added with `weights`, their covariance as in `covariance_rows`; `part` is scratch.

    `out` (3,) gets the products in which `term` has no part, one factor and both factors.
    """
    n = root.shape[1]
    out[:] = 0.0
    table = -1
    for a in range(4):
        for b in range(a, 5):
            table += 1
            left, right = root[a], root[b]
            biggest = 0.0
            for j in range(n):
                part[j] = left[j] * right[j] * weights[j]
                biggest = max(biggest, abs(part[j]))
            if biggest == 0.0:
                continue
            total = 0.0
            for i in range(n):
                line, share = tables[i, table], inverse[i]
                dot = -0.5 * line[i] * part[i] * share
                for j in range(np.uint64(i & -LANES), np.uint64(n)):
                    dot += line[j] * part[j] * min(share, inverse[j])
                total += 2.0 * dot * part[i]
            out[(a == term) + (b == term)] += total


@njit(**INNER)
def degrees_of_freedom(squares, avar, white, quantization, ramp, factor, columns, to_samples, diagonal, out):  # type: ignore[no-untyped-def]
    """Equivalent degrees of freedom of each finite cell under a mixture of noises, ``2 mean^2 / variance``."""
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
