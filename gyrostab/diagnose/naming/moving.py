"""Axes that turn far above their noise with no effect to say why: their moving stretches are kept out of what is compared with noise.

What one axis measures while it turns stays there as what the others may see of it, through a lean of theirs.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.naming.claims import Claim
from gyrostab.diagnose.reduction.reduced import reduce_log
from gyrostab.progress import Stage, no_stage

__all__ = ["moving_blocks", "unexplained_motion", "without_motion"]

Array = NDArray[np.float64]
_BEYOND, _FAR = 6.0, 100.0  # times the scatter of the means at rest
_GROWN = 2  # blocks to either side that belong to a motion
_FEWEST, _MOST = 2, 0.5  # blocks that move, and share of them: what turns most of the time has no rest to be compared with
_ROUNDS = 3
_MEANS = ("mean", "levels", "wander", "marks", "order", "transfer")  # views of effects that account for a mean that moves
_KEPT = ("mean", "power", "cross")


def moving_blocks(reduced: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks in which an axis moves, of those axes that somewhere move far above their scatter at rest.

    Parameters
    ----------
    reduced : xarray.Dataset
        From `reduce_log`.

    Returns
    -------
    ndarray of bool, shape (axis, block)

    Examples
    --------
    >>> from gyrostab.log import make_log
    >>> rate = np.random.default_rng(1).standard_normal((2, 60_000))
    >>> rate[1, 20_000:30_000] += 500.0
    >>> moving_blocks(reduce_log(make_log(rate, rate=100.0, unit="deg/h"), block="5s")).sum(axis=1)
    array([ 0, 24])
    """
    means = reduced["mean"].transpose("axis", "block").values
    return np.stack([_moving(row) for row in means])


def _moving(mean: Array) -> NDArray[np.bool_]:
    """Blocks of one axis."""
    good = np.isfinite(mean)
    nothing = np.zeros(mean.size, np.bool_)
    rest = good
    away, scale = np.zeros(mean.size), 0.0
    for _ in range(_ROUNDS):
        if rest.sum() < max(_FEWEST, (1.0 - _MOST) * good.sum()):
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
    near = np.convolve(there[place], np.ones(2 * _GROWN + 1), "same") > 0.5  # neighbours among the blocks that are there
    out = nothing.copy()
    out[place] = near
    return out if near.mean() <= _MOST else nothing


def unexplained_motion(reduced: xr.Dataset, claims: Iterable[Claim]) -> NDArray[np.bool_]:
    """Moving blocks, (axis, block), of the axes on which no named effect accounts for the means.

    Parameters
    ----------
    reduced : xarray.Dataset
    claims : iterable of Claim
    """
    told = {axis for claim in claims for part in claim.parts if part.candidate.view in _MEANS for axis in part.row}
    named = np.array([str(axis) in told for axis in reduced["axis"].values])
    return np.asarray(moving_blocks(reduced) & ~named[:, None])


def without_motion(
    log: xr.Dataset, reduced: xr.Dataset, moving: NDArray[np.bool_], *, restart_gap: Any = 5.0, progress: Stage = no_stage
) -> xr.Dataset:
    """The reduced record with the moving blocks left out on the axes that move; what they measured stays as ``measured_<name>``.

    Parameters
    ----------
    log : xarray.Dataset
    reduced : xarray.Dataset
        The log, from `reduce_log`.
    moving : ndarray of bool, shape (axis, block)
    restart_gap, progress
        As for `reduce_log`.
    """
    same = f"{reduced.attrs['block_samples']}samples"
    out = reduce_log(log, block=same, restart_gap=restart_gap, left_out=moving, progress=progress)
    out = out.assign({f"measured_{one}": reduced[one] for one in _KEPT if one in reduced})
    out = out.drop_dims([dim for dim in ("gap", "restart") if dim in out.dims]).assign(
        {one: reduced[one] for one in ("gap_begin", "gap_end", "restart_begin", "restart_end")}
    )
    out["moving"] = (("axis", "block"), moving, {"long_name": "left out because the axis moves", "units": "1"})
    return out
