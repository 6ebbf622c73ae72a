"""Signals of the axes at multiples of the tool rotation, filled while a log is read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools, Complexes, Floats, Ints
from gyrostab.diagnose.reduce.log_blocks import finite_range, numeric_channels
from gyrostab.errors import UnitError
from gyrostab.physics.phase import turns_of_samples
from gyrostab.simulate.drivers import DriverChannel, make_source
from gyrostab.time.grid import first_stamp, grid_times
from gyrostab.units import INNER, parse_unit

#: Multiples of the tool rotation that are measured.
HARMONICS = (1, 2, 3)
#: Turns per block from an order at which its noise is measured.
_NEIGHBOURS = np.array([-4, -3, -2, -1, 1, 2, 3, 4])
#: Variance of an amplitude in the samples present, relative to that of an even rotation, 2 / n,
#: from which a block is not fitted, such as one that lost the samples of a turn. Design choice:
#: half of the samples determine the amplitude.
_MAX_VARIANCE_RATIO = 2.0
_MIN_NEIGHBOUR_RATIO = 2.0  # times expected density from which noise near an order is significant
_MIN_TURNS_APART = 0.9  # turns per block from a line that was removed; just below one DFT bin


class RotationOrders:
    """Demodulation of the axes at multiples of the tool rotation, in order of time."""

    def __init__(
        self, log: xr.Dataset, source: DriverChannel, factor: float, length: int, rate: float
    ):
        self.source, self.factor = source, factor  # rotation rate, and its factor to degree s-1
        self.start, self.rate, self.length = first_stamp(log), rate, length
        self.carry: float | None = None
        self.turns = 0.0

    def read_turns(self, block_range: slice) -> tuple[Floats, Floats]:
        """Return the turns up to the middle of each sample, and within it, (block, sample) each.

        The turns are counted from the start, less a number of whole turns.
        """
        index = np.arange(block_range.start * self.length, block_range.stop * self.length)
        instants = grid_times(self.start, self.rate, index)
        rotation, self.carry = self.source.at(instants, self.carry)
        turns, inside, end = turns_of_samples(rotation * self.factor, self.rate, self.turns)
        self.turns = math.fmod(end, 1.0)
        return turns.reshape(-1, self.length), inside.reshape(-1, self.length)

    def measure(
        self, turns: Floats, inside: Floats, centred: Floats, counts: Ints, min_samples: float
    ) -> dict[str, Array]:
        """Demodulate blocks of the axes (axis, block, sample), zero where samples are missing."""
        often = inside.sum(axis=-1)
        enough = (np.abs(often) >= 1.0) & (counts >= min_samples)
        wheels = [np.exp(-2j * math.pi * harmonic * turns) for harmonic in HARMONICS]
        present = centred != 0.0
        turn_mean = [
            _mean_of_present(np.conj(wheel) * np.sinc(harmonic * inside), present)
            for harmonic, wheel in zip(HARMONICS, wheels, strict=True)
        ]
        # a harmonic above half of the sampling rate has the samples of one below
        is_sampled = np.abs(often)[:, None] * HARMONICS < self.length / 2.0
        fit = _fit_harmonics(centred, wheels, enough, is_sampled)
        order_level = []
        with np.errstate(invalid="ignore", divide="ignore"):
            for place, (harmonic, wheel) in enumerate(zip(HARMONICS, wheels, strict=True)):
                level = _level_near_order(
                    fit.residual * wheel, fit.noise_left[:, :, place], often, harmonic
                )
                fitted = fit.samples[..., place] > 0.0  # elsewhere the residual has the harmonic
                order_level.append(np.where(fitted, level / (counts * self.rate), np.nan))
        return {
            "order": fit.amplitudes,
            "order_samples": fit.samples,
            "order_level": np.stack(order_level, -1),
            "turn_mean": np.stack(turn_mean, -1),
        }


def _mean_of_present(values: Complexes, present: Bools) -> Complexes:
    """Average values (block, sample) over the samples present (axis, block, sample), else all."""
    used = present | ~present.any(axis=-1, keepdims=True)
    return np.asarray(np.einsum("bs,abs->ab", values, used) / used.sum(axis=-1))


class _Harmonics(NamedTuple):
    """Harmonics of the rotation in each block."""

    amplitudes: Complexes  # (axis, block, harmonic): NaN where not fitted
    samples: Floats  # (axis, block, harmonic): of an even rotation with the same error
    residual: Floats  # (axis, block, sample): values less the harmonics; zero where missing
    #: (axis, block, harmonic, neighbour): share of white noise in the residual at `_NEIGHBOURS`
    noise_left: Floats


def _fit_harmonics(
    values: Floats, wheels: Sequence[Complexes], enough: Bools, is_sampled: Bools
) -> _Harmonics:
    """Fit a constant and harmonics to the samples of each block by least squares.

    Where the rotation is uneven (stick-slip), or samples are missing, harmonics are not
    orthogonal: products with each of them would show the first one in all. The variance of an
    amplitude is then larger than with an even rotation: 1.2 times with stick-slip of 0.6 once per
    turn, up to 1.4 times with 0.9.

    The values (axis, block, sample) are zero where samples are missing. Each wheel (block, sample)
    demodulates a harmonic. `enough` (axis, block) selects the blocks to fit, `is_sampled` (block,
    harmonic) their harmonics.
    """
    basis = np.stack([part for wheel in wheels for part in (wheel.real, -wheel.imag)], axis=-1)
    amplitudes = np.full((*enough.shape, len(wheels)), np.nan + 0j)
    samples = np.zeros(amplitudes.shape)
    residual, noise_left = values.copy(), np.ones((*amplitudes.shape, _NEIGHBOURS.size))
    size = values.shape[-1]
    away = np.exp(-2j * math.pi * np.arange(size)[:, None] * _NEIGHBOURS / size)
    for axis, block in np.argwhere(enough):
        present, fitted = values[axis, block] != 0.0, is_sampled[block]
        columns = basis[block][present][:, np.repeat(fitted, 2)]
        with_constant = np.column_stack([columns, np.ones(len(columns))])
        left, scale, right = np.linalg.svd(with_constant, full_matrices=False)
        with np.errstate(divide="ignore"):
            inverse = right.T / scale
        variance = (inverse**2).sum(axis=1)[:-1]
        if not (variance * len(columns) / 2.0 < _MAX_VARIANCE_RATIO).all():
            continue
        sizes = (inverse @ (left.T @ values[axis, block, present]))[:-1]
        amplitudes[axis, block, fitted] = sizes[::2] - 1j * sizes[1::2]
        samples[axis, block, fitted] = 4.0 / (variance[::2] + variance[1::2])
        residual[axis, block, present] -= columns @ sizes
        for place, wheel in enumerate(wheels):
            fitted_part = left.T @ (wheel[block, present, None] * away[present])
            noise_left[axis, block, place] -= (np.abs(fitted_part) ** 2).sum(axis=0) / len(columns)
    return _Harmonics(amplitudes, samples, residual, noise_left)


def make_rotation_orders(log: xr.Dataset, length: int, rate: float) -> RotationOrders | None:
    """Prepare the orders of the rotation of the tool; None if its rate is not known throughout."""
    name = "rotation_rate"
    if any(name in names for names in numeric_channels(log)):
        inner_unit = parse_unit(INNER[name])
        try:
            log_unit = parse_unit(str(log[name].attrs.get("units")))
        except UnitError:
            return None
        is_known = np.isfinite(finite_range(log[name].data)).all()
        if is_known and log_unit.quantity == inner_unit.quantity:
            factor = log_unit.factor / inner_unit.factor
            return RotationOrders(log, make_source(log, name), factor, length, rate)
    return None


def _level_near_order(
    turned: Complexes, noise_left: Floats, often: Floats, harmonic: int
) -> Floats:
    """Measure the mean power (axis, block) of the noise next to a harmonic, NaN if unknown.

    The samples (axis, block, sample) have no harmonics, and are demodulated by this one; of the
    noise at its neighbours they have the share left (axis, block, neighbour). The tool turns so
    often (block,), negative if it turns back. Lines at which the block mean or a harmonic was
    removed, and their mirror lines, do not count.
    """
    power = np.abs(np.fft.fft(turned, axis=-1)[..., _NEIGHBOURS]) ** 2
    place = np.abs(harmonic * often[:, None] + _NEIGHBOURS)
    removed = np.abs(often)[:, None, None] * np.array([0, *HARMONICS])
    free = (np.abs(place[..., None] - removed) >= _MIN_TURNS_APART).all(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((power * free).sum(axis=-1) / (noise_left * free).sum(axis=-1))


def noise_at_orders(blocks: xr.Dataset, expected: Floats) -> Floats:
    """Return the noise density near the rotation orders, as expected or as measured next to them.

    Waves unrelated to the tool, such as those of the ground, have the same power at an order as
    next to it. A density that the order itself raises is not noise: the measured density next to it
    gives the level of the expected one, and replaces it in blocks with much more. Densities are by
    (..., axis, block, harmonic).
    """
    if "order_level" not in blocks:
        return expected
    nearby = blocks["order_level"].values
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = nearby / expected
    usual = np.isfinite(ratio) & (ratio <= _MIN_NEIGHBOUR_RATIO)
    number = usual.sum(axis=-2, keepdims=True)
    level = np.where(usual, ratio, 0.0).sum(axis=-2, keepdims=True) / np.maximum(number, 1)
    return np.where(ratio > _MIN_NEIGHBOUR_RATIO, nearby, expected * np.where(number, level, 1.0))
