"""Degrees of freedom of the cells of windows, from the squared coefficients of their noise."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.compiled import INNER, KERNEL


def combine_diagonal(pairs: Floats, ramps: Floats, strides: Ints) -> Floats:
    """Combine the diagonals (4, 4, n_tau) and (4, n_tau) of `product_tables`: (15, n_tau).

    Last is what the `strides` of pairs of clusters add to the product of quantization noise with
    itself, which has a covariance at single lags only.
    """
    rows: list[Floats] = []
    for a in range(4):
        rows += [pairs[a, b] * (1.0 if a == b else 2.0) for b in range(a, 4)]
        rows.append(ramps[a])
    rows.append((strides - 1.0) * pairs[0, 0])
    return np.stack(rows)


@njit(**INNER)
def degrees_of_freedom(squares, curves, w, terms, to_samples, diagonal, out):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of each finite cell of window w, ``2 mean^2 / variance``.

    `terms` (5, n_tau) is the Allan variance per squared coefficient. The sum over pairs of terms is
    written out, which takes half of the time of a loop.
    """
    row = min(w, curves.white.shape[0] - 1)
    avar, white, quantization = curves.avar[w], curves.white[row], curves.quantization[row]
    ramp, factor = curves.ramp[row], curves.factor[row]
    s0, s1, s2, s3, s4 = squares[0], squares[1], squares[2], squares[3], squares[4]
    a2, a3 = s2 * to_samples[2], s3 * to_samples[3]
    d = diagonal
    for i in range(avar.size):
        relative = terms[0, i] / terms[1, i]
        excess = max(quantization[i] - 1.0, 0.0) * relative
        a0 = s0 * min(quantization[i], 1.0) * to_samples[0]
        a1 = (s1 * white[i] + s0 * excess) * to_samples[1]
        a4 = s4 * ramp[i] * to_samples[4]
        mean = s0 * quantization[i] * terms[0, i] + s1 * white[i] * terms[1, i]
        mean += s2 * terms[2, i] + s3 * terms[3, i] + s4 * ramp[i] * terms[4, i]
        variance = a0 * (a0 * d[0, i] + a1 * d[1, i] + a2 * d[2, i] + a3 * d[3, i] + a4 * d[4, i])
        variance += a1 * (a1 * d[5, i] + a2 * d[6, i] + a3 * d[7, i] + a4 * d[8, i])
        variance += a2 * (a2 * d[9, i] + a3 * d[10, i] + a4 * d[11, i])
        variance += a3 * (a3 * d[12, i] + a4 * d[13, i])
        # see `gyrostab.kernels.fit.mixture.describe_gaps`
        jumps = s0 * s0 * excess * relative * to_samples[1] * to_samples[1]
        variance += jumps * d[5, i] * factor[i]
        variance += a0 * a0 * d[14, i] if white[i] > 1.0 else 0.0
        dof = 2.0 * mean * mean / variance * factor[i] if variance > 0.0 else 0.0
        out[i] = dof if np.isfinite(avar[i]) else out[i]


@njit(**KERNEL)
def cell_freedoms(squares, curves, columns, to_samples, diagonal):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of each cell from the squared coefficients of its window.

    Parameters
    ----------
    squares : float64 (n_windows, 5)
        Squared coefficients.
    curves, columns, to_samples
        As for `identify_noise`.
    diagonal : float64 (15, n_tau)
        Result of `combine_diagonal`.

    Returns
    -------
    float64 (n_windows, n_tau)
        NaN without a variance above zero.
    """
    avar, terms = curves.avar, np.ascontiguousarray(columns.T)
    out = np.empty(avar.shape)
    for w in range(avar.shape[0]):
        degrees_of_freedom(squares[w], curves, w, terms, to_samples, diagonal, out[w])
        shares = curves.factor[min(w, curves.factor.shape[0] - 1)]
        for i in range(avar.shape[1]):
            is_known = avar[w, i] > 0.0 and avar[w, i] < np.inf and shares[i] > 0.0
            out[w, i] = out[w, i] if is_known else np.nan
    return out
