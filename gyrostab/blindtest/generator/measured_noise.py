"""The noise of a real recording, measured on itself, as far as limits need it: no five terms describe it.

Its spectrum at every line, with all its slopes, filters and lines; how loud it typically is in each
band; how much that level wanders by itself in time; and how far its wildest sample jumps out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal, special
from scipy.ndimage import uniform_filter1d
from scipy.optimize import nnls

__all__ = ["BANDS", "OwnNoise", "line_density", "own_noise"]

Array = NDArray[np.float64]

#: Bands of equal width in which levels are measured, from 0 to half the rate.
BANDS = 24

_SAMPLES = 6 * BANDS  # of a block, at least
_WIDE = 33  # lines that are averaged
_LOW = 128  # lines that the slope of the slow noise is fitted to
#: White, flicker and random walk from which the fit of the slope starts, times the level: one loud
#: line can make more than one best fit.
_STARTS = (
    (1.0, 1e-2, 1e-2),
    (1.0, 10.0, 1e-2),
    (1.0, 1e-2, 100.0),
    (1e-2, 10.0, 1e-2),
    (1e-2, 1e-2, 100.0),
)
_ROUNDS, _ENOUGH = (
    100,
    1e-9,
)  # of the fit of the slope, at most; and nats that a round brings at least
_STEPS = 0.5 ** np.arange(20.0)
_LOST = 0.5  # of two blocks, at most
_LINES = 1.94  # neighbouring lines whose powers say as much as one, behind a Hann window


@dataclass(frozen=True)
class OwnNoise:
    """Noise of a real recording.

    `lines` (axis, line) is its two-sided density [(deg/h)2/Hz] at the frequencies ``k rate / (2
    size)``, k from 1; `level` (axis, band) that in `BANDS` bands, typical in time; `logs` (axis,
    block, band) the logarithm of the power about blocks of `block` samples over it, NaN where too
    much is lost; `jump` (axis,) [deg/h] the standard deviation that a single odd sample has to
    stand out of.
    """

    rate: float
    lines: Array
    level: Array
    logs: Array
    block: int
    jump: Array

    def blocks(self, values: Array) -> Array:
        """Means over the blocks, the first of which begins half a block late, of values (..., second, band)."""
        number, seconds = self.logs.shape[1], values.shape[-2]
        sample = np.arange(number * self.block)
        second = ((sample + self.block // 2) // self.rate).astype(np.int64)
        share = np.bincount(sample // self.block * seconds + second, minlength=number * seconds)
        return np.asarray(share.reshape(number, seconds) / self.block @ values)

    def change_nats(self, change: Array, *, axis: int) -> float:
        """What a known change of the level is worth beside the wandering of the level itself.

        Parameters
        ----------
        change : ndarray, shape (block, band)
            Of the logarithm of the density.
        axis : int

        Returns
        -------
        float
            Expected log-likelihood [nats], by the weights of the bands that are best where the
            level does not wander.
        """
        there = np.isfinite(self.logs[axis]).all(axis=1)
        change = change[there] - change[there].mean(axis=0)
        gain = np.sqrt((change**2).mean(axis=0))
        if not gain.any():
            return 0.0
        samples = self.block / BANDS
        weight = gain / float((gain**2).sum())
        size, wander = change @ weight, self.logs[axis][there] @ weight
        rate = self.rate / self.block
        density = np.maximum(
            line_density(wander, rate=rate), 2.0 / (samples * float((gain**2).sum())) / rate
        )
        return 0.5 * float((fft.dct(size, norm="ortho")[1:] ** 2 / rate / density).sum())


def line_density(values: Array, *, rate: float) -> Array:
    """Two-sided density [unit2/Hz] of values (time,) at the frequencies ``k rate / (2 size)``, k from 1 to size - 1.

    The mean of `_WIDE` lines about each, of what the lines are over a slope that is fitted to the
    slowest: white, flicker and random walk.

    Examples
    --------
    >>> found = line_density(np.random.default_rng(0).normal(0, 3.0, 10_000), rate=100.0)
    >>> found.size, round(float(found.mean()), 2)
    (9999, 0.09)
    """
    there = np.isfinite(values)
    filled = np.where(there, values - values[there].mean(), 0.0)
    lines = fft.dct(filled, norm="ortho")[1:] ** 2 / (rate * there.mean())
    slope = _slope(lines[:_LOW])(np.arange(1.0, values.size))
    return np.asarray(
        slope * uniform_filter1d(lines / slope, min(_WIDE, lines.size), mode="reflect")
    )


def _slope(lines: Array) -> Callable[[Array], Array]:
    """White, flicker and random walk, as a function of the number of the line, that suit the first lines best (Whittle's likelihood)."""
    level = float(np.median(lines)) / math.log(2.0) + 1e-300
    power, shapes = lines / level, _shapes(np.arange(1.0, lines.size + 1))
    found = [_suited(power, shapes, np.array(start)) for start in _STARTS]
    best = min(found, key=lambda size: _misfit(power, shapes @ size))
    return lambda k: level * (_shapes(k) @ best)


def _suited(power: Array, shapes: Array, size: Array) -> Array:
    """Sizes of terms, none below zero, that suit powers best as seen from a start.

    By Fisher scoring: least squares with the weights of the density found before, and a shorter
    step where the whole one is no better.
    """
    density = shapes @ size
    misfit = _misfit(power, density)
    for _ in range(_ROUNDS):
        way = nnls(shapes / density[:, None], power / density)[0] - size
        before = misfit
        for step in _STEPS:
            density = shapes @ (size + step * way)
            misfit = _misfit(power, density)
            if misfit < before:
                break
        else:
            return size
        size = size + step * way
        if before - misfit < _ENOUGH:
            break
    return size


def _shapes(number: Array) -> Array:
    """White, flicker and random walk (line, term) at lines of these numbers."""
    return np.asarray(number[:, None] ** -np.arange(3.0))


def _misfit(power: Array, density: Array) -> float:
    """Minus the logarithm of Whittle's likelihood."""
    return float((np.log(density) + power / density).sum())


def _block_powers(values: Array, *, rate: float, block: int) -> Array:
    """Two-sided density [unit2/Hz] about blocks (block, band) of values (time,), by Hann windows twice as long; NaN where much is lost."""
    cut = np.lib.stride_tricks.sliding_window_view(values, 2 * block)[::block]
    there = np.isfinite(cut)
    mean = np.nansum(cut, axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
    window = signal.windows.hann(2 * block, sym=False)
    weight = (there * window**2).sum(axis=1, keepdims=True)
    lines = np.abs(fft.rfft(np.where(there, (cut - mean) * window, 0.0), axis=1)[:, 1:-1]) ** 2 / (
        rate * np.maximum(weight, 1e-9)
    )
    edges = np.linspace(0, block - 1, BANDS + 1).astype(int)
    power = np.add.reduceat(lines, edges[:-1], axis=1) / np.diff(edges)
    return np.where(there.mean(axis=1, keepdims=True) > _LOST, np.maximum(power, 1e-300), np.nan)


def _jump(values: Array, lines: Array, *, rate: float) -> float:
    """Standard deviation for a single odd sample: what the spectrum leaves of it, times how wild the wildest of its own is."""
    there = np.isfinite(values)
    white = fft.dct(np.where(there, values - values[there].mean(), 0.0), norm="ortho")
    white[0], white[1:] = 0.0, white[1:] / (lines * rate)
    seen = fft.idct(white, norm="ortho")  # of every sample: its matched filter
    worth = float((1.0 / (lines * rate)).mean())
    wildest = float(np.abs(seen[there]).max()) / math.sqrt(worth)
    return max(1.0, wildest / math.sqrt(2.0 * math.log(values.size))) / math.sqrt(worth)


def own_noise(record: Array, *, rate: float, axes: int | None = None) -> OwnNoise:
    """Measure the noise of a real record.

    Parameters
    ----------
    record : ndarray, shape (axis, time)
        Rates [deg/h], NaN where lost.
    rate : float
        Rate [Hz].
    axes : int, optional
        Axes of the answer: those that the record does not have are as the first.

    Examples
    --------
    >>> found = own_noise(np.random.default_rng(0).normal(0, 1.8, (1, 100_000)), rate=100.0)
    >>> bool(abs(np.median(found.level[0]) / 0.0324 - 1) < 0.02), bool(abs(found.jump[0] / 1.8 - 1) < 0.05)
    (True, True)
    """
    block = max(math.ceil(rate), _SAMPLES)
    lines = np.stack([line_density(row, rate=rate) for row in record])
    powers = np.log(np.stack([_block_powers(row, rate=rate, block=block) for row in record]))
    half = block / BANDS / _LINES  # a mean of so many pairs of squares has a median below its mean
    typical = np.nanmedian(powers, axis=1, keepdims=True) - math.log(
        float(special.gammaincinv(half, 0.5)) / half
    )
    jump = np.array([_jump(row, own, rate=rate) for row, own in zip(record, lines, strict=True)])
    of = np.r_[0 : len(record), np.zeros(max(0, (axes or 0) - len(record)), dtype=int)]
    return OwnNoise(
        rate, lines[of], np.exp(typical[of, 0]), (powers - typical)[of], block, jump[of]
    )
