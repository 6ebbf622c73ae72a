"""Test effects against time-shifted surrogates of the channel or axis that they follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.predict.windows import (
    driver_names,
    fill_linearly,
    make_windows,
    rebuild_variant,
)
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.physics.prediction import Windows

#: Number of time-shifted surrogates: two of them make the allowed share of 1 %.
TIME_SHIFTS = 200
SHIFT_RANGE = (0.05, 0.95)  # of the record
_FOLLOWING_AXES = ("misalignment",)  # effects that follow the means of other axes


class TimeShifts(NamedTuple):
    """Result of the time-shift test.

    Attributes
    ----------
    passed : bool
        Also true where no surrogate can be made.
    p_value : float
        Share of the surrogates that explain as much; NaN where too few of them differ from the
        channel.
    nats : float
        By how much the best of them explains more than the channel [nats]; NaN as above.
    """

    passed: bool
    p_value: float = np.nan
    nats: float = np.nan


def passes_time_shift_test(
    components: Sequence[Component], state: State, folds: xr.DataArray
) -> TimeShifts:
    """Test whether an effect explains more than time-shifted surrogates of its channel.

    Parameters
    ----------
    components : sequence of Component
        Components of the effect.
    state : State
        What is in the model without it.
    """
    following_components = [component for component in components if _follows_channel(component)]
    if not following_components:
        return TimeShifts(True)
    block_count = state.blocks.sizes["block"]
    shifts = np.unique(
        np.linspace(block_count * SHIFT_RANGE[0], block_count * SHIFT_RANGE[1], TIME_SHIFTS).astype(
            int
        )
    )
    real, shifted = 0.0, np.zeros(shifts.size)
    valid = np.ones(shifts.size, np.bool_)
    limit = state.settings.surrogate_correlation
    for component in following_components:
        surrogates = _make_surrogates(component, state, shifts)
        row = state.axes.index(component.row[0])
        for number, surrogate in enumerate(surrogates):
            if surrogate is None or _max_correlation(surrogate, component.variant, row) > limit:
                valid[number] = False
        chosen = [
            surrogate if surrogate is not None else component.variant for surrogate in surrogates
        ]
        shifted_candidates = [
            replace(component.candidate, effect=f"shifted {number}", variants=(variant,))
            for number, variant in enumerate(chosen)
        ]
        # all variants: the channel pays for the search of the best one, as no surrogate has to
        all_evidence = compute_evidence(
            [component.candidate, *shifted_candidates],
            state.blocks,
            state,
            folds,
        )
        values = np.array([evidence.evidence_nats[0, row] for evidence in all_evidence])
        real += float(values[0])
        shifted += values[1:]
    if valid.sum() < state.settings.min_surrogates:
        return TimeShifts(True)
    p_value = float(np.mean(shifted[valid] >= real))
    passed = p_value <= state.settings.surrogate_share
    return TimeShifts(passed, p_value, float(shifted[valid].max() - real))


def _follows_channel(component: Component) -> bool:
    """Return whether a component follows a channel, or the means of other axes."""
    if not (component.statistic.is_linear_in_means or component.statistic.is_power):
        return False
    return any(component.candidate.driver) or (
        component.statistic.is_linear_in_means and component.candidate.effect in _FOLLOWING_AXES
    )


def _make_surrogates(
    component: Component, state: State, shifts: NDArray[np.int64]
) -> list[Variant | None]:
    """Return the variant for channels that are rotated in time by each shift, end to start."""
    candidate, blocks = component.candidate, state.blocks
    drivers = driver_names(candidate)
    windows = make_windows(blocks, drivers)
    channels = {inner: blocks[f"channel_{name}"].values for inner, name in drivers.items()}
    means = measured(blocks, "mean").values

    def shift_windows(shift: int) -> Windows:
        def rotate(values: NDArray[Any]) -> NDArray[Any]:
            return np.roll(values, shift, axis=0)

        shifted = replace(
            windows,
            drivers={inner: fill_linearly(rotate(values)) for inner, values in channels.items()},
            fine={inner: rotate(values) for inner, values in windows.fine.items()},
        )
        if candidate.effect not in _FOLLOWING_AXES:
            return shifted
        rotated_means = (fill_linearly(rotate(mean)) for mean in means)
        return replace(shifted, own=dict(zip(windows.axes, rotated_means, strict=True)))

    coefficient = state.baseline["coefficient"]
    return [
        rebuild_variant(
            candidate, component.variant, blocks, coefficient, shift_windows(int(shift))
        )
        for shift in shifts
    ]


def _max_correlation(surrogate: Variant, true: Variant, row: int) -> float:
    """Return the largest correlation of the columns over time, of either sign."""

    def flat(design: NDArray[Any]) -> NDArray[Any]:
        rows = design[:, row if design.shape[1] > 1 else 0]
        rows = rows.reshape(rows.shape[0], rows.shape[1], -1).mean(axis=-1)
        return np.asarray(rows - rows.mean(axis=1, keepdims=True))

    a, b = flat(surrogate.design), flat(true.design)
    size = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return float(np.max(np.abs((a * b).sum(axis=1)) / np.where(size > 0, size, 1.0)))
