"""Rotation of a drilling tool with stick-slip, its toolface, and projections of fixed vectors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rate of the earth [deg/h].
EARTH_RATE = 15.041


def rotation(
    rng: np.random.Generator, seconds: float, *, dt: float, fastest: float = 120.0
) -> Array:
    """Draw the rotation rate [deg/s], every `dt` [s], of a tool that alternately drills and rests.

    In some intervals stick-slip makes the rate oscillate at 0.1-0.5 Hz. The highest speed `fastest`
    [revolutions per minute] must be resolved by `dt` and the rate of the log.

    Examples
    --------
    >>> w = rotation(np.random.default_rng(3), 900.0, dt=0.1)
    >>> bool(w.min() >= 0), bool(w.max() > 30), bool((w == 0).any())
    (True, True, True)
    """
    size = math.ceil(seconds / dt) + 1
    t = np.arange(size) * dt
    rate = np.zeros(size)
    begin = rng.uniform(0.05, 0.15) * seconds
    while begin < 0.9 * seconds:
        end = begin + rng.uniform(0.1, 0.35) * seconds
        mean = rng.uniform(0.4, 1.0) * fastest * 6.0
        inside = (t >= begin) & (t < end)
        swing = rng.uniform(0.3, 0.95) if rng.random() < 0.5 else 0.0
        beat = rng.uniform(0.1, 0.5)
        drift = 1 + 0.02 * np.sin(2 * math.pi * t / rng.uniform(40, 200))
        rate[inside] = (mean / (1 + swing) * drift * (1 + swing * np.sin(2 * math.pi * beat * t)))[
            inside
        ]
        begin = end + rng.uniform(0.08, 0.25) * seconds
    return rate


def toolface(rotation_rate: Array, *, dt: float, first: float = 0.0) -> Array:
    """Integrate rotation rates [deg/s] every `dt` [s] to the toolface [rad] by the trapezoid rule.

    Examples
    --------
    >>> round(float(toolface(np.full(11, 36.0), dt=1.0)[-1] / math.pi), 6)  # a turn in 10 s
    2.0
    """
    w = np.radians(rotation_rate)
    return np.asarray(first + np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]) * dt)]))


def cross_axis(angle: Array, *, across: float) -> tuple[Array, Array]:
    """Project a fixed vector of size `across` on the rotating axes x and y."""
    return np.asarray(across * np.cos(angle)), np.asarray(-across * np.sin(angle))


def gravity(angle: Array, *, inclination: float) -> tuple[Array, Array, Array]:
    """Compute gravity [g] along x, y, z of a tool at an `inclination` [deg] from vertical."""
    x, y = cross_axis(angle, across=math.sin(math.radians(inclination)))
    return x, y, np.full(np.shape(angle), math.cos(math.radians(inclination)))
