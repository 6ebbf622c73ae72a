"""Evidence for designs of unknown size, from products of whitened data and designs.

A design has columns x with unknown factors beta. The prior of beta is a mixture of normal
distributions of several widths; with eigenvalues of ``x' x`` the marginal likelihood of each width
is a sum.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.compiled import KERNEL, REORDER

#: What is this much less likely than the best, as a logarithm, adds nothing that counts: it is
#: taken for so likely.
_NEGLIGIBLE = 40.0


@njit(**KERNEL)
def _mixture_terms(
    base: Floats, rotated: Floats, constant: Floats, share: Floats
) -> tuple[Floats, Floats]:
    """Compute the log terms of the mixture (design, record, width x grid) less their maximum."""
    designs, records, grid, p = rotated.shape
    kinds = constant.shape[1]
    out = np.empty((designs, records, kinds * grid))
    best = np.empty((designs, records))
    square = np.empty((p, grid))
    peak = np.empty(grid)
    for d in range(designs):
        for r in range(records):
            for g in range(grid):
                for j in range(p):
                    square[j, g] = rotated[d, r, g, j] * rotated[d, r, g, j]
            peak[:] = -np.inf
            for k in range(kinds):
                row = out[d, r, k * grid : (k + 1) * grid]
                for g in range(grid):
                    row[g] = base[r, g] + constant[d, k, g]
                for j in range(p):
                    for g in range(grid):
                        row[g] += share[d, k, j, g] * square[j, g]
                for g in range(grid):
                    peak[g] = row[g] if row[g] > peak[g] else peak[g]
            best[d, r] = peak.max()
            for i in range(kinds * grid):
                below = out[d, r, i] - best[d, r]
                out[d, r, i] = below if below > -_NEGLIGIBLE else -_NEGLIGIBLE
    return out, best


def mixed_evidence(base: Floats, rotated: Floats, eigenvalues: Floats, widths: Floats) -> Floats:
    """Compute the log marginal likelihood of every design and record over a grid of laws.

    Parameters
    ----------
    base : ndarray, shape (record, grid)
        Log likelihood without the design, with the weight of the grid point.
    rotated : ndarray, shape (design, record, grid, p)
        ``x' y`` in the frame of the eigenvectors of ``x' x``.
    eigenvalues : ndarray, shape (design, grid, p)
        Of ``x' x``.
    widths : ndarray, shape (width,)
        Variances of the factors.

    Returns
    -------
    ndarray, shape (design, record)
    """
    # (design, width, p, grid)
    spread = 1.0 + widths[:, None, None] * eigenvalues.transpose(0, 2, 1)[:, None]
    share = 0.5 * widths[:, None, None] / spread
    constant = -np.log(widths.size) - 0.5 * np.log(spread).sum(axis=2)
    terms, best = _mixture_terms(base, rotated, constant, share)
    # numpy takes many exponentials at once
    return np.asarray(best + np.log(np.exp(terms, out=terms).sum(axis=2)))


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
