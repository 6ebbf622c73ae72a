"""Find motion that no identified effect explains."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.identify.selections import Selection, components_of
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State, band_widths
from gyrostab.diagnose.reduce.moving_blocks import (
    find_moving_blocks,
    find_moving_blocks_of_axis,
    sample_range,
)
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.sample_counts import mask_anomalous_blocks


def find_unexplained_motion(
    blocks: xr.Dataset, identified: Iterable[Selection], state: State
) -> Bools:
    """Find the moving blocks (axis, block) of axes without an effect that explains the motion.

    An effect must leave next to nothing of the motion, in the means or, where it follows a channel
    sample by sample, in the power. It is not enough that it adds evidence: a step or a drifting
    channel also explains a part of an intermittent rotation. Two levels, or several steps, have
    their course from the means themselves, hence no error of form: they must leave the axis at
    rest. Outliers explain the blocks in which they are. The state is that without any effect,
    weighted with all of them.
    """
    components, settings = components_of(identified), state.settings
    explained_axes = {
        axis
        for component in components
        if component.statistic.moves_means(component)
        for axis in component.row
    }
    moving = find_moving_blocks(blocks, settings=settings)
    usual_blocks = mask_anomalous_blocks(blocks, components, settings)
    moving_as_usual = find_moving_blocks(usual_blocks, settings=settings)
    span = sample_range(blocks)
    for row, axis in enumerate(map(str, blocks["axis"].values)):
        axis_components = [
            component
            for component in components
            if component.statistic.is_in_means and component.row == (axis,)
        ]
        columns = [
            column
            for component in axis_components
            for column in mean_columns(component.variant, row)
        ]
        has_cause = (
            axis in explained_axes
            or not moving_as_usual[row].any()
            or _explains_power(components, axis, moving[row], state)
        )
        if has_cause or (
            columns
            and _is_explained(
                axis_values(blocks, "mean", axis),
                moving[row],
                np.stack(columns, axis=1),
                span,
                settings,
                has_form=not any(component.statistic.is_switching for component in axis_components)
                and sum(component.is_step for component in axis_components) < 2,
            )
        ):
            moving[row] = False
    return moving


def _explains_power(
    components: Iterable[Component], axis: str, moving: Bools, state: State
) -> bool:
    """Return whether what follows channels leaves next to nothing of the power in a motion."""
    followers = [
        component
        for component in components
        if component.statistic.is_transfer and component.row == (axis,)
    ]
    if not followers:
        return False
    measured = axis_values(state.blocks, "power", axis)
    predicted = np.zeros_like(measured)
    for component in followers:
        power, *_ = component.statistic.noise_shares(component, axis, state, state.expected_power)
        predicted += power
    good = np.isfinite(measured) & moving[:, None]
    width = np.broadcast_to(band_widths(state.blocks), measured.shape)[good]
    left = width @ np.abs(measured - predicted)[good]
    return float(left) <= state.settings.spectrum_error_share * float(width @ measured[good])


def _is_explained(
    mean: Floats, moving: Bools, columns: Floats, span: float, settings: Settings, *, has_form: bool
) -> bool:
    """Return whether these columns leave next to nothing of a motion.

    Columns without a given form cannot have an error of form, and must leave the axis at rest.
    """
    good = np.isfinite(mean)
    if not (good & moving).any():
        return True
    design = np.column_stack([np.ones(mean.size), np.nan_to_num(columns)])[good]
    design /= np.maximum(np.abs(design).max(axis=0), 1e-300)
    size, *_ = np.linalg.lstsq(design, mean[good], rcond=None)
    residual = mean[good] - design @ size
    if not has_form and find_moving_blocks_of_axis(residual, span, settings).any():
        return False
    away = mean[good] - np.median(mean[good & ~moving])
    is_moving = moving[good]
    return float((residual[is_moving] ** 2).sum()) <= settings.spectrum_error_share * float(
        (away[is_moving] ** 2).sum()
    )
