"""From light power to noise: shot, thermal and excess noise at the detector, loss of light, one source for several axes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["detector_psd", "loss_db", "rate_noise", "relative_psd", "share_source"]

Array = NDArray[np.float64]

CHARGE = 1.602176634e-19
BOLTZMANN = 1.380649e-23
LIGHT_SPEED = 299_792_458.0


def detector_psd(
    power: Array,
    *,
    responsivity: float = 0.9,
    load: float = 50e3,
    temperature: float = 300.0,
    rin: float = 1e-12,
) -> dict[str, Array]:
    """One-sided spectral densities [A2/Hz] of the current of a detector under `power` [W].

    Parameters
    ----------
    power : ndarray
        Light at the detector [W].
    responsivity : float
        Current per light power [A/W].
    load : float
        Load resistance [ohm].
    temperature : float
        Of the load [K].
    rin : float
        Excess noise of the source, relative to its power [1/Hz]: about the coherence time.

    Returns
    -------
    dict
        ``shot``, ``thermal`` and ``excess``.

    Examples
    --------
    >>> parts = detector_psd(np.array([10e-6]))
    >>> f"{parts['shot'][0]:.3g}"  # 2 e i at 9 uA
    '2.88e-24'
    """
    current = responsivity * np.asarray(power, dtype=float)
    return {
        "shot": 2 * CHARGE * current,
        "thermal": np.full_like(current, 4 * BOLTZMANN * temperature / load),
        "excess": rin * current**2,
    }


def relative_psd(power: Array, *, depth: float = 0.75 * math.pi, **detector: float) -> Array:
    """Spectral density of the phase noise [rad2/Hz], one-sided, of an interferometer biased at phase `depth` [rad].

    The signal is ``P (1 + cos(phase))``, so the slope is ``P sin(depth)`` and the light that
    reaches the detector ``P (1 + cos(depth))``.

    Examples
    --------
    >>> strong, weak = relative_psd(np.array([1e-3, 0.5e-3]))
    >>> bool(abs(weak / strong - 1) < 0.02)  # excess noise does not care for the power
    True
    """
    seen = np.asarray(power, dtype=float) * (1 + math.cos(depth))
    total = sum(detector_psd(seen, **detector).values())
    slope = detector.get("responsivity", 0.9) * np.asarray(power) * math.sin(depth)
    return np.asarray(total / slope**2)


def rate_noise(
    power: Array,
    *,
    diameter: float = 0.04,
    length: float = 500.0,
    wavelength: float = 1.55e-6,
    **detector: float,
) -> Array:
    """White level N_s of the rate [deg/h per root Hz, two-sided] at light power [W].

    Examples
    --------
    >>> bool(0.005 < rate_noise(np.array([20e-6]))[0] < 1.0)
    True
    """
    phase_per_rate = 2 * math.pi * length * diameter / (wavelength * LIGHT_SPEED)
    two_sided = relative_psd(power, **detector) / 2
    return np.asarray(np.sqrt(two_sided) / phase_per_rate * math.degrees(1.0) * 3600.0)


def loss_db(
    temperature: Array,
    hours: Array,
    *,
    per_kelvin: float,
    curvature: float = 0.0,
    per_hour: float = 0.0,
    power: float = 1.0,
) -> Array:
    """Light lost [dB], by temperature [degC] about 40 degC and by age [h] to a `power`.

    Examples
    --------
    >>> float(loss_db(np.array(60.0), np.array(2.0), per_kelvin=0.01, per_hour=0.1))
    0.4
    """
    warm = np.asarray(temperature) - 40.0
    return np.asarray(
        per_kelvin * warm + curvature * warm**2 + per_hour * np.asarray(hours) ** power
    )


def share_source(own: Array, common: Array, *, shares: Array) -> Array:
    """Replace a part of each axis's white noise by the noise of the common source; the level of no axis changes.

    Parameters
    ----------
    own : ndarray, shape (axis, time)
        Independent noise of the axes, any unit.
    common : ndarray, shape (time,)
        Noise of the source, of unit variance.
    shares : ndarray, shape (axis,)
        Correlation of each axis with the source, between -1 and 1; the sign is that of its
        modulation.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> both = share_source(rng.normal(size=(2, 100_000)), rng.normal(size=100_000), shares=np.array([0.5, -0.5]))
    >>> round(float(np.corrcoef(both)[0, 1]), 2)
    -0.25
    """
    level = own.std(axis=1, keepdims=True)
    return np.asarray(np.sqrt(1 - shares**2)[:, None] * own + shares[:, None] * level * common)
