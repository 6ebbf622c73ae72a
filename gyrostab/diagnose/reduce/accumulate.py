"""Block statistics of the batches of a log, while it is read."""

from __future__ import annotations

import math
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools, Complexes, Floats, Ints
from gyrostab.diagnose.reduce.log_blocks import BlockBatch, finite_range, numeric_channels
from gyrostab.diagnose.reduce.outliers import (
    Peaks,
    find_peaks,
    simultaneous_samples,
    simultaneous_zeros,
)
from gyrostab.diagnose.reduce.rotation_orders import HARMONICS, make_rotation_orders
from gyrostab.diagnose.reduce.steady_sines import SineSearch
from gyrostab.kernels.samples import moments as moments_kernel
from gyrostab.kernels.samples.outliers import HISTOGRAM
from gyrostab.kernels.spectra import periodogram as kernel
from gyrostab.time.grid import first_stamp

#: Parts of the record, each with its own line spectrum, in which a line persists or drifts. The
#: score of a drifting line grows with the root of their number, the time with the number.
RECORD_PARTS = 16
#: Bins of the ramp phase. Design choice.
RAMP_PHASE_BINS = 40
#: Parts of a block over which lagged channels are averaged. Design choice.
CHANNEL_PARTS = 4
#: Prefixes of channels that effects follow with a lag.
LAGGED_CHANNEL_PREFIXES = ("temperature", "supply_voltage", "light_power")
#: Sub-blocks of a block over which the axes are averaged. Design choice: fast switching.
SUB_BLOCKS = 16
_MIN_SPECTRUM_SHARE = 0.25  # of a block that must be present for its spectrum; design choice
#: Samples that a frame which was sent twice has at least: the first of which chance repeats hardly
#: any, on finer or coarser grids. Design choice.
RESENT_LENGTHS = (3, 6, 12)
_GRID_BLOCKS = 64  # blocks of which samples are kept for the quantization grid; limits memory
_GRID_SAMPLES_PER_AXIS = 2**16  # limits memory


class _Masks(NamedTuple):
    """What the gaps of blocks do to their powers."""

    expected: Floats  # (block, line): expected power of white noise
    shape: Floats  # (block, band): shapes of the gamma distributions of the powers
    neighbours: Floats  # (block,): tapered share of neighbouring pairs of samples


class _BlockMasks(NamedTuple):
    """What the gaps of blocks do to their powers, where most blocks have no gaps."""

    number: Ints  # (block,): row of `expected`; 0 for a block without gaps
    expected: Floats  # (mask, line): expected power of white noise
    shape: Floats  # (block, band): as in `_Masks`; NaN without a spectrum
    neighbours: Floats  # (block,)


