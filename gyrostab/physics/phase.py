"""Phases, spectral lines and aliased frequencies."""

from __future__ import annotations

import math

import numpy as np

from gyrostab.physics.base import Array, Windows

__all__ = ["TURN", "fold", "line_density", "turn_means", "turns_of_samples", "turns_of_windows"]

#: Degrees in a turn.
TURN = 360.0


def fold(frequency: Array | float, rate: float) -> Array:
    """Compute the aliased frequency of a line in samples at `rate` [Hz], from 0 to half of it.

    Examples
    --------
    >>> fold(np.array([30.0, 70.0, 120.0]), 100.0)
    array([30., 30., 20.])
    """
    return np.abs(frequency - rate * np.round(np.asarray(frequency, np.float64) / rate))


def turns_of_samples(rotation: Array, rate: float, carry: float) -> tuple[Array, Array, float]:
    """Compute the turns at the middle of every sample, within it, and at the end of the last.

    The rotation rate is constant within a sample.

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
    """Average ``cos(2 pi turns + phase)`` over intervals of constant rotation (`phase` in rad)."""
    return np.asarray(np.sinc(inside) * np.cos(2.0 * math.pi * np.remainder(middle, 1.0) + phase))


def turns_of_windows(windows: Windows, rotation: Array) -> tuple[Array, Array]:
    """Compute the turns up to the middle of every window, and within it, from its mean rate."""
    rate, centre = rotation / TURN, windows.centre
    between = (rate[1:] + rate[:-1]) / 2.0 * np.diff(centre)
    return np.cumsum(np.concatenate([rate[:1] * centre[:1], between])), rate * (
        windows.end - windows.begin
    )


def line_density(windows: Windows, frequency: Array | float, power: Array | float) -> Array:
    """Compute the two-sided density [unit of `power` Hz-1] that a line adds to its band.

    The bands meet halfway in log frequency.

    Parameters
    ----------
    windows : Windows
        Windows with their bands.
    frequency : ndarray, shape (window,)
        Aliased frequency of the line [Hz].
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
