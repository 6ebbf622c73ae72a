"""Generalised autocovariance of the angle, and of its running sum, under each noise term.

In units of one sample and unit squared coefficient. The autocovariance G of the running sum follows
from that of the angle, R = -(second difference of G):

    term                 angle                     running sum
    quantization         delta(t)                  -|t| / 2
    angle random walk    -|t| / 2                  (|t|^3 - |t|) / 12
    bias instability     t^2 ln|t| / (2 pi)        no closed form; summed
    rate random walk     |t|^3 / 12                -(|t|^5 - 5/3 |t|^3 + 2/3 |t|) / 240
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

#: Number of stochastic terms: quantization, angle random walk, bias instability, rate random walk.
STOCHASTIC = 4


def angle_covariances(term: int, lags: NDArray[np.float64]) -> NDArray[np.float64]:
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


def autocovariances(lags: int, *, summed: bool) -> NDArray[np.float64]:
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
