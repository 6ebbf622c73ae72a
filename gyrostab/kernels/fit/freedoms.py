"""Degrees of freedom of the cells of windows, from the squared coefficients of their noise."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.fit.lanes import PLACES, eights, number, put, take, take_four, where_above
from gyrostab.kernels.fit.mixture import PRODUCTS, sum_products


def combine_diagonal(pairs: NDArray[np.float64], ramps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Combine the diagonals (4, 4, n_tau) and (4, n_tau) of `product_tables`: (n_tau, 14)."""
    columns: list[NDArray[np.float64]] = []
    for a in range(4):
        columns += [pairs[a, b] * (1.0 if a == b else 2.0) for b in range(a, 4)]
        columns.append(ramps[a])
    return np.stack(columns, axis=1)


@njit(**INNER)
def degrees_of_freedom(squares, curves, w, columns, to_samples, diagonal, out):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of each finite cell of window w, ``2 mean^2 / variance``."""
    avar, white, quantization = curves.avar[w], curves.white[w], curves.quantization[w]
    ramp, factor = curves.ramp[w], curves.factor[w]
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


@njit(**INNER)
def _whole_degrees_of_freedom(squares, columns, to_samples, diagonal, freedom, out):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of the cells of up to eight windows without gaps.

    `squares` holds their squared coefficients (row ``term``), `freedom` is scratch; tables are
    flat.
    """
    s0, s1, s2, s3 = take_four(squares, np.int64(0), np.int64(1))
    s4 = take(squares, 4)
    a0 = s0 * number(to_samples, 0)
    a1 = s1 * number(to_samples, 1)
    a2 = s2 * number(to_samples, 2)
    a3 = s3 * number(to_samples, 3)
    a4 = s4 * number(to_samples, 4)
    for i in range(out.shape[1]):
        mean = (
            s0 * number(columns, 5 * i)
            + s1 * number(columns, 5 * i + 1)
            + s2 * number(columns, 5 * i + 2)
            + s3 * number(columns, 5 * i + 3)
            + s4 * number(columns, 5 * i + 4)
        )
        variance = sum_products(diagonal, PRODUCTS * i, a0, a1, a2, a3, a4)
        put(freedom, 0, where_above(variance, 0.0, 2.0 * mean * mean / variance, 0.0))
        for place in range(out.shape[0]):
            out[place, i] = freedom[0, place]


@njit(**KERNEL)
def cell_freedoms(squares, curves, columns, to_samples, diagonal):  # type: ignore[no-untyped-def]
    """Compute the degrees of freedom of each cell from the squared coefficients of its window.

    Parameters
    ----------
    squares : float64 (n_windows, 5)
        Squared coefficients.
    curves, columns, to_samples
        As for `identify_noise`.
    diagonal : float64 (n_tau, 14)
        Result of `combine_diagonal`.

    Returns
    -------
    float64 (n_windows, n_tau)
        NaN without a variance above zero.
    """
    avar = curves.avar
    n_windows, n_tau = avar.shape
    out = np.empty(avar.shape)
    if curves.white.shape[0] == n_windows:
        for w in range(n_windows):
            degrees_of_freedom(squares[w], curves, w, columns, to_samples, diagonal, out[w])
    else:
        eight_squares, lanes = eights(np.int64(5)), eights(np.int64(1))
        columns = columns.ravel()
        diagonal = diagonal.ravel()
        for start in range(0, n_windows, PLACES):
            count = min(PLACES, n_windows - start)
            for place in range(count):
                for a in range(5):
                    eight_squares[a, place] = squares[start + place, a]
            _whole_degrees_of_freedom(
                eight_squares, columns, to_samples, diagonal, lanes, out[start : start + count]
            )
    for w in range(n_windows):
        shares = curves.factor[min(w, curves.factor.shape[0] - 1)]
        for i in range(n_tau):
            if not (avar[w, i] > 0.0 and avar[w, i] < np.inf and shares[i] > 0.0):
                out[w, i] = np.nan
    return out
