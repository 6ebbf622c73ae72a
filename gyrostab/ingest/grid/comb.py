"""Find sampling periods of stamps with many random losses from the periodogram of the stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Bins of a stretch, bins in the shortest period, and stretches that are used at most.
_BINS, _BINS_PER_PERIOD, _MAX_STRETCHES = 1 << 15, 4, 64
_MAX_PEAKS = 3
#: Shortest period [ticks of the clock]: of a tick all stamps are multiples, however sampled. The
#: longest tick [ns] that is certainly one, as in stamps in milliseconds.
MIN_TICKS, _COMMON_TICK = 1.5, 1e6
_PEAK_WIDTH = 0.02  # relative distance of two peaks, at least

#: Rows over which random losses accumulate, at most, and the share of the variance of independent
#: steps below which they do not.
_SPAN_ROWS, _MIN_ACCUMULATION = 256, 0.2


def losses_accumulate(parts: list[NDArray[np.int64]]) -> bool:
    """Return whether the time of many rows varies as much as independent steps make it vary.

    It does if samples are lost at random; pauses between packets of rows do not change the number
    of rows in a long time.
    """
    steps = np.concatenate([np.diff(part) for part in parts]).astype(np.float64)
    length = min(_SPAN_ROWS, len(steps) // 16)
    if length < 16:
        return False
    spans = np.concatenate(
        [(part[length:] - part[:-length])[::length] for part in parts if len(part) > length]
    ).astype(np.float64)
    usual = steps[steps < 50 * np.median(steps[steps > 0])]
    scatter = 1.4826 * np.median(np.abs(spans - np.median(spans)))
    return bool(scatter**2 >= _MIN_ACCUMULATION * length * usual.var())


def clock_tick(parts: list[NDArray[np.int64]]) -> float:
    """Return the largest time [ns] of which all stamps are multiples, from the first on."""
    return float(np.gcd.reduce(np.concatenate([np.diff(part) for part in parts])))


def comb_peaks(parts: list[NDArray[np.int64]]) -> list[tuple[float, float]]:
    """Return periods [ns] near multiples of which the stamps lie, and the jitter [samples].

    The power of N stamps at the sampling frequency is 1 + N exp(-4 pi^2 sigma^2) for a jitter of
    sigma samples, whichever samples are missing.
    """
    steps = np.concatenate([np.diff(part) for part in parts])
    steps = steps[steps > 0]
    tick = min(clock_tick(parts), _COMMON_TICK)
    shortest = max(0.7 * float(np.quantile(steps, 0.1)), MIN_TICKS * tick)
    longest = 1.1 * float(np.mean(steps[steps <= 50 * np.median(steps)]))
    width = shortest / _BINS_PER_PERIOD
    counts = [
        table
        for part in parts
        for table in _count_stamps(((part - part.min()) / width).astype(np.int64))
    ]
    counts = counts[:: -(-len(counts) // _MAX_STRETCHES)]
    rows = np.array([table.sum() for table in counts])
    power = sum(np.abs(np.fft.rfft(table - table.mean())) ** 2 for table in counts) / rows.sum()
    frequency = np.fft.rfftfreq(_BINS, width)
    inside = (frequency > 1 / longest) & (frequency < 1 / shortest)
    frequency, power = frequency[inside], power[inside]
    peaks: list[tuple[float, float]] = []
    level = 1 + 7 / np.sqrt(len(counts)) + 16 / len(counts)  # 1e-6 of chance
    while len(power) and len(peaks) < _MAX_PEAKS:
        best = int(np.argmax(power))
        excess = power[best] / np.median(power)
        if excess < level:
            break
        coherence = min(0.99, power[best] * rows.sum() / (rows**2).sum())
        peaks.append((1 / frequency[best], float(np.sqrt(-np.log(coherence)) / (2 * np.pi))))
        apart = np.abs(frequency / frequency[best] - 1) > _PEAK_WIDTH
        frequency, power = frequency[apart], power[apart]
    return peaks


def _count_stamps(bins: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Count the stamps in each bin, in stretches of `_BINS` bins that hold at least 64 stamps."""
    stretch = bins // _BINS
    numbers, rows = np.unique(stretch, return_counts=True)
    return [
        np.bincount(bins[stretch == number] % _BINS, minlength=_BINS).astype(np.float64)
        for number in numbers[rows >= min(64, rows.max())]
    ]
