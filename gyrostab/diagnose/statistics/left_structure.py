"""Check whether what the identified effects leave is still structured in time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.posterior import visible_coefficients
from gyrostab.diagnose.evidence.held_out import noise_weight
from gyrostab.diagnose.evidence.mixture import products_mixture
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import mean_mixture
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.units import HOUR

Array = NDArray[np.float64]
#: Flicker and random walk that are tried, as multiples of the least that the record can show.
_NOISE_STEPS = (1.0, 3.0, 10.0, 30.0)


def with_neighbouring_variants(state: State, components: Sequence[Component], axis: str) -> State:
    """Return the state with the neighbours of the fitted nuisance values in the model as well.

    A time constant lies between two points of its grid.
    """
    row = state.axes.index(axis)
    for component in components:
        if not (component.statistic.is_linear_in_means and component.row == (axis,)):
            continue
        family = [
            variant
            for variant in component.candidate.variants
            if variant.columns == component.variant.columns
        ]
        place = next(
            number for number, variant in enumerate(family) if variant is component.variant
        )
        for neighbour in family[max(place - 1, 0) : place] + family[place + 1 : place + 2]:
            state = state.with_columns("mean", axis, mean_columns(neighbour, row))
    return state


def excess_low_frequency_noise(state: State, axis: str) -> float:
    """Return the evidence [nats] of free random walk and flicker over the calibrated ones.

    All identified effects are in the model. It is zero where the record shows less slow noise than
    calibrated: a calibration on blocks with an effect takes the effect for noise.
    """
    span = state.blocks.sizes["block"] * float(state.blocks.attrs["block_s"])
    slow = (
        axis_values(state.baseline, "grid_K", axis) ** 2 * span / HOUR
        + axis_values(state.baseline, "grid_B", axis) ** 2
    )
    free, calibrated = (mean_mixture(state, axis, [], tier=tier) for tier in ("free", "calibrated"))
    free_prior, calibrated_prior = (
        noise_weight(state.baseline, axis, tier) for tier in ("free", "calibrated")
    )
    free_sum, calibrated_sum = map(np.logaddexp.reduce, (free_prior, calibrated_prior))
    if free.weights() @ slow <= np.exp(calibrated_prior - calibrated_sum) @ slow:
        return 0.0
    return float((free.evidence - free_sum) - (calibrated.evidence - calibrated_sum))


def variance_fluctuation(state: State, axis: str) -> float:
    """Return the evidence [nats] of a power level that wanders over one that is constant.

    The level is that of all bands of a block together, relative to the expected one with all
    identified effects. As in `excess_low_frequency_noise`, a large value shows that the noise
    changes in another way than the effects predict.
    """
    row = state.axes.index(axis)
    level, variance, columns = _power_levels(state, row, axis)
    present = np.isfinite(level) & np.isfinite(variance) & ~state.masked[row]
    if present.sum() < state.settings.min_rest_blocks:
        return 0.0
    step = float(state.blocks.attrs["block_s"])
    usual = float(np.median(variance[present]))
    smallest_coefficients = visible_coefficients(usual * step, present.sum() * step)
    K, B = (
        component.ravel()
        for component in np.meshgrid(
            *(
                [0.0, *(coefficient * np.array(_NOISE_STEPS))]
                for coefficient in smallest_coefficients
            ),
            indexing="ij",
        )
    )
    safe = np.where(present, variance, usual)
    limit = state.settings.max_level_sigma * np.sqrt(safe)
    values = np.clip(np.where(present, level, 0.0), -limit, limit)[:, None]
    products = mean_products(values, columns, variance=safe, step=step, K=K, B=B, present=present)
    log = products_mixture(products, np.zeros(K.size)).log_weight
    return float(np.logaddexp.reduce(log[1:]) - np.log(log.size - 1) - log[0])


def _power_levels(state: State, row: int, axis: str) -> tuple[Array, Array, Array]:
    """Return level and variance of each block, and what changes of size of the effects do to them.

    The level is relative to the expected one, less 1.
    """
    shape = axis_values(state.baseline, "shape_alone", axis)
    ratio = state.blocks["power"].values[row] / state.weight[row] - 1.0
    use = np.where(np.isfinite(shape) & np.isfinite(ratio), shape, 0.0)
    total = use.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = (use * np.nan_to_num(ratio)).sum(axis=1) / total
        variance = 1.0 / total + axis_values(state.baseline, "common", axis)
        named = [
            (use * column / state.weight[row]).sum(axis=1) / total
            for column in state.power_columns(axis)
        ]
    columns = np.nan_to_num(np.stack(named, axis=-1)) if named else np.empty((total.size, 0))
    largest = np.abs(columns).max(axis=0, initial=1e-300)
    moves = np.ptp(columns, axis=0) > 1e-9 * largest
    return level, variance, columns[:, moves] / largest[moves]
