"""Evidence for designs of unknown size, from products of whitened data and designs.

A design has columns x with unknown factors beta. The prior of beta is a mixture of normal
distributions of several widths; with eigenvalues of ``x' x`` the marginal likelihood of each width
is a sum.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.compiled import INNER, KERNEL, REORDER

#: What is this much less likely than the best, as a logarithm, adds nothing that counts: it is
#: taken for so likely.
_NEGLIGIBLE = 40.0
#: Taylor coefficients of the exponential, the highest power first. The terms left out change the
#: 128th power of the series by at most 3e-16 between -40 and 0.
_EXPONENTIAL_SERIES = tuple(1.0 / math.factorial(n) for n in range(7, -1, -1))


@njit(fastmath=REORDER, **INNER)
def _take_exponentials(values):  # type: ignore[no-untyped-def]
    """Replace values from -40 to 0 by their exponentials, to an error of 2e-14 (rounding).

    The 128th power of a Taylor series takes only products and sums, which become vector code; the
    exponential of the mathematical library is several times slower without AVX-512.
    """
    for i in range(values.size):
        x = values[i] / 128.0
        power = 0.0
        for coefficient in _EXPONENTIAL_SERIES:
            power = power * x + coefficient
        for _ in range(7):
            power *= power
        values[i] = power


@njit(fastmath=REORDER, **INNER)
def _write_terms(base, rotated, eigenvalues, widths, terms):  # type: ignore[no-untyped-def]
    """Write the log terms of the mixture (grid x width, record) for one design."""
    grid, p, records = rotated.shape
    square = np.empty((p, records))
    for g in range(grid):
        for j in range(p):
            for r in range(records):
                square[j, r] = rotated[g, j, r] * rotated[g, j, r]
        for k in range(widths.size):
            term = terms[g * widths.size + k]
            constant = 0.0
            for j in range(p):
                constant -= 0.5 * np.log(1.0 + widths[k] * eigenvalues[g, j])
            for r in range(records):
                term[r] = base[g, r] + constant
            for j in range(p):
                share = 0.5 * widths[k] / (1.0 + widths[k] * eigenvalues[g, j])
                for r in range(records):
                    term[r] += share * square[j, r]


@njit(fastmath=REORDER, **INNER)
def _subtract_largest(terms, largest):  # type: ignore[no-untyped-def]
    """Subtract from the terms (term, record) the largest of each record, and write it."""
    largest[:] = -np.inf
    for term in terms:
        for r in range(largest.size):
            largest[r] = term[r] if term[r] > largest[r] else largest[r]
    for term in terms:
        for r in range(largest.size):
            below = term[r] - largest[r]
            term[r] = below if below > -_NEGLIGIBLE else -_NEGLIGIBLE


@njit(fastmath=REORDER, **KERNEL)
def mixed_evidence(base: Floats, rotated: Floats, eigenvalues: Floats, widths: Floats) -> Floats:
    """Compute the log marginal likelihood of every design and record over a grid of laws.

    Parameters
    ----------
    base : ndarray, shape (grid, record)
        Log likelihood without the design, with the weight of the grid point.
    rotated : ndarray, shape (grid, design, p, record)
        ``x' y`` in the frame of the eigenvectors of ``x' x``.
    eigenvalues : ndarray, shape (grid, design, p)
        Of ``x' x``.
    widths : ndarray, shape (width,)
        Variances of the factors.

    Returns
    -------
    ndarray, shape (design, record)
    """
    grid, designs, _, records = rotated.shape
    out = np.empty((designs, records))
    terms, total = np.empty((grid * widths.size, records)), np.empty(records)
    for d in range(designs):
        _write_terms(base, rotated[:, d], eigenvalues[:, d], widths, terms)
        _subtract_largest(terms, out[d])
        _take_exponentials(terms.ravel())
        total[:] = 0.0
        for term in terms:
            for r in range(records):
                total[r] += term[r]
        for r in range(records):
            out[d, r] += np.log(total[r] / widths.size)
    return out


@njit(fastmath=REORDER, **KERNEL)
def row_products(rows: Floats, first: Ints, second: Ints) -> Floats:
    """Sum products of pairs of rows, ``rows[first[q]] @ rows[second[q]]``."""
    out = np.empty(first.size)
    for q in range(first.size):
        own, other = rows[first[q]], rows[second[q]]
        total = 0.0
        for i in range(own.size):
            total += own[i] * other[i]
        out[q] = total
    return out
