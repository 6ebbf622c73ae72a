"""What a named effect leaves for the next ones: given columns in every view that it touches, masked blocks, new weights."""

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
from gyrostab.diagnose.predict.filter_response import is_filter, straightened
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
    "FLOOR",
    "Component",
    "add_fast_switching",
    "condition_on",
    "condition_on_component",
    "condition_on_components",
    "find_anomalous_blocks",
    "mask_anomalous_blocks",
    "mean_columns",
    "mirrored",
    "power_shares",
    "reweighted",
    "without_turns",
]

Array = NDArray[np.float64]
#: Of the expected power, below which no fit goes.
FLOOR = 0.2
_LINE_REACH = 3  # lines on each side of one that belong to it
_FEW = 0.5  # of the blocks at most may be masked
_ODD = 0.75  # of those that the axis has may be left out for odd samples
_THERE = 0.1  # of the samples of the fullest block, above which an axis has a block
_FLAT = 0.04  # of a density, by which its bands may differ where it is white
_HOPS = 0.05  # share of a piece, by which a course that hops within a block differs in it
_TURN = 0.2  # change of the logarithm of the noise power from block to block


@dataclass(frozen=True)
class Component:
    """One row of a view in which a named effect shows.

    Attributes
    ----------
    candidate : Candidate
    variant : Variant
    row : tuple of str
        Axes.
    evidence_nats : float
        On held-out time [nats].
    place : int
        Line, or set of harmonics; -1 where there is none.
    """

    candidate: Candidate
    variant: Variant
    row: tuple[str, ...]
    evidence_nats: float
    place: int = -1


def mirrored(component: Component) -> bool:
    """Whether the axes see what turns in the other order: y stands at -90 degrees from x, or the channel runs back."""
    return (
        component.candidate.statistic == "order"
        and not component.candidate.each
        and component.place % 2 == 1
    )


def condition_on(state: State, components: list[Component]) -> State:
    """The state with an effect in it."""
    return reweighted(condition_on_components(state, components))


def condition_on_components(state: State, components: Iterable[Component]) -> State:
    """The state with rows of effects in it, before its powers are fitted anew."""
    for component in components:
        state = condition_on_component(state, component)
    return state


def condition_on_component(state: State, component: Component) -> State:
    """The state with one row of an effect in it."""
    return _TAKERS[component.candidate.statistic](state, component)


def mean_columns(variant: Variant, row: int) -> list[Array]:
    """Columns of the mean on an axis, (block,) each."""
    return [np.asarray(one[row] if one.shape[0] > 1 else one[0]) for one in variant.design]


def _mean(state: State, component: Component) -> State:
    axis = component.row[0]
    row = state.axes.index(axis)
    columns = mean_columns(component.variant, row)
    state = state.with_columns("mean", axis, columns)
    return replace(state, masked=state.masked | _edges(state, row, columns))


def _hopping(state: State, component: Component) -> State:
    """A bias of two levels; where it hops within blocks its course is the power there, and their kurtosis says nothing."""
    inside = component.variant.inside
    if not inside.size:
        return _mean(state, component)
    axis = component.row[0]
    row = state.axes.index(axis)
    attrs = state.blocks.attrs
    low, high = (float(component.variant.values[name]) for name in ("low", "high"))
    power = switching_powers(
        inside, low, high, int(attrs["block_samples"]), float(attrs["sampling_rate_hz"])
    )
    state = add_fast_switching(state, component)
    state = state.with_columns("power", axis, [power_column(power[None], row, state)])
    moves = xr.DataArray(np.ptp(inside, axis=1) > _HOPS, dims="block") & (
        state.blocks["axis"] == axis
    )
    blank = {
        name: state.blocks[name].where(~moves, other)
        for name, other in (("kurtosis", np.nan), ("outliers", 0))
    }
    return replace(state, blocks=state.blocks.assign(blank))


def add_fast_switching(state: State, component: Component) -> State:
    """The state with the course of a bias that hops within blocks, in the means of blocks and of their pieces."""
    axis = component.row[0]
    return state.with_columns("mean", axis, mean_columns(component.variant, 0)).with_columns(
        "inner", axis, [component.variant.inside]
    )


def _edges(state: State, row: int, columns: list[Array]) -> NDArray[np.bool_]:
    """Blocks in which the effect moves so much that it shows in the power of the axis."""
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
    if strong.mean() <= _FEW:
        mask[row] = strong
    return mask


