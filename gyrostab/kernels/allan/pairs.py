"""Sums over pairs of second differences, for the degrees of freedom of an Allan variance.

For Gaussian second differences with autocorrelation ``rho(l)`` a mean of n squares has ``n^2 /
v(n)`` equivalent degrees of freedom, ``v(n) = sum_ij rho(i - j)^2`` (Greenhall and Riley, PTTI
2003). For angle random walk rho is piecewise linear and the sum has a closed form; runs between
gaps of a rate log share no samples and so simply add their v.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.allan.intervals import valid_intervals
from gyrostab.kernels.compiled import INNER, KERNEL


@njit(**INNER)
def _weighted_moment(n, slope, a, b):  # type: ignore[no-untyped-def]
    """``sum((n - l) (1 - slope l)^2 for l in a..b)`` in closed form."""
    if b < a:
        return 0.0
    x, y = float(b), float(a - 1)
    s0 = x - y
    s1 = (x * (x + 1) - y * (y + 1)) / 2
    s2 = (x * (x + 1) * (2 * x + 1) - y * (y + 1) * (2 * y + 1)) / 6
    s3 = ((x * (x + 1)) ** 2 - (y * (y + 1)) ** 2) / 4
    return n * s0 - (1 + 2 * slope * n) * s1 + (2 * slope + slope**2 * n) * s2 - slope**2 * s3


@njit(**KERNEL)
def white_pair_sum(n, k):  # type: ignore[no-untyped-def]
    """Sum ``rho(i - j)^2`` over n consecutive second differences, for angle random walk."""
    if n < 1:
        return 0.0
    short_lags = _weighted_moment(float(n), 1.5 / k, np.int64(1), min(n - 1, k))
    long_lags = _weighted_moment(float(n), 0.5 / k, k + 1, min(n - 1, 2 * k - 1))
    return n + 2.0 * (short_lags + long_lags)


#: Products of the weights of a third difference with themselves, moved by -3 k to 3 k.
_THIRD_WEIGHTS = (-1.0, 6.0, -15.0, 20.0, -15.0, 6.0, -1.0)


@njit(**INNER)
def _third_pair_moments(k, summed):  # type: ignore[no-untyped-def]
    """Sum ``rho(l)^2`` and ``l rho(l)^2`` over the lags 1 to l, for third differences, (2, 3 k).

    The angle has the generalised autocovariance -|l| / 2, its running sum (|l|^3 - |l|) / 12.
    """
    out = np.zeros((2, 3 * k + 1))
    variance = 1.0
    for lag in range(out.shape[1]):
        total = 0.0
        for i in range(7):
            t = float(abs(lag + (i - 3) * k))
            total += _THIRD_WEIGHTS[i] * (t * (t * t - 1.0) / 12.0 if summed else -0.5 * t)
        if lag == 0:
            variance = total
        else:
            square = (total / variance) ** 2
            out[0, lag] = out[0, lag - 1] + square
            out[1, lag] = out[1, lag - 1] + lag * square
    return out


@njit(**INNER)
def _pair_sum(n, k, moments):  # type: ignore[no-untyped-def]
    """`white_pair_sum`, or that of third differences with `_third_pair_moments`."""
    if moments.size == 0:
        return white_pair_sum(n, k)
    last = min(max(n - 1, 0), moments.shape[1] - 1)
    return n + 2.0 * (n * moments[0, last] - moments[1, last])


@njit(**KERNEL)
def strict_gap_factors(  # type: ignore[no-untyped-def]
    starts, stops, window, step, ks, spans, order, summed, counts, full, out
):
    """Degrees of freedom of each window of a rate log, as a share of the gap-free window's.

    Parameters
    ----------
    starts, stops : int64 (n_runs,)
        Runs of present samples.
    window, step : int
        Window and step [samples].
    ks, spans : int64 (n_tau,)
        Averaging factors, and samples that a term uses.
    order, summed : int, bool
        Order of the differences; whether they are those of the running sum of the angle.
    counts, full : float64 (n_windows, n_tau)
        Terms used and terms without gaps.
    out : float64 (n_windows, n_tau)
        Overwritten where terms are missing, with 0 where none is left.
    """
    for i in range(ks.size):
        k, length = ks[i], window - spans[i] + 1
        begin, end = valid_intervals(starts, stops, k, spans[i], np.int64(0))
        moments = np.empty((2, 0)) if order == 2 else _third_pair_moments(k, summed)
        v = 0
        for j in range(counts.shape[0]):
            first = j * step
            while v < begin.size and end[v] <= first:
                v += 1
            if counts[j, i] == full[j, i]:
                continue
            if counts[j, i] == 0:
                out[j, i] = 0.0
                continue
            pairs = 0.0
            for u in range(v, begin.size):
                if begin[u] >= first + length:
                    break
                a, b = max(begin[u], first), min(end[u], first + length)
                pairs += _pair_sum(b - a, k, moments)
            ratio = counts[j, i] / full[j, i]
            out[j, i] = ratio * ratio * _pair_sum(int(full[j, i]), k, moments) / pairs
