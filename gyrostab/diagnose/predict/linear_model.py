"""Views whose noise is independent from cell to cell: powers, cross-spectra, orders, profiles, transfers, as linear models.

The data may be a recording or null records, with the dimension ``record`` in front. Weights and
given columns are those of a `State`: what is believed of the noise, and what is named so far.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.held_out import LinearModel, independent, noise_columns
from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.reduce.block_statistics import measured, noise_at_orders
from gyrostab.kernels.spectra.periodogram import taper

__all__ = [
    "State",
    "begin_state",
    "build_linear_model",
    "cross_column",
    "cross_without",
    "drawn",
    "effective",
    "in_place",
    "known_cross",
    "pair_rows",
    "reference_channel_power",
    "statistic_rows",
]

Array = NDArray[Any]
_MOVING = (
    9.0  # times the noise, beyond which the power of an axis is motion: three times in amplitude
)
_CALM = 0.25  # of the blocks that are calm
_LEAST_SHARE = (
    0.05  # of the variance of a cross-spectrum, that is left beside the phase of what is shared
)


@dataclass(frozen=True)
class State:
    """What is believed of a record when a candidate is tried.

    Attributes
    ----------
    blocks : xarray.Dataset
        The recording: shapes, samples, channels.
    baseline : xarray.Dataset
        From `gyrostab.diagnose.baseline.calibrate`.
    weight : ndarray, shape (axis, block, band)
        Powers that the weights of all cells are taken from [degree2 hour-2 Hz-1]: the expected ones
        and those of the effects so far.
    masked : ndarray of bool, shape (axis, block)
        Blocks of which powers and cross-spectra are left out.
    given : mapping of (str, str) to list of ndarray
        (view, row) -> columns that are in the model with and without a candidate; the row is an
        axis, or both axes of a pair with a comma between.
    """

    blocks: xr.Dataset
    baseline: xr.Dataset
    weight: Array
    masked: NDArray[np.bool_]
    given: dict[tuple[str, str], list[Array]] = field(default_factory=dict)

    def with_columns(self, statistic: str, row: str, columns: Sequence[Array]) -> State:
        """The same with more given columns."""
        given = dict(self.given)
        given[statistic, row] = [*given.get((statistic, row), []), *columns]
        return replace(self, given=given)

    @property
    def axes(self) -> list[str]:
        """Names of the axes."""
        return [str(one) for one in self.blocks["axis"].values]


def begin_state(blocks: xr.Dataset, baseline: xr.Dataset) -> State:
    """Nothing is named yet."""
    weight = baseline["spectrum"].transpose("axis", "block", "band").values
    return State(blocks, baseline, weight, np.zeros(weight.shape[:2], np.bool_))


def drawn(cells: LinearModel, rng: np.random.Generator, count: int) -> LinearModel:
    """The same cells with noise alone, `count` records of it."""
    spread = np.where(
        cells.weight > 0.0, 1.0 / np.sqrt(np.where(cells.weight > 0.0, cells.weight, 1.0)), 0.0
    )
    return cells._replace(values=spread[..., None] * rng.standard_normal((*spread.shape, count)))


def in_place(blocks: xr.Dataset, row: str = "axis") -> Array:
    """Share of a density that the samples of each block show at its own frequencies, (axis or pair, block): 1 without gaps.

    Random gaps spread the rest over all frequencies. That the tapered ends of a block have fewer
    neighbours spreads nothing.
    """
    near = (
        blocks["neighbours" if row == "axis" else "cross_neighbours"].transpose(row, "block").values
    )
    weights = taper(int(blocks.attrs["block_samples"]))
    whole = float((weights[1:] * weights[:-1]).sum() / (weights**2).sum())
    return np.minimum(np.where(np.isfinite(near), near, whole) / whole, 1.0)


def effective(density: Array, blocks: xr.Dataset, row: str = "axis") -> Array:
    """A density, (axis or 1, block or 1, band), as gaps let it be seen: mixed with its mean over frequency, (axis, block, band).

    The row may be a pair of axes in place of an axis.
    """
    return _mixed(density, in_place(blocks, row), band_widths(blocks))


def band_widths(blocks: xr.Dataset) -> Array:
    """Widths of the bands [Hz]."""
    return np.asarray(blocks["band_high"].values - blocks["band_low"].values)


def _mixed(density: Array, near: Array, width: Array) -> Array:
    """A density (..., band) with that share of it in its place, `near` (...), and the rest spread over all bands."""
    level = (density * width).sum(axis=-1, keepdims=True) / width.sum()
    return np.asarray(near[..., None] * density + (1.0 - near[..., None]) * level)


def _row_of(density: Array, row: int) -> Array:
    """One row of a density that has all of them, or one for all."""
    return np.asarray(density[row if density.shape[0] > 1 else 0])


def pair_rows(blocks: xr.Dataset) -> list[tuple[str, ...]]:
    """Both axes of each pair."""
    return [
        (str(a), str(b))
        for a, b in zip(blocks["first"].values, blocks["second"].values, strict=True)
    ]


def cross_without(blocks: xr.Dataset, left_out: NDArray[np.bool_]) -> xr.DataArray:
    """Covariances of the pairs of axes without the blocks that are left out on either, (axis, block)."""
    axes = [str(axis) for axis in blocks["axis"].values]
    pairs = np.array(
        [[axes.index(axis) for axis in pair] for pair in pair_rows(blocks)], np.int64
    ).reshape(-1, 2)
    return blocks["cross"].where(~xr.DataArray(left_out[pairs].any(axis=1), dims=("pair", "block")))


def statistic_rows(candidate: Candidate, state: State) -> list[tuple[str, ...]]:
    """Axes that each row of a view speaks about."""
    if candidate.statistic == "cross":
        return pair_rows(state.blocks)
    if candidate.statistic == "order" and not candidate.each:
        pattern = np.abs(candidate.variants[0].design[0]).max(axis=-1)
        return [tuple(axis for axis, size in zip(state.axes, pattern, strict=True) if size > 0)]
    return [(axis,) for axis in state.axes]


def build_linear_model(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    """One row of a view for candidates of that view that have the same rows; the designs are those of all their variants in order.

    Candidates of the view "transfer" must have the same witness.
    """
    return _BUILDERS[candidates[0].statistic](candidates, row, data, state)


# ----------------------------------------------------------------------------------------------------------------
# frames


def _records(values: Array, plain: int) -> Array:
    """Data with the record last."""
    return np.moveaxis(values, 0, -1) if values.ndim > plain else values[..., None]


def _parts(values: Array, axis: int = -1) -> Array:
    """Real and imaginary parts side by side."""
    return np.concatenate([values.real, values.imag], axis=axis)


def _beside(
    state: State,
    statistic: str,
    row: tuple[str, ...],
    shape: tuple[int, ...],
    known: Sequence[Array] = (),
    precision: Any = (),
) -> Any:
    """Given columns (block, cell, column) and their precision: those known beforehand, and those of the effects named."""
    named = state.given.get((statistic, ",".join(row)), [])
    columns = [np.broadcast_to(one, shape) for one in [*known, *named]]
    given = np.stack(columns, axis=-1) if columns else np.empty((*shape, 0))
    return given, np.diag([*precision, *[-1.0] * len(named)])


def _spread(columns: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Columns (block, cell, column)."""
    return np.stack([np.broadcast_to(one, shape) for one in columns], axis=-1)


