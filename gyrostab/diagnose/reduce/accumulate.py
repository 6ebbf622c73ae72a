"""Arrays of block statistics that are filled while a log is read."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.reduce.log_blocks import BlockBatch, finite_range, numeric_channels
from gyrostab.diagnose.reduce.outliers import (
    Peaks,
    find_peaks,
    simultaneous_samples,
    simultaneous_zeros,
)
from gyrostab.diagnose.reduce.rotation_orders import make_rotation_orders
from gyrostab.diagnose.reduce.steady_sines import SineSearch
from gyrostab.kernels.spectra import periodogram as kernel
from gyrostab.kernels.spectra.outliers import HISTOGRAM
from gyrostab.time.grid import first_stamp

Array = NDArray[np.float64]
#: Parts of the record, each with its own line spectrum. Design choice: eight show whether a line
#: persists or drifts.
RECORD_PARTS = 8
#: Bins of the ramp phase. Design choice.
RAMP_PHASE_BINS = 40
#: Parts of a block over which lagged channels are averaged. Design choice.
CHANNEL_PARTS = 4
#: Prefixes of channels that effects follow with a lag.
LAGGED_CHANNEL_PREFIXES = ("temperature", "supply_voltage", "light_power")
#: Sub-blocks of a block over which the axes are averaged. Design choice: fast switching.
SUB_BLOCKS = 16
_MIN_SPECTRUM_SHARE = 0.25  # of a block that must be present for its spectrum; design choice
# Samples of a frame that was sent twice. In a block of 8000 samples of 2^16 equally likely values,
# chance repeats as many in their order with a probability of 8000^2 / 2 / 2^48 = 1e-7.
_MIN_RESENT = 3
_MIN_GAP_S = 1.0  # shorter gaps are not listed; design choice
_GRID_BLOCKS = 64  # blocks of which samples are kept for the quantization grid; limits memory
_GRID_SAMPLES_PER_AXIS = 2**16  # limits memory


class Accumulator:
    """Block statistics of a log, filled batch by batch in order of time.

    Rows are the axes, then the channels on the log's own time stamps.
    """

    def __init__(self, log: xr.Dataset, length: int, block_count: int, rate: float):
        self.rate, self.length, self.block_count = rate, length, block_count
        self.start = first_stamp(log)
        self.min_samples = max(_MIN_SPECTRUM_SHARE * length, 2)  # of a block, for its spectrum
        self.axes = log.sizes["axis"]
        self.channels = numeric_channels(log)[0]
        rows = self.rows = self.axes + len(self.channels)
        self.edges = kernel.band_edges(length)
        self.weights = kernel.taper(length)
        all_present = np.ones((1, length), bool)
        self.full, mask, squared = kernel.gap_spectra(all_present, self.weights)
        self.full_shape = kernel.shape_of_bands(
            mask, squared, self.full, np.array([length]), self.edges, length
        )[0]
        self.full_neighbours = _neighbour_share(all_present, self.weights)[0]
        bands = self.edges.size - 1
        self.moments = np.full((rows, block_count, 5), np.nan)
        self.counts = np.zeros((rows, block_count, 9), np.int64)
        self.resent = np.zeros((self.axes, block_count, 2), np.int64)
        self.common_zeros = np.zeros((self.axes, block_count), np.int64)
        self.at_once: dict[tuple[bool, ...], NDArray[np.int64]] = {
            (True,) * self.axes: np.zeros(block_count, np.int64)
        }
        self.histogram = np.zeros((self.axes, block_count, HISTOGRAM), np.uint32)
        self.peaks: list[list[Peaks]] = [[] for _ in range(self.axes)]
        self.power = np.full((rows, block_count, bands), np.nan)
        self.shape = np.full((self.axes, block_count, bands), np.nan)
        self.neighbours = np.full((self.axes, block_count), np.nan)
        self.adjacent = np.zeros((self.axes, block_count), np.int64)
        self.pairs = [(a, b) for a, b in combinations(range(rows), 2) if a < self.axes]
        self.cross = np.full((len(self.pairs), block_count, bands), np.nan + 0j)
        self.cross_shape = np.full(self.cross.shape, np.nan)
        self.cross_neighbours = np.full(self.cross.shape[:2], np.nan)
        self.cross_samples = np.zeros(self.cross.shape[:2], np.int64)
        self.line_sum = np.zeros((self.axes, RECORD_PARTS, kernel.ordinates(length)))
        self.line_expected = np.zeros_like(self.line_sum)
        self.line_counts = np.zeros((self.axes, RECORD_PARTS, 2))
        self.sines = SineSearch(self.axes, block_count, length, rate)
        # sums and numbers of samples
        self.sub_blocks = np.zeros((2, self.axes, block_count, SUB_BLOCKS))
        self.channel_parts = {
            name: np.full((block_count, CHANNEL_PARTS), np.nan)
            for name in self.channels
            if name.startswith(LAGGED_CHANNEL_PREFIXES)
        }
        self.kept_samples: list[Array] = []
        self.gaps: list[tuple[int, int]] = []
        self.gap_begin: int | None = None
        self.rotation = make_rotation_orders(log, length, block_count, rate)
        self.ramp = self.channels.index("ramp") + self.axes if "ramp" in self.channels else None
        self.ramp_range = finite_range(log["ramp"].data) if self.ramp is not None else (0.0, 0.0)
        if self.ramp_range[0] >= self.ramp_range[1]:
            self.ramp = None
        self.profile_sums = (
            np.zeros((self.axes, block_count, RAMP_PHASE_BINS)) if self.ramp is not None else None
        )
        self.profile_counts = np.zeros((self.axes, block_count, RAMP_PHASE_BINS), np.int64)
        self.ramp_turns = np.full(block_count, np.nan) if self.ramp is not None else None

    def add(self, batch: BlockBatch) -> None:
        """Add some blocks."""
        block_range = slice(batch.first, batch.first + batch.values.shape[1])
        present = ~np.isnan(batch.values)
        centred = np.empty_like(batch.values)
        for row in range(self.rows):
            kernel.block_samples(
                batch.values[row],
                centred[row],
                self.moments[row, block_range],
                self.counts[row, block_range],
            )
            if row < self.axes:
                peaks = find_peaks(batch.values[row], self.histogram[row, block_range])
                is_sent = present[row] & (batch.values[row] != 0.0)
                kernel.resent_samples(
                    np.where(is_sent, batch.values[row].view(np.int64), 0),
                    _MIN_RESENT,
                    self.resent[row, block_range],
                )
                self.peaks[row].append(peaks._replace(block=peaks.block + batch.first))
        self._add_spectra(block_range, centred, present)
        self.sines.add(batch.values[: self.axes].reshape(self.axes, -1))
        self.common_zeros[:, block_range] = simultaneous_zeros(batch.values[: self.axes])
        for kind, number in simultaneous_samples(present[: self.axes]).items():
            self.at_once.setdefault(kind, np.zeros(self.block_count, np.int64))[block_range] = (
                number
            )
        self.adjacent[:, block_range] = np.count_nonzero(
            present[: self.axes, :, 1:] & present[: self.axes, :, :-1], axis=-1
        )
        self._find_gaps(block_range, present[: self.axes])
        for row in range(self.axes):
            self.sub_blocks[:, row, block_range] = _sum_parts(batch.values[row], SUB_BLOCKS)
        for name, fine in self.channel_parts.items():
            row = self.axes + self.channels.index(name)
            total, count = _sum_parts(batch.values[row], CHANNEL_PARTS)
            with np.errstate(invalid="ignore", divide="ignore"):
                fine[block_range] = total / count
        every = max(1, self.block_count // _GRID_BLOCKS)
        samples = slice(_GRID_SAMPLES_PER_AXIS // _GRID_BLOCKS)
        self.kept_samples += [
            batch.values[: self.axes, number - block_range.start, samples].copy()
            for number in range(block_range.start, block_range.stop)
            if number % every == 0
        ]
        if self.rotation is not None:
            counts = self.counts[: self.axes, block_range, 0]
            self.rotation.add(block_range, centred[: self.axes], counts, self.min_samples)
        if self.profile_sums is not None:
            phase = batch.values[self.ramp]
            self._count_ramp_turns(block_range, phase)
            for row in range(self.axes):
                sums = self.profile_sums[row, block_range]
                counts = self.profile_counts[row, block_range]
                kernel.phase_profile(
                    centred[row], present[row], phase, *self.ramp_range, sums, counts
                )

    def _count_ramp_turns(self, block_range: slice, phase: Array) -> None:
        """Measure the ramp's turns per second; a move between samples is below half a turn."""
        assert self.ramp_turns is not None
        low, high = self.ramp_range
        moved = np.diff(phase, axis=1) / (high - low)
        moved -= np.round(moved)
        finite = np.isfinite(moved)
        total = np.where(finite, moved, 0.0).sum(axis=1)
        self.ramp_turns[block_range] = (
            np.where(finite.any(axis=1), total / np.maximum(finite.sum(axis=1), 1), np.nan)
            * self.rate
        )

    def _add_spectra(self, block_range: slice, centred: Array, present: NDArray[np.bool_]) -> None:
        """Add band powers, cross-powers and line spectra.

        A channel counts where a gyro sample is present: gaps spread a slow wave of the channel over
        all bands, and would do so in its cross-powers only.
        """
        inside = slice(1, kernel.ordinates(self.length) + 1)
        counts = self.counts[:, block_range, 0]
        if self.channels:
            received = present[: self.axes].any(axis=0)
            present = np.concatenate([present[: self.axes], present[self.axes :] & received])
            counts = np.count_nonzero(present, axis=-1)
            centred = np.concatenate(
                [centred[: self.axes], _subtract_mean(centred[self.axes :], present[self.axes :])]
            )
        spectra = np.fft.rfft(centred * self.weights, axis=-1)[..., inside]
        used = counts >= self.min_samples
        places, tables = [], []
        for row in range(self.rows):
            place, table = self._tabulate_masks(
                row, block_range, present[row], counts[row], used[row]
            )
            places.append(place)
            tables.append(table)
            power = kernel.band_powers(
                spectra[row], spectra[row], table, place, self.edges, self.rate
            ).real
            self.power[row, block_range] = np.where(used[row][:, None], power, np.nan)
            if row < self.axes:
                self._add_line_spectra(row, block_range, spectra[row], table, place, used[row])
        for number, (a, b) in enumerate(self.pairs):
            joint_count = np.count_nonzero(present[a] & present[b], axis=-1)
            cross = kernel.band_powers(
                spectra[a], spectra[b], tables[a], places[a], self.edges, self.rate
            )
            differ = (joint_count != counts[a]) | (joint_count != counts[b])
            differ &= used[a] & used[b]
            self.cross_shape[number, block_range] = self.shape[a, block_range]
            self.cross_neighbours[number, block_range] = self.neighbours[a, block_range]
            self.cross_samples[number, block_range] = joint_count
            if differ.any():
                joint = (present[a] & present[b])[differ]
                cross[differ], self.cross_shape[number, block_range][differ] = self._joint_spectra(
                    centred[[a, b]][:, differ], joint, self.power[[a, b], block_range][:, differ]
                )
                self.cross_neighbours[number, block_range][differ] = _neighbour_share(
                    joint, self.weights
                )
            cross[~(used[a] & used[b])] = np.nan
            cross[joint_count < self.min_samples] = np.nan
            self.cross[number, block_range] = cross

    def _tabulate_masks(
        self,
        row: int,
        block_range: slice,
        present: NDArray[np.bool_],
        counts: NDArray[np.int64],
        used: NDArray[np.bool_],
    ) -> tuple[NDArray[np.int64], Array]:
        """Return the mask index of each block (0 is full), and the expected powers by mask."""
        gappy = used & (counts < self.length)
        place = np.zeros(counts.size, np.int64)
        place[gappy] = 1 + np.arange(np.count_nonzero(gappy))
        table = self.full
        if gappy.any():
            expected, mask, squared = kernel.gap_spectra(present[gappy], self.weights)
            table = np.concatenate([table, expected])
        if row < self.axes:
            shape = np.broadcast_to(self.full_shape, (counts.size, self.full_shape.size)).copy()
            neighbours = np.full(counts.size, self.full_neighbours)
            if gappy.any():
                shape[gappy] = kernel.shape_of_bands(
                    mask, squared, expected, counts[gappy], self.edges, self.length
                )
                neighbours[gappy] = _neighbour_share(present[gappy], self.weights)
            shape[~used] = neighbours[~used] = np.nan
            self.shape[row, block_range], self.neighbours[row, block_range] = shape, neighbours
        return place, table

    def _add_line_spectra(
        self,
        row: int,
        block_range: slice,
        spectra: NDArray[np.complex128],
        table: Array,
        place: NDArray[np.int64],
        used: NDArray[np.bool_],
    ) -> None:
        """Add periodograms at full resolution to the parts of the record."""
        part_of = np.arange(block_range.start, block_range.stop) * RECORD_PARTS // self.block_count
        for part in np.unique(part_of):
            chosen = used & (part_of == part)
            self.line_sum[row, part] += (spectra[chosen].real ** 2 + spectra[chosen].imag ** 2).sum(
                axis=0
            )
            expected = table[place[chosen]]
            self.line_expected[row, part] += expected.sum(axis=0)
            middle = expected.mean(axis=1)
            self.line_counts[row, part] += [middle.sum(), (middle**2).sum()]

    def _joint_spectra(
        self, centred: Array, present: NDArray[np.bool_], power: Array
    ) -> tuple[NDArray[np.complex128], Array]:
        """Return cross-periodogram and gamma shape of blocks over the samples of both signals.

        The coherency is that of the joint samples, `power` (2, block, band) that of each signal.
        """
        out = np.full((present.shape[0], self.edges.size - 1), np.nan + 0j)
        shape = np.full(out.shape, np.nan)
        enough = present.sum(axis=-1) >= self.min_samples
        if enough.any():
            present, centred = present[enough], centred[:, enough]
            centred = _subtract_mean(centred, present)
            spectrum, other_spectrum = np.fft.rfft(centred * self.weights, axis=-1)[
                ..., 1 : kernel.ordinates(self.length) + 1
            ]
            expected, mask, squared = kernel.gap_spectra(present, self.weights)
            cross, *powers = (
                kernel.band_powers(
                    *pair, expected, np.arange(present.shape[0]), self.edges, self.rate
                )
                for pair in (
                    (spectrum, other_spectrum),
                    (spectrum, spectrum),
                    (other_spectrum, other_spectrum),
                )
            )
            joint = powers[0].real * powers[1].real
            scale = np.divide(
                power[:, enough].prod(axis=0), joint, out=np.zeros_like(joint), where=joint > 0.0
            )
            out[enough] = cross * np.sqrt(scale)
            shape[enough] = kernel.shape_of_bands(
                mask, squared, expected, present.sum(axis=-1), self.edges, self.length
            )
        return out, shape

    def _find_gaps(self, block_range: slice, present: NDArray[np.bool_]) -> None:
        """List the long gaps, in which no axis has a sample."""
        lost = np.concatenate([[self.gap_begin is not None], ~present.any(axis=0).ravel()])
        first = block_range.start * self.length
        for place in np.flatnonzero(lost[1:] != lost[:-1]) if lost.any() else ():
            if lost[place + 1]:
                self.gap_begin = first + int(place)
            else:
                begin = self.gap_begin if self.gap_begin is not None else first
                if first + place - begin >= _MIN_GAP_S * self.rate:
                    self.gaps.append((begin, first + int(place)))
                self.gap_begin = None


def _sum_parts(values: Array, parts: int) -> tuple[Array, Array]:
    """Return sums and numbers of the samples in equal parts of the blocks (block, sample)."""
    edges, present = np.arange(parts) * values.shape[1] // parts, ~np.isnan(values)
    total = np.add.reduceat(np.where(present, values, 0.0), edges, axis=1)
    return total, np.add.reduceat(present, edges, axis=1, dtype=np.float64)


def _subtract_mean(values: Array, present: NDArray[np.bool_]) -> Array:
    """Subtract the mean of the samples present from each block; 0 where none is present."""
    total = (values * present).sum(axis=-1, keepdims=True)
    mean = total / np.maximum(present.sum(axis=-1), 1)[..., None]
    return np.where(present, values - mean, 0.0)


def _neighbour_share(present: NDArray[np.bool_], weights: Array) -> Array:
    """Return the tapered share of neighbouring pairs of samples."""
    tapered = present * weights
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (tapered[:, 1:] * tapered[:, :-1]).sum(axis=-1) / (tapered**2).sum(axis=-1)
        )
