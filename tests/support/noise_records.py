"""Noise of an ideal sensor for tests, independent of the package: means over each sample."""

from __future__ import annotations

import numpy as np

from gyrostab.arrays import Floats


def white(rng: np.random.Generator, trials: int, n: int, *, N: float, rate: float) -> Floats:
    """Return angle random walk of N [deg/sqrt(h)] as rate [deg/h]: N sqrt(dt) of angle in dt."""
    hours = 1 / rate / 3600
    return N * np.sqrt(hours) / hours * rng.standard_normal((trials, n))


def quantization(rng: np.random.Generator, trials: int, n: int, *, Q: float, rate: float) -> Floats:
    """Return quantization noise of Q [urad]: an angle error at each end of a sample."""
    angle = np.degrees(Q * 1e-6) * rng.standard_normal((trials, n + 1))
    return np.diff(angle, axis=1) * rate * 3600


def random_walk(rng: np.random.Generator, trials: int, n: int, *, K: float, rate: float) -> Floats:
    """Rate random walk of K [deg/h^1.5]: Brownian motion averaged over each sample.

    The mean over an interval with increment d is the start plus d / 2 plus an independent part of
    variance dt / 12.
    """
    hours = 1 / rate / 3600
    steps = K * np.sqrt(hours) * rng.standard_normal((trials, n))
    return (
        np.cumsum(steps, axis=1)
        - steps / 2
        + K * np.sqrt(hours / 12) * rng.standard_normal((trials, n))
    )


def flicker(rng: np.random.Generator, trials: int, n: int, *, B: float) -> Floats:
    """Return bias instability of B [deg/h]: B^2 / (2 pi f), at eight times the rate, averaged."""
    out = np.empty((trials, n))
    fine = 8 * n
    f = np.fft.rfftfreq(4 * fine)
    amplitude = np.zeros(f.size)
    amplitude[1:] = B * np.sqrt(1 / (2 * np.pi * f[1:])) * np.sqrt(2 * fine)
    for i in range(trials):
        z = rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)
        out[i] = np.fft.irfft(amplitude * z)[:fine].reshape(n, 8).mean(axis=1)
    return out


def mixture(
    rng: np.random.Generator, trials: int, n: int, *, rate: float, **terms: float
) -> Floats:
    """Return the sum of Q, N, B and K, drawn in the order in which they are given."""
    laws = {"Q": quantization, "N": white, "K": random_walk}
    x = np.zeros((trials, n))
    for term, value in terms.items():
        if term == "B":
            x += flicker(rng, trials, n, B=value)
        else:
            x += laws[term](rng, trials, n, **{term: value}, rate=rate)
    return x


def lose(rng: np.random.Generator, x: Floats, share: float, block: float) -> Floats:
    """Lose blocks of geometric length until `share` of each row is NaN."""
    for row in x:
        lost = np.count_nonzero(np.isnan(row))
        while share and lost / row.size < share:
            start = int(rng.integers(0, row.size))
            piece = row[start : start + int(rng.geometric(1 / block))]
            lost += np.count_nonzero(np.isfinite(piece))
            piece[:] = np.nan
    return x
