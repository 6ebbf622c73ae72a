"""Covariance of the variances of a surface between averaging factors, for Gaussian noise.

A second difference is ``d_k[m] = theta[m + 2k] - 2 theta[m + k] + theta[m]``; its covariances
follow from the generalised autocovariance of the angle (Greenhall and Riley, PTTI 2003), in units
of one sample and unit squared coefficient. The Hadamard variance has third differences of the
angle, the modified Allan variance those of its running sum. The autocovariance G of the running sum
follows from that of the angle, R = -(second difference of G):

    term                 Allan variance   angle                running sum
    quantization         3 / k^2          delta(t)             -|t| / 2
    angle random walk    1 / k            -|t| / 2             (|t|^3 - |t|) / 12
    bias instability     2 ln 2 / pi      t^2 ln|t| / (2 pi)   no closed form; summed
    rate random walk     k / 3            |t|^3 / 12           -(|t|^5 - 5/3 |t|^3 + 2/3 |t|) / 240

By Isserlis' theorem the covariance of two mean squares is twice the mean squared covariance of
their terms. Because the terms add, a mixture of noises needs only the tables of products made here,
once per window length.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.kernels.compiled import INNER, KERNEL, REORDER

#: Number of stochastic terms: quantization, angle random walk, bias instability, rate random walk.
STOCHASTIC = 4
#: Lags are taken in steps of this share of the shorter factor.
_LAG_STEPS = 32
_FLICKER_FACTOR = 1.0 / (2.0 * math.pi)
_THIRD_WEIGHTS = (-1.0, 3.0, -3.0, 1.0)
#: Lag over k from which a third difference is taken as a derivative, which is then good to 1e-8.
_FAR = 1e4


def angle_covariances(term: int, lags: Floats) -> Floats:
    """Compute the generalised autocovariance of the angle under Q, N, B or K (0 to 3)."""
    if term == 0:
        return np.where(lags == 0, 1.0, 0.0)
    if term == 1:
        return -0.5 * lags
    out = np.maximum(lags, 1.0) if term == 2 else lags * lags
    if term == 2:
        np.log(out, out=out)
        out *= lags * lags
        out /= 2.0 * math.pi
    else:
        out *= lags
        out /= 12.0
    return out


def autocovariances(lags: int, *, summed: bool) -> Floats:
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
                out[row, a] += _THIRD_WEIGHTS[i] * table[a, t]


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
def _count_pairs(lag, n1, n2):  # type: ignore[no-untyped-def]
    """Number of pairs of terms with this lag."""
    return max(0, min(n1, n2 - lag) - max(0, -lag))


@njit(**INNER)
def _second_covariances(lag, k1, k2, first, logarithm, out):  # type: ignore[no-untyped-def]
    """Compute the covariances of d_k1[m] and d_k2[m + lag] over 2 k1 k2; Q only if `first` is 0."""
    point = white = flicker = walk = 0.0
    for i in range(3):
        for j in range(3):
            t = abs(lag + j * k2 - i * k1)
            weight = (-2.0 if i == 1 else 1.0) * (-2.0 if j == 1 else 1.0)
            square = float(t) * t
            if first == 0 and t == 0:
                point += weight
            white += weight * t
            flicker += weight * square * logarithm[t]
            walk += weight * square * t
    scale = 1.0 / (2.0 * k1 * k2)
    out[0] = point / (2.0 * k1 * k2)
    out[1] = -0.5 * white * scale
    out[2] = _FLICKER_FACTOR * flicker * scale
    out[3] = walk / 12.0 * scale


@njit(**INNER)
def _third_covariances(lag, k2, scale, crossed, out):  # type: ignore[no-untyped-def]
    """Compute those of third differences, from `_cross_covariances` of k1."""
    at = crossed.shape[0] // 2 + lag
    for a in range(STOCHASTIC):
        out[a] = scale * (
            crossed[at + 3 * k2, a]
            - 3.0 * (crossed[at + 2 * k2, a] - crossed[at + k2, a])
            - crossed[at, a]
        )


@njit(**INNER)
def _add_steps(window, n1, n2, k1, k2, order, first, scale, logarithm, crossed, r, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of the noise terms from `first` on, whose covariances are smooth in the lag."""
    step = max(1, k1 // _LAG_STEPS)
    centre = order * (k1 - k2) // 2
    reach = min(order * (k1 + k2), window)
    for lag in range(centre - (reach // step) * step, centre + reach + 1, step):
        weight = _count_pairs(lag, n1, n2) * step
        if weight == 0:
            continue
        if order == 2:
            _second_covariances(lag, k1, k2, first, logarithm, r)
        else:
            _third_covariances(lag, k2, scale, crossed, r)
        for a in range(first, STOCHASTIC):
            means[a] += weight * r[a]
            for b in range(first, STOCHASTIC):
                products[a, b] += weight * r[a] * r[b]


@njit(**INNER)
def _add_points(n1, n2, k1, k2, order, scale, logarithm, crossed, r, products, means):  # type: ignore[no-untyped-def]
    """Add the pairs of white angle noise with every term.

    They have a covariance only where points of both differences coincide: at 9 or 16 lags at most.
    """
    points = order + 1
    for p in range(points * points):
        lag = (p // points) * k1 - (p % points) * k2
        is_repeated = False
        for q in range(p):
            is_repeated = is_repeated or lag == (q // points) * k1 - (q % points) * k2
        weight = _count_pairs(lag, n1, n2)
        if is_repeated or weight == 0:
            continue
        if order == 2:
            _second_covariances(lag, k1, k2, np.int64(0), logarithm, r)
        else:
            _third_covariances(lag, k2, scale, crossed, r)
        means[0] += weight * r[0]
        for b in range(STOCHASTIC):
            products[0, b] += weight * r[0] * r[b]
    for b in range(1, STOCHASTIC):
        products[b, 0] = products[0, b]


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
    """What `_add_steps` adds where it takes every lag, from `_difference_covariances` of k1 <= k2.

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
def _sum_pairs(  # type: ignore[no-untyped-def]
    window, k1, k2, order, summed, logarithm, zero, differences, crossed, r, products, means
):
    """Average the products ``r_a r_b`` and values ``r_a`` over all pairs of terms, k1 <= k2."""
    products[:] = 0.0
    means[:] = 0.0
    n1, n2 = window - order * k1 + 1 + summed, window - order * k2 + 1 + summed
    scale = 1.0 / (2.0 * float(k1 * k2) ** 2) if summed else 1.0 / (6.0 * k1 * k2)
    first = np.int64(0 if summed else 1)
    if differences.size:
        _add_every(window, k1, k2, zero, differences, products, means)
    else:
        _add_steps(
            window, n1, n2, k1, k2, order, first, scale, logarithm, crossed, r, products, means
        )
    if not summed:
        _add_points(n1, n2, k1, k2, order, scale, logarithm, crossed, r, products, means)
    pairs = float(n1) * n2
    for a in range(STOCHASTIC):
        means[a] /= pairs
        for b in range(STOCHASTIC):
            products[a, b] /= pairs


@njit(**INNER)
def _reached_lags(window, longest):  # type: ignore[no-untyped-def]
    """Number of lags, from 0, at which `_add_every` needs the covariances."""
    return min(2 * (longest + 2 * _LAG_STEPS), window) + longest + 1


@njit(**KERNEL)
def _fill_tables(window, ks, order, summed, diagonal, logarithm, table):  # type: ignore[no-untyped-def]
    """Fill `product_tables`, or only the diagonals (4, 4, n_tau, 1) and (4, n_tau, 1).

    Second differences need `logarithm`, third ones `table`; the other one may have any size.
    """
    n_tau = ks.size
    width = 1 if diagonal else n_tau
    products = np.zeros((STOCHASTIC, STOCHASTIC, n_tau, width))
    means = np.zeros((STOCHASTIC, n_tau, width))
    pair_products, mean = np.empty((STOCHASTIC, STOCHASTIC)), np.empty(STOCHASTIC)
    r, zero = np.zeros(STOCHASTIC), ks[-1]
    lags = 0 if order == 3 or diagonal else zero + _reached_lags(window, zero)
    small, none = np.empty((3, lags)), np.empty((3, 0))
    room = np.empty((2 * table.shape[1] - 1, STOCHASTIC))
    for i in range(n_tau):
        last = i + 1 if diagonal else n_tau
        differences = small if ks[i] < 2 * _LAG_STEPS else none
        reach = 2 * (3 * (ks[i] + ks[last - 1]) + 2 + min(3 * (ks[i] + ks[last - 1]), window))
        crossed = room[: min(reach, room.shape[0] - 1) + 1]
        if order == 3:
            _cross_covariances(ks[i], table, summed, crossed)
        elif differences.size:
            _difference_covariances(ks[i], zero, logarithm, differences)
        for j in range(i, last):
            _sum_pairs(
                window, ks[i], ks[j], order, summed, logarithm, zero, differences, crossed, r,
                pair_products, mean,
            )  # fmt: skip
            at, mirrored = (i, 0) if diagonal else (i, j), (i, 0) if diagonal else (j, i)
            for a in range(STOCHASTIC):
                means[a, at[0], at[1]] = means[a, mirrored[0], mirrored[1]] = mean[a]
                for b in range(STOCHASTIC):
                    products[a, b, at[0], at[1]] = pair_products[a, b]
                    products[a, b, mirrored[0], mirrored[1]] = pair_products[a, b]
    return products, means


def product_tables(
    window: int, ks: Ints, *, variance: str = "avar", diagonal: bool = False
) -> tuple[Floats, Floats]:
    """Tabulate the covariance of a variance per product of squares, and with a ramp.

    Parameters
    ----------
    window : int
        Samples of the window; averaging factor k has ``window - span + 1`` terms.
    ks : int64 (n_tau,)
        Averaging factors, rising, with spans up to the window.
    variance : str
        One of `gyrostab.kernels.allan.variances.VARIANCES`.
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
    order, summed = VARIANCES[variance].order, VARIANCES[variance].summed
    logarithm = _log_lags(window, int(ks[-1])) if order == 2 else np.empty(0)
    table = autocovariances(window + 2 if order == 3 else 1, summed=summed)
    products, means = _fill_tables(window, ks, order, summed, diagonal, logarithm, table)
    factors = ks.astype(np.float64)
    # a third difference of the angle does not see a ramp
    scale = 2.0 * float(order == 2 or summed) * factors[:, None]
    pairs, ramps = 2.0 * products, scale * (factors[:, None] if diagonal else factors) * means
    return (pairs[..., 0], ramps[..., 0]) if diagonal else (pairs, ramps)


def _log_lags(window: int, longest: int) -> Floats:
    """``ln t`` for every lag that can occur, 0 at t = 0."""
    lags = max(window, _reached_lags.py_func(window, longest) + 2 * _LAG_STEPS)
    t = np.arange(lags + 1, dtype=np.float64)
    t[0] = 1.0
    return np.log(t, out=t)


def third_columns(variance: str, ks: Ints) -> Floats:
    """Compute the variance per squared coefficient in sample units, (n_tau, 5).

    Examples
    --------
    >>> third_columns("hadamard", np.array([4]))[0].round(4)  # 10/3k^2, 1/k, ..., k/6, no ramp
    array([0.2083, 0.25  , 0.358 , 0.6667, 0.    ])
    """
    summed = VARIANCES[variance].summed
    table = autocovariances(3 * int(ks[-1]) + 2, summed=summed)
    pairs = [20.0 * table[:, 0] + 0.0 * ks[:, None]]
    pairs += [2.0 * weight * table[:, i * ks].T for i, weight in ((1, -15.0), (2, 6.0), (3, -1.0))]
    noise = np.sum(pairs, axis=0) / VARIANCES[variance].divisors(ks)[:, None]
    ramp = 0.5 * ks.astype(np.float64) ** 2 if summed else np.zeros(ks.size)
    return np.column_stack([noise, ramp])
