"""Closed loop: serrodyne ramp, error of its 2 pi reset, and dead zone by crosstalk."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


#: Diameter of the coil [m], refractive index of its fiber, and wavelength of the light [m].
_DIAMETER, _INDEX, _WAVELENGTH = 0.04, 1.45, 1.55e-6


def reset_frequency(rate: Array) -> Array:
    """Compute the reset frequency [Hz] at a rotation rate [deg/h]: ``D w / (n lambda)``."""
    return np.asarray(_DIAMETER * np.radians(np.asarray(rate) / 3600.0) / (_INDEX * _WAVELENGTH))


def ramp_phase(rate: Array, *, dt: float, first: float = 0.0) -> Array:
    """Compute the phase of the ramp, 0 to 1 between resets, from rates [deg/h] every `dt` [s]."""
    turned = first + np.cumsum(reset_frequency(rate)) * dt
    return np.asarray(turned % 1.0)


def reset_error(phase: Array, *, settle: float = 0.05) -> Array:
    """Compute the normalised rate error after a reset that differs from 2 pi; its mean is zero.

    The loop removes the error over the share `settle` of the ramp.

    Examples
    --------
    >>> error = reset_error(np.linspace(0, 1, 100_000, endpoint=False))
    >>> bool(abs(error.mean()) < 1e-3), bool(error[0] > 0.9)
    (True, True)
    """
    mean = settle * (1 - math.exp(-1 / settle))
    return np.asarray(np.exp(-np.asarray(phase) / settle) - mean)


def dead_zone(rate: Array, *, width: float) -> Array:
    """Apply a dead zone: crosstalk holds the output at zero below `width` [deg/h]."""
    rate = np.asarray(rate, dtype=float)
    above = np.sqrt(np.maximum(rate**2 - width**2, 0.0))
    return np.asarray(np.copysign(above, rate) + 0.0)
