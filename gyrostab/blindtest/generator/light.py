"""Noise from light: shot, thermal and excess noise, and loss of light."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CHARGE = 1.602176634e-19
BOLTZMANN = 1.380649e-23
#: Current of the detector per light power [A/W], and temperature of its load [K].
RESPONSIVITY, LOAD_TEMPERATURE = 0.9, 300.0


def detector_psd(power: Array, *, load: float = 50e3, rin: float = 1e-12) -> dict[str, Array]:
    """Compute the one-sided densities [A2/Hz] of the current of a detector under `power` [W].

    `load` is its resistance [ohm], and `rin` the relative intensity noise of the source [1/Hz],
    about its coherence time.
    """
    current = RESPONSIVITY * np.asarray(power, dtype=float)
    return {
        "shot": 2 * CHARGE * current,
        "thermal": np.full_like(current, 4 * BOLTZMANN * LOAD_TEMPERATURE / load),
        "excess": rin * current**2,
    }


def relative_psd(power: Array, *, depth: float = 0.75 * math.pi, **detector: float) -> Array:
    """Compute the one-sided phase noise [rad2/Hz] of an interferometer biased at `depth` [rad].

    The signal is ``P (1 + cos(phase))``: its slope is ``P sin(depth)``, and the light at the
    detector ``P (1 + cos(depth))``.
    """
    detected_power = np.asarray(power, dtype=float) * (1 + math.cos(depth))
    total = sum(detector_psd(detected_power, **detector).values())
    slope = RESPONSIVITY * np.asarray(power) * math.sin(depth)
    return np.asarray(total / slope**2)


def loss_db(
    temperature: Array,
    hours: Array,
    *,
    per_kelvin: float,
    curvature: float = 0.0,
    per_hour: float = 0.0,
    power: float = 1.0,
) -> Array:
    """Compute the loss of light [dB] from temperature [degC], relative to 40 degC, and age [h].

    Examples
    --------
    >>> float(loss_db(np.array(60.0), np.array(2.0), per_kelvin=0.01, per_hour=0.1))
    0.4
    """
    warm = np.asarray(temperature) - 40.0
    return np.asarray(
        per_kelvin * warm + curvature * warm**2 + per_hour * np.asarray(hours) ** power
    )
