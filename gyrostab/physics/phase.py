"""Phases, lines and folded frequencies: what the effects with a frequency share."""

from __future__ import annotations

import math

import numpy as np

from gyrostab.physics.base import Array, Windows

__all__ = ["TURN", "fold", "line_density", "turn_means", "turns_of_samples", "turns_of_windows"]

#: Degrees in a turn.
TURN = 360.0


def fold(frequency: Array | float, rate: float) -> Array:
    """Frequency at which a line shows in samples at `rate` [Hz], from 0 to half of it.

    Examples
    --------
    >>> fold(np.array([30.0, 70.0, 120.0]), 100.0)
    array([30., 30., 20.])
    """
    return np.abs(frequency - rate * np.round(np.asarray(frequency, np.float64) / rate))


def turns_of_samples(rotation: Array, rate: float, carry: float) -> tuple[Array, Array, float]:
    """Turns at the middle of every sample and inside of it, and at the end of the last, with the rotation rate constant inside of each.

    Parameters
    ----------
    rotation : ndarray, shape (n,)
        Rotation rate [degree s-1].
    rate : float
        Sampling rate [Hz].
    carry : float
        Turns at the start of the first sample.

    Examples
    --------
    >>> turns_of_samples(np.array([180.0, 360.0]), 1.0, 10.0)
    (array([10.25, 11.  ]), array([0.5, 1. ]), 11.5)
    """
    inside = rotation / (TURN * rate)
    edges = np.cumsum(np.concatenate([[carry], inside]))
    return edges[:-1] + inside / 2.0, inside, float(edges[-1])


def turn_means(middle: Array, inside: Array, phase: Array | float = 0.0) -> Array:
    """Mean of ``cos(2 pi turns + phase)`` over intervals in which the turns go on evenly; `phase` in radian."""
    return np.asarray(np.sinc(inside) * np.cos(2.0 * math.pi * np.remainder(middle, 1.0) + phase))


def turns_of_windows(windows: Windows, rotation: Array) -> tuple[Array, Array]:
    """Turns from the start of the log to the middle of every window, and inside of it, from its mean rotation rate [degree s-1]."""
    rate, centre = rotation / TURN, windows.centre
    between = (rate[1:] + rate[:-1]) / 2.0 * np.diff(centre)
    return np.cumsum(np.concatenate([rate[:1] * centre[:1], between])), rate * (
        windows.end - windows.begin
    )


def line_density(windows: Windows, frequency: Array | float, power: Array | float) -> Array:
    """Two-sided density [Hz-1 times the unit of `power`] that a line adds to the band it lies in; the bands meet halfway, in log frequency.

    Parameters
    ----------
    windows : Windows
        Its bands.
    frequency : ndarray, shape (window,)
        Where the line shows [Hz].
    power : ndarray or float
        Mean square of the line.

    Returns
    -------
    ndarray, shape (window, band)
    """
    centres = windows.frequency
    if centres.size < 2:
        edges = np.array([0.5, 1.5]) * centres
    else:
        inner = np.sqrt(centres[1:] * centres[:-1])
        edges = np.concatenate(
            [[centres[0] ** 2 / inner[0]], inner, [centres[-1] ** 2 / inner[-1]]]
        )
    where = np.broadcast_to(np.asarray(frequency, np.float64), windows.begin.shape)[:, None]
    hit = (where >= edges[:-1]) & (where < edges[1:])
    strength = np.broadcast_to(np.asarray(power, np.float64), windows.begin.shape)[:, None]
    return hit * strength / (2.0 * np.diff(edges))
