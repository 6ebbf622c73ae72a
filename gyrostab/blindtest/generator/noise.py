"""Base noise, independent of the package, and the noise of real recordings.

Base noise is white, flicker, random walk and angle quantization. Noise of a real recording is
measured on the recording, because five terms do not describe it: the spectrum at every line, the
typical level of each band, the fluctuation of that level in time, and the largest outlier.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft, signal, special
from scipy.ndimage import uniform_filter1d
from scipy.optimize import nnls
from scipy.signal import lfilter

from gyrostab.arrays import Floats

URAD = math.degrees(1e-6) * 3600.0  # urad -> deg/h s

#: Bands of equal width in which levels are measured, from 0 to half the rate.
BANDS = 24

_MIN_BLOCK_SAMPLES = 6 * BANDS
_SMOOTHING_LINES = 33
_SLOPE_LINES = 128  # lowest lines, to which the slope of the slow noise is fitted
#: White, flicker and random walk, in units of the level, from which the fit of the slope starts:
#: one strong line can cause several local optima.
_STARTS = (
    (1.0, 1e-2, 1e-2),
    (1.0, 10.0, 1e-2),
    (1.0, 1e-2, 100.0),
    (1e-2, 10.0, 1e-2),
    (1e-2, 1e-2, 100.0),
)
_MAX_ROUNDS = 100
_MIN_STEP_NATS = 1e-9
_STEPS = 0.5 ** np.arange(20.0)
_MIN_PRESENT_SHARE = 0.5  # of the samples of two blocks
_LINES_PER_INDEPENDENT = (
    1.94  # neighbouring lines whose powers say as much as one, behind a Hann window
)


def white_level(n: float) -> float:
    """Convert an angle random walk `n` [deg/sqrt(h)] to a root density [deg/h per root Hz]."""
    return 60.0 * n


def floor_psd(frequency: Floats, *, noise: dict[str, float], rate: float) -> Floats:
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
) -> Floats:
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


def random_walk(rng: np.random.Generator, size: int, *, k: float, rate: float) -> Floats:
    """Draw a rate random walk `k` [deg/h^1.5] that starts at 0."""
    return np.asarray(np.cumsum(rng.standard_normal(size)) * k / math.sqrt(3600.0 * rate))


def quantize_angle(values: Floats, *, q: float, rate: float, first: float = 0.0) -> Floats:
    """Quantize rates (time,) [deg/h] like an angle counter: they become differences of steps.

    `q` is the coefficient Q [urad], the step of the angle over root 12, and `first` the initial
    position of the angle within its step, 0 to 1.
    """
    if q == 0:
        return np.asarray(values, dtype=float)
    step = q * URAD * math.sqrt(12.0)
    angle = np.floor(np.cumsum(np.asarray(values, dtype=float) / rate) / step + first)
    return np.asarray(np.diff(angle, prepend=math.floor(first)) * step * rate)


@dataclass(frozen=True)
class MeasuredNoise:
    """Noise of a real recording."""

    rate: float  # sampling rate [Hz]
    #: (axis, line): two-sided density [(deg/h)2/Hz] at the frequencies ``k rate / (2 size)``, k
    #: from 1.
    lines: Floats
    level: Floats  # (axis, band): typical density in `BANDS` bands [(deg/h)2/Hz]
    #: (axis, block, band): logarithm of the density near each block over `level`; NaN where too
    #: much is missing.
    log_power: Floats
    block: int  # samples of a block
    outlier_sigma: Floats  # (axis,): standard deviation that a single outlier must exceed [deg/h]

    def blocks(self, values: Floats) -> Floats:
        """Average values (..., second, band) over blocks; the first starts half a block late."""
        number, seconds = self.log_power.shape[1], values.shape[-2]
        sample = np.arange(number * self.block)
        second = ((sample + self.block // 2) // self.rate).astype(np.int64)
        share = np.bincount(sample // self.block * seconds + second, minlength=number * seconds)
        return np.asarray(share.reshape(number, seconds) / self.block @ values)

    def change_nats(self, change: Floats, *, axis: int) -> float:
        """Compute the evidence [nats] for a known change of level against its fluctuation.

        `change` (block, band) is that of the logarithm of the density. The bands have the weights
        that are best for a steady level.
        """
        present = np.isfinite(self.log_power[axis]).all(axis=1)
        change = change[present] - change[present].mean(axis=0)
        gain = np.sqrt((change**2).mean(axis=0))
        if not gain.any():
            return 0.0
        samples = self.block / BANDS
        weight = gain / float((gain**2).sum())
        size, wander = change @ weight, self.log_power[axis][present] @ weight
        rate = self.rate / self.block
        density = np.maximum(
            smooth_periodogram(wander, rate=rate), 2.0 / (samples * float((gain**2).sum())) / rate
        )
        return 0.5 * float((fft.dct(size, norm="ortho")[1:] ** 2 / rate / density).sum())


def smooth_periodogram(values: Floats, *, rate: float) -> Floats:
    """Compute the two-sided density [unit2/Hz] of values (time,) at ``k rate / (2 size)``, k >= 1.

    The ratio of each line to a fitted slope (white, flicker and random walk) is averaged over 33
    lines.
    """
    present = np.isfinite(values)
    filled = np.where(present, values - values[present].mean(), 0.0)
    lines = fft.dct(filled, norm="ortho")[1:] ** 2 / (rate * present.mean())
    slope = _fit_slope(lines[:_SLOPE_LINES])(np.arange(1.0, values.size))
    return np.asarray(
        slope * uniform_filter1d(lines / slope, min(_SMOOTHING_LINES, lines.size), mode="reflect")
    )


def _fit_slope(lines: Floats) -> Callable[[Floats], Floats]:
    """Fit white, flicker and random walk to the first lines by Whittle's likelihood."""
    level = float(np.median(lines)) / math.log(2.0) + 1e-300
    power, shapes = lines / level, _slope_terms(np.arange(1.0, lines.size + 1))
    fits = [_fit_from_start(power, shapes, np.array(start)) for start in _STARTS]
    best = min(fits, key=lambda size: _minus_log_likelihood(power, shapes @ size))
    return lambda k: level * (_slope_terms(k) @ best)


