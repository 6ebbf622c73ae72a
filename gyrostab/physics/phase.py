"""Phases, and the spectra of lines, resonances and correlated bias in averaged samples."""

from __future__ import annotations

import math

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.kernels.spectra.expected import interval_variance
from gyrostab.physics.base import Chunk, Windows

#: Degrees in a turn.
TURN = 360.0


def fold(frequency: Floats | float, rate: float) -> Floats:
    """Compute the aliased frequency of a line in samples at `rate` [Hz], from 0 to half of it.

    Examples
    --------
    >>> fold(np.array([30.0, 70.0, 120.0]), 100.0)
    array([30., 30., 20.])
    """
    return np.abs(frequency - rate * np.round(np.asarray(frequency, np.float64) / rate))


def turns_of_samples(rotation: Floats, rate: float, carry: float) -> tuple[Floats, Floats, float]:
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


def turn_means(middle: Floats, inside: Floats, phase: Floats | float = 0.0) -> Floats:
    """Average ``cos(2 pi turns + phase)`` over intervals of constant rotation (`phase` in rad)."""
    return np.asarray(np.sinc(inside) * np.cos(2.0 * math.pi * np.remainder(middle, 1.0) + phase))


def sine_means(chunk: Chunk, frequency: float, phase: Floats | float = 0.0) -> Floats:
    """Average ``sin(2 pi f t + phase)`` over every sample (`frequency` in Hz, `phase` in rad)."""
    cycles = frequency / chunk.rate
    middle = (np.arange(chunk.first, chunk.first + chunk.size, dtype=np.float64) + 0.5) * cycles
    return turn_means(middle, np.full(1, cycles), phase - math.pi / 2.0)


def turn_means_of_windows(
    windows: Windows, rotation: Floats, phase: Floats, *, order: float = 1.0
) -> Floats:
    """Average ``cos(2 pi order turns + phase)`` over windows, as measured where that is known.

    Otherwise the rotation is taken as even within a window, which it is not in stick-slip.

    Parameters
    ----------
    rotation : ndarray, shape (window,)
        Mean rotation rate [degree s-1].
    phase : ndarray, shape (axis,)
        Phase on each axis of the windows [radian].

    Returns
    -------
    ndarray, shape (axis, window)
    """
    rate, centre = order * rotation / TURN, windows.centre
    between = (rate[1:] + rate[:-1]) / 2.0 * np.diff(centre)
    middle = np.cumsum(np.concatenate([rate[:1] * centre[:1], between]))
    means = turn_means(middle, rate * (windows.end - windows.begin), phase[:, None])
    for row, axis in enumerate(windows.axes):
        known = windows.turn_means.get(axis, np.empty((0, 0)))
        if order in range(1, known.shape[1] + 1):
            means[row] = (known[:, int(order) - 1] * np.exp(1j * phase[row])).real
    return means


def line_density(windows: Windows, frequency: Floats | float, power: Floats | float) -> Floats:
    """Compute the two-sided density [unit of `power` Hz-1] that a line adds to its band.

    The bands meet halfway in log frequency.

    Parameters
    ----------
    windows : Windows
        Windows with their bands.
    frequency : ndarray, shape (window,)
        Aliased frequency of the line [Hz]; several lines, shape (line, window), add up.
    power : ndarray or float
        Mean square of the line, or of each; NaN in all bands where it is unknown.

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
    shape = (windows.begin.size, centres.size)
    band = np.searchsorted(edges, frequency, side="right") - 1
    band, strength, window = np.broadcast_arrays(band, power, np.arange(shape[0]))
    hit = (band >= 0) & (band < shape[1])
    density = np.zeros(shape)
    np.add.at(density, (window[hit], band[hit]), strength[hit])
    density[window[np.isnan(strength)]] = np.nan
    return density / (2.0 * np.diff(edges))


def steady_line(windows: Windows, frequency: float) -> tuple[Floats, Floats]:
    """Compute aliased frequency [Hz] and density of a sinusoid of unit amplitude in the windows."""
    place = np.full(windows.begin.size, float(fold(frequency, windows.rate)))
    return place, line_density(windows, place, 0.5 * np.sinc(frequency / windows.rate) ** 2)


def resonance_density(windows: Windows, frequency: float, quality: float) -> Floats:
    """Compute the two-sided density [Hz-1] of a resonance of unit mean square in the samples.

    It is the same in all windows, shape (window, band).
    """
    from gyrostab.kernels.random.coloured import folded_psd, oscillator_psd

    highest = frequency * (1.0 + 20.0 / quality)
    folded = folded_psd(
        lambda f: oscillator_psd(f, frequency, quality),
        windows.frequency,
        windows.rate,
        highest,
        average=True,
    )
    return np.broadcast_to(folded, (windows.begin.size, folded.size))


def lorentz_density(frequency: Floats, correlation_time: float, rate: float) -> Floats:
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
    at_once = float(interval_variance(np.array(x)))
    turn = np.exp(-2j * np.pi * np.asarray(frequency, np.float64) / rate)
    return np.asarray(
        (at_once + 2.0 * (lost / x) ** 2 * (turn / (1.0 - math.exp(-x) * turn)).real) / rate
    )
