"""Expected periodograms of noise in a block, with taper, mean and sampling."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gyrostab.arrays import Floats

# ordinates that are computed one by one; above, the ratio to the plain spectrum is interpolated
_EXACT = 48
_SPARSE = 48


def _second_difference(integral: Floats) -> Floats:
    """``F(l + 1) - 2 F(l) + F(l - 1)`` for an even F given at 0, 1, 2, ..."""
    return np.concatenate(
        [[2.0 * (integral[1] - integral[0])], integral[2:] - 2.0 * integral[1:-1] + integral[:-2]]
    )


def sample_covariance(size: int, rate: float) -> Floats:
    """Compute the covariance of samples l apart for unit Q, N, B and K, as means over intervals.

    That of B and K is defined up to a constant, on which no block statistic depends.

    Parameters
    ----------
    size : int
        Lags.
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    ndarray, shape (4, size)
        For angles of unit variance [1 s-2], a density of 1 [Hz], ``B = 1`` and ``variance of the
        walk 1 / s`` [s].
    """
    lag = np.arange(size + 1, dtype=np.float64)
    out = np.zeros((4, size))
    out[0, :2] = 2.0 * rate**2, -(rate**2)
    out[1, 0] = rate
    inner = np.log(np.maximum(lag, 1.0)) * lag**2
    distance = np.maximum(lag[:-1], 1.0)
    out[2] = _second_difference(0.75 * lag**2 - 0.5 * inner) / math.pi
    # of the second difference, which loses its digits far out
    series = -(np.log(distance) - 1.0 / (12.0 * distance**2)) / math.pi
    out[2] = np.where(lag[:-1] > 1000.0, series, out[2])
    out[3] = np.where(lag[:-1] > 0.0, -lag[:-1] / 2.0, -1.0 / 6.0) / rate
    return out


def _plain_spectra(frequency: Floats, rate: float) -> Floats:
    """Compute plain two-sided densities of the four terms, shape (4, frequency).

    For unit strength, without averaging over the samples: only the shape that is interpolated. The
    laws are in `gyrostab.noise`, which kernels do not import.
    """
    bend = np.sin(math.pi * frequency / rate)
    return np.stack(
        [
            4.0 * rate * bend**2,
            np.ones_like(frequency),
            0.5 / (math.pi * frequency),
            1.0 / (2.0 * rate * bend) ** 2,
        ]
    )


def expected_powers(weights: Floats, rate: float, ordinates: int) -> Floats:
    """Compute the expected periodogram of a full block for unit strength of each term, two-sided.

    Parameters
    ----------
    weights : ndarray, shape (size,)
        The taper, applied after the mean of the block is removed.
    rate : float
        Sampling rate [Hz].
    ordinates : int
        Number of ordinates, from 1 on.

    Returns
    -------
    ndarray, shape (4, ordinates)
        Q, N, B, K in the units of `sample_covariance`; the power of white noise is exactly its
        density.

    Examples
    --------
    >>> powers = expected_powers(np.ones(256), 1.0, 100)
    >>> plain = 1.0 / (2.0 * np.pi * np.arange(1, 101) / 256.0) ** 2
    >>> (powers[3] / plain)[:3].round(1)  # no taper: a random walk appears twice
    array([2., 2., 2.])
    """
    powers = _tapered_powers(
        sample_covariance(weights.size, rate),
        weights,
        ordinates,
        lambda frequency: _plain_spectra(frequency, rate),
        rate,
    )
    return np.asarray(powers / powers[1])


def interval_variance(ratio: Floats) -> Floats:
    """Compute the variance of the mean of a unit exponentially correlated process over an interval.

    Parameters
    ----------
    ratio : ndarray
        Interval over correlation time.

    Examples
    --------
    >>> interval_variance(np.array([1e-6, 1.0])).round(3)  # 2 / e
    array([1.   , 0.736])
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        law = 2.0 * (ratio + np.expm1(-ratio)) / ratio**2
    return np.where(ratio > 1e-3, law, 1.0 - ratio / 3.0 + ratio**2 / 12.0)


def correlated_powers(weights: Floats, rate: float, ordinates: int, time: float) -> Floats:
    """Compute the expected periodogram of an exponentially correlated process.

    Parameters
    ----------
    weights, rate, ordinates
        As in `expected_powers`.
    time : float
        Correlation time [s].

    Returns
    -------
    ndarray, shape (ordinates,)
        For unit variance [Hz-1], in the sense of `expected_powers`.

    Examples
    --------
    >>> powers = correlated_powers(np.ones(256), 1.0, 100, 1e6)
    >>> walk = 2e-6 * expected_powers(np.ones(256), 1.0, 100)[3]  # of a variance of 2 s / 1e6 s
    >>> (powers / walk)[:3].round(3)
    array([1., 1., 1.])
    """
    step = 1.0 / (rate * time)
    lost = -math.expm1(-step)
    lag = np.arange(weights.size)
    covariance = (lost / step) ** 2 * np.exp(-step * np.maximum(lag - 1, 0))
    covariance[0] = interval_variance(np.array(step))
    white = np.zeros(weights.size)
    white[0] = rate

    def plain(frequency: Floats) -> Floats:
        bend = 2.0 * np.sin(math.pi * frequency / rate)
        return np.stack([np.ones_like(frequency), 1.0 / (step**2 + bend**2)])

    of_white, power = _tapered_powers(
        np.stack([white, covariance]), weights, ordinates, plain, rate
    )
    return np.asarray(power / of_white)


def _tapered_powers(
    covariance: Floats,
    weights: Floats,
    ordinates: int,
    plain: Callable[[Floats], Floats],
    rate: float,
) -> Floats:
    """Compute expected periodograms (row, ordinate) of covariances (row, size), up to a factor.

    Between the ordinates that are computed one by one, the ratio to `plain` spectra (row, ...) is
    interpolated.
    """
    size = weights.size
    places = np.unique(
        np.concatenate(
            [
                np.arange(1, min(_EXACT, ordinates) + 1),
                np.geomspace(1, ordinates, _SPARSE).round().astype(int),
            ]
        )
    )
    middle = np.zeros((len(covariance), 1))
    wrapped = np.concatenate([covariance, middle, covariance[:, :0:-1]], axis=1)
    density = np.fft.fft(wrapped, axis=1).real
    taper, box = np.fft.fft(weights, 2 * size), np.fft.fft(np.ones(size), 2 * size)
    powers = np.empty((len(covariance), places.size))
    for number, k in enumerate(places):
        response = np.roll(taper, 2 * k) - np.conj(taper[2 * k]) * box / size
        powers[:, number] = density @ (response.real**2 + response.imag**2) / (2 * size)
    ratio = powers / plain(places * rate / size)
    lines = np.arange(1, ordinates + 1)
    between = np.stack([np.interp(np.log(lines), np.log(places), row) for row in ratio])
    return np.asarray(between * plain(lines * rate / size))
