"""Covariance of overlapping Allan variance estimates between averaging factors, exact for Gaussian noise.

A second difference is ``d_k[m] = theta[m + 2k] - 2 theta[m + k] + theta[m]``; its covariances follow from the generalised
autocovariance of the angle (Greenhall and Riley, PTTI 2003), in units of one sample and unit squared coefficient:

    quantization         delta(t)                  Allan variance 3 / k^2
    angle random walk    -|t| / 2                                 1 / k
    bias instability     t^2 ln|t| / (2 pi)                       2 ln 2 / pi
    rate random walk     |t|^3 / 12                               k / 3

By Isserlis' theorem the covariance of two mean squares is twice the mean squared covariance of their terms. Because the
terms add, a mixture of noises needs only the tables of products made here, once per window length.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["STOCHASTIC", "diagonal_products", "pair_products", "ramp_products"]

#: Number of stochastic terms: quantization, angle random walk, bias instability, rate random walk.
STOCHASTIC = 4

_FLICKER = 1.0 / (2.0 * math.pi)


@njit(nogil=True, cache=True)
def _smooth(lag, k1, k2, logarithm, out):  # type: ignore[no-untyped-def]
    """Covariance of d_k1[m] and d_k2[m + lag] over 2 k1 k2, for the terms N, B and K (entries 1..3 of `out`)."""
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
    out[2] = _FLICKER * flicker * scale
    out[3] = walk / 12.0 * scale


@njit(nogil=True, cache=True)
def _quantization(lag, k1, k2):  # type: ignore[no-untyped-def]
    """The same for white angle noise: nonzero only where points of both second differences coincide."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            if lag + j * k2 - i * k1 == 0:
                total += (-2.0 if i == 1 else 1.0) * (-2.0 if j == 1 else 1.0)
    return total / (2.0 * k1 * k2)


@njit(nogil=True, cache=True)
def _weight(lag, n1, n2):  # type: ignore[no-untyped-def]
    """Number of pairs of terms with this lag."""
    return max(0, min(n1, n2 - lag) - max(0, -lag))


