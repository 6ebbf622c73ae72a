"""State of the model of a record, and parts of linear models whose noise is independent by cell.

The data may be a recording or null records, with the dimension ``record`` first. Weights and given
columns are those of a `State`: the current model of the noise, and the effects named so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Bools
from gyrostab.diagnose.evidence.held_out import LinearModel
from gyrostab.diagnose.predict.candidates import Candidate, content_digest
from gyrostab.diagnose.reduce.schema import pair_indices, read_as_measured
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.spectra.expected import correlated_powers
from gyrostab.kernels.spectra.periodogram import band_edges, ordinates, taper
from gyrostab.physics.prediction import Prediction

Result = TypeVar("Result")


@dataclass(frozen=True)
class State:
    """Model of a record in which a candidate is tried."""

    blocks: xr.Dataset
    baseline: xr.Dataset
    #: (axis, block, band): expected powers with the named effects [degree2 hour-2 Hz-1]. They give
    #: the variance, and so the weight, of every cell.
    expected_power: Array
    masked: Bools  # (axis, block): blocks whose powers and cross-spectra are left out
    #: (data, row) -> columns in the model with and without a candidate. The data are "mean",
    #: "power", "added_power" (powers that effects add, whose sizes cannot be negative), "cross",
    #: "sub_block", "order", "phase_locked" or "transfer"; the row is an axis, or the two axes of a
    #: pair with a comma between them. ("line", "all") has the lines that are explained, as masks.
    given: dict[tuple[str, str], list[Array]] = field(default_factory=dict)
    settings: Settings = DEFAULTS
    #: What was computed for the record, in any of its states, by the digest of the inputs.
    memory: dict[bytes, object] = field(default_factory=dict)

    def recall(self, compute: Callable[[], Result], *inputs: Array | bytes | None) -> Result:
        """Compute something, or recall what the same inputs gave before.

        Most of what a search tries again has not changed: an effect on one axis changes nothing on
        the others, and a line nothing in the means. Bytes among the inputs name the computation:
        two computations on the same arrays need different ones.
        """
        key = content_digest(*inputs)
        if key not in self.memory:
            self.memory[key] = compute()
        return cast(Result, self.memory[key])

    def given_to(self, data: str, axis: str) -> Array | None:
        """Return the given columns of such data of an axis, (..., column); None without any."""
        columns = self.given.get((data, axis))
        return np.stack(columns, axis=-1) if columns else None

    def with_columns(self, data: str, row: str, columns: Sequence[Array]) -> State:
        """Return the state with more given columns."""
        given = dict(self.given)
        given[data, row] = [*given.get((data, row), []), *columns]
        return replace(self, given=given)

    def power_columns(self, axis: str) -> list[Array]:
        """Return the given columns of the powers of an axis, those that effects add last."""
        return [*self.given.get(("power", axis), []), *self.given.get(("added_power", axis), [])]

    def least_powers(self, axis: str) -> list[float]:
        """Return the least sizes of these columns."""
        any_count, added_count = (
            len(self.given.get((name, axis), [])) for name in ("power", "added_power")
        )
        return [-np.inf] * any_count + [0.0] * added_count

    def is_recalibrated(self, axis: str) -> bool:
        """Return whether the noise of an axis was calibrated with the effects in the model."""
        return axis in self.baseline.attrs.get("recalibrated", ())

    @property
    def axes(self) -> list[str]:
        """Names of the axes."""
        return [str(axis) for axis in self.blocks.variables["axis"].values]


def initial_state(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> State:
    """Return the state in which no effect is named."""
    power = baseline["spectrum"].values
    return State(blocks, baseline, power, np.zeros(power.shape[:2], np.bool_), settings=settings)


def simulate_noise(model: LinearModel, rng: np.random.Generator, count: int) -> LinearModel:
    """Replace the values of a model by `count` records of noise alone."""
    spread = np.where(
        model.weight > 0.0, 1.0 / np.sqrt(np.where(model.weight > 0.0, model.weight, 1.0)), 0.0
    )
    return model._replace(values=spread[..., None] * rng.standard_normal((*spread.shape, count)))


def unspread_share(blocks: xr.Dataset, row: str = "axis") -> Array:
    """Return the share of a density that each block shows at its own frequencies, 1 without gaps.

    Shape (axis or pair, block). Random gaps spread the rest over all frequencies. The missing
    neighbours at the tapered ends of a block spread nothing.
    """
    neighbours = blocks.variables["neighbours" if row == "axis" else "cross_neighbours"].values
    weights = taper(int(blocks.attrs["block_samples"]))
    without_gaps = float((weights[1:] * weights[:-1]).sum() / (weights**2).sum())
    return np.minimum(
        np.where(np.isfinite(neighbours), neighbours, without_gaps) / without_gaps, 1.0
    )


def unspread_share_of_lines(blocks: xr.Dataset) -> Array:
    """Return the `unspread_share` of the mean periodograms of the record, (axis,)."""
    used = np.isfinite(blocks["neighbours"].values)
    total = (unspread_share(blocks) * used).sum(axis=1)
    return np.asarray(np.where(used.any(axis=1), total / np.maximum(used.sum(axis=1), 1), 1.0))


def spread_by_gaps(density: Array, blocks: xr.Dataset, row: str = "axis") -> Array:
    """Mix a density with its mean over frequency, as gaps do; (axis, block, band).

    The density is (axis or 1, block or 1, band); the row may be a pair of axes instead of an axis.
    """
    return mix_with_mean(density, unspread_share(blocks, row), band_widths(blocks))


def band_widths(blocks: xr.Dataset) -> Array:
    """Return the widths of the bands [Hz]."""
    return np.asarray(blocks.variables["band_high"].values - blocks.variables["band_low"].values)


def average_in_bands(density: Array, blocks: xr.Dataset) -> Array:
    """Average a density (..., line) over the lines of every band."""
    edges = band_edges(int(blocks.attrs["block_samples"])) - 1
    return np.asarray(np.add.reduceat(density, edges[:-1], axis=-1) / np.diff(edges))


def mix_with_mean(density: Array, unspread: Array, width: Array) -> Array:
    """Spread a density (..., band) over all bands, except for its share `unspread` (...)."""
    level = (density * width).sum(axis=-1, keepdims=True) / width.sum()
    return np.asarray(unspread[..., None] * density + (1.0 - unspread[..., None]) * level)


def select_row(density: Array, row: int) -> Array:
    """Return one row of a density that has all of them, or one for all."""
    return np.asarray(density[row if density.shape[0] > 1 else 0])


def pair_rows(blocks: xr.Dataset) -> list[tuple[str, ...]]:
    """Return the two axes of each pair."""
    first, second = (blocks.variables[name].values for name in ("first", "second"))
    return [(str(a), str(b)) for a, b in zip(first, second, strict=True)]


def moves_within_blocks(
    mean: Array, density: Array, blocks: xr.Dataset, settings: Settings
) -> Bools:
    """Find the blocks in which a mean (..., block) moves far above noise of this density.

    None where most blocks move. A step of D in the middle of a block of T seconds adds the power
    D^2 T / pi^2 to its lowest frequency, 1 / T.
    """
    step = np.abs(np.diff(mean, axis=-1))
    sides = [(0, 0)] * (step.ndim - 1)
    moved = np.maximum(np.pad(step, [*sides, (0, 1)]), np.pad(step, [*sides, (1, 0)]))
    moving = moved**2 * float(blocks.attrs["block_s"]) > settings.step_power_ratio * density
    is_rare = moving.mean(axis=-1, keepdims=True) <= settings.majority_share
    return np.asarray(moving & is_rare)


def cross_without(blocks: xr.Dataset, left_out: Bools) -> xr.DataArray:
    """Return cross-spectra of the pairs without blocks that are left out (axis, block)."""
    first, second = pair_indices(blocks)
    without = xr.DataArray(left_out[first] | left_out[second], dims=("pair", "block"))
    return blocks["cross"].where(~without)


def records_last(values: Array, plain: int) -> Array:
    """Return data with the record last."""
    return np.moveaxis(values, 0, -1) if values.ndim > plain else values[..., None]


def real_and_imaginary(values: Array, axis: int = -1) -> Array:
    """Concatenate real and imaginary parts."""
    return np.concatenate([values.real, values.imag], axis=axis)


def linear_model(
    values: Array,
    weight: Array,
    designs: Iterable[Iterable[Array]],
    given: Sequence[Array],
    *,
    noise_columns: Sequence[Array] = (),
    precision: Any = (),
    is_bounded: Sequence[bool] = (),
    low: Sequence[float] = (),
) -> LinearModel:
    """Return a linear model of cells (block, cell) from columns of any shape that suits them.

    In the model without a design are `noise_columns` with a prior `precision`, and nearly free ones
    of named effects, which are `given`; `low` are the least sizes of both, if any. The sizes of
    designs cannot be negative where `is_bounded`.
    """
    return LinearModel(
        values,
        weight,
        [stack_columns(design, weight.shape) for design in designs],
        stack_columns([*noise_columns, *given], weight.shape),
        np.diag([*precision, *[-1.0] * len(given)]),
        is_bounded,
        np.array(low) if len(low) else np.full(len(noise_columns) + len(given), -np.inf),
    )


def stack_columns(columns: Iterable[Array], shape: tuple[int, ...]) -> Array:
    """Stack columns as (block, cell, column)."""
    stacked = [np.broadcast_to(column, shape) for column in columns]
    return np.stack(stacked, axis=-1) if stacked else np.empty((*shape, 0))


def variant_designs(
    candidates: Sequence[Candidate], make_column: Callable[[Array], Array] = np.asarray
) -> list[list[Array]]:
    """Return the columns of the designs of all variants, in order."""
    return [
        [make_column(column) for column in variant.design]
        for candidate in candidates
        for variant in candidate.variants
    ]


def power_column(density: Array, row: int, state: State) -> Array:
    """Return an added density (axis or 1, block or 1, band) of an axis with gaps, (block, band)."""
    mixed = mix_with_mean(
        select_row(density, row), unspread_share(state.blocks)[row], band_widths(state.blocks)
    )
    return np.broadcast_to(mixed, state.expected_power.shape[1:])


def cross_column(density: Array, row: int, blocks: xr.Dataset) -> Array:
    """Return a cross-density (1, block or 1, band) of a pair with gaps, complex (block, band)."""
    shape = blocks["cross"].shape
    return np.asarray(np.broadcast_to(spread_by_gaps(density + 0j, blocks, "pair"), shape)[row])


def expected_cross(baseline: xr.Dataset, blocks: xr.Dataset) -> Array:
    """Return the cross-spectra of the baseline, (pair, block, band); zero if it has none."""
    source = baseline["cross"] if "cross" in baseline else xr.zeros_like(blocks["cross"])
    return np.asarray(source.values)


def reference_channel_power(name: str, blocks: xr.Dataset) -> Array:
    """Return the power of a channel on the log's time, or of an axis as measured, (block, band)."""
    variables = blocks.variables
    axes = variables["axis"].values.tolist()
    if name in axes:
        return np.asarray(read_as_measured(blocks, "power").values[axes.index(name)])
    place = variables["reference"].values.tolist().index(name)
    return np.asarray(variables["reference_power"].values[place])