def _fit_from_start(power: Floats, shapes: Floats, size: Floats) -> Floats:
    """Fit non-negative sizes of terms to powers by Fisher scoring with step halving."""
    density = shapes @ size
    misfit = _minus_log_likelihood(power, density)
    for _ in range(_MAX_ROUNDS):
        way = nnls(shapes / density[:, None], power / density)[0] - size
        previous_misfit = misfit
        for step in _STEPS:
            density = shapes @ (size + step * way)
            misfit = _minus_log_likelihood(power, density)
            if misfit < previous_misfit:
                break
        else:
            return size
        size = size + step * way
        if previous_misfit - misfit < _MIN_STEP_NATS:
            break
    return size


def _slope_terms(number: Floats) -> Floats:
    """Compute white, flicker and random walk (line, term) at line numbers."""
    return np.asarray(number[:, None] ** -np.arange(3.0))


def _minus_log_likelihood(power: Floats, density: Floats) -> float:
    """Compute minus the logarithm of Whittle's likelihood."""
    return float((np.log(density) + power / density).sum())


def _block_powers(values: Floats, *, rate: float, block: int) -> Floats:
    """Compute the two-sided density (block, band) [unit2/Hz] in Hann windows of two blocks."""
    cut = np.lib.stride_tricks.sliding_window_view(values, 2 * block)[::block]
    present = np.isfinite(cut)
    mean = np.nansum(cut, axis=1, keepdims=True) / np.maximum(present.sum(axis=1, keepdims=True), 1)
    window = signal.windows.hann(2 * block, sym=False)
    weight = (present * window**2).sum(axis=1, keepdims=True)
    lines = np.abs(
        fft.rfft(np.where(present, (cut - mean) * window, 0.0), axis=1)[:, 1:-1]
    ) ** 2 / (rate * np.maximum(weight, 1e-9))
    edges = np.linspace(0, block - 1, BANDS + 1).astype(int)
    power = np.add.reduceat(lines, edges[:-1], axis=1) / np.diff(edges)
    return np.where(
        present.mean(axis=1, keepdims=True) > _MIN_PRESENT_SHARE, np.maximum(power, 1e-300), np.nan
    )


def _outlier_sigma(values: Floats, lines: Floats, *, rate: float) -> float:
    """Compute the standard deviation for one outlier, from whitened noise and its extreme."""
    present = np.isfinite(values)
    white = fft.dct(np.where(present, values - values[present].mean(), 0.0), norm="ortho")
    white[0], white[1:] = 0.0, white[1:] / (lines * rate)
    filtered = fft.idct(white, norm="ortho")  # matched filter of each sample
    worth = float((1.0 / (lines * rate)).mean())
    wildest = float(np.abs(filtered[present]).max()) / math.sqrt(worth)
    return max(1.0, wildest / math.sqrt(2.0 * math.log(values.size))) / math.sqrt(worth)


def measure_noise(record: Floats, *, rate: float, axes: int | None = None) -> MeasuredNoise:
    """Measure the noise of a real record (axis, time) [deg/h], NaN where lost, at a rate [Hz].

    Axes that the record lacks of the number `axes` repeat the first.
    """
    block = max(math.ceil(rate), _MIN_BLOCK_SAMPLES)
    lines = np.stack([smooth_periodogram(row, rate=rate) for row in record])
    powers = np.log(np.stack([_block_powers(row, rate=rate, block=block) for row in record]))
    half = (
        block / BANDS / _LINES_PER_INDEPENDENT
    )  # degrees of freedom: the median of a mean of squares is below its mean
    typical = np.nanmedian(powers, axis=1, keepdims=True) - math.log(
        float(special.gammaincinv(half, 0.5)) / half
    )
    jump = np.array(
        [
            _outlier_sigma(row, row_lines, rate=rate)
            for row, row_lines in zip(record, lines, strict=True)
        ]
    )
    of = np.r_[0 : len(record), np.zeros(max(0, (axes or 0) - len(record)), dtype=int)]
    return MeasuredNoise(
        rate, lines[of], np.exp(typical[of, 0]), (powers - typical)[of], block, jump[of]
    )
