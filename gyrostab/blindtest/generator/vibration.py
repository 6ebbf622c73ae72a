"""Shaking at some kHz, through the mount and the logger's decimator, so that folding and rectification come out by themselves."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import signal

__all__ = [
    "FAST",
    "band_noise",
    "decimate",
    "decimator_taps",
    "folded_psd",
    "mount_filter",
    "rectify",
]

Array = NDArray[np.float64]

#: Rate at which shaking is made [Hz].
FAST = 4000.0


def _band(low: float, high: float) -> Array:
    return np.asarray(signal.butter(2, [low, high], btype="bandpass", fs=FAST, output="sos"))


def _power(sos: Array, low: float) -> float:
    """Variance of white noise of unit variance behind the filter."""
    f = np.geomspace(low / 30, FAST / 2 - 1e-6, 4000)
    gain = np.abs(signal.freqz_sos(sos, worN=f, fs=FAST)[1]) ** 2
    return float(np.trapezoid(gain, f)) / (FAST / 2)


def band_noise(rng: np.random.Generator, size: int, *, low: float, high: float) -> Array:
    """Random acceleration of unit rms between two frequencies [Hz], `size` samples at `FAST`.

    Examples
    --------
    >>> x = band_noise(np.random.default_rng(0), 200_000, low=700, high=800)
    >>> bool(abs(x.std() - 1) < 0.03)
    True
    """
    sos = _band(low, high)
    settle = round(2 * FAST / low)
    x = signal.sosfilt(sos, rng.standard_normal(size + settle))[settle:]
    return np.asarray(x / math.sqrt(_power(sos, low)))


def mount_filter(resonance: float, *, quality: float) -> tuple[Array, Array]:
    """Digital filter (b, a) at `FAST` of a mass on a damped spring: 1 below the `resonance` [Hz], `quality` at it.

    Examples
    --------
    >>> b, a = mount_filter(120.0, quality=8.0)
    >>> round(float(abs(signal.freqz(b, a, worN=[120.0], fs=FAST)[1][0])), 1)  # root(1 + Q^2)
    8.1
    """
    w = 2 * math.pi * resonance
    warped = 2 * FAST * math.tan(w / (2 * FAST))
    damping = warped / quality
    b, a = signal.bilinear([damping, warped**2], [1.0, damping, warped**2], fs=FAST)
    return np.asarray(b), np.asarray(a)


def decimator_taps(rate: float, kind: str) -> Array:
    """Weights of the logger's filter from `FAST` down to `rate` [Hz]; they sum to 1.

    Parameters
    ----------
    rate : float
        Rate of the log [Hz], a divisor of `FAST`.
    kind : {"point", "dump", "cic2", "cic3", "fir"}
        Take every n-th value, integrate and dump, two or three such in a row, or a short windowed
        sinc.

    Examples
    --------
    >>> decimator_taps(400.0, "dump").size
    10
    """
    factor = round(FAST / rate)
    box = np.full(factor, 1.0 / factor)
    if kind == "point":
        return np.ones(1)
    if kind == "fir":
        taps = np.asarray(signal.firwin(3 * factor + 1, 0.42 * rate, fs=FAST, window="hamming"))
        return np.asarray(taps / taps.sum())
    taps = box
    for _ in range({"dump": 0, "cic2": 1, "cic3": 2}[kind]):
        taps = np.convolve(taps, box)
    return taps


def decimate(x: Array, *, rate: float, kind: str) -> Array:
    """Values of `x` (at `FAST`) as the logger gives them at `rate` [Hz].

    Examples
    --------
    >>> decimate(np.ones(40_000), rate=100.0, kind="cic2").round(6)[[5, 500]].tolist()
    [1.0, 1.0]
    """
    factor = round(FAST / rate)
    smooth = signal.oaconvolve(x, decimator_taps(rate, kind))[: x.size]
    return np.asarray(smooth[factor - 1 :: factor])


def folded_psd(
    frequency: Array,
    *,
    rate: float,
    kind: str,
    low: float,
    high: float,
    mount: tuple[Array, Array] | None = None,
) -> Array:
    """Two-sided density [1/Hz] at `rate` [Hz] of unit-rms band noise behind mount and decimator: all aliases added.

    Examples
    --------
    >>> f = (np.arange(200) + 0.5)
    >>> flat = folded_psd(f, rate=400.0, kind="point", low=700, high=800)
    >>> round(float(2 * flat.sum()), 1)  # all of the band is there
    1.0
    """
    sos = _band(low, high)
    level = 1.0 / (FAST * _power(sos, low))
    taps = decimator_taps(rate, kind)
    alias = (np.asarray(frequency)[None, :] + rate * np.arange(round(FAST / rate))[:, None]) % FAST
    flat = alias.ravel()
    gain = (
        np.abs(signal.freqz_sos(sos, worN=flat, fs=FAST)[1]) ** 2
        * np.abs(signal.freqz(taps, worN=flat, fs=FAST)[1]) ** 2
    )
    if mount is not None:
        gain = gain * np.abs(signal.freqz(*mount, worN=flat, fs=FAST)[1]) ** 2
    return np.asarray(level * gain.reshape(alias.shape).sum(axis=0))


def rectify(rms: Array, *, exponent: float, saturation: float) -> Array:
    """Shift of the mean by shaking of `rms` [g], in g to the `exponent`; beyond `saturation` [g] it grows slower.

    Examples
    --------
    >>> rectify(np.array([1.0, 2.0, 100.0]), exponent=2.0, saturation=np.inf).tolist()
    [1.0, 4.0, 10000.0]
    """
    rms = np.asarray(rms, dtype=float)
    return np.asarray(rms**exponent / (1.0 + (rms / saturation) ** exponent))