def with_correlated_powers(prediction: Prediction, blocks: xr.Dataset) -> Prediction:
    """Return a prediction with the powers that blocks show of exponentially correlated processes.

    A block is shorter than the correlation time, so that the steep spectrum leaks into all bands:
    up to 1.4 times the density of the process. Frequencies of the spectra are equally many in every
    band.
    """
    spectrum = dict(prediction.spectrum)
    for name, (time, variance) in prediction.wander.items():
        if name in spectrum and np.isfinite(time):
            power = correlated_band_powers(blocks, time)
            per_band = spectrum[name].shape[-1] // power.size
            spectrum[name] = np.asarray(variance)[:, None] * np.repeat(power, per_band)
    return replace(prediction, spectrum=spectrum)


def is_correlated_bias(name: str, prediction: Prediction, blocks: xr.Dataset) -> bool:
    """Return whether a random process is a bias of random course that the block means show.

    A process faster than half a block shows in the powers alone; one of two levels by its course.
    """
    time, _ = prediction.wander.get(name, (0.0, None))
    is_slow = float(blocks.attrs["block_s"]) / 2.0 <= time < np.inf
    return is_slow and not prediction.levels


def correlated_band_powers(blocks: xr.Dataset, time: float) -> Array:
    """Return the expected power (band,) of a process of unit variance [Hz-1]."""
    size, rate = int(blocks.attrs["block_samples"]), float(blocks.attrs["sampling_rate_hz"])
    return average_in_bands(correlated_powers(taper(size), rate, ordinates(size), time), blocks)
