"""Conditioning on named effects: given columns in every statistic, masked blocks, new weights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.fast_switching import switching_powers
from gyrostab.diagnose.evidence.held_out import noise_columns
from gyrostab.diagnose.evidence.spectral_lines import expected_lines, line_skirt
from gyrostab.diagnose.predict.candidates import Candidate, Variant
from gyrostab.diagnose.predict.filter_response import is_filter, undo_filter
from gyrostab.diagnose.predict.linear_model import (
    State,
    cross_column,
    cross_without,
    harmonic_sets,
    order_columns,
    pair_rows,
    power_column,
    reference_channel_power,
)
from gyrostab.physics.phase import fold

__all__ = [
    "MIN_POWER_RATIO",
    "Component",
    "add_fast_switching",
    "condition_on",
    "condition_on_component",
    "condition_on_components",
    "drop_changed_tails",
    "find_anomalous_blocks",
    "is_reversed",
    "mask_anomalous_blocks",
    "mean_columns",
    "power_shares",
    "refit_weights",
]

Array = NDArray[np.float64]
#: Least fitted power over the expected one. Design choice.
MIN_POWER_RATIO = 0.2
_LINE_REACH = 3  # lines on each side that belong to a line; leakage of the taper
_MAX_MASKED_SHARE = 0.5  # of the blocks; design choice
_MAX_ANOMALOUS_SHARE = 0.75  # of an axis's blocks, left out for anomalous samples; design choice
_MIN_SAMPLE_SHARE = 0.1  # of the fullest block's samples, from which an axis has a block
_MAX_WHITE_RANGE = 0.04  # of a density, over the bands, for white noise; design choice
_MIN_SHARE_RANGE = 0.05  # within a block, of a course that switches there; design choice
_MAX_LOG_POWER_STEP = 0.2  # of noise, from block to block, for usable tails; design choice


@dataclass(frozen=True)
class Component:
    """One row of a statistic in which a named effect shows.

    Attributes
    ----------
    candidate : Candidate
    variant : Variant
    row : tuple of str
        Axes of the row.
    evidence_nats : float
        Held-out evidence [nats].
    place : int
        Index of the line, or of the set of harmonics; -1 if there is none.
    """

    candidate: Candidate
    variant: Variant
    row: tuple[str, ...]
    evidence_nats: float
    place: int = -1


def is_reversed(component: Component) -> bool:
    """Return whether the rotation is reversed: y at -90 degrees from x, or a reversed channel."""
    return (
        component.candidate.statistic == "order"
        and not component.candidate.each
        and component.place % 2 == 1
    )


def condition_on(state: State, components: list[Component]) -> State:
    """Add an effect to the state and refit the powers."""
    return refit_weights(condition_on_components(state, components))


def condition_on_components(state: State, components: Iterable[Component]) -> State:
    """Add components of effects to the state, without refitting the powers."""
    for component in components:
        state = condition_on_component(state, component)
    return state


def condition_on_component(state: State, component: Component) -> State:
    """Add one component of an effect to the state."""
    return _CONDITIONERS[component.candidate.statistic](state, component)


def mean_columns(variant: Variant, row: int) -> list[Array]:
    """Return the columns of the mean on an axis, (block,) each."""
    return [np.asarray(one[row] if one.shape[0] > 1 else one[0]) for one in variant.design]


def _condition_mean(state: State, component: Component) -> State:
    """Condition on a component in the means."""
    axis = component.row[0]
    row = state.axes.index(axis)
    columns = mean_columns(component.variant, row)
    state = state.with_columns("mean", axis, columns)
    return replace(state, masked=state.masked | _moving_blocks(state, row, columns))


def _condition_telegraph(state: State, component: Component) -> State:
    """Condition on a bias of two levels.

    If it switches within blocks, its course is the power there and invalidates their kurtosis.
    """
    inside = component.variant.inside
    if not inside.size:
        return _condition_mean(state, component)
    axis = component.row[0]
    row = state.axes.index(axis)
    attrs = state.blocks.attrs
    low, high = (float(component.variant.values[name]) for name in ("low", "high"))
    power = switching_powers(
        inside, low, high, int(attrs["block_samples"]), float(attrs["sampling_rate_hz"])
    )
    state = add_fast_switching(state, component)
    state = state.with_columns("power", axis, [power_column(power[None], row, state)])
    moves = xr.DataArray(np.ptp(inside, axis=1) > _MIN_SHARE_RANGE, dims="block") & (
        state.blocks["axis"] == axis
    )
    blank = {
        name: state.blocks[name].where(~moves, other)
        for name, other in (("kurtosis", np.nan), ("outliers", 0))
    }
    return replace(state, blocks=state.blocks.assign(blank))


def add_fast_switching(state: State, component: Component) -> State:
    """Add the course of a bias that switches within blocks to the block and sub-block means."""
    axis = component.row[0]
    return state.with_columns("mean", axis, mean_columns(component.variant, 0)).with_columns(
        "sub_block", axis, [component.variant.inside]
    )


def _moving_blocks(state: State, row: int, columns: list[Array]) -> NDArray[np.bool_]:
    """Return the blocks in which the effect moves enough to show in the power of the axis."""
    blocks = state.blocks
    y = blocks["mean"].values[row] - state.baseline["known_mean"].values[row]
    good = np.isfinite(y)
    design = np.nan_to_num(np.stack([np.ones(y.size), *columns], axis=1))
    largest = np.abs(design).max(axis=0)
    design = design[:, largest > 0.0] / largest[largest > 0.0]
    size, *_ = np.linalg.lstsq(design[good], y[good], rcond=None)
    curve = design @ size
    step = np.abs(np.diff(curve))
    moved = np.maximum(np.append(step, 0.0), np.append(0.0, step))
    seconds = float(blocks.attrs["block_s"])
    strong = moved**2 * seconds > 5.0 * state.weight[row, :, 0]
    mask = np.zeros_like(state.masked)
    if strong.mean() <= _MAX_MASKED_SHARE:
        mask[row] = strong
    return mask


def _condition_power(state: State, component: Component) -> State:
    """Condition on a component in the powers."""
    axis = component.row[0]
    row = state.axes.index(axis)
    if is_filter("power", component.variant) and "line_power" in state.blocks:
        expected = expected_lines(state.baseline, state.blocks["line_frequency"].values)[row]
        blocks, stopped = undo_filter(
            state.blocks, axis, component.candidate.effect, component.variant.values, expected
        )
        state = replace(state, blocks=blocks).with_columns("line", "all", [stopped])
    if is_filter("power", component.variant) and axis in state.baseline.attrs.get(
        "recalibrated", ()
    ):
        return state  # the noise of the baseline is filtered already
    return state.with_columns(
        "power", axis, [power_column(one, row, state) for one in component.variant.design]
    )


def _condition_cross(state: State, component: Component) -> State:
    """Condition on a component in the cross-spectra."""
    row = pair_rows(state.blocks).index(component.row)
    columns = []
    for one in component.variant.design:
        chosen = cross_column(one, row, state.blocks)
        columns.append(np.concatenate([chosen.real, chosen.imag], axis=-1))
    state = state.with_columns("cross", ",".join(component.row), columns)
    if not component.variant.squared:
        return state
    calibrated = state.baseline.attrs.get("source", "calibrated") == "calibrated"
    # White noise was calibrated with it.
    added = [one.real for one in component.variant.design if not (calibrated and _is_white(one))]
    for axis in component.row if added else ():
        powers = [power_column(one, state.axes.index(axis), state) for one in added]
        known = state.given.get(("power", axis), [])
        state = state.with_columns(
            "power",
            axis,
            [one for one in powers if not any(np.array_equal(one, other) for other in known)],
        )
    return state


def _is_white(density: NDArray[np.complex128]) -> bool:
    """Return whether a density is the same in all bands, up to `_MAX_WHITE_RANGE`."""
    size = np.abs(density)
    return bool(np.ptp(size, axis=-1).max() <= _MAX_WHITE_RANGE * size.max(initial=0.0))


def _free_covariance(state: State, axes: tuple[str, ...], density: Array) -> State:
    """Add any covariance of these axes with the others of this density, (block, band)."""
    nothing = np.zeros_like(density)
    for pair in pair_rows(state.blocks) if "cross" in state.blocks else []:
        if set(pair) & set(axes):
            real_and_imaginary = [
                np.concatenate([density, nothing], axis=-1),
                np.concatenate([nothing, density], axis=-1),
            ]
            state = state.with_columns("cross", ",".join(pair), real_and_imaginary)
    return state


def _bands_at(state: State, frequency: Array) -> NDArray[np.bool_]:
    """Return the bands (block, band) of frequencies, (block,) or scalar, and adjacent ones."""
    low, high = state.blocks["band_low"].values, state.blocks["band_high"].values
    reach = 1.0 / float(state.blocks.attrs["block_s"])
    place = np.broadcast_to(frequency, (state.weight.shape[1],))[:, None]
    return (place >= low - reach) & (place < high + reach)


def _condition_order(state: State, component: Component) -> State:
    """Condition on a component in the rotation orders."""
    count = state.blocks.sizes["harmonic"]
    turn = np.abs(state.blocks["channel_rotation_rate"].values) / 360.0
    if component.candidate.each:
        chosen = harmonic_sets(count)[component.place]
        patterns = [(axis, np.ones(count, np.complex128)) for axis in component.row]
    else:
        chosen = (0,)
        pattern = (
            np.conj(component.variant.design[0])
            if is_reversed(component)
            else component.variant.design[0]
        )
        patterns = [(axis, pattern[state.axes.index(axis)]) for axis in component.row]
    for axis, pattern in patterns:
        state = state.with_columns("order", axis, order_columns(pattern, chosen))
        for k in chosen:
            density = _bands_at(state, turn * (k + 1)).astype(float)
            for band in np.flatnonzero(density.any(axis=0)):
                column = np.zeros_like(density)
                column[:, band] = density[:, band]
                state = state.with_columns("power", axis, [column])
                state = _free_covariance(state, (axis,), column)
    lines = state.blocks["line_frequency"].values
    taken = np.zeros(lines.size, np.bool_)
    for k in chosen:
        taken |= (lines >= np.nanmin(turn) * (k + 1) - 2 * lines[0]) & (
            lines <= np.nanmax(turn) * (k + 1) + 2 * lines[0]
        )
    return state.with_columns("line", "all", [taken])


def _free_shape(state: State, axis: str) -> State:
    """Add any spectrum of constant shape to the powers of an axis."""
    bands = state.weight.shape[2]
    return state.with_columns(
        "power", axis, [np.broadcast_to(one, state.weight.shape[1:]) for one in np.eye(bands)]
    )


def _condition_profile(state: State, component: Component) -> State:
    """Condition on a component in the ramp profile."""
    state = state.with_columns("phase_locked", component.row[0], list(component.variant.design))
    if "ramp_turns" in state.blocks:
        state = state.with_columns("line", "all", [_ramp_lines(state)])
    return _free_shape(state, component.row[0])


def _ramp_lines(state: State) -> NDArray[np.bool_]:
    """Return the lines at multiples of the ramp frequency, aliased by the sampling."""
    lines, rate = (
        state.blocks["line_frequency"].values,
        float(state.blocks.attrs["sampling_rate_hz"]),
    )
    turns = np.abs(state.blocks["ramp_turns"].values)
    turns = turns[np.isfinite(turns)]
    if not turns.size:
        return np.zeros(lines.size, np.bool_)
    number = np.arange(1, max(2, int(rate / max(turns.mean(), lines[0]))))
    low, high = (fold(number * one, rate) for one in (turns.min(), turns.max()))
    reach = _LINE_REACH * lines[0]
    near = (lines[:, None] >= np.minimum(low, high) - reach) & (
        lines[:, None] <= np.maximum(low, high) + reach
    )
    return np.asarray(near.any(axis=1))


def _condition_transfer(state: State, component: Component) -> State:
    """Condition on a transfer from a reference channel."""
    axis = component.row[0]
    power = reference_channel_power(component.candidate.reference[0], state.blocks)
    power = np.where(np.isfinite(power), power, 0.0)
    columns = np.concatenate(
        [
            component.variant.design.real * np.sqrt(power)[:, None],
            component.variant.design.imag * np.sqrt(power)[:, None],
        ],
        axis=-1,
    )
    state = state.with_columns("transfer", axis, list(np.moveaxis(columns, 1, 0)))
    for band in range(power.shape[1]):
        column = np.zeros_like(power)
        column[:, band] = power[:, band] / max(power[:, band].max(initial=0.0), 1e-300)
        if np.ptp(column[:, band]) > 0.5:
            state = state.with_columns("power", axis, [column])
        state = _free_covariance(state, (axis,), column)
    return state


def _condition_line(state: State, component: Component) -> State:
    """Condition on a spectral line."""
    frequency = float(state.blocks["line_frequency"].values[component.place])
    axis = component.row[0]
    density = _bands_at(state, np.asarray(frequency)).astype(float)
    known = state.given.get(("power", axis), [])
    for band in np.flatnonzero(density.any(axis=0)):
        column = np.zeros_like(density)
        column[:, band] = 1.0
        if any(np.array_equal(column, other) for other in known):
            continue  # another line in the same band is already given
        state = state.with_columns("power", axis, [column])
        state = _free_covariance(state, (axis,), column)
    return state.with_columns("line", "all", [line_skirt(state.blocks, axis, component.place)])


def _condition_sample_counts(state: State, component: Component) -> State:
    """Leave out blocks with anomalous samples; if too many, free the shape of the spectrum."""
    if _is_everywhere(component):
        return state
    axis, anomalous = component.row[0], find_anomalous_blocks(component, state.blocks)
    if not anomalous.any():
        return _free_shape(state, axis)
    keep = xr.DataArray(~anomalous, dims="block")
    is_axis = state.blocks["axis"] == axis
    blocks = state.blocks.copy()
    for variable in ("mean", "power"):
        blocks[variable] = blocks[variable].where(keep | ~is_axis)
    if "cross" in blocks:
        rows = np.array([one == axis for one in state.axes])
        blocks["cross"] = cross_without(blocks, anomalous & rows[:, None])
    return replace(state, blocks=blocks)


def _is_everywhere(component: Component) -> bool:
    """Return whether the samples are anomalous in all blocks alike."""
    return (
        component.candidate.effect == "rate_quantization"
        or component.candidate.effect.startswith("~")
    )


def find_anomalous_blocks(component: Component, blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Return the blocks left out for anomalous samples; none if too many, or if all are alike."""
    samples = blocks["samples"].sel(axis=component.row[0]).values
    kept = samples > _MIN_SAMPLE_SHARE * samples.max(initial=0)
    if _is_everywhere(component) or not kept.any():
        return np.zeros(kept.size, np.bool_)
    count = blocks[component.variant.columns[0]].sel(axis=component.row[0]).values
    # The noise has a negligible number of outliers.
    usual = 0.0 if component.variant.columns[0] == "outliers" else float(np.median(count[kept]))
    anomalous = count > usual + 3.0 * np.sqrt(max(usual, 0.0))
    return np.asarray(anomalous & (anomalous[kept].mean() <= _MAX_ANOMALOUS_SHARE))


