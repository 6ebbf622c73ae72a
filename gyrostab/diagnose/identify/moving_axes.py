"""Axes that turn far above their noise with no effect to say why: their moving stretches are kept out of what is compared with noise.

What one axis measures while it turns stays there as what the others may see of it, through a lean
of theirs.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.identify.identification import Identification
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.progress import Stage, no_stage

__all__ = ["moving_blocks", "unexplained_motion", "without_motion"]

Array = NDArray[np.float64]
_BEYOND, _FAR = 6.0, 100.0  # times the scatter of the means at rest
_GROWN = 2  # blocks to either side that belong to a motion
_FEWEST, _MOST = (
    2,
    2.0 / 3.0,
)  # blocks that move, and share of them: what turns most of the time has no rest to be compared with
_CORE, _CORE_WIDTH = (
    0.25,
    0.637,
)  # share of the blocks whose means lie closest together, and its width in standard deviations
_LEAST_REST = 12  # blocks
_ROUNDS = 3
_FITTED = (
    "mean",
    "levels",
)  # views whose columns say how much of a mean that moves they account for
_MEANS = (
    "wander",
    "marks",
    "order",
    "transfer",
)  # views of effects that account for it in other ways
# of the squares of the motion, which may be left by what accounts for it: an error of its form
_LEFT = 0.1
_KEPT = ("mean", "power", "cross")


def moving_blocks(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks in which an axis moves, of those axes that somewhere move far above their scatter at rest.

    Parameters
    ----------
    blocks : xarray.Dataset
        From `reduce_log`.

    Returns
    -------
    ndarray of bool, shape (axis, block)

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> rate = np.random.default_rng(1).standard_normal((2, 60_000))
    >>> rate[1, 20_000:30_000] += 500.0
    >>> moving_blocks(reduce_log(make_log(rate, rate=100.0, unit="deg/h"), block="5s")).sum(axis=1)
    array([ 0, 24])
    """
    means = blocks["mean"].transpose("axis", "block").values
    return np.stack([_moving(row) for row in means])


def _moving(mean: Array) -> NDArray[np.bool_]:
    """Blocks of one axis."""
    good = np.isfinite(mean)
    nothing = np.zeros(mean.size, np.bool_)
    if good.sum() < _LEAST_REST:
        return nothing
    centre, scale = _core(mean[good])
    away = np.abs(mean - centre)
    rest = good & (away <= _BEYOND * scale)
    for _ in range(_ROUNDS):
        if rest.sum() < max(_LEAST_REST, (1.0 - _MOST) * good.sum()):
            return nothing
        away = np.abs(mean - np.median(mean[rest]))
        scale = 1.4826 * float(np.median(away[rest]))
        rest = good & (away <= _BEYOND * scale)
    if not scale > 0.0 or not np.nanmax(away) > _FAR * scale:
        return nothing
    there = good & ~rest
    if there.sum() < _FEWEST:
        return nothing
    place = np.flatnonzero(good)
    near = (
        np.convolve(there[place], np.ones(2 * _GROWN + 1), "same") > 0.5
    )  # neighbours among the blocks that are there
    out = nothing.copy()
    out[place] = near
    return (
        out
        if rest.sum() >= (1.0 - _MOST) * good.sum() and np.count_nonzero(~near) >= _LEAST_REST
        else nothing
    )


def _core(mean: Array) -> tuple[float, float]:
    """Where the means lie closest together, and their scatter there: at rest, however much of the time the axis moves."""
    ordered = np.sort(mean)
    size = int(np.ceil(_CORE * mean.size))
    width = ordered[size - 1 :] - ordered[: mean.size - size + 1]
    first = int(width.argmin())
    return float(np.median(ordered[first : first + size])), float(width[first]) / _CORE_WIDTH


def unexplained_motion(
    blocks: xr.Dataset, identified: Iterable[Identification]
) -> NDArray[np.bool_]:
    """Moving blocks, (axis, block), of the axes on which no named effect accounts for the means.

    What stands for a mean must leave next to nothing of the motion. It is not enough that it brings
    something: of a turning that comes and goes, a step or a channel that drifts explains a part as
    well.

    Parameters
    ----------
    blocks : xarray.Dataset
    identified : iterable of Claim
    """
    components = [
        component for identification in identified for component in identification.components
    ]
    told = {
        axis
        for component in components
        if component.candidate.statistic in _MEANS
        for axis in component.row
    }
    moving = moving_blocks(blocks)
    for row, axis in enumerate(map(str, blocks["axis"].values)):
        columns = [
            column
            for component in components
            if component.candidate.statistic in _FITTED and component.row == (axis,)
            for column in mean_columns(component.variant, row)
        ]
        if axis in told or (
            columns
            and _accounted(
                blocks["mean"].sel(axis=axis).values, moving[row], np.stack(columns, axis=1)
            )
        ):
            moving[row] = False
    return moving


def _accounted(mean: Array, moving: NDArray[np.bool_], columns: Array) -> bool:
    """Whether these columns leave next to nothing of a motion: a step that stays is no turning that comes and goes."""
    good = np.isfinite(mean)
    if not (good & moving).any():
        return True
    design = np.column_stack([np.ones(mean.size), np.nan_to_num(columns)])[good]
    design /= np.maximum(np.abs(design).max(axis=0), 1e-300)
    size, *_ = np.linalg.lstsq(design, mean[good], rcond=None)
    left = mean[good] - design @ size
    away = mean[good] - np.median(mean[good & ~moving])
    there = moving[good]
    return float((left[there] ** 2).sum()) <= _LEFT * float((away[there] ** 2).sum())


def without_motion(
    log: xr.Dataset,
    blocks: xr.Dataset,
    moving: NDArray[np.bool_],
    *,
    restart_gap: Any = 5.0,
    progress: Stage = no_stage,
) -> xr.Dataset:
    """The reduced record with the moving blocks left out on the axes that move; what they measured stays as ``measured_<name>``.

    Parameters
    ----------
    log : xarray.Dataset
    blocks : xarray.Dataset
        The log, from `reduce_log`.
    moving : ndarray of bool, shape (axis, block)
    restart_gap, progress
        As for `reduce_log`.
    """
    same = f"{blocks.attrs['block_samples']}samples"
    out = reduce_log(log, block=same, restart_gap=restart_gap, left_out=moving, progress=progress)
    out = out.assign({f"measured_{one}": blocks[one] for one in _KEPT if one in blocks})
    out = out.drop_dims([dim for dim in ("gap", "restart") if dim in out.dims]).assign(
        {one: blocks[one] for one in ("gap_begin", "gap_end", "restart_begin", "restart_end")}
    )
    out["moving"] = (
        ("axis", "block"),
        moving,
        {"long_name": "left out because the axis moves", "units": "1"},
    )
    return out
