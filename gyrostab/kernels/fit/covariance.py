"""Covariance of overlapping Allan variances between averaging factors, for Gaussian noise.

A second difference is ``d_k[m] = theta[m + 2k] - 2 theta[m + k] + theta[m]``; its covariances
follow from the generalised autocovariance of the angle (Greenhall and Riley, PTTI 2003), in units
of one sample and unit squared coefficient:

    quantization         delta(t)                  Allan variance 3 / k^2
    angle random walk    -|t| / 2                                 1 / k
    bias instability     t^2 ln|t| / (2 pi)                       2 ln 2 / pi
    rate random walk     |t|^3 / 12                               k / 3

By Isserlis' theorem the covariance of two mean squares is twice the mean squared covariance of
their terms. Because the terms add, a mixture of noises needs only the tables of products made here,
once per window length.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import INNER, KERNEL, REORDER

#: Number of stochastic terms: quantization, angle random walk, bias instability, rate random walk.
STOCHASTIC = 4

#: Lags are taken in steps of this share of the shorter factor.
_LAG_STEPS = 32
_FLICKER_FACTOR = 1.0 / (2.0 * math.pi)


@njit(**INNER)
def _smooth_covariance(lag, k1, k2, logarithm, out):  # type: ignore[no-untyped-def]
    """Compute the covariance of d_k1[m] and d_k2[m + lag] over 2 k1 k2, for N, B and K."""
    white = 0.0
    flicker = 0.0
    walk = 0.0
    for i in range(3):
        for j in range(3):
            t = abs(lag + j * k2 - i * k1)
            weight = (-2.0 if i == 1 else 1.0) * (-2.0 if j == 1 else 1.0)
            square = float(t) * t
            white += weight * t
            flicker += weight * square * logarithm[t]
            walk += weight * square * t
    scale = 1.0 / (2.0 * k1 * k2)
    out[1] = -0.5 * white * scale
    out[2] = _FLICKER_FACTOR * flicker * scale
    out[3] = walk / 12.0 * scale


@njit(**INNER)
def _quantization_covariance(lag, k1, k2):  # type: ignore[no-untyped-def]
    """Compute it for white angle noise: nonzero only where points of both differences coincide."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            if lag + j * k2 - i * k1 == 0:
                total += (-2.0 if i == 1 else 1.0) * (-2.0 if j == 1 else 1.0)
    return total / (2.0 * k1 * k2)


@njit(**INNER)
def _count_pairs(lag, n1, n2):  # type: ignore[no-untyped-def]
    """Number of pairs of terms with this lag."""
    return max(0, min(n1, n2 - lag) - max(0, -lag))


