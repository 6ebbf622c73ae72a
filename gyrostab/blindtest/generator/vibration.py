"""Vibration at 4 kHz through mount and decimator, which produces aliasing and rectification."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]

#: Rate at which vibration is generated [Hz].
FAST_HZ = 4000.0


def _design_bandpass(low: float, high: float) -> Array:
    return np.asarray(signal.butter(2, [low, high], btype="bandpass", fs=FAST_HZ, output="sos"))


def _filtered_variance(sos: Array, low: float) -> float:
    """Compute the variance of filtered white noise of unit variance."""
    f = np.geomspace(low / 30, FAST_HZ / 2 - 1e-6, 4000)
    gain = np.abs(signal.freqz_sos(sos, worN=f, fs=FAST_HZ)[1]) ** 2
    return float(np.trapezoid(gain, f)) / (FAST_HZ / 2)


def band_noise(rng: np.random.Generator, size: int, *, low: float, high: float) -> Array:
    """Draw acceleration of unit rms between two frequencies [Hz], `size` samples at `FAST_HZ`."""
    sos = _design_bandpass(low, high)
    settle = round(2 * FAST_HZ / low)
    x = signal.sosfilt(sos, rng.standard_normal(size + settle))[settle:]
    return np.asarray(x / math.sqrt(_filtered_variance(sos, low)))


def mount_filter(resonance: float, *, quality: float) -> tuple[Array, Array]:
    """Design the filter (b, a) at `FAST_HZ` of a damped mount with a `resonance` [Hz]."""
    w = 2 * math.pi * resonance
    warped = 2 * FAST_HZ * math.tan(w / (2 * FAST_HZ))
    damping = warped / quality
    b, a = signal.bilinear([damping, warped**2], [1.0, damping, warped**2], fs=FAST_HZ)
    return np.asarray(b), np.asarray(a)


def decimator_taps(rate: float, kind: str) -> Array:
    """Compute the weights, of sum 1, of the decimator from `FAST_HZ` to its divisor `rate` [Hz].

    Kinds are "point" (every n-th value), "dump" (integrate and dump), "cic2" (two of these in
    series) and "fir" (a short windowed sinc).
    """
    factor = round(FAST_HZ / rate)
    box = np.full(factor, 1.0 / factor)
    if kind == "point":
        return np.ones(1)
    if kind == "fir":
        taps = np.asarray(signal.firwin(3 * factor + 1, 0.42 * rate, fs=FAST_HZ, window="hamming"))
        return np.asarray(taps / taps.sum())
    return box if kind == "dump" else np.convolve(box, box)


def decimate(x: Array, *, rate: float, kind: str) -> Array:
    """Decimate `x` from `FAST_HZ` to `rate` [Hz] like the logger."""
    factor = round(FAST_HZ / rate)
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
    """Compute the aliased two-sided density [1/Hz] of unit-rms band noise after the decimator."""
    sos = _design_bandpass(low, high)
    level = 1.0 / (FAST_HZ * _filtered_variance(sos, low))
    taps = decimator_taps(rate, kind)
    alias = (
        np.asarray(frequency)[None, :] + rate * np.arange(round(FAST_HZ / rate))[:, None]
    ) % FAST_HZ
    flat = alias.ravel()
    gain = (
        np.abs(signal.freqz_sos(sos, worN=flat, fs=FAST_HZ)[1]) ** 2
        * np.abs(signal.freqz(taps, worN=flat, fs=FAST_HZ)[1]) ** 2
    )
    if mount is not None:
        gain = gain * np.abs(signal.freqz(*mount, worN=flat, fs=FAST_HZ)[1]) ** 2
    return np.asarray(level * gain.reshape(alias.shape).sum(axis=0))


def rectify(rms: Array, *, exponent: float, saturation: float) -> Array:
    """Compute the shift of the mean by vibration `rms` [g], with exponent and saturation [g]."""
    rms = np.asarray(rms, dtype=float)
    return np.asarray(rms**exponent / (1.0 + (rms / saturation) ** exponent))
