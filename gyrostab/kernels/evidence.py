"""Evidence for designs whose sizes are unknown, by the products of whitened data and designs.

A design has columns x with unknown factors beta. The prior of beta is a mixture of normal distributions of several widths; with
eigenvalues of ``x' x`` the marginal likelihood of each width is a sum.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import KERNEL

__all__ = ["mixed_evidence"]

Array = NDArray[np.float64]
#: What is this much less likely than the best, as a logarithm, adds nothing that counts.
_NEGLIGIBLE = 36.0


@njit(**KERNEL)
def mixed_evidence(base: Array, rotated: Array, eigenvalues: Array, widths: Array) -> Array:
    """Log marginal likelihood of every record over grid points, and widths of the prior, of equal weight.

    Parameters
    ----------
    base : ndarray, shape (record, grid)
        Log likelihood without the design, with the weight of the grid point.
    rotated : ndarray, shape (record, grid, p)
        ``x' y`` in the frame of the eigenvectors of ``x' x``.
    eigenvalues : ndarray, shape (grid, p)
        Of ``x' x``.
    widths : ndarray, shape (width,)
        Variances of the factors.

    Returns
    -------
    ndarray, shape (record,)
    """
    records, grid, p = rotated.shape
    kinds = widths.size
    share = np.empty((grid, kinds, p))
    constant = np.empty((grid, kinds))
    for g in range(grid):
        for k in range(kinds):
            constant[g, k] = -np.log(kinds)
            for j in range(p):
                share[g, k, j] = 0.5 * widths[k] / (1.0 + widths[k] * eigenvalues[g, j])
                constant[g, k] -= 0.5 * np.log1p(widths[k] * eigenvalues[g, j])
    out = np.empty(records)
    terms = np.empty(grid * kinds)
    square = np.empty(p)
    for r in range(records):
        best = -np.inf
        for g in range(grid):
            for j in range(p):
                square[j] = rotated[r, g, j] * rotated[r, g, j]
            for k in range(kinds):
                value = base[r, g] + constant[g, k]
                for j in range(p):
                    value += share[g, k, j] * square[j]
                terms[g * kinds + k] = value
                best = max(best, value)
        total = 0.0
        for i in range(terms.size):
            if terms[i] > best - _NEGLIGIBLE:
                total += np.exp(terms[i] - best)
        out[r] = best + np.log(total)
    return out