@njit(**INNER)
def _add_smooth(window, k1, k2, logarithm, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of N, B and K, whose covariances are smooth in the lag."""
    n1, n2 = window - 2 * k1 + 1, window - 2 * k2 + 1
    r = np.zeros(STOCHASTIC)
    step = max(1, min(k1, k2) // _LAG_STEPS)
    centre = k1 - k2
    reach = min(2 * (k1 + k2), window)
    for lag in range(centre - (reach // step) * step, centre + reach + 1, step):
        weight = _count_pairs(lag, n1, n2) * step
        if weight == 0:
            continue
        _smooth_covariance(lag, k1, k2, logarithm, r)
        for a in range(1, STOCHASTIC):
            means[a] += weight * r[a]
            for b in range(1, STOCHASTIC):
                products[a, b] += weight * r[a] * r[b]


@njit(**INNER)
def _add_quantization(window, k1, k2, thin, logarithm, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of white angle noise with every term: at most nine lags, times `thin`."""
    n1, n2 = window - 2 * k1 + 1, window - 2 * k2 + 1
    r = np.zeros(STOCHASTIC)
    for p in range(9):
        lag = (p // 3) * k1 - (p % 3) * k2
        is_repeated = False
        for q in range(p):
            is_repeated = is_repeated or lag == (q // 3) * k1 - (q % 3) * k2
        weight = _count_pairs(lag, n1, n2) * thin
        if is_repeated or weight == 0:
            continue
        _smooth_covariance(lag, k1, k2, logarithm, r)
        r[0] = _quantization_covariance(lag, k1, k2)
        means[0] += weight * r[0]
        products[0, 0] += weight * r[0] * r[0]
        for b in range(1, STOCHASTIC):
            products[0, b] += weight * r[0] * r[b]
            products[b, 0] += weight * r[0] * r[b]


@njit(**INNER)
def _difference_covariances(k, zero, logarithm, out):  # type: ignore[no-untyped-def]
    """Compute second differences at distance k of three autocovariances; column `zero` is lag 0."""
    for lag in range(out.shape[1] - zero):
        white = 0.0
        flicker = 0.0
        walk = 0.0
        for i in range(3):
            t = abs(lag + (i - 1) * k)
            weight = -2.0 if i == 1 else 1.0
            square = float(t) * t
            white += weight * t
            flicker += weight * square * logarithm[t]
            walk += weight * square * t
        mirrored = zero + (lag if lag > zero else -lag)
        out[0, zero + lag] = out[0, mirrored] = -0.5 * white
        out[1, zero + lag] = out[1, mirrored] = _FLICKER_FACTOR * flicker
        out[2, zero + lag] = out[2, mirrored] = walk / 12.0


@njit(fastmath=REORDER, **INNER)
def _add_every(window, k1, k2, zero, differences, products, means):  # type: ignore[no-untyped-def]
    """What `_add_smooth` adds where it takes every lag, from `_difference_covariances` of k1 <= k2.

    Covariances and numbers of pairs are even about the lag k1 - k2, so half of the lags are enough.
    """
    scale = 1.0 / (2.0 * k1 * k2)
    terms = float(window - 2 * k1 + 1)
    apart = float(k2 - k1)
    reach = min(2 * (k1 + k2), window)
    centre = np.uint64(zero)
    lower, upper = centre - np.uint64(k2), centre + np.uint64(k2)
    white, flicker, walk = differences[0], differences[1], differences[2]
    n = b = k = nn = bb = kk = nb = nk = bk = 0.0
    for u in range(np.uint64(0), np.uint64(reach + 1)):
        lag = float(u)
        weight = max(terms - (apart + lag) - max(apart - lag, 0.0), 0.0) * (
            2.0 if lag > 0.0 else 1.0
        )
        r1 = (white[lower + u] - 2.0 * white[centre + u] + white[upper + u]) * scale
        r2 = (flicker[lower + u] - 2.0 * flicker[centre + u] + flicker[upper + u]) * scale
        r3 = (walk[lower + u] - 2.0 * walk[centre + u] + walk[upper + u]) * scale
        n += weight * r1
        b += weight * r2
        k += weight * r3
        nn += weight * r1 * r1
        bb += weight * r2 * r2
        kk += weight * r3 * r3
        nb += weight * r1 * r2
        nk += weight * r1 * r3
        bk += weight * r2 * r3
    means[1], means[2], means[3] = n, b, k
    products[1, 1], products[2, 2], products[3, 3] = nn, bb, kk
    products[1, 2] = products[2, 1] = nb
    products[1, 3] = products[3, 1] = nk
    products[2, 3] = products[3, 2] = bk


@njit(**INNER)
def _sum_pairs(window, k1, k2, thin, logarithm, zero, differences, products, means):  # type: ignore[no-untyped-def]
    """Average the products ``r_a r_b`` and values ``r_a`` over all pairs of terms."""
    products[:] = 0.0
    means[:] = 0.0
    if differences.size:
        _add_every(window, k1, k2, zero, differences, products, means)
    else:
        _add_smooth(window, k1, k2, logarithm, products, means)
    _add_quantization(window, k1, k2, thin, logarithm, products, means)
    pairs = float(window - 2 * k1 + 1) * (window - 2 * k2 + 1)
    for a in range(STOCHASTIC):
        means[a] /= pairs
        for b in range(STOCHASTIC):
            products[a, b] /= pairs


@njit(**INNER)
def _reached_lags(window, longest):  # type: ignore[no-untyped-def]
    """Number of lags, from 0, at which `_add_every` needs the covariances."""
    return min(2 * (longest + 2 * _LAG_STEPS), window) + longest + 1


@njit(**KERNEL)
def _fill_tables(window, ks, shifts, diagonal, logarithm):  # type: ignore[no-untyped-def]
    """Fill `product_tables`, or only the diagonals (4, 4, n_tau, 1) and (4, n_tau, 1)."""
    n_tau = ks.size
    width = 1 if diagonal else n_tau
    products = np.zeros((STOCHASTIC, STOCHASTIC, n_tau, width))
    means = np.zeros((STOCHASTIC, n_tau, width))
    pair_products, mean = np.empty((STOCHASTIC, STOCHASTIC)), np.empty(STOCHASTIC)
    zero, lags = ks[-1], _reached_lags(window, ks[-1])
    room = np.empty((3, 0 if diagonal else zero + lags))
    for i in range(n_tau):
        differences = room if ks[i] < 2 * _LAG_STEPS else room[:, :0].copy()
        if differences.size:
            _difference_covariances(ks[i], zero, logarithm, differences)
        for j in range(i, i + 1 if diagonal else n_tau):
            thin = 1 << min(shifts[i], shifts[j])
            _sum_pairs(
                window, ks[i], ks[j], thin, logarithm, zero, differences, pair_products, mean
            )
            row, column = (i, 0) if diagonal else (j, i)
            for a in range(STOCHASTIC):
                means[a, i, 0 if diagonal else j] = means[a, row, column] = mean[a]
                for b in range(STOCHASTIC):
                    value = pair_products[a, b]
                    products[a, b, i, 0 if diagonal else j] = products[a, b, row, column] = value
    return products, means


def product_tables(
    window: int, ks: NDArray[np.int64], shifts: NDArray[np.int64], *, diagonal: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tabulate the covariance of Allan variances per product of squares, and with a ramp.

    Parameters
    ----------
    window : int
        Samples of the window; averaging factor k has ``window - 2k + 1`` terms.
    ks : int64 (n_tau,)
        Averaging factors, rising, at most ``window // 2``.
    shifts : int64 (n_tau,)
        Thinning of the terms (every ``2**shift``-th is used).
    diagonal : bool
        Compute only the diagonals: (4, 4, n_tau) and (4, n_tau).

    Returns
    -------
    pairs : ndarray (4, 4, n_tau, n_tau)
        ``P[a, b]``, such that noise with squared coefficients s (in sample units) gives estimates
        with the covariance ``sum_ab s[a] s[b] P[a, b]``.
    ramps : ndarray (4, n_tau, n_tau)
        ``D[a]``, such that a rate that grows by rho per sample adds ``rho^2 sum_a s[a] D[a]``.
    """
    factors = ks.astype(np.float64)
    products, means = _fill_tables(window, ks, shifts, diagonal, _log_lags(window, int(ks[-1])))
    if diagonal:
        return 2.0 * products[..., 0], 2.0 * factors**2 * means[..., 0]
    return 2.0 * products, 2.0 * factors[:, None] * factors * means


def _log_lags(window: int, longest: int) -> NDArray[np.float64]:
    """``ln t`` for every lag that can occur, 0 at t = 0."""
    lags = max(window, _reached_lags.py_func(window, longest) + 2 * _LAG_STEPS)
    t = np.arange(lags + 1, dtype=np.float64)
    t[0] = 1.0
    return np.log(t, out=t)
