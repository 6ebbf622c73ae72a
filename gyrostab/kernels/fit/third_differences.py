"""Covariance of Hadamard or modified Allan variances between averaging factors.

What `gyrostab.kernels.fit.covariance` does for second differences of the angle, for third
differences of the angle (Hadamard) or of its running sum (modified Allan variance). The generalised
autocovariance G of the running sum follows from that of the angle, R = -(second difference of G):

    quantization         -|t| / 2
    angle random walk    (|t|^3 - |t|) / 12
    bias instability     no closed form; summed
    rate random walk     -(|t|^5 - 5/3 |t|^3 + 2/3 |t|) / 240
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.fit.covariance import STOCHASTIC
from gyrostab.kernels.fit.trend import angle_covariances

#: Lags are taken in steps of this share of the shorter factor.
_LAG_STEPS = 32
_WEIGHTS = (-1.0, 3.0, -3.0, 1.0)
#: Lag over k from which a third difference is taken as a derivative, which is then good to 1e-8.
_FAR = 1e4


def _autocovariances(lags: int, *, summed: bool) -> NDArray[np.float64]:
    """Compute the generalised autocovariances of Q, N, B and K, (4, lags)."""
    t = np.arange(lags, dtype=np.float64)
    out = np.empty((STOCHASTIC, lags))
    if not summed:
        for term, row in enumerate(out):
            row[:] = angle_covariances(term, t)
        return out
    out[0] = -0.5 * t
    out[1] = (t**3 - t) / 12.0
    flicker = angle_covariances(2, t)
    out[2, :2] = 0.0
    out[2, 2:] = -np.cumsum(np.cumsum(flicker[1:-1]))
    out[3] = -(t**5 - 5.0 / 3.0 * t**3 + 2.0 / 3.0 * t) / 240.0
    return out


@njit(**INNER)
def _cross_covariances(k, table, summed, out):  # type: ignore[no-untyped-def]
    """Compute the covariance of an angle with a third difference, l samples later (row l).

    Row 0 is in the middle. No two angles of a window have a lag beyond the table.
    """
    middle = out.shape[0] // 2
    for row in range(out.shape[0]):
        distance = row - middle - 1.5 * k
        if abs(distance) > _FAR * k:
            _derivative_covariances(k, distance, summed, out[row])
            continue
        for a in range(STOCHASTIC):
            out[row, a] = 0.0
        for i in range(4):
            t = min(abs(row - middle - i * k), table.shape[1] - 1)
            for a in range(STOCHASTIC):
                out[row, a] += _WEIGHTS[i] * table[a, t]


@njit(**INNER)
def _derivative_covariances(k, distance, summed, out):  # type: ignore[no-untyped-def]
    """Compute it far away, -k^3 times the third derivative: differences would cancel."""
    t = abs(distance)
    cube = float(k) ** 3 if distance > 0.0 else -(float(k) ** 3)
    out[0] = 0.0
    if summed:
        out[1] = -0.5 * cube
        out[2] = cube * t * (2.0 * math.log(t) + 1.0) / (2.0 * math.pi)
        out[3] = cube * (t * t / 4.0 + k * k / 16.0 - 1.0 / 24.0)
    else:
        out[1] = 0.0
        out[2] = -cube / (math.pi * t)
        out[3] = -0.5 * cube


@njit(**INNER)
def _add_lag(lag, weight, first, k2, crossed, scale, r, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of terms with this lag, for the noise terms from number `first` on."""
    at = crossed.shape[0] // 2 + lag
    for a in range(STOCHASTIC):
        r[a] = scale * (
            crossed[at + 3 * k2, a]
            - 3.0 * (crossed[at + 2 * k2, a] - crossed[at + k2, a])
            - crossed[at, a]
        )
    for a in range(first, STOCHASTIC):
        means[a] += weight * r[a]
        for b in range(first, STOCHASTIC):
            products[a, b] += weight * r[a] * r[b]