# ---------------------------------------------------------------------------------------------------------------
# powers


def power_column(density: Array, row: int, state: State) -> Array:
    """An added density (axis or 1, block or 1, band) on one axis as gaps let it be seen, (block, band)."""
    seen = _mixed(_row_of(density, row), in_place(state.blocks)[row], band_widths(state.blocks))
    return np.broadcast_to(seen, state.weight.shape[1:])


def _power(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    axis = state.axes[row]
    expected = state.baseline["spectrum"].sel(axis=axis).transpose("block", "band").values
    values = (
        _records(data["power"].transpose(..., "axis", "block", "band").values, 3)[row]
        - expected[..., None]
    )
    weight = (
        state.baseline["shape_alone"].sel(axis=axis).transpose("block", "band").values
        / state.weight[row] ** 2
    )
    weight = np.where(state.masked[row][:, None], 0.0, weight)
    level, precision = noise_columns(state.baseline, axis=axis)
    known = [level[..., number] * expected for number in range(level.shape[2])]
    given, whole = _beside(state, "power", (axis,), weight.shape, known, np.diagonal(precision))
    near, width = in_place(state.blocks)[row], band_widths(state.blocks)
    designs = [
        _spread([_mixed(_row_of(one, row), near, width) for one in variant.design], weight.shape)
        for each in candidates
        for variant in each.variants
    ]
    return independent(
        LinearModel(values, weight, designs, given, whole),
        state.baseline["common"].sel(axis=axis).values,
        state.weight[row],
    )


# ---------------------------------------------------------------------------------------------------------------
# crosses


def cross_column(density: Array, row: int, blocks: xr.Dataset) -> Array:
    """A cross-density (1, block or 1, band) of a pair of axes as gaps let it be seen, complex (block, band)."""
    shape = blocks["cross"].transpose("pair", "block", "band").shape
    return np.asarray(np.broadcast_to(effective(density + 0j, blocks, "pair"), shape)[row])


def known_cross(baseline: xr.Dataset) -> Array | None:
    """Cross-spectra that the baseline expects, (pair, block, band); None where it expects nothing of them."""
    return (
        np.asarray(baseline["cross"].transpose("pair", "block", "band").values)
        if "cross" in baseline
        else None
    )


def _cross(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    pair = pair_rows(state.blocks)[row]
    i, j = (state.axes.index(axis) for axis in pair)
    known = known_cross(state.baseline)
    shared = known[row] if known is not None else np.zeros(1)
    values = (
        _records(data["cross"].transpose(..., "pair", "block", "band").values, 3)[row]
        - shared[..., None]
    )
    shape = state.blocks["cross_shape"].transpose("pair", "block", "band").values[row]
    alone, apart = (
        state.weight[i] * state.weight[j],
        (shared**2).real,
    )  # in phase with what is shared the scatter is larger, beside it less
    weight = np.concatenate(
        [
            2.0 * shape / (alone + apart),
            2.0 * shape / np.maximum(alone - apart, _LEAST_SHARE * alone),
        ],
        axis=1,
    )
    weight = np.where((state.masked[i] | state.masked[j])[:, None], 0.0, weight)
    given, precision = _beside(state, "cross", pair, weight.shape)
    near, width = in_place(state.blocks, "pair")[row], band_widths(state.blocks)
    designs = [
        _spread(
            [_parts(_mixed(_row_of(one, row) + 0j, near, width)) for one in variant.design],
            weight.shape,
        )
        for each in candidates
        for variant in each.variants
    ]
    return LinearModel(_parts(values, axis=1), weight, designs, given, precision)


# ----------------------------------------------------------------------------------------------------------------
# orders


def order_weight(state: State) -> Array:
    """(axis, block, harmonic): one over the variance of each part of a complex amplitude."""
    blocks = state.blocks
    rate, frequency = float(blocks.attrs["sampling_rate_hz"]), blocks["frequency"].values
    place = (
        np.abs(blocks["channel_rotation_rate"].values)[:, None] / 360.0 * blocks["harmonic"].values
    )
    good = (
        np.isfinite(blocks["order"].values)
        & (place * float(blocks.attrs["block_s"]) >= 2.0)
        & (place < rate / 2.0)
    )
    nearest = np.abs(np.log(np.maximum(place, frequency[0])[..., None] / frequency)).argmin(axis=-1)
    level = np.take_along_axis(
        state.weight, np.broadcast_to(nearest, (state.weight.shape[0], *nearest.shape)), axis=2
    )
    level = noise_at_orders(blocks, level)
    seconds = blocks["samples"].values[..., None] / rate
    return np.where(good, seconds / (2.0 * level), 0.0)


def harmonic_sets(count: int) -> list[tuple[int, ...]]:
    """Each harmonic by itself, and all together."""
    return [*((k,) for k in range(count)), *([tuple(range(count))] if count > 1 else [])]


def order_columns(pattern: Array, chosen: tuple[int, ...]) -> list[Array]:
    """Columns (cell,) of a complex factor for each harmonic chosen, the cells real parts then imaginary parts of the harmonics."""
    columns = []
    for k in chosen:
        one = np.zeros_like(pattern)
        one[..., k] = pattern[..., k]
        columns += [_parts(one), _parts(1j * one)]
    return columns


def _order(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    values = _records(data["order"].transpose(..., "axis", "block", "harmonic").values, 3)
    weight = order_weight(state)
    count = weight.shape[-1]
    if candidates[0].each:
        both = np.concatenate([weight[row], weight[row]], axis=1)
        designs = [
            _spread(order_columns(np.ones(count, complex), chosen), both.shape)
            for chosen in harmonic_sets(count)
        ]
        given, precision = _beside(state, "order", (state.axes[row],), both.shape)
        return LinearModel(
            _parts(values[row], axis=1), both, designs * len(candidates), given, precision
        )
    both = np.concatenate(
        [np.concatenate([one, one], axis=1) for one in weight], axis=1
    )  # the cells of all axes side by side
    stacked = np.concatenate([_parts(one, axis=1) for one in values], axis=1)
    designs = []
    for each in candidates:
        for variant in each.variants:
            for pattern in (variant.design[0], np.conj(variant.design[0])):
                by_axis = [order_columns(one, (0,)) for one in pattern]
                designs.append(
                    _spread(
                        [np.concatenate(components) for components in zip(*by_axis, strict=True)],
                        both.shape,
                    )
                )
    named = [state.given.get(("order", axis), []) for axis in state.axes]
    given, precision = np.empty((*both.shape, 0)), np.empty((0, 0))
    for number, columns in enumerate(named):
        for one in columns:
            wide = np.zeros((*both.shape, 1))
            wide[:, number * 2 * count : (number + 1) * 2 * count, 0] = one
            given = np.concatenate([given, wide], axis=2)
    if given.shape[2]:
        precision = -np.eye(given.shape[2])
    return LinearModel(stacked, both, designs, given, precision)


# --------------------------------------------------------------------------------------------------------------
# profiles


def _profile(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    values = _records(data["profile"].transpose(..., "axis", "block", "phase").values, 3)[row]
    rate = float(state.blocks.attrs["sampling_rate_hz"])
    width = (state.blocks["band_high"] - state.blocks["band_low"]).values
    variance = rate * (state.weight[row] * width).sum(axis=-1) / width.sum()
    weight = state.blocks["profile_samples"].values[row] / variance[:, None]
    given, precision = _beside(
        state, "phase_locked", (state.axes[row],), weight.shape, [np.ones(weight.shape[1])], [-1.0]
    )
    designs = [
        _spread(list(variant.design), weight.shape)
        for each in candidates
        for variant in each.variants
    ]
    return LinearModel(values, weight, designs, given, precision)


# -------------------------------------------------------------------------------------------------------------
# transfers


def reference_channel_of(
    name: str, row: int, data: xr.Dataset, blocks: xr.Dataset, baseline: xr.Dataset
) -> tuple[Array, Array]:
    """Cross-power of an axis with a channel or another axis, (block, band, record), and the power of that, (block, band).

    What both axes are known to share is taken off.
    """
    axes = [str(one) for one in blocks["axis"].values]
    if name in axes:
        cross = _records(measured(data, "cross").transpose(..., "pair", "block", "band").values, 3)
        there = np.isfinite(blocks["power"].values[row])[..., None]
        known = known_cross(baseline)
        cross = cross if known is None else cross - known[..., None]
        found = np.full(cross.shape[1:], np.nan + 0j)
        for number, pair in enumerate(pair_rows(blocks)):
            if set(pair) == {name, axes[row]} and name != axes[row]:
                found = np.where(
                    there, np.conj(cross[number]) if pair[0] == name else cross[number], np.nan
                )
        return found, reference_channel_power(name, blocks)
    place = [str(one) for one in blocks["witness"].values].index(name)
    cross = _records(
        data["witness_cross"].transpose(..., "axis", "witness", "block", "band").values, 4
    )
    return cross[row, place], reference_channel_power(name, blocks)


def reference_channel_power(name: str, blocks: xr.Dataset) -> Array:
    """Power of a channel on the log's time, or of an axis as it measured, (block, band)."""
    if name in blocks["axis"].values:
        return np.asarray(
            measured(blocks, "power").sel(axis=name).transpose("block", "band").values
        )
    return np.asarray(blocks["witness_power"].sel(witness=name).transpose("block", "band").values)


def _transfer(
    candidates: Sequence[Candidate], row: int, data: xr.Dataset, state: State
) -> LinearModel:
    cross, power = reference_channel_of(
        candidates[0].witness[0], row, data, state.blocks, state.baseline
    )
    root = np.sqrt(np.where(power > 0.0, power, np.nan))
    share = _moving_share(candidates[0].witness[0], power, state)
    weight = 2.0 * state.blocks["shape"].values[row] / state.weight[row]
    weight = np.where(
        np.isfinite(root) & np.isfinite(weight) & ~state.masked[row][:, None], weight, 0.0
    )
    weight = np.concatenate([weight, weight], axis=1)
    with np.errstate(invalid="ignore"):
        values = _parts(cross / root[..., None], axis=1)
    given, precision = _beside(state, "transfer", (state.axes[row],), weight.shape)
    designs = [
        _spread([_parts(one * root * share) for one in variant.design], weight.shape)
        for each in candidates
        for variant in each.variants
    ]
    return LinearModel(values, weight, designs, given, precision)


def _moving_share(name: str, power: Array, state: State) -> Array:
    """Share of the power of another axis (block, band) that is motion; 1 for a channel, whose noise is not known.

    What leaks is motion that comes and goes: while the tool rests axes may have noise and lines in
    common, which is no leak. So what an axis shows in the calmer blocks of a band, and its expected
    noise, are no motion.
    """
    if name not in state.axes:
        return np.ones_like(power)
    row = state.axes.index(name)
    noise = state.baseline["spectrum"].transpose("axis", "block", "band").values[row]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a band without data has no motion
        noise = np.fmax(noise, np.nanquantile(power, _CALM, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(power > _MOVING * noise, 1.0 - noise / power, 0.0)


_BUILDERS = {
    "power": _power,
    "cross": _cross,
    "order": _order,
    "phase_locked": _profile,
    "transfer": _transfer,
}