class Accumulator:
    """Block statistics of a log, from its batches in order of time.

    Rows are the axes, then the channels on the log's own time stamps.
    """

    def __init__(self, log: xr.Dataset, length: int, block_count: int, rate: float):
        self.rate, self.length, self.block_count = rate, length, block_count
        self.start = first_stamp(log)
        self.min_samples = max(_MIN_SPECTRUM_SHARE * length, 2)  # of a block, for its spectrum
        self.axis_count = log.sizes["axis"]
        self.channels = numeric_channels(log)[0]
        self.row_count = self.axis_count + len(self.channels)
        self.pairs = [
            (a, b) for a, b in combinations(range(self.row_count), 2) if a < self.axis_count
        ]
        self.edges = kernel.band_edges(length)
        # cross-powers (block, band) of two spectra, with a table of expected powers of masks
        self.band_powers = partial(kernel.band_powers, edges=self.edges, rate=rate)
        self.weights = kernel.taper(length)
        full = self._describe_masks(np.ones((1, length), bool))
        self.full = _Masks(full.expected, full.shape[0], full.neighbours[0])
        self.lagged = [name for name in self.channels if name.startswith(LAGGED_CHANNEL_PREFIXES)]
        self.batches: list[dict[str, Array]] = []
        self.at_once: dict[tuple[bool, ...], Ints] = {
            (True,) * self.axis_count: np.zeros(block_count, np.int64)
        }
        self.peaks: list[list[Peaks]] = [[] for _ in range(self.axis_count)]
        self.line_sum = np.zeros((self.axis_count, RECORD_PARTS, kernel.ordinates(length)))
        self.line_expected = np.zeros_like(self.line_sum)
        #: (axis, part, 2): sums of the expected powers of blocks, and of their squares.
        self.line_weight_sums = np.zeros((self.axis_count, RECORD_PARTS, 2))
        self.sines = SineSearch(self.axis_count, block_count, length, rate)
        self.kept_samples: list[Floats] = []
        self.gap_ends: list[int] = []  # samples from which on samples are lost, or there again
        self.is_lost = False
        self.rotation = make_rotation_orders(log, length, rate)
        self.turn_line_sum = np.zeros((len(HARMONICS), kernel.ordinates(length)))
        self.turn_line_expected = np.zeros(kernel.ordinates(length))
        self.ramp = (
            self.channels.index("ramp") + self.axis_count if "ramp" in self.channels else None
        )
        self.ramp_range = finite_range(log["ramp"].data) if self.ramp is not None else (0.0, 0.0)
        if self.ramp_range[0] >= self.ramp_range[1]:
            self.ramp = None

    def collect(self) -> dict[str, Array]:
        """Return the statistics of all blocks, by name, as arrays (row, block, ...)."""
        return {
            name: np.concatenate([batch[name] for batch in self.batches], axis=1)
            for name in self.batches[0]
        }

    def add(self, batch: BlockBatch) -> None:
        """Add some blocks."""
        values, axes, count = batch.values, self.axis_count, batch.values.shape[1]
        block_range = slice(batch.first, batch.first + count)
        present = ~np.isnan(values)
        centred = np.empty_like(values)
        moments = np.full((self.row_count, count, moments_kernel.MOMENTS), np.nan)
        counts = np.zeros((self.row_count, count, moments_kernel.COUNTS), np.int64)
        resent = np.zeros((axes, count, len(RESENT_LENGTHS), 2), np.int64)
        histogram = np.zeros((axes, count, HISTOGRAM), np.uint32)
        for row in range(self.row_count):
            moments_kernel.measure_samples(values[row], centred[row], moments[row], counts[row])
        for row in range(axes):
            peaks = find_peaks(values[row], histogram[row])
            self.peaks[row].append(peaks._replace(block=peaks.block + batch.first))
            is_sent = present[row] & (values[row] != 0.0)
            bits = np.where(is_sent, values[row].view(np.int64), 0)
            moments_kernel.count_resent(bits, RESENT_LENGTHS, resent[row])
        sub_blocks = [_average_parts(axis_values, SUB_BLOCKS) for axis_values in values[:axes]]
        by_name: dict[str, Array] = {
            "moments": moments,
            "counts": counts,
            "resent": resent,
            "histogram": histogram,
            "common_zeros": simultaneous_zeros(values[:axes]),
            "adjacent": np.count_nonzero(present[:axes, :, 1:] & present[:axes, :, :-1], axis=-1),
            "sub_block_mean": np.stack([mean for mean, _ in sub_blocks]),
            "sub_block_samples": np.stack([number for _, number in sub_blocks]),
            **self._measure_spectra(block_range, centred, present),
        }
        for name in self.lagged:
            channel = values[axes + self.channels.index(name)]
            by_name[f"parts_{name}"] = _average_parts(channel, CHANNEL_PARTS)[0][None]
        self.sines.add(values[:axes].reshape(axes, -1))
        for axis_set, at_once in simultaneous_samples(present[:axes]).items():
            count_of_set = self.at_once.setdefault(axis_set, np.zeros(self.block_count, np.int64))
            count_of_set[block_range] = at_once
        self._find_gaps(block_range, present[:axes])
        self._keep_samples(block_range, values[:axes])
        if self.rotation is not None:
            turns, inside = self.rotation.read_turns(block_range)
            by_name |= self.rotation.measure(
                turns,
                inside,
                centred[:axes],
                counts[:axes, :, moments_kernel.PRESENT],
                self.min_samples,
            )
            by_name["turn_power"] = self._measure_turn_spectra(
                turns, np.logical_or.reduce(present[:axes])
            )
        if self.ramp is not None:
            by_name |= self._measure_ramp(centred[:axes], present[:axes], values[self.ramp])
        self.batches.append(by_name)

    def _keep_samples(self, block_range: slice, values: Floats) -> None:
        """Keep the first samples (axis, block, sample) of some blocks of the record."""
        every = max(1, self.block_count // _GRID_BLOCKS)
        samples = slice(_GRID_SAMPLES_PER_AXIS // _GRID_BLOCKS)
        self.kept_samples += [
            values[:, number - block_range.start, samples].copy()
            for number in range(block_range.start, block_range.stop)
            if number % every == 0
        ]

    def _measure_ramp(self, centred: Floats, present: Bools, phase: Floats) -> dict[str, Array]:
        """Return means by phase of the ramp, and its turns, of blocks (axis, block, sample)."""
        sums = np.zeros((*centred.shape[:2], RAMP_PHASE_BINS))
        numbers = np.zeros(sums.shape, np.int64)
        for arrays in zip(centred, present, sums, numbers, strict=True):
            axis_centred, axis_present, axis_sums, axis_numbers = arrays
            moments_kernel.add_phase_profile(
                axis_centred, axis_present, phase, *self.ramp_range, axis_sums, axis_numbers
            )
        with np.errstate(invalid="ignore"):
            sums /= numbers
        return {
            "profile": sums,
            "profile_samples": numbers,
            "ramp_turns": self._measure_ramp_turns(phase)[None],
        }

    def _measure_ramp_turns(self, phase: Floats) -> Floats:
        """Measure the ramp's turns per second; a move between samples is below half a turn."""
        low, high = self.ramp_range
        moved = np.diff(phase, axis=1) / (high - low)
        moved -= np.round(moved)
        finite = np.isfinite(moved)
        total = np.where(finite, moved, 0.0).sum(axis=1)
        mean = np.where(finite.any(axis=1), total / np.maximum(finite.sum(axis=1), 1), np.nan)
        return np.asarray(mean * self.rate)

    def _measure_spectra(
        self, block_range: slice, centred: Floats, present: Bools
    ) -> dict[str, Array]:
        """Return band powers and cross-powers, and add line spectra.

        A channel counts where a gyro sample is present: gaps spread a slow wave of the channel over
        all bands, and would do so in its cross-powers only.
        """
        axes = self.axis_count
        if self.channels:
            received = present[:axes].any(axis=0)
            present = np.concatenate([present[:axes], present[axes:] & received])
            of_channels = _subtract_mean(centred[axes:], present[axes:])
            centred = np.concatenate([centred[:axes], of_channels])
        counts = np.count_nonzero(present, axis=-1)
        used = counts >= self.min_samples
        spectra = self._transform_axes(centred)
        masks = [self._describe_gaps(present[row], used[row]) for row in range(self.row_count)]
        power = np.stack(
            [
                self.band_powers(spectrum, spectrum, row_masks.expected, row_masks.number).real
                for spectrum, row_masks in zip(spectra, masks, strict=True)
            ]
        )
        power[~used] = np.nan
        for row, axis_masks in enumerate(masks[:axes]):
            self._add_line_spectra(row, block_range, spectra[row], axis_masks, used[row])
        shape = np.stack([axis_masks.shape for axis_masks in masks[:axes]])
        neighbours = np.stack([axis_masks.neighbours for axis_masks in masks[:axes]])
        first = np.array([a for a, _ in self.pairs], np.int64)
        cross = np.full((first.size, *power.shape[1:]), np.nan + 0j)
        cross_shape, cross_neighbours = shape[first], neighbours[first]
        cross_samples = np.zeros(cross.shape[:2], np.int64)
        for number, (a, b) in enumerate(self.pairs):
            joint = present[a] & present[b]
            joint_count = cross_samples[number] = np.count_nonzero(joint, axis=-1)
            enough = joint_count >= self.min_samples
            cross[number] = self.band_powers(
                spectra[a], spectra[b], masks[a].expected, masks[a].number
            )
            differ = (joint_count != counts[a]) | (joint_count != counts[b])
            differ &= used[a] & used[b]
            if differ.any():
                cross_neighbours[number, differ] = _neighbour_share(joint[differ], self.weights)
                cross_shape[number, differ & ~enough] = np.nan
                differ &= enough
                cross[number, differ], cross_shape[number, differ] = self._joint_spectra(
                    centred[[a, b]][:, differ], joint[differ], power[[a, b]][:, differ]
                )
            cross[number, ~(used[a] & used[b] & enough)] = np.nan
        return {
            "power": power,
            "shape": shape,
            "neighbours": neighbours,
            "cross": cross,
            "cross_shape": cross_shape,
            "cross_neighbours": cross_neighbours,
            "cross_samples": cross_samples,
        }

    def _measure_turn_spectra(self, turns: Floats, present: Bools) -> Floats:
        """Return band powers of waves at the harmonics of the rotation, and add line spectra.

        The waves have an amplitude of 1 and any phase, and are sampled where an axis is: an uneven
        rotation or gaps spread them over many bands. The shape is (harmonic, block, band).
        """
        used = np.count_nonzero(present, axis=-1) >= self.min_samples
        masks = self._describe_gaps(present, used)
        power = np.zeros((len(HARMONICS), used.size, self.edges.size - 1))
        for number, harmonic in enumerate(HARMONICS):
            for wave in (np.cos, np.sin):
                values = wave(2.0 * math.pi * harmonic * turns)
                spectrum = self._transform_axes(_subtract_mean(values, present))
                band_power = self.band_powers(spectrum, spectrum, masks.expected, masks.number)
                power[number] += band_power.real / 2.0
                square = spectrum[used].real ** 2 + spectrum[used].imag ** 2
                self.turn_line_sum[number] += square.sum(axis=0) / 2.0
        self.turn_line_expected += masks.expected[masks.number[used]].sum(axis=0)
        power[:, ~used] = 0.0
        return power

    def _transform_axes(self, centred: Floats) -> Complexes:
        """Return the tapered spectra (..., line) of blocks (..., sample)."""
        spectra = np.fft.rfft(centred * self.weights, axis=-1)
        return np.asarray(spectra[..., 1 : kernel.ordinates(self.length) + 1])

    def _describe_masks(self, present: Bools) -> _Masks:
        """Return what the gaps of blocks (block, sample) do to their powers."""
        expected, mask, squared = kernel.gap_spectra(present, self.weights)
        shape = kernel.shape_of_bands(
            mask, squared, expected, present.sum(axis=-1), self.edges, self.length
        )
        return _Masks(expected, shape, _neighbour_share(present, self.weights))

    def _describe_gaps(self, present: Bools, used: Bools) -> _BlockMasks:
        """Return what gaps do to blocks (block, sample), of which those `used` have a spectrum."""
        gappy = used & ~present.all(axis=-1)
        number = np.zeros(used.size, np.int64)
        number[gappy] = 1 + np.arange(np.count_nonzero(gappy))
        expected, full_shape, full_neighbours = self.full
        shape = np.where(used[:, None], full_shape, np.nan)
        neighbours = np.where(used, full_neighbours, np.nan)
        if gappy.any():
            masks = self._describe_masks(present[gappy])
            shape[gappy], neighbours[gappy] = masks.shape, masks.neighbours
            expected = np.concatenate([expected, masks.expected])
        return _BlockMasks(number, expected, shape, neighbours)

    def _add_line_spectra(
        self,
        row: int,
        block_range: slice,
        spectra: Complexes,
        masks: _BlockMasks,
        used: Bools,
    ) -> None:
        """Add periodograms at full resolution to the parts of the record."""
        part_of = np.arange(block_range.start, block_range.stop) * RECORD_PARTS // self.block_count
        for part in np.unique(part_of):
            chosen = used & (part_of == part)
            self.line_sum[row, part] += (spectra[chosen].real ** 2 + spectra[chosen].imag ** 2).sum(
                axis=0
            )
            expected = masks.expected[masks.number[chosen]]
            self.line_expected[row, part] += expected.sum(axis=0)
            block_level = expected.mean(axis=1)
            self.line_weight_sums[row, part] += [block_level.sum(), (block_level**2).sum()]

    def _joint_spectra(
        self, centred: Floats, present: Bools, power: Floats
    ) -> tuple[Complexes, Floats]:
        """Return cross-powers and shapes of blocks over the samples of both signals.

        The coherency is that of the joint samples, `power` (2, block, band) that of each signal.
        """
        first, second = self._transform_axes(_subtract_mean(centred, present))
        masks = self._describe_masks(present)
        number = np.arange(len(present))
        cross, *powers = (
            self.band_powers(*pair, masks.expected, number)
            for pair in ((first, second), (first, first), (second, second))
        )
        joint = powers[0].real * powers[1].real
        scale = np.divide(power.prod(axis=0), joint, out=np.zeros_like(joint), where=joint > 0.0)
        return cross * np.sqrt(scale), masks.shape

    def _find_gaps(self, block_range: slice, present: Bools) -> None:
        """List the ends of the gaps, in which no axis has a sample."""
        lost = ~present.any(axis=0).ravel()
        changes = np.flatnonzero(np.diff(lost, prepend=self.is_lost))
        self.gap_ends += (block_range.start * self.length + changes).tolist()
        self.is_lost = bool(lost[-1])


def _average_parts(values: Floats, parts: int) -> tuple[Floats, Ints]:
    """Return means and numbers of the samples in equal parts of the blocks (block, sample)."""
    edges, present = np.arange(parts) * values.shape[1] // parts, ~np.isnan(values)
    total = np.add.reduceat(np.where(present, values, 0.0), edges, axis=1)
    number = np.add.reduceat(present, edges, axis=1, dtype=np.int64)
    with np.errstate(invalid="ignore"):
        return total / number, number


def _subtract_mean(values: Floats, present: Bools) -> Floats:
    """Subtract the mean of the samples present from each block; 0 where none is present."""
    total = (values * present).sum(axis=-1, keepdims=True)
    mean = total / np.maximum(present.sum(axis=-1), 1)[..., None]
    return np.where(present, values - mean, 0.0)


def _neighbour_share(present: Bools, weights: Floats) -> Floats:
    """Return the tapered share of neighbouring pairs of samples."""
    tapered = present * weights
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (tapered[:, 1:] * tapered[:, :-1]).sum(axis=-1) / (tapered**2).sum(axis=-1)
        )
