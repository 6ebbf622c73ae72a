"""Find motion that no identified effect explains."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.identify.identification import Selection, components_of
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.reduce.moving_blocks import (
    moving_blocks,
    moving_blocks_of_axis,
    sample_range,
)
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import DEFAULTS, Settings

Array = NDArray[np.float64]


def unexplained_motion(
    blocks: xr.Dataset, identified: Iterable[Selection], *, settings: Settings = DEFAULTS
) -> NDArray[np.bool_]:
    """Find the moving blocks of axes without an effect that explains the means.

    An effect on the means must leave next to nothing of the motion. It is not enough that it adds
    evidence: a step or a drifting channel also explains a part of an intermittent rotation. Two
    levels have their course from the means themselves, hence no error of form: they must leave the
    axis at rest.

    Returns
    -------
    ndarray of bool, shape (axis, block)
    """
    components = components_of(identified)
    explained_axes = {
        axis
        for component in components
        if component.statistic.explains_motion
        for axis in component.row
    }
    moving = moving_blocks(blocks, settings=settings)
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
        if axis in explained_axes or (
            columns
            and _is_explained(
                axis_values(blocks, "mean", axis),
                moving[row],
                np.stack(columns, axis=1),
                span,
                settings,
                has_form=not any(component.statistic.is_switching for component in axis_components),
            )
        ):
            moving[row] = False
    return moving


def _is_explained(
    mean: Array,
    moving: NDArray[np.bool_],
    columns: Array,
    span: float,
    settings: Settings,
    *,
    has_form: bool,
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
    if not has_form and moving_blocks_of_axis(residual, span, settings).any():
        return False
    away = mean[good] - np.median(mean[good & ~moving])
    is_moving = moving[good]
    return float((residual[is_moving] ** 2).sum()) <= settings.spectrum_error_share * float(
        (away[is_moving] ** 2).sum()
    )
