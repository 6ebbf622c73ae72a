"""Allan variances less the part of a trend: tables of their covariance.

The square b^2 of the least-squares slope of a window estimates R^2 plus the variance v of the slope
under the other terms. ``z = avar - b^2 tau^2 / 2`` therefore has no part of a ramp; its mean per
squared coefficient is that of the Allan variance less ``v tau^2 / 2``. All quantities are exact for
windows without gaps, in units of one sample, from the autocovariances of
`gyrostab.kernels.fit.covariance`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.fit.covariance import STOCHASTIC, angle_covariances

#: Second differences are taken at steps of this share of k, and at this many places at least.
_STEPS, _PLACES = 32, 2**16


class TrendTables(NamedTuple):
    """Variance of the slope per squared coefficient (4,), and `product_tables` of z."""

    variance: Floats
    pairs: Floats
    ramps: Floats


def _slope_covariances(window: int) -> tuple[Floats, Floats]:
    """Compute the covariance of each angle with the slope (4, window + 2), and that of the slope.

    A zero precedes those of the angles, for sums of them. The slope weights the angles by -1/S, and
    by (W - 1) / 2S at both ends, S = W (W^2 - 1) / 12. Arrays are changed in place: those of a long
    window fill the memory.
    """
    spread = window * (window**2 - 1.0) / 12.0
    end = 0.5 * (window - 1.0) / spread
    lags = np.arange(window + 1.0)
    out, sums = np.zeros((STOCHASTIC, window + 2)), np.zeros(window + 2)
    for term, row in enumerate(out[:, 1:]):
        covariance = angle_covariances(term, lags)
        np.cumsum(covariance, out=sums[1:])
        np.add(covariance, covariance[::-1], out=row)
        row *= end
        first = covariance[0]
        np.add(sums[:-1], sums[-2::-1], out=covariance)
        covariance -= first
        covariance /= spread
        row -= covariance
        del covariance  # before the next one is made
    variance = end * (out[:, 1] + out[:, -1]) - out[:, 2:-1].sum(axis=1) / spread
    return out, variance


def detrend_tables(
    window: int, ks: Ints, pairs: Floats, ramps: Floats, *, summed: bool = False
) -> TrendTables:
    """Turn the tables of Allan variances into those of Allan variances less their trend.

    Parameters
    ----------
    window : int
        Samples of the window.
    ks : int64 (n_tau,)
        Averaging factors.
    pairs : float64 (4, 4, n_tau, n_tau); ramps : float64 (4, n_tau, n_tau)
        `gyrostab.kernels.fit.covariance.product_tables`.
    summed : bool
        The variances are modified Allan variances, of third differences of the sum of the angle.
    """
    angles, variance = _slope_covariances(window)
    sums = np.cumsum(angles, axis=1, out=angles) if summed else angles[:, 1:]
    products = np.empty((STOCHASTIC, STOCHASTIC, ks.size))
    means = np.empty((STOCHASTIC, ks.size))
    for i, k in enumerate(ks):
        step = max(1, int(k) // _STEPS, window // _PLACES)
        count = window - (3 * int(k) - 1 if summed else 2 * int(k)) + 1
        points = [sums[:, j * k : j * k + count : step] for j in range(4 if summed else 3)]
        covariance = (
            (points[3] - 3.0 * (points[2] - points[1]) - points[0]) / float(k) ** 2
            if summed
            else (points[0] - 2.0 * points[1] + points[2]) / k
        )
        products[..., i] = covariance @ covariance.T / covariance.shape[1]
        means[:, i] = covariance.mean(axis=1) / k
    half = 0.5 * ks.astype(np.float64) ** 2
    shared = products[:, :, None, :] * half[:, None]
    outer = np.outer(half, half)
    square = 2.0 * outer * np.multiply.outer(variance, variance)[..., None, None]
    lines = ramps - 4.0 * outer * (means[:, :, None] + means[:, None, :] - variance[:, None, None])
    for term in range(STOCHASTIC):  # sums in steps leave small negative eigenvalues
        values, vectors = np.linalg.eigh(lines[term] / outer)
        lines[term] = (vectors * np.maximum(values, 0.0)) @ vectors.T * outer
    return TrendTables(variance, pairs - shared - shared.swapaxes(2, 3) + square, lines)