def _power(state: State, component: Component) -> State:
    axis = component.row[0]
    row = state.axes.index(axis)
    if is_filter("power", component.variant) and "line_power" in state.blocks:
        expected = expected_lines(state.baseline, state.blocks["line_frequency"].values)[row]
        blocks, stopped = straightened(
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


def _cross(state: State, component: Component) -> State:
    row = pair_rows(state.blocks).index(component.row)
    columns = []
    for one in component.variant.design:
        chosen = cross_column(one, row, state.blocks)
        columns.append(np.concatenate([chosen.real, chosen.imag], axis=-1))
    state = state.with_columns("cross", ",".join(component.row), columns)
    if not component.variant.squared:
        return state
    calibrated = state.baseline.attrs.get("source", "calibrated") == "calibrated"
    added = [
        one.real for one in component.variant.design if not (calibrated and _white(one))
    ]  # white noise was calibrated with it
    for axis in component.row if added else ():
        powers = [power_column(one, state.axes.index(axis), state) for one in added]
        known = state.given.get(("power", axis), [])
        state = state.with_columns(
            "power",
            axis,
            [one for one in powers if not any(np.array_equal(one, other) for other in known)],
        )
    return state


def _white(density: NDArray[np.complex128]) -> bool:
    """Whether a density is the same in all bands, to the error of a form."""
    size = np.abs(density)
    return bool(np.ptp(size, axis=-1).max() <= _FLAT * size.max(initial=0.0))


def _coherent(state: State, axes: tuple[str, ...], density: Array) -> State:
    """Any covariance of these axes with the rest of this density, (block, band)."""
    nothing = np.zeros_like(density)
    for pair in pair_rows(state.blocks) if "cross" in state.blocks else []:
        if set(pair) & set(axes):
            both = [
                np.concatenate([density, nothing], axis=-1),
                np.concatenate([nothing, density], axis=-1),
            ]
            state = state.with_columns("cross", ",".join(pair), both)
    return state


def _bands_of(state: State, frequency: Array) -> NDArray[np.bool_]:
    """Bands in which frequencies, (block,) or scalar, lie, and the next ones where they are at an edge; (block, band)."""
    low, high = state.blocks["band_low"].values, state.blocks["band_high"].values
    reach = 1.0 / float(state.blocks.attrs["block_s"])
    place = np.broadcast_to(frequency, (state.weight.shape[1],))[:, None]
    return (place >= low - reach) & (place < high + reach)


def _order(state: State, component: Component) -> State:
    count = state.blocks.sizes["harmonic"]
    turn = np.abs(state.blocks["channel_rotation_rate"].values) / 360.0
    if component.candidate.each:
        chosen = harmonic_sets(count)[component.place]
        patterns = [(axis, np.ones(count, np.complex128)) for axis in component.row]
    else:
        chosen = (0,)
        pattern = (
            np.conj(component.variant.design[0])
            if mirrored(component)
            else component.variant.design[0]
        )
        patterns = [(axis, pattern[state.axes.index(axis)]) for axis in component.row]
    for axis, pattern in patterns:
        state = state.with_columns("order", axis, order_columns(pattern, chosen))
        for k in chosen:
            density = _bands_of(state, turn * (k + 1)).astype(float)
            for band in np.flatnonzero(density.any(axis=0)):
                column = np.zeros_like(density)
                column[:, band] = density[:, band]
                state = state.with_columns("power", axis, [column])
                state = _coherent(state, (axis,), column)
    lines = state.blocks["line_frequency"].values
    taken = np.zeros(lines.size, np.bool_)
    for k in chosen:
        taken |= (lines >= np.nanmin(turn) * (k + 1) - 2 * lines[0]) & (
            lines <= np.nanmax(turn) * (k + 1) + 2 * lines[0]
        )
    return state.with_columns("line", "all", [taken])


def _free_shape(state: State, axis: str) -> State:
    bands = state.weight.shape[2]
    return state.with_columns(
        "power", axis, [np.broadcast_to(one, state.weight.shape[1:]) for one in np.eye(bands)]
    )


def _profile(state: State, component: Component) -> State:
    state = state.with_columns("phase_locked", component.row[0], list(component.variant.design))
    if "ramp_turns" in state.blocks:
        state = state.with_columns("line", "all", [_comb(state)])
    return _free_shape(state, component.row[0])


def _comb(state: State) -> NDArray[np.bool_]:
    """Lines at the multiples of the turns of the ramp, folded as samples see them."""
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


def _transfer(state: State, component: Component) -> State:
    axis = component.row[0]
    power = reference_channel_power(component.candidate.witness[0], state.blocks)
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
        state = _coherent(state, (axis,), column)
    return state


def _line(state: State, component: Component) -> State:
    frequency = float(state.blocks["line_frequency"].values[component.place])
    axis = component.row[0]
    density = _bands_of(state, np.asarray(frequency)).astype(float)
    known = state.given.get(("power", axis), [])
    for band in np.flatnonzero(density.any(axis=0)):
        column = np.zeros_like(density)
        column[:, band] = 1.0
        if any(np.array_equal(column, other) for other in known):
            continue  # another line in the same band has made it free already
        state = state.with_columns("power", axis, [column])
        state = _coherent(state, (axis,), column)
    return state.with_columns("line", "all", [line_skirt(state.blocks, axis, component.place)])


def _marks(state: State, component: Component) -> State:
    """Blocks with odd samples say nothing of the rest; where there are too many of them, the shape of the spectrum does not."""
    if _everywhere(component):
        return state
    axis, odd = component.row[0], find_anomalous_blocks(component, state.blocks)
    if not odd.any():
        return _free_shape(state, axis)
    keep = xr.DataArray(~odd, dims="block")
    here = state.blocks["axis"] == axis
    blocks = state.blocks.copy()
    for variable in ("mean", "power"):
        blocks[variable] = blocks[variable].where(keep | ~here)
    if "cross" in blocks:
        rows = np.array([one == axis for one in state.axes])
        blocks["cross"] = cross_without(blocks, odd & rows[:, None])
    return replace(state, blocks=blocks)


def _everywhere(component: Component) -> bool:
    """Odd samples that are in every block alike, so that none says less of the rest than others."""
    return (
        component.candidate.effect == "rate_quantization"
        or component.candidate.effect.startswith("~")
    )


def find_anomalous_blocks(component: Component, blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks with odd samples, which are left out on the axis; none where they would be too many, or the effect is in all alike."""
    samples = blocks["samples"].sel(axis=component.row[0]).values
    there = samples > _THERE * samples.max(initial=0)
    if _everywhere(component) or not there.any():
        return np.zeros(there.size, np.bool_)
    count = blocks[component.variant.columns[0]].sel(axis=component.row[0]).values
    usual = (
        0.0 if component.variant.columns[0] == "outliers" else float(np.median(count[there]))
    )  # noise has as good as none
    odd = count > usual + 3.0 * np.sqrt(max(usual, 0.0))
    return np.asarray(odd & (odd[there].mean() <= _ODD))


def mask_anomalous_blocks(blocks: xr.Dataset, components: Iterable[Component]) -> xr.Dataset:
    """The record without the blocks of odd samples that are named: their counts tell what they gain, their powers have no model."""
    axes = [str(axis) for axis in blocks["axis"].values]
    odd = np.zeros((len(axes), blocks.sizes["block"]), np.bool_)
    for component in (
        component for component in components if component.candidate.statistic == "marks"
    ):
        odd[axes.index(component.row[0])] |= find_anomalous_blocks(component, blocks)
    if not odd.any():
        return blocks
    there = xr.DataArray(~odd, dims=("axis", "block"))
    left = blocks.assign(mean=blocks["mean"].where(there), power=blocks["power"].where(there))
    return left.assign(cross=cross_without(blocks, odd)) if "cross" in blocks else left


_TAKERS = {
    "mean": _mean,
    "power": _power,
    "cross": _cross,
    "order": _order,
    "phase_locked": _profile,
    "transfer": _transfer,
    "line": _line,
    "marks": _marks,
    "levels": _hopping,
}


def reweighted(state: State, *, rounds: int = 4) -> State:
    """The state with weights from a fit of everything given to the powers (Fisher scoring of the gamma likelihood)."""
    weight = state.weight.copy()
    for row, axis in enumerate(state.axes):
        named = state.given.get(("power", axis))
        if named:
            weight[row] = _fit(
                state,
                row,
                axis,
                np.stack([np.broadcast_to(one, weight.shape[1:]) for one in named], axis=-1),
                rounds,
            )[0]
    return replace(state, weight=weight, blocks=without_turns(state.blocks, weight))


def power_shares(state: State, axis: str, *, rounds: int = 4) -> Array:
    """What each column given to the powers of an axis adds to them in the fit of all, (column, block, band)."""
    row, shape = state.axes.index(axis), state.weight.shape[1:]
    named = [np.broadcast_to(one, shape) for one in state.given.get(("power", axis), [])]
    if not named:
        return np.empty((0, *shape))
    sizes = _fit(state, row, axis, np.stack(named, axis=-1), rounds)[1]
    return np.stack([size * one for size, one in zip(sizes, named, strict=True)])


def without_turns(blocks: xr.Dataset, expected: Array) -> xr.Dataset:
    """The record without the kurtosis and outliers that a changing level of the noise explains.

    Two levels in one block have tails that neither of them has; and noise of another level than
    usual has another kurtosis, since that of rounding gets lost in what is louder.

    Parameters
    ----------
    blocks : xarray.Dataset
    expected : ndarray, shape (axis, block, band)
        Expected power.
    """
    level = np.log(expected @ (blocks["band_high"].values - blocks["band_low"].values))
    step = np.abs(np.diff(level, axis=1)) > _TURN
    turns = np.pad(step, ((0, 0), (1, 0))) | np.pad(step, ((0, 0), (0, 1)))
    unusual = turns | (np.abs(level - np.median(level, axis=1, keepdims=True)) > _TURN)
    left_out = {"kurtosis": (unusual, np.nan), "outliers": (turns, 0)}
    return blocks.assign(
        {
            name: blocks[name].where(xr.DataArray(~where, dims=("axis", "block")), other)
            for name, (where, other) in left_out.items()
            if name in blocks
        }
    )


def _fit(state: State, row: int, axis: str, named: Array, rounds: int) -> tuple[Array, Array]:
    """Fitted powers of an axis, and the sizes of the named columns."""
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
        fitted = np.maximum(expected.ravel() + columns @ sizes, FLOOR * expected.ravel())
    return np.asarray(fitted.reshape(expected.shape)), (sizes / size)[level.shape[2] :]
