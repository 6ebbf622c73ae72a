"""Whether what is left, with all that is named in the model, is still structured in time: then the names are not the whole of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.posterior import visible_coefficients
from gyrostab.diagnose.evidence.held_out import mean_factors
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.identify.identification import Identification
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import mean_mixture
from gyrostab.noise import HOUR

__all__ = ["excess_low_frequency_noise", "flexible", "variance_fluctuation"]

Array = NDArray[np.float64]
_STEPS = (1.0, 3.0, 10.0, 30.0)  # of the flicker and random walk that just show
_LOUDEST = 8.0  # standard deviations that the level of one block may be away


def flexible(state: State, identified: Sequence[Identification], axis: str) -> State:
    """The state with the next points of the nuisance grids beside those named: a time constant lies between two of them."""
    row = state.axes.index(axis)
    for component in (
        component
        for one in identified
        for component in one.components
        if component.candidate.statistic == "mean" and component.row == (axis,)
    ):
        family = [
            one for one in component.candidate.variants if one.columns == component.variant.columns
        ]
        place = next(number for number, one in enumerate(family) if one is component.variant)
        for other in family[max(place - 1, 0) : place] + family[place + 1 : place + 2]:
            state = state.with_columns("mean", axis, mean_columns(other, row))
    return state


def excess_low_frequency_noise(state: State, axis: str, folds: xr.DataArray) -> float:
    """What free random walk and flicker gain over the calibrated ones, with all that is named in the model [nats].

    Zero where the noise is less red than calibrated: a calibration on blocks that an effect touches
    takes it for noise.
    """
    given = state.given.get(("mean", axis))
    beside = np.stack(given, axis=-1) if given else None
    columns = [np.linspace(-1.0, 1.0, state.blocks.sizes["block"])] if not given else []
    evidence, strength = [], []
    span = state.blocks.sizes["block"] * float(state.blocks.attrs["block_s"])
    slow = (
        state.baseline["grid_K"].sel(axis=axis).values ** 2 * span / HOUR
        + state.baseline["grid_B"].sel(axis=axis).values ** 2
    )
    for tier in ("free", "calibrated"):
        evidence.append(
            mean_factors(
                state.blocks, state.baseline, [], axis=axis, tier=tier, given=beside, folds=folds
            )[0, 0, 0]
        )
        strength.append(float(mean_mixture(state, axis, columns, tier=tier).weights() @ slow))
    return float(evidence[0] - evidence[1]) if strength[0] > strength[1] else 0.0


def variance_fluctuation(state: State, axis: str) -> float:
    """What a level of the powers that wanders freely, as flicker and random walk do, gains over one that stands still [nats].

    The level is that of all bands of a block together, over the one expected with all that is
    named. It is the twin of `excess_low_frequency_noise`: where something is left, the noise
    changes in another way than what is named says.
    """
    row = state.axes.index(axis)
    level, variance, columns = _levels(state, row, axis)
    present = np.isfinite(level) & np.isfinite(variance) & ~state.masked[row]
    if present.sum() < 8:
        return 0.0
    step = float(state.blocks.attrs["block_s"])
    usual = float(np.median(variance[present]))
    least = visible_coefficients(usual * step, present.sum() * step)
    K, B = (
        component.ravel()
        for component in np.meshgrid(
            *([0.0, *(one * np.array(_STEPS))] for one in least), indexing="ij"
        )
    )
    safe = np.where(present, variance, usual)
    error = np.sqrt(safe)
    values = np.clip(np.where(present, level, 0.0), -_LOUDEST * error, _LOUDEST * error)[:, None]
    products = mean_products(values, columns, variance=safe, step=step, K=K, B=B, present=present)
    gram = products.gram + 1e-9 * np.eye(columns.shape[1]) * (
        1.0 + np.trace(products.gram, axis1=1, axis2=2)[:, None, None]
    )
    size = np.linalg.solve(gram, products.cross)[..., 0]
    square = products.square[:, 0] - (size * products.cross[..., 0]).sum(axis=1)
    log = -0.5 * (square + products.log_determinant + np.linalg.slogdet(gram)[1])
    return float(np.logaddexp.reduce(log[1:]) - np.log(log.size - 1) - log[0])


def _levels(state: State, row: int, axis: str) -> tuple[Array, Array, Array]:
    """Of every block: level over the expected less one, its variance, and what a change of size of all that is named does to it."""
    shape = state.baseline["shape_alone"].sel(axis=axis).transpose("block", "band").values
    ratio = (
        state.blocks["power"].transpose("axis", "block", "band").values[row] / state.weight[row]
        - 1.0
    )
    use = np.where(np.isfinite(shape) & np.isfinite(ratio), shape, 0.0)
    total = use.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = (use * np.nan_to_num(ratio)).sum(axis=1) / total
        variance = 1.0 / total + state.baseline["common"].sel(axis=axis).values
        named = [
            (use * one / state.weight[row]).sum(axis=1) / total
            for one in state.given.get(("power", axis), [])
        ]
    columns = np.nan_to_num(np.stack(named, axis=-1)) if named else np.empty((total.size, 0))
    moves = (
        np.ptp(columns, axis=0) > 1e-9 * np.abs(columns).max(axis=0, initial=1e-300)
        if named
        else np.zeros(0, bool)
    )
    columns = columns[:, moves]
    columns = (
        columns / np.maximum(np.abs(columns).max(axis=0, initial=0.0), 1e-300)
        if columns.shape[1]
        else columns
    )
    return level, variance, columns