def mask_anomalous_blocks(blocks: xr.Dataset, components: Iterable[Component]) -> xr.Dataset:
    """Leave out blocks with named anomalous samples, whose powers have no model."""
    axes = [str(axis) for axis in blocks["axis"].values]
    anomalous = np.zeros((len(axes), blocks.sizes["block"]), np.bool_)
    for component in (
        component for component in components if component.candidate.statistic == "marks"
    ):
        anomalous[axes.index(component.row[0])] |= find_anomalous_blocks(component, blocks)
    if not anomalous.any():
        return blocks
    kept = xr.DataArray(~anomalous, dims=("axis", "block"))
    left = blocks.assign(mean=blocks["mean"].where(kept), power=blocks["power"].where(kept))
    return left.assign(cross=cross_without(blocks, anomalous)) if "cross" in blocks else left


_CONDITIONERS = {
    "mean": _condition_mean,
    "power": _condition_power,
    "cross": _condition_cross,
    "order": _condition_order,
    "phase_locked": _condition_profile,
    "transfer": _condition_transfer,
    "line": _condition_line,
    "marks": _condition_sample_counts,
    "levels": _condition_telegraph,
}


def refit_weights(state: State, *, rounds: int = 4) -> State:
    """Set the weights by a fit of all given power columns (Fisher scoring, gamma likelihood)."""
    weight = state.weight.copy()
    for row, axis in enumerate(state.axes):
        named = state.given.get(("power", axis))
        if named:
            weight[row] = _fit_powers(
                state,
                row,
                axis,
                np.stack([np.broadcast_to(one, weight.shape[1:]) for one in named], axis=-1),
                rounds,
            )[0]
    return replace(state, weight=weight, blocks=drop_changed_tails(state.blocks, weight))


