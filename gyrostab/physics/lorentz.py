"""Spectrum of exponentially correlated bias in averaged samples."""

from __future__ import annotations

import math

import numpy as np

from gyrostab.physics.base import Array

__all__ = ["lorentz_density"]


def lorentz_density(frequency: Array, correlation_time: float, rate: float) -> Array:
    """Compute the aliased two-sided density [Hz-1] of a unit exponentially correlated process.

    A sample is the mean over its interval. With x the interval over the correlation time, the
    samples have the covariances ``c_0 = 2 (x - 1 + e^-x) / x^2`` and ``c_k = ((1 - e^-x) / x)^2
    e^-(k-1)x``, and the density is the Fourier sum of these.

    Parameters
    ----------
    frequency : ndarray
        Frequencies [Hz].
    correlation_time : float
        Time constant of the correlation [s].
    rate : float
        Sampling rate [Hz].

    Examples
    --------
    At low frequency twice the correlation time, as without sampling:

    >>> lorentz_density(np.array([1e-6]), 30.0, 10.0).round(3)
    array([60.])
    """
    x = 1.0 / (rate * correlation_time)
    lost = -math.expm1(-x)
    at_once = 2.0 * (x - lost) / x**2 if x > 1e-4 else 1.0 - x / 3.0
    turn = np.exp(-2j * np.pi * np.asarray(frequency, np.float64) / rate)
    return np.asarray(
        (at_once + 2.0 * (lost / x) ** 2 * (turn / (1.0 - math.exp(-x) * turn)).real) / rate
    )
