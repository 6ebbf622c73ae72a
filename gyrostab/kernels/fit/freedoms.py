"""Degrees of freedom of the cells of windows, from the squared coefficients of their noise."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.compiled import INNER, KERNEL


def combine_diagonal(pairs: Floats, ramps: Floats, strides: Ints) -> Floats:
    """Combine the diagonals (4, 4, n_tau) and (4, n_tau) of `product_tables`: (n_tau, 15).

    Last is what the `strides` of pairs of clusters add to the product of quantization noise with
    itself, which has a covariance at single lags only.
    """
    columns: list[Floats] = []
    for a in range(4):
        columns += [pairs[a, b] * (1.0 if a == b else 2.0) for b in range(a, 4)]
        columns.append(ramps[a])
    columns.append((strides - 1.0) * pairs[0, 0])
    return np.stack(columns, axis=1)


@njit(**INNER)
def degrees_of_freedom(squares, curves, w, columns, to_samples, diagonal, out):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of each finite cell of window w, ``2 mean^2 / variance``."""
    row = min(w, curves.white.shape[0] - 1)
    avar, white, quantization = curves.avar[w], curves.white[row], curves.quantization[row]
    ramp, factor = curves.ramp[row], curves.factor[row]
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
        # see `gyrostab.kernels.fit.mixture.describe_gaps`
        jumps = squares[0] ** 2 * excess * columns[i, 0] / columns[i, 1] * to_samples[1] ** 2
        variance += jumps * diagonal[i, 5] * factor[i]
        if white[i] > 1.0:
            variance += amounts[0] ** 2 * diagonal[i, 14]
        out[i] = 2.0 * mean * mean / variance * factor[i] if variance > 0.0 else 0.0


@njit(**KERNEL)
def cell_freedoms(squares, curves, columns, to_samples, diagonal):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of each cell from the squared coefficients of its window.

    Parameters
    ----------
    squares : float64 (n_windows, 5)
        Squared coefficients.
    curves, columns, to_samples
        As for `identify_noise`.
    diagonal : float64 (n_tau, 15)
        Result of `combine_diagonal`.

    Returns
    -------
    float64 (n_windows, n_tau)
        NaN without a variance above zero.
    """
    avar = curves.avar
    out = np.empty(avar.shape)
    for w in range(avar.shape[0]):
        degrees_of_freedom(squares[w], curves, w, columns, to_samples, diagonal, out[w])
        shares = curves.factor[min(w, curves.factor.shape[0] - 1)]
        for i in range(avar.shape[1]):
            if not (avar[w, i] > 0.0 and avar[w, i] < np.inf and shares[i] > 0.0):
                out[w, i] = np.nan
    return out