@njit(nogil=True, cache=True)
def _add_smooth(window, k1, k2, logarithm, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of the terms N, B and K, whose covariances are smooth in the lag on the scale of the shorter factor."""
    n1, n2 = window - 2 * k1 + 1, window - 2 * k2 + 1
    r = np.zeros(STOCHASTIC)
    step = max(1, min(k1, k2) // 32)
    centre = k1 - k2
    reach = min(2 * (k1 + k2), window)
    for lag in range(centre - (reach // step) * step, centre + reach + 1, step):
        weight = _weight(lag, n1, n2) * step
        if weight == 0:
            continue
        _smooth(lag, k1, k2, logarithm, r)
        for a in range(1, STOCHASTIC):
            means[a] += weight * r[a]
            for b in range(1, STOCHASTIC):
                products[a, b] += weight * r[a] * r[b]


@njit(nogil=True, cache=True)
def _add_quantization(window, k1, k2, thin, logarithm, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of white angle noise with every term: at most nine lags, met `thin` times as often by thinned terms."""
    n1, n2 = window - 2 * k1 + 1, window - 2 * k2 + 1
    r = np.zeros(STOCHASTIC)
    for p in range(9):
        lag = (p // 3) * k1 - (p % 3) * k2
        seen = False
        for q in range(p):
            seen = seen or lag == (q // 3) * k1 - (q % 3) * k2
        weight = _weight(lag, n1, n2) * thin
        if seen or weight == 0:
            continue
        _smooth(lag, k1, k2, logarithm, r)
        r[0] = _quantization(lag, k1, k2)
        means[0] += weight * r[0]
        products[0, 0] += weight * r[0] * r[0]
        for b in range(1, STOCHASTIC):
            products[0, b] += weight * r[0] * r[b]
            products[b, 0] += weight * r[0] * r[b]


@njit(nogil=True, cache=True)
def _sum_pairs(window, k1, k2, thin, logarithm, products, means):  # type: ignore[no-untyped-def]
    """Products ``r_a r_b`` and values ``r_a`` averaged over all pairs of terms."""
    products[:] = 0.0
    means[:] = 0.0
    _add_smooth(window, k1, k2, logarithm, products, means)
    _add_quantization(window, k1, k2, thin, logarithm, products, means)
    pairs = float(window - 2 * k1 + 1) * (window - 2 * k2 + 1)
    for a in range(STOCHASTIC):
        means[a] /= pairs
        for b in range(STOCHASTIC):
            products[a, b] /= pairs


@njit(nogil=True, cache=True)
def _tables(window, ks, shifts, logarithm):  # type: ignore[no-untyped-def]
    n_tau = ks.size
    products = np.zeros((STOCHASTIC, STOCHASTIC, n_tau, n_tau))
    means = np.zeros((STOCHASTIC, n_tau, n_tau))
    one = np.empty((STOCHASTIC, STOCHASTIC))
    mean = np.empty(STOCHASTIC)
    for i in range(n_tau):
        for j in range(i, n_tau):
            _sum_pairs(window, ks[i], ks[j], 1 << min(shifts[i], shifts[j]), logarithm, one, mean)
            for a in range(STOCHASTIC):
                means[a, i, j] = means[a, j, i] = mean[a]
                for b in range(STOCHASTIC):
                    products[a, b, i, j] = products[a, b, j, i] = one[a, b]
    return products, means


def pair_products(window: int, ks: NDArray[np.int64], shifts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Covariance of Allan variances per product of squared coefficients.

    Parameters
    ----------
    window : int
        Samples of the window; averaging factor k has ``window - 2k + 1`` terms.
    ks : int64 (n_tau,)
        Averaging factors, at most ``window // 2``.
    shifts : int64 (n_tau,)
        Thinning of the terms (every ``2**shift``-th is used).

    Returns
    -------
    ndarray (4, 4, n_tau, n_tau)
        ``P[a, b]``, such that noise with squared coefficients s (in sample units) gives estimates with the covariance
        ``sum_ab s[a] s[b] P[a, b]``.
    """
    products, _ = _tables(window, np.asarray(ks), np.asarray(shifts), _logarithms(window))
    return np.asarray(2.0 * products)


def ramp_products(window: int, ks: NDArray[np.int64], shifts: NDArray[np.int64]) -> NDArray[np.float64]:
    """What a deterministic ramp adds to the covariance, ``rho^2 sum_a s[a] P[a]`` for a rate that grows by rho per sample.

    Parameters are those of `pair_products`; the result has shape (4, n_tau, n_tau).
    """
    _, means = _tables(window, np.asarray(ks), np.asarray(shifts), _logarithms(window))
    factors = np.asarray(ks, dtype=np.float64)
    return np.asarray(2.0 * factors[:, None] * factors[None, :] * means)


@njit(nogil=True, cache=True)
def _diagonals(window, ks, shifts, logarithm):  # type: ignore[no-untyped-def]
    products = np.zeros((STOCHASTIC, STOCHASTIC, ks.size))
    means = np.zeros((STOCHASTIC, ks.size))
    one = np.empty((STOCHASTIC, STOCHASTIC))
    mean = np.empty(STOCHASTIC)
    for i in range(ks.size):
        _sum_pairs(window, ks[i], ks[i], 1 << shifts[i], logarithm, one, mean)
        for a in range(STOCHASTIC):
            means[a, i] = mean[a]
            for b in range(STOCHASTIC):
                products[a, b, i] = one[a, b]
    return products, means


def diagonal_products(window: int, ks: NDArray[np.int64], shifts: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Diagonals of `pair_products`, shape (4, 4, n_tau), and of `ramp_products`, shape (4, n_tau), without the rest."""
    products, means = _diagonals(window, np.asarray(ks), np.asarray(shifts), _logarithms(window))
    return np.asarray(2.0 * products), np.asarray(2.0 * np.asarray(ks, dtype=np.float64) ** 2 * means)


def _logarithms(window: int) -> NDArray[np.float64]:
    """``ln t`` for every lag that can occur, 0 at t = 0."""
    t = np.arange(5 * window + 2, dtype=np.float64)
    t[0] = 1.0
    return np.log(t)