def power_shares(state: State, axis: str, *, rounds: int = 4) -> Array:
    """Return the fitted contribution of each power column of an axis, (column, block, band)."""
    row, shape = state.axes.index(axis), state.weight.shape[1:]
    named = [np.broadcast_to(one, shape) for one in state.given.get(("power", axis), [])]
    if not named:
        return np.empty((0, *shape))
    sizes = _fit_powers(state, row, axis, np.stack(named, axis=-1), rounds)[1]
    return np.stack([size * one for size, one in zip(sizes, named, strict=True)])


def drop_changed_tails(blocks: xr.Dataset, expected: Array) -> xr.Dataset:
    """Drop kurtosis and outliers that a changing noise level explains.

    Two levels in one block have tails that neither level has. Another noise level has another
    kurtosis, because higher noise hides that of rounding.

    Parameters
    ----------
    blocks : xarray.Dataset
    expected : ndarray, shape (axis, block, band)
        Expected power.
    """
    level = np.log(expected @ (blocks["band_high"].values - blocks["band_low"].values))
    step = np.abs(np.diff(level, axis=1)) > _MAX_LOG_POWER_STEP
    turns = np.pad(step, ((0, 0), (1, 0))) | np.pad(step, ((0, 0), (0, 1)))
    unusual = turns | (
        np.abs(level - np.median(level, axis=1, keepdims=True)) > _MAX_LOG_POWER_STEP
    )
    left_out = {"kurtosis": (unusual, np.nan), "outliers": (turns, 0)}
    return blocks.assign(
        {
            name: blocks[name].where(xr.DataArray(~where, dims=("axis", "block")), other)
            for name, (where, other) in left_out.items()
            if name in blocks
        }
    )


