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
#: What is this much less likely than the best, as a logarithm, adds nothing that counts: it is taken for so likely.
_NEGLIGIBLE = 40.0


@njit(**KERNEL)
def _terms(base: Array, rotated: Array, constant: Array, share: Array) -> tuple[Array, Array]:
    """Logarithm of every term of the mixture less the largest of its record, (record, width x grid), and that largest one."""
    records, grid, p = rotated.shape
    kinds = constant.shape[0]
    out = np.empty((records, kinds * grid))
    best = np.empty(records)
    square = np.empty((p, grid))
    peak = np.empty(grid)
    for r in range(records):
        for g in range(grid):
            for j in range(p):
                square[j, g] = rotated[r, g, j] * rotated[r, g, j]
        peak[:] = -np.inf
        for k in range(kinds):
            row = out[r, k * grid : (k + 1) * grid]
            for g in range(grid):
                row[g] = base[r, g] + constant[k, g]
            for j in range(p):
                for g in range(grid):
                    row[g] += share[k, j, g] * square[j, g]
            for g in range(grid):
                peak[g] = row[g] if row[g] > peak[g] else peak[g]
        best[r] = peak.max()
        for i in range(kinds * grid):
            below = out[r, i] - best[r]
            out[r, i] = below if below > -_NEGLIGIBLE else -_NEGLIGIBLE
    return out, best


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
    spread = 1.0 + widths[:, None, None] * eigenvalues.T  # (width, p, grid)
    share = 0.5 * widths[:, None, None] / spread
    constant = -np.log(widths.size) - 0.5 * np.log(spread).sum(axis=1)
    terms, best = _terms(base, rotated, constant, share)
    return np.asarray(best + np.log(np.exp(terms, out=terms).sum(axis=1)))  # numpy takes many exponentials at once
