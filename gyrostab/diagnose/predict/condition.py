"""Conditioning on named effects: given columns in every statistic, masked blocks, new powers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.diagnose.evidence.held_out import noise_columns
from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State, pair_rows, select_row
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.kernels.regression.nonnegative import solve_bounded

#: Least ratio of fitted to expected power. Design choice.
MIN_FITTED_POWER_RATIO = 0.2
SCORING_STEPS = 4  # of Fisher scoring, which fits powers


def condition_on(state: State, components: Iterable[Component]) -> State:
    """Add an effect to the state and refit the powers."""
    return refit_powers(condition_on_components(state, components))


def condition_on_components(state: State, components: Iterable[Component]) -> State:
    """Add components of effects to the state, without refitting the powers."""
    for component in components:
        state = component.statistic.condition(state, component)
    return state


def mean_columns(variant: Variant, row: int) -> list[Floats]:
    """Return the columns of the mean on an axis, (block,) each."""
    return [select_row(design, row) for design in variant.design]


def free_covariance(state: State, axis: str, density: Floats) -> State:
    """Add any covariance of an axis with the others of this density, (block, band)."""
    nothing = np.zeros_like(density)
    for pair in pair_rows(state.blocks):
        if axis in pair:
            real_and_imaginary = [
                np.concatenate([density, nothing], axis=-1),
                np.concatenate([nothing, density], axis=-1),
            ]
            state = state.with_columns("cross", ",".join(pair), real_and_imaginary)
    return state


def find_bands(blocks: xr.Dataset, frequency: float) -> Ints:
    """Return the indices of the bands within the resolution of a block of a frequency."""
    reach = 1.0 / float(blocks.attrs["block_s"])
    low, high = blocks["band_low"].values - reach, blocks["band_high"].values + reach
    return np.flatnonzero((low <= frequency) & (frequency < high))


def free_shape(state: State, axis: str) -> State:
    """Add any spectrum of constant shape to the powers of an axis."""
    shape = state.expected_power.shape[1:]
    return state.with_columns(
        "power", axis, [np.broadcast_to(band, shape) for band in np.eye(shape[1])]
    )


def refit_powers(state: State) -> State:
    """Set the expected powers by a fit of all given power columns (Fisher scoring, gamma law)."""
    power = state.expected_power.copy()
    for row, axis in enumerate(state.axes):
        if state.power_columns(axis):
            power[row] = fit_powers(state, axis)
    return replace(
        state, expected_power=power, blocks=drop_changed_tails(state.blocks, power, state.settings)
    )


def fit_powers(state: State, axis: str, left_out: Bools | None = None) -> Floats:
    """Fit the powers of an axis, (block, band), and leave some of its power columns out of them."""
    row, shape = state.axes.index(axis), state.expected_power.shape[1:]
    expected = axis_values(state.baseline, "spectrum", axis)
    level, precision, low = noise_columns(state.baseline, axis=axis)
    level_count = level.shape[2]
    given = [np.broadcast_to(column, shape) for column in state.power_columns(axis)]
    columns = np.concatenate([level * expected[..., None], np.stack(given, axis=-1)], axis=-1)
    prior = np.zeros(columns.shape[2])
    prior[:level_count] = np.diagonal(precision)
    least = np.array([*low, *state.least_powers(axis)])
    power, degrees = (state.blocks[name].values[row] for name in ("power", "shape"))
    degrees = np.where(state.masked[row][:, None], np.nan, degrees)
    inputs = expected, columns, prior, least, power, degrees
    sizes = state.recall(partial(_fit_sizes, *inputs), b"powers", *inputs)
    if left_out is not None:
        sizes = np.where(np.append(np.zeros(level_count, np.bool_), left_out), 0.0, sizes)
    return np.maximum(expected + columns @ sizes, MIN_FITTED_POWER_RATIO * expected)


def drop_changed_tails(
    blocks: xr.Dataset, expected: Floats, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Drop kurtosis and outliers that a changing noise level explains.

    Two levels in one block have tails that neither level has. Another noise level has another
    kurtosis, because higher noise hides that of rounding. `expected` is the power by (axis, block,
    band).
    """
    level = np.log(expected @ (blocks["band_high"].values - blocks["band_low"].values))
    step = np.abs(np.diff(level, axis=1)) > settings.max_level_step
    turns = np.pad(step, ((0, 0), (1, 0))) | np.pad(step, ((0, 0), (0, 1)))
    unusual = turns | (
        np.abs(level - np.median(level, axis=1, keepdims=True)) > settings.max_level_step
    )
    out = blocks.copy()
    replacements: dict[str, tuple[Bools, float]]
    replacements = {"kurtosis": (unusual, np.nan), "outliers": (turns, 0)}
    for name, (where, replacement) in replacements.items():
        out[name].values = np.where(where, replacement, out[name].values)
    return out


def _fit_sizes(
    expected: Floats, columns: Floats, prior: Floats, low: Floats, power: Floats, shape: Floats
) -> Floats:
    """Fit the sizes of columns (block, band, column) to powers with gamma distributions.

    The sizes are at least `low`.
    """
    flat, power, shape = expected.ravel(), power.ravel(), shape.ravel()
    columns = columns.reshape(flat.size, -1)
    largest = np.abs(columns).max(axis=0)
    size = np.where(largest > 0.0, largest, 1.0)
    columns = columns / size
    good = np.isfinite(power) & np.isfinite(shape)
    fitted, sizes = flat, np.zeros(size.size)
    for _ in range(SCORING_STEPS):
        w = np.where(good, shape / fitted**2, 0.0)
        w = np.where(np.isfinite(w), w, 0.0)
        normal = (columns * w[:, None]).T @ columns + np.diag(prior / size**2)
        diagonal = np.diagonal(normal)
        normal += np.diag(np.where(diagonal > 0.0, 1e-9 * diagonal, 1.0))  # 1 where nothing shows
        right = columns.T @ (w * np.where(good, power - flat, 0.0))
        sizes = solve_bounded(normal, right, low * size)
        fitted = np.maximum(flat + columns @ sizes, MIN_FITTED_POWER_RATIO * flat)
    return np.asarray(sizes / size)