def _fit_powers(
    state: State, row: int, axis: str, named: Array, rounds: int
) -> tuple[Array, Array]:
    """Fit the powers of an axis; return them and the sizes of the named columns."""
    expected = state.baseline["spectrum"].sel(axis=axis).transpose("block", "band").values
    level, precision = noise_columns(state.baseline, axis=axis)
    columns = np.concatenate([level * expected[..., None], named], axis=-1).reshape(
        expected.size, -1
    )
    size = np.maximum(np.abs(columns).max(axis=0), 1e-300)
    columns = columns / size
    prior = np.zeros(columns.shape[1])
    prior[: level.shape[2]] = np.diagonal(precision) / size[: level.shape[2]] ** 2
    power = state.blocks["power"].values[row].ravel()
    shape = state.blocks["shape"].values[row].ravel()
    good = (
        np.isfinite(power) & np.isfinite(shape) & ~np.repeat(state.masked[row], expected.shape[1])
    )
    fitted, sizes = expected.ravel().copy(), np.zeros(size.size)
    for _ in range(rounds):
        w = np.where(good, shape / fitted**2, 0.0)
        w = np.where(np.isfinite(w), w, 0.0)
        normal = (columns * w[:, None]).T @ columns + np.diag(prior)
        normal += 1e-9 * np.diag(np.maximum(np.diagonal(normal), 1e-300))
        moved = columns.T @ (w * np.where(good, power - expected.ravel(), 0.0))
        sizes = np.linalg.solve(normal, moved)
        fitted = np.maximum(expected.ravel() + columns @ sizes, MIN_POWER_RATIO * expected.ravel())
    return np.asarray(fitted.reshape(expected.shape)), (sizes / size)[level.shape[2] :]
