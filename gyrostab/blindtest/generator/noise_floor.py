"""Base noise: white, flicker, random walk and angle quantization, independent of the package."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.signal import lfilter

Array = NDArray[np.float64]

URAD = math.degrees(1e-6) * 3600.0  # urad -> deg/h s


def white_level(n: float) -> float:
    """Convert an angle random walk `n` [deg/sqrt(h)] to a root density [deg/h per root Hz]."""
    return 60.0 * n


def floor_psd(frequency: Array, *, noise: dict[str, float], rate: float) -> Array:
    """Compute the two-sided density [(deg/h)2/Hz] of N, B, K, Q [urad] at frequencies > 0 [Hz]."""
    f = np.asarray(frequency, dtype=float)
    q = noise.get("Q", 0.0) * URAD
    return np.asarray(
        white_level(noise.get("N", 0.0)) ** 2
        + 4 * q**2 * rate * np.sin(math.pi * f / rate) ** 2
        + noise.get("B", 0.0) ** 2 / (2 * math.pi * f)
        + noise.get("K", 0.0) ** 2 / 3600.0 / (2 * math.pi * f) ** 2
    )


def flicker(
    rng: np.random.Generator, size: int, *, b: float, rate: float, method: str = "spectrum"
) -> Array:
    """Draw bias instability `b` [deg/h] from its "spectrum", or as a sum of many "relaxations"."""
    if b == 0:
        return np.zeros(size)
    if method == "spectrum":
        length = fft.next_fast_len(2 * size, real=True)
        f = fft.rfftfreq(length, 1 / rate)
        f[0] = np.inf
        level = np.sqrt(b**2 / (2 * math.pi * f) * rate * length / 2)
        lines = (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)) * level
        return np.asarray(fft.irfft(lines, length)[:size])
    total = np.zeros(size)
    slowest, fastest, per_decade = 4.0 * size / rate, 0.5 / rate, 3
    times = np.geomspace(
        fastest, slowest, math.ceil(per_decade * math.log10(slowest / fastest)) + 1
    )
    step = math.log(times[1] / times[0])
    # Relaxations of equal power per log time sum to 1/f; each adds S = 2 s2 tau / (1 + (w tau)^2).
    for tau in times:
        sd = math.sqrt(b**2 / (2 * math.pi) * 2 * step)
        keep = math.exp(-1 / (rate * tau))
        shocks = rng.standard_normal(size) * sd * math.sqrt(1 - keep**2)
        shocks[0] = rng.standard_normal() * sd
        total += lfilter([1.0], [1.0, -keep], shocks)
    return total


def random_walk(rng: np.random.Generator, size: int, *, k: float, rate: float) -> Array:
    """Draw a rate random walk `k` [deg/h^1.5] that starts at 0."""
    return np.asarray(np.cumsum(rng.standard_normal(size)) * k / math.sqrt(3600.0 * rate))


def quantize_angle(values: Array, *, q: float, rate: float, first: float = 0.0) -> Array:
    """Quantize rates (time,) [deg/h] like an angle counter: they become differences of steps.

    `q` is the coefficient Q [urad], the step of the angle over root 12, and `first` the initial
    position of the angle within its step, 0 to 1.
    """
    if q == 0:
        return np.asarray(values, dtype=float)
    step = q * URAD * math.sqrt(12.0)
    angle = np.floor(np.cumsum(np.asarray(values, dtype=float) / rate) / step + first)
    return np.asarray(np.diff(angle, prepend=math.floor(first)) * step * rate)