@njit(**INNER)
def _add_points(n1, n2, k1, k2, thin, crossed, scale, r, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of white angle noise with every term: at most sixteen lags, times `thin`."""
    pair_products, sums = np.zeros((STOCHASTIC, STOCHASTIC)), np.zeros(STOCHASTIC)
    for p in range(16):
        lag = (p // 4) * k1 - (p % 4) * k2
        is_repeated = False
        for q in range(p):
            is_repeated = is_repeated or lag == (q // 4) * k1 - (q % 4) * k2
        weight = max(0, min(n1, n2 - lag) - max(0, -lag)) * thin
        if is_repeated or weight == 0:
            continue
        _add_lag(lag, weight, 0, k2, crossed, scale, r, pair_products, sums)
    means[0] = sums[0]
    for a in range(STOCHASTIC):
        products[0, a] = products[a, 0] = pair_products[0, a]


@njit(**INNER)
def _sum_pairs(window, k1, k2, thin, summed, crossed, r, products, means):  # type: ignore[no-untyped-def]
    """Average the products ``r_a r_b`` and values ``r_a`` over all pairs of terms, k1 <= k2."""
    products[:] = 0.0
    means[:] = 0.0
    n1, n2 = window - 3 * k1 + 1 + summed, window - 3 * k2 + 1 + summed
    scale = 1.0 / (2.0 * float(k1 * k2) ** 2) if summed else 1.0 / (6.0 * k1 * k2)
    step = max(1, k1 // _LAG_STEPS)
    centre = 3 * (k1 - k2) // 2
    reach = min(3 * (k1 + k2), window)
    for lag in range(centre - (reach // step) * step, centre + reach + 1, step):
        weight = max(0, min(n1, n2 - lag) - max(0, -lag)) * step
        if weight > 0:
            _add_lag(lag, weight, 0 if summed else 1, k2, crossed, scale, r, products, means)
    if not summed:
        _add_points(n1, n2, k1, k2, thin, crossed, scale, r, products, means)
    pairs = float(n1) * n2
    for a in range(STOCHASTIC):
        means[a] /= pairs
        for b in range(STOCHASTIC):
            products[a, b] /= pairs


@njit(**KERNEL)
def _fill_tables(window, ks, shifts, summed, diagonal, table):  # type: ignore[no-untyped-def]
    """Fill `third_tables`, or only the diagonals (4, 4, n_tau, 1) and (4, n_tau, 1)."""
    n_tau = ks.size
    width = 1 if diagonal else n_tau
    products = np.zeros((STOCHASTIC, STOCHASTIC, n_tau, width))
    means = np.zeros((STOCHASTIC, n_tau, width))
    pair_products, mean = np.empty((STOCHASTIC, STOCHASTIC)), np.empty(STOCHASTIC)
    r, room = np.empty(STOCHASTIC), np.empty((2 * table.shape[1] - 1, STOCHASTIC))
    for i in range(n_tau):
        last = i + 1 if diagonal else n_tau
        reach = 2 * (3 * (ks[i] + ks[last - 1]) + 2 + min(3 * (ks[i] + ks[last - 1]), window))
        crossed = room[: min(reach, room.shape[0] - 1) + 1]
        _cross_covariances(ks[i], table, summed, crossed)
        for j in range(i, last):
            thin = 1 << min(shifts[i], shifts[j])
            _sum_pairs(window, ks[i], ks[j], thin, summed, crossed, r, pair_products, mean)
            at, mirrored = (i, 0) if diagonal else (i, j), (i, 0) if diagonal else (j, i)
            for a in range(STOCHASTIC):
                means[a, at[0], at[1]] = means[a, mirrored[0], mirrored[1]] = mean[a]
                for b in range(STOCHASTIC):
                    products[a, b, at[0], at[1]] = pair_products[a, b]
                    products[a, b, mirrored[0], mirrored[1]] = pair_products[a, b]
    return products, means


def third_tables(
    variance: str,
    window: int,
    ks: NDArray[np.int64],
    shifts: NDArray[np.int64],
    *,
    diagonal: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tabulate the covariance of a variance as `gyrostab.kernels.fit.covariance.product_tables`.

    Parameters
    ----------
    variance : {"hadamard", "modified"}
    window, ks, shifts, diagonal
        As for `product_tables`; averaging factors are at most ``(window + 1) // 3``.
    """
    summed = VARIANCES[variance].summed
    table = _autocovariances(window + 2, summed=summed)
    products, means = _fill_tables(window, ks, shifts, summed, diagonal, table)
    factors = ks.astype(np.float64)
    ramp_response = 1.0 if summed else 0.0  # a third difference of the angle does not see a ramp
    other_factors = factors[:, None] if diagonal else factors[None, :]
    pairs = 2.0 * products
    ramps = 2.0 * ramp_response * factors[:, None] * other_factors * means
    return (pairs[..., 0], ramps[..., 0]) if diagonal else (pairs, ramps)


def third_columns(variance: str, ks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Compute the variance per squared coefficient in sample units, (n_tau, 5).

    Examples
    --------
    >>> third_columns("hadamard", np.array([4]))[0].round(4)  # 10/3k^2, 1/k, ..., k/6, no ramp
    array([0.2083, 0.25  , 0.358 , 0.6667, 0.    ])
    """
    summed = VARIANCES[variance].summed
    table = _autocovariances(3 * int(ks[-1]) + 2, summed=summed)
    pairs = [20.0 * table[:, 0] + 0.0 * ks[:, None]]
    pairs += [2.0 * weight * table[:, i * ks].T for i, weight in ((1, -15.0), (2, 6.0), (3, -1.0))]
    noise = np.sum(pairs, axis=0) / VARIANCES[variance].divisors(ks)[:, None]
    ramp = 0.5 * ks.astype(np.float64) ** 2 if summed else np.zeros(ks.size)
    return np.column_stack([noise, ramp])
