"""The arrays that fill up while a log is read, block by block."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.reduce.log_blocks import Stretch, channel_at, numeric_channels
from gyrostab.diagnose.reduce.outliers import Peaks, find_peaks, samples_at_once, zeros_together
from gyrostab.errors import UnitError
from gyrostab.kernels.spectra import periodogram as kernel
from gyrostab.kernels.spectra.outliers import HISTOGRAM
from gyrostab.simulate.drivers import Source, make_source
from gyrostab.time.grid import first_stamp, grid_times
from gyrostab.units import INNER, parse_unit

__all__ = ["FINE", "FOLLOWED", "HARMONICS", "PARTS", "PHASES", "PIECES", "Accumulator"]

Array = NDArray[np.float64]
#: Parts of the record with a line spectrum each; harmonics of the rotation; bins of the ramp's
#: phase.
PARTS, HARMONICS, PHASES = 8, (1, 2, 3), 40
#: Parts of a block over which channels are averaged, and the beginnings of the names of those that
#: effects follow with a lag.
FINE, FOLLOWED = 4, ("temperature", "supply_voltage", "light_power")
#: Pieces of a block over which the axes are averaged.
PIECES = 16
_POWER_SHARE = 0.25  # of a block that must be present for its spectrum
_BESIDE = (
    1,
    5,
)  # turns in a block, from and below, beside those of the tool, where the noise about an order is measured
_APART = 0.9  # turns in a block, that these are away from what was taken off
_GAP_S = 1.0  # shorter gaps are not listed
_FOR_LATTICE, _KEPT = 64, 2**16  # blocks whose values are kept; of each axis, about


class Accumulator:
    """Block statistics of a log, from its stretches in their order.

    Rows are the axes, then the channels on the log's own time.
    """

    def __init__(self, log: xr.Dataset, length: int, block_count: int, rate: float):
        self.rate, self.length, self.block_count, self.start = (
            rate,
            length,
            block_count,
            first_stamp(log),
        )
        self.axes = log.sizes["axis"]
        self.beside = numeric_channels(log)[0]
        rows = self.rows = self.axes + len(self.beside)
        self.edges = kernel.band_edges(length)
        self.weights = kernel.taper(length)
        whole = np.ones((1, length), bool)
        self.whole = kernel.gap_spectra(whole, self.weights)
        self.whole_shape = kernel.shape_of_bands(
            *_swap(self.whole), np.array([length]), self.edges, length
        )[0]
        self.whole_neighbours = _neighbours(whole, self.weights)[0]
        bands = self.edges.size - 1
        self.moments = np.full((rows, block_count, 5), np.nan)
        self.counts = np.zeros((rows, block_count, 9), np.int64)
        self.together = np.zeros((self.axes, block_count), np.int64)
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
        self.line_sum = np.zeros((self.axes, PARTS, kernel.ordinates(length)))
        self.line_expected = np.zeros_like(self.line_sum)
        self.line_counts = np.zeros((self.axes, PARTS, 2))
        self.pieces = np.zeros((2, self.axes, block_count, PIECES))  # sums and numbers of samples
        self.fine = {
            name: np.full((block_count, FINE), np.nan)
            for name in self.beside
            if name.startswith(FOLLOWED)
        }
        self.kept: list[Array] = []
        self.gaps: list[tuple[int, int]] = []
        self.open: int | None = None
        self.turning, self.turning_factor = _turning(log)
        self.turn_carry: float | None = None
        self.turns = 0.0
        self.order = (
            np.full((self.axes, block_count, len(HARMONICS)), np.nan + 0j) if self.turning else None
        )
        self.order_level = np.full(self.order.shape, np.nan) if self.order is not None else None
        self.ramp = self.beside.index("ramp") + self.axes if "ramp" in self.beside else None
        self.ramp_range = _range(log["ramp"].data) if self.ramp is not None else (0.0, 0.0)
        if self.ramp_range[0] >= self.ramp_range[1]:
            self.ramp = None
        self.profile_sums = (
            np.zeros((self.axes, block_count, PHASES)) if self.ramp is not None else None
        )
        self.profile_counts = np.zeros((self.axes, block_count, PHASES), np.int64)
        self.ramp_turns = np.full(block_count, np.nan) if self.ramp is not None else None

    def add(self, stretch: Stretch) -> None:
        """Take in some blocks."""
        component = slice(stretch.first, stretch.first + stretch.values.shape[1])
        present = ~np.isnan(stretch.values)
        centred = np.empty_like(stretch.values)
        for row in range(self.rows):
            kernel.block_samples(
                stretch.values[row],
                centred[row],
                self.moments[row, component],
                self.counts[row, component],
            )
            if row < self.axes:
                found = find_peaks(stretch.values[row], self.histogram[row, component])
                self.peaks[row].append(found._replace(block=found.block + stretch.first))
        self._spectra(component, centred, present)
        self.together[:, component] = zeros_together(stretch.values[: self.axes])
        for kind, number in samples_at_once(present[: self.axes]).items():
            self.at_once.setdefault(kind, np.zeros(self.block_count, np.int64))[component] = number
        self.adjacent[:, component] = np.count_nonzero(
            present[: self.axes, :, 1:] & present[: self.axes, :, :-1], axis=-1
        )
        self._find_gaps(component, present[: self.axes])
        inner = np.arange(PIECES) * self.length // PIECES
        for row in range(self.axes):
            self.pieces[0, row, component] = np.add.reduceat(
                np.where(present[row], stretch.values[row], 0.0), inner, axis=1
            )
            self.pieces[1, row, component] = np.add.reduceat(
                present[row], inner, axis=1, dtype=np.float64
            )
        for name, fine in self.fine.items():
            row, edges = self.axes + self.beside.index(name), np.arange(FINE) * self.length // FINE
            total = np.add.reduceat(np.where(present[row], stretch.values[row], 0.0), edges, axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                fine[component] = total / np.add.reduceat(
                    present[row].astype(np.float64), edges, axis=1
                )
        every = max(1, self.block_count // _FOR_LATTICE)
        chosen = [
            number for number in range(component.start, component.stop) if number % every == 0
        ]
        self.kept += [
            stretch.values[: self.axes, number - component.start, : _KEPT // _FOR_LATTICE].copy()
            for number in chosen
        ]
        if self.order is not None:
            self._orders(component, centred[: self.axes])
        if self.profile_sums is not None:
            phase = stretch.values[self.ramp]
            self._turn_ramp(component, phase)
            for row in range(self.axes):
                sums, counts = (
                    self.profile_sums[row, component],
                    self.profile_counts[row, component],
                )
                kernel.phase_profile(
                    centred[row], present[row], phase, *self.ramp_range, sums, counts
                )

    def _turn_ramp(self, component: slice, phase: Array) -> None:
        """How often the ramp turns in each block, from the moves between samples, none of them half a turn."""
        assert self.ramp_turns is not None
        low, high = self.ramp_range
        moved = np.diff(phase, axis=1) / (high - low)
        moved -= np.round(moved)
        there = np.isfinite(moved)
        total = np.where(there, moved, 0.0).sum(axis=1)
        self.ramp_turns[component] = (
            np.where(there.any(axis=1), total / np.maximum(there.sum(axis=1), 1), np.nan)
            * self.rate
        )

    def _spectra(self, component: slice, centred: Array, present: NDArray[np.bool_]) -> None:
        inside = slice(1, kernel.ordinates(self.length) + 1)
        counts = self.counts[:, component, 0]
        spectra = np.fft.rfft(centred * self.weights, axis=-1)[..., inside]
        used = counts >= max(_POWER_SHARE * self.length, 2)
        places, tables = [], []
        for row in range(self.rows):
            place, table = self._masks(row, component, present[row], counts[row], used[row])
            places.append(place)
            tables.append(table)
            power = kernel.band_powers(
                spectra[row], spectra[row], table, place, self.edges, self.rate
            ).real
            self.power[row, component] = np.where(used[row][:, None], power, np.nan)
            if row < self.axes:
                self._lines(row, component, spectra[row], table, place, used[row])
        for number, (a, b) in enumerate(self.pairs):
            both = np.count_nonzero(present[a] & present[b], axis=-1)
            cross = kernel.band_powers(
                spectra[a], spectra[b], tables[a], places[a], self.edges, self.rate
            )
            differ = (both != counts[a]) | (both != counts[b])
            differ &= used[a] & used[b]
            self.cross_shape[number, component] = self.shape[a, component]
            self.cross_neighbours[number, component] = self.neighbours[a, component]
            self.cross_samples[number, component] = both
            if differ.any():
                both_there = (present[a] & present[b])[differ]
                cross[differ], self.cross_shape[number, component][differ] = self._jointly(
                    centred[[a, b]][:, differ], both_there
                )
                self.cross_neighbours[number, component][differ] = _neighbours(
                    both_there, self.weights
                )
            cross[~(used[a] & used[b])] = np.nan
            cross[both < max(_POWER_SHARE * self.length, 2)] = np.nan
            self.cross[number, component] = cross

    def _masks(
        self,
        row: int,
        component: slice,
        present: NDArray[np.bool_],
        counts: NDArray[np.int64],
        used: NDArray[np.bool_],
    ) -> tuple[NDArray[np.int64], Array]:
        """Expected powers of the masks that occur, number 0 being the full one, and which of them each block has."""
        gappy = used & (counts < self.length)
        place = np.zeros(counts.size, np.int64)
        place[gappy] = 1 + np.arange(np.count_nonzero(gappy))
        table = self.whole[0]
        if gappy.any():
            expected, mask, squared = kernel.gap_spectra(present[gappy], self.weights)
            table = np.concatenate([table, expected])
        if row < self.axes:
            shape = np.broadcast_to(self.whole_shape, (counts.size, self.whole_shape.size)).copy()
            neighbours = np.full(counts.size, self.whole_neighbours)
            if gappy.any():
                shape[gappy] = kernel.shape_of_bands(
                    mask, squared, expected, counts[gappy], self.edges, self.length
                )
                neighbours[gappy] = _neighbours(present[gappy], self.weights)
            shape[~used] = neighbours[~used] = np.nan
            self.shape[row, component], self.neighbours[row, component] = shape, neighbours
        return place, table

    def _lines(
        self,
        row: int,
        component: slice,
        spectra: NDArray[np.complex128],
        table: Array,
        place: NDArray[np.int64],
        used: NDArray[np.bool_],
    ) -> None:
        part_of = np.arange(component.start, component.stop) * PARTS // self.block_count
        for piece in np.unique(part_of):
            chosen = used & (part_of == piece)
            self.line_sum[row, piece] += (
                spectra[chosen].real ** 2 + spectra[chosen].imag ** 2
            ).sum(axis=0)
            expected = table[place[chosen]]
            self.line_expected[row, piece] += expected.sum(axis=0)
            middle = expected.mean(axis=1)
            self.line_counts[row, piece] += [middle.sum(), (middle**2).sum()]

    def _jointly(
        self, centred: Array, present: NDArray[np.bool_]
    ) -> tuple[NDArray[np.complex128], Array]:
        """Cross-periodogram of blocks over the samples that both signals have, and the shape that powers of these would have."""
        out = np.full((present.shape[0], self.edges.size - 1), np.nan + 0j)
        shape = np.full(out.shape, np.nan)
        enough = present.sum(axis=-1) >= max(_POWER_SHARE * self.length, 2)
        if enough.any():
            present, centred = present[enough], centred[:, enough]
            centred = np.where(
                present,
                centred - (centred * present).sum(-1, keepdims=True) / present.sum(-1)[:, None],
                0.0,
            )
            one, other = np.fft.rfft(centred * self.weights, axis=-1)[
                ..., 1 : kernel.ordinates(self.length) + 1
            ]
            expected, mask, squared = kernel.gap_spectra(present, self.weights)
            out[enough] = kernel.band_powers(
                one, other, expected, np.arange(present.shape[0]), self.edges, self.rate
            )
            shape[enough] = kernel.shape_of_bands(
                mask, squared, expected, present.sum(axis=-1), self.edges, self.length
            )
        return out, shape

    def _find_gaps(self, component: slice, present: NDArray[np.bool_]) -> None:
        """List the long stretches in which no axis has a sample."""
        lost = np.concatenate([[self.open is not None], ~present.any(axis=0).ravel()])
        first = component.start * self.length
        for place in np.flatnonzero(lost[1:] != lost[:-1]) if lost.any() else ():
            if lost[place + 1]:
                self.open = first + int(place)
            else:
                begin = self.open if self.open is not None else first
                if first + place - begin >= _GAP_S * self.rate:
                    self.gaps.append((begin, first + int(place)))
                self.open = None

    def _orders(self, component: slice, centred: Array) -> None:
        assert self.turning is not None
        assert self.order is not None
        assert self.order_level is not None
        index = np.arange(component.start * self.length, component.stop * self.length)
        rotation, self.turn_carry = channel_at(
            self.turning, grid_times(self.start, self.rate, index), self.turn_carry
        )
        inside = rotation * self.turning_factor / (360.0 * self.rate)
        edges = np.cumsum(np.concatenate([[self.turns], inside]))
        self.turns = math.fmod(float(edges[-1]), 1.0)
        turns = (edges[:-1] + inside / 2.0).reshape(centred.shape[1:])
        often = np.diff(edges).reshape(turns.shape).sum(axis=-1)
        turned = np.abs(often) >= 1.0
        counts = self.counts[: self.axes, component, 0]
        enough = turned & (counts >= max(_POWER_SHARE * self.length, 2))
        wheels = [np.exp(-2j * math.pi * harmonic * turns) for harmonic in HARMONICS]
        present, left = centred != 0.0, centred  # missing samples count as zero
        with np.errstate(invalid="ignore", divide="ignore"):
            for number, wheel in enumerate(wheels):
                value = 2.0 * np.einsum("abi,bi->ab", centred, wheel) / counts
                self.order[:, component, number] = np.where(enough, value, np.nan)
                left = left - np.where(present, (value[..., None] * np.conj(wheel)).real, 0.0)
            for number, wheel in enumerate(wheels):
                level = _power_beside(left * wheel, often, HARMONICS[number]) / (counts * self.rate)
                self.order_level[:, component, number] = np.where(enough, level, np.nan)


def _power_beside(turned: NDArray[np.complex128], often: Array, harmonic: int) -> Array:
    """Mean power (axis, block) of what turns a few times in the block more or less than a harmonic, NaN where nothing tells it.

    Places at which the mean of the block or a harmonic was taken off, or would be seen in the
    mirror, do not count.

    Parameters
    ----------
    turned : ndarray, shape (axis, block, sample)
        Samples without the harmonics, by the wheel of this one.
    often : ndarray, shape (block,)
        Turns of the tool in the block, negative where it turns back.
    harmonic : int
    """
    beside = np.concatenate([-np.arange(*_BESIDE)[::-1], np.arange(*_BESIDE)])
    power = np.abs(np.fft.fft(turned, axis=-1)[..., beside]) ** 2
    place = np.abs(harmonic * often[:, None] + beside)
    taken = np.abs(often)[:, None, None] * np.array([0, *HARMONICS])
    free = (np.abs(place[..., None] - taken) >= _APART).all(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((power * free).sum(axis=-1) / free.sum(axis=-1))


def _swap(found: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    expected, mask, squared = found
    return mask, squared, expected


def _neighbours(present: NDArray[np.bool_], weights: Array) -> Array:
    tapered = present * weights
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (tapered[:, 1:] * tapered[:, :-1]).sum(axis=-1) / (tapered**2).sum(axis=-1)
        )


def _turning(log: xr.Dataset) -> tuple[Source | None, float]:
    """The rotation rate of the tool at any instant, and the factor to degree s-1; None when the log has it not, or without a number."""
    name = "rotation_rate"
    if (
        name not in numeric_channels(log)[0] + numeric_channels(log)[1]
        or not np.isfinite(_range(log[name].data)).all()
    ):
        return None, 1.0
    wanted = parse_unit(INNER[name])
    try:
        found = parse_unit(str(log[name].attrs.get("units")))
    except UnitError:
        return None, 1.0
    return (
        (make_source(log, name), found.factor / wanted.factor)
        if found.quantity == wanted.quantity
        else (None, 1.0)
    )


def _range(data: Any) -> tuple[float, float]:
    """Smallest and largest number; infinite and the wrong way round when there is none."""
    import dask.array as da

    array = da.asarray(data)
    finite = da.isfinite(array)
    low, high = da.compute(
        da.where(finite, array, np.inf).min(), da.where(finite, array, -np.inf).max()
    )
    return float(low), float(high)
