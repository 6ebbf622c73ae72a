"""Search for sines of constant phase, at the resolution of the whole record.

A mean of periodograms of blocks loses the phase from block to block: a sine that gains 0.3 nats in
each of 200 blocks would gain 60 nats in one periodogram of them all, and gains 9 in their mean.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.spectra.line_levels import LEAK_LINES, level_around
from gyrostab.kernels.spectra.periodogram import ordinates, taper

_MAX_SAMPLES = 2**21  # of a segment; bounds memory
#: Segments are transformed whole, and in parts, for lines whose phase wanders.
_PARTS = (1, 8)
#: Frequencies per line: a sine between two lines is 2.1 times weaker in both, with two 1.2 times.
_FINER = 2
_LEVEL_LINES = 512  # of a whole segment that define a level, to 6 %; design choice
_SIDE_LINES = 128  # of a whole segment, on either side; design choice
_MIN_LEVELS = 4  # intervals of `_LEVEL_LINES` that a spectrum must have
_NOISE_BANDS = 16  # of equal width, in which periodograms are compared; design choice
_EQUAL_SIGMA = 2.5  # by which equal levels may differ by chance: one band in 20 with 8 periodograms
_MIN_SHARE = 0.25  # of a transformed length that must be present; design choice
#: Sums that replace a window; in the three lines on either side that count, their spectrum is
#: exact to (3 pi / 1024)^2 / 6 = 1.4e-5.
_WINDOW_PARTS = 1024
#: Expected nats of a sine of known frequency and phase, a sample of its prior.
_STRENGTHS = 3.0 * 3.0 ** np.arange(12)


class _Spectrum:
    """Sum of periodograms of one length."""

    def __init__(self, axis_count: int, size: int) -> None:
        lines, self.size, self.taper = ordinates(_FINER * size), size, taper(size)
        self.total = np.zeros((axis_count, lines))  # [degree2 hour-2 Hz-1]
        self.used = np.zeros(axis_count, np.int64)  # their number
        self.in_line = np.zeros(axis_count)  # sum of the shares of a sine's power in its line
        # bands of noise: first line, and number of lines
        self.edges = np.linspace(0, lines, min(_NOISE_BANDS, lines), endpoint=False).astype(int)
        self.widths = np.diff(self.edges, append=lines)
        # (axis, band): sum of the levels, and that of the noisiest periodogram
        self.band_total, self.band_largest = np.zeros((2, axis_count, self.edges.size))

    def add(self, axis: int, values: Floats, rate: float) -> None:
        """Add the periodogram of some samples of an axis, if enough are present."""
        present = np.isfinite(values)
        if np.count_nonzero(present) < _MIN_SHARE * self.size:
            return
        centred = np.where(present, values - values[present].mean(), 0.0) * self.taper
        lines = self.total.shape[1]
        power = np.abs(np.fft.rfft(centred, _FINER * self.size)[1 : lines + 1]) ** 2
        window = self.taper * present
        power /= (window**2).sum() * rate
        self.total[axis] += power
        self.used[axis] += 1
        self.in_line[axis] += _share_in_line(window)
        level = np.add.reduceat(power, self.edges) / self.widths
        self.band_total[axis] += level
        self.band_largest[axis] = np.maximum(self.band_largest[axis], level)

    def equal_count(self) -> Floats:
        """Return how many equal periodograms have a sum with this upper tail, (axis, band).

        A noisier stretch leaves fewer: with a single one, the sum is an exponential variable.
        """
        used = np.maximum(self.used, 1)[:, None]
        mean = np.where(self.band_total > 0.0, self.band_total / used, 1.0)
        excess = self.band_largest / mean
        is_equal = excess < 1.0 + _EQUAL_SIGMA * np.sqrt(_FINER / self.widths)
        return used / np.where(is_equal, 1.0, excess)


class SineSearch:
    """Periodograms of long segments of the axes of a log, filled block by block."""

    def __init__(self, axis_count: int, block_count: int, length: int, rate: float):
        segments = -(-block_count * length // _MAX_SAMPLES)
        blocks = block_count // segments
        self.rate, self.length = rate, length
        sizes = [blocks // parts * length for parts in _PARTS if blocks >= 2 * parts]
        # none in blocks so long that hardly one fits a segment
        self.segment = np.full((axis_count, blocks * length if sizes else 0), np.nan)
        self.filled = 0
        self.spectra = [_Spectrum(axis_count, size) for size in sizes]

    def add(self, values: Floats) -> None:
        """Add the samples (axis, sample) that follow; NaN where missing."""
        while self.spectra and values.shape[1]:
            count = min(values.shape[1], self.segment.shape[1] - self.filled)
            self.segment[:, self.filled : self.filled + count] = values[:, :count]
            self.filled, values = self.filled + count, values[:, count:]
            if self.filled == self.segment.shape[1]:
                self.filled = 0
                self._transform_segment()

    def _transform_segment(self) -> None:
        """Add the periodograms of the segment, and of its parts, to the spectra."""
        for spectrum in self.spectra:
            size = spectrum.size
            for begin in range(0, self.segment.shape[1] - size + 1, size):
                for axis, part in enumerate(self.segment[:, begin : begin + size]):
                    spectrum.add(axis, part, self.rate)

    def strongest(self, lines: Floats) -> dict[str, Any]:
        """Return the strongest sine nearest to each line (frequencies [Hz], evenly spaced).

        The variables are described in `gyrostab.diagnose.reduce.schema.BLOCK_STATISTICS`; the
        evidence is minus infinity without a search.
        """
        unknown = np.full((self.segment.shape[0], lines.size), np.nan)
        out: dict[str, Any] = {
            "sine_nats": np.full(unknown.shape, -np.inf),
            "sine_frequency": lines.copy(),
            "sine_resolution": np.full(lines.size, np.nan),
            "sine_square": unknown,
            "sine_square_stderr": unknown.copy(),
        }
        best = np.full(lines.size, -np.inf)
        for spectrum in self.spectra:
            result = self._search_spectrum(spectrum, lines)
            if result is None:
                continue
            place, total, arrays = result
            better = total > best[place]
            best[place[better]] = total[better]
            for name, values in arrays.items():
                out[name][..., place[better]] = values[..., better]
        return out

    def _search_spectrum(
        self, spectrum: _Spectrum, lines: Floats
    ) -> tuple[Ints, Floats, dict[str, Floats]] | None:
        """Return lines, the nats of all axes, and the results of `strongest`; None if too short."""
        split = self.segment.shape[1] // spectrum.size
        step = self.rate / (_FINER * spectrum.size)
        frequency = step * np.arange(1, spectrum.total.shape[1] + 1)
        width, side = (_FINER * number // split for number in (_LEVEL_LINES, _SIDE_LINES))
        # Lower ones are in the means of blocks; the first `side` only define the level of the next.
        inside = frequency >= lines[0] - side * step
        frequency = frequency[inside]
        usable = (spectrum.used > 0) & spectrum.total.any(axis=1)  # a constant axis has no noise
        if frequency.size < _MIN_LEVELS * width or not usable.any():
            return None
        band_counts = spectrum.equal_count()
        count, median = (
            np.repeat(part, spectrum.widths, axis=1)[:, inside]
            for part in (band_counts, gammaincinv(band_counts, 0.5) / band_counts)
        )
        mean = spectrum.total[:, inside] / np.maximum(spectrum.used, 1)[:, None]
        power = np.where(usable[:, None], mean, 1.0)
        level = level_around(power, width, side) / median
        factor = np.where(usable[:, None], sine_factors(power / level, count), -np.inf)
        place = np.clip(np.rint(frequency / lines[0]).astype(np.int64) - 1, 0, lines.size - 1)
        # An axis has the sine or not; one frequency of all that were tried.
        cost = math.log(frequency.size * len(self.spectra))
        total = np.logaddexp(0.0, factor).sum(axis=0) - math.log(2.0) * len(factor) - cost
        total[:side] = -np.inf
        order = np.lexsort((total, place))
        last = np.append(np.flatnonzero(np.diff(place[order])), order.size - 1)
        chosen = order[last]
        axis_nats = factor[:, chosen] - math.log(2.0)
        sharing = np.maximum((axis_nats > 0.0).sum(axis=0), 1)
        leak = np.arange(-_FINER * LEAK_LINES, _FINER * LEAK_LINES + 1)
        neighbours = np.clip(chosen[:, None] + leak, 0, frequency.size - 1)
        # (axis, line, neighbour)
        peak, usual, shape = (part[:, neighbours] for part in (power, level, count))
        above = peak - usual
        in_line = (spectrum.in_line / np.maximum(spectrum.used, 1))[:, None]
        scale = 4.0 * step / np.where(usable[:, None], in_line, 1.0)
        # Power N and a sine S have the variance N^2 + 2 N S; frequencies within a line are one.
        variance = np.maximum(2.0 * peak - usual, usual)
        noise = np.sqrt(_FINER * (usual * variance / shape).sum(axis=-1))
        weights = np.maximum(above, 0.0).sum(axis=0)
        total_weight = np.maximum(weights.sum(axis=-1), 1e-300)
        centre = (weights * frequency[neighbours]).sum(axis=-1) / total_weight
        arrays = {
            "sine_nats": axis_nats - cost / sharing,
            "sine_frequency": centre,
            "sine_resolution": np.full(chosen.size, _FINER * step),
            "sine_square": scale * above.sum(axis=-1),
            "sine_square_stderr": scale * noise,
        }
        return place[chosen], total[chosen], arrays


def _share_in_line(window: Floats) -> float:
    """Return the share of a sine's power in the `LEAK_LINES` on either side of its frequency.

    Lost samples (zeros of the window) spread the rest over the spectrum.
    """
    size = window.size
    edges = np.linspace(0, size, min(_WINDOW_PARTS, size), endpoint=False).astype(np.int64)
    middle = 0.5 * (edges + np.append(edges[1:], size) - 1)
    turns = np.outer(np.arange(1, _FINER * LEAK_LINES + 1), middle) / (_FINER * size)
    sums = np.add.reduceat(window, edges)
    spectrum = np.exp(-2j * math.pi * turns) @ sums
    total = sums.sum() ** 2 + 2.0 * float((np.abs(spectrum) ** 2).sum())
    return float(total / (_FINER * size * (window**2).sum()))


def sine_factors(ratio: Floats, count: Floats | float) -> Floats:
    r"""Return the log Bayes factor of a sine from mean periodograms relative to noise.

    With a sine of random phase whose expected gain is E nats, each of n periodograms is 1 + E / n
    times an exponential variable, so that their mean r has the likelihood ratio
    :math:`\exp(n r x / (1 + x)) / (1 + x)^n` for x = E / n. It is averaged over strengths from 3 to
    half a million nats, evenly spaced in log. The ratio is the mean of `count` periodograms of
    equal noise, relative to its density.

    Examples
    --------
    >>> sine_factors(np.array([1.0, 40.0]), 1).round(1).tolist()  # noise, and a sine of 39 nats
    [-2.6, 33.8]
    """
    total = np.full(np.broadcast_shapes(np.shape(ratio), np.shape(count)), -np.inf)
    for strength in _STRENGTHS:  # one at a time: there are millions of ratios
        factor = count * (ratio * strength / (count + strength) - np.log1p(strength / count))
        np.logaddexp(total, factor, out=total)
    return total - math.log(len(_STRENGTHS))
