"""Find the blocks in which an axis moves far beyond its noise, and leave them out.

What a moving axis measures stays in the record, because other axes may sense it through their
misalignment.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import binary_dilation, binary_propagation

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.noise import NORMAL_95
from gyrostab.progress import Stage, no_stage

#: Share of the blocks whose means lie closest together, and the width of the central quarter of a
#: normal law in standard deviations: 2 * 0.3186.
CORE_SHARE, CORE_WIDTH_SIGMA = 0.25, 0.637
MAD_TO_SIGMA = 1.4826  # median absolute deviation of a normal law
#: Scatter of equal means, relative to the range of the samples, and that by rounding errors alone.
#: The means do not move by a few samples that are one quantization step from all others.
EQUAL_SCATTER, ROUNDING = 1e-3, 1e-9
REST_ROUNDS = 3  # in which centre and scatter at rest are refined
#: Variables of moving blocks that are kept as ``measured_<name>``.
_MEASURED_STATISTICS = ("mean", "power", "cross")


def find_moving_blocks(blocks: xr.Dataset, *, settings: Settings = DEFAULTS) -> Bools:
    """Find the blocks (axis, block) in which an axis moves far beyond its scatter at rest.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> rate = np.random.default_rng(1).standard_normal((2, 60_000))
    >>> rate[1, 20_000:30_000] += 500.0
    >>> blocks = reduce_log(make_log(rate, rate=100.0, unit="deg/h"), block="5s")
    >>> find_moving_blocks(blocks).sum(axis=1)
    array([ 0, 24])
    """
    span = sample_range(blocks)
    return np.stack(
        [find_moving_blocks_of_axis(mean, span, settings) for mean in blocks["mean"].values]
    )


def sample_range(blocks: xr.Dataset) -> float:
    """Return the distance of the largest sample of the record from the smallest."""
    return float(np.ptp(blocks["range_end"].values))


def find_moving_blocks_of_axis(mean: Floats, span: float, settings: Settings) -> Bools:
    """Find the moving blocks of one axis of a record whose samples have the range `span`.

    The level at rest is where a quarter of the means lie closest together, if a third of the record
    is at rest. Otherwise it is that of the steadiest stretch; a random walk has one by chance in 1
    of 300 records of 4000 blocks, and in none of 4800 shorter ones.
    """
    good = np.isfinite(mean)
    if good.sum() < settings.min_rest_blocks:
        return np.zeros(mean.size, np.bool_)
    min_blocks = max(settings.min_rest_blocks, (1.0 - settings.max_moving_share) * good.sum())
    moving = _find_motion(mean, _closest_quarter(mean[good]), min_blocks, span, settings)
    if moving.any():
        return moving
    steadiest = _steadiest_stretch(mean[good], settings.min_rest_blocks)
    return _find_motion(mean, steadiest, settings.min_rest_blocks, span, settings)


def _find_motion(
    mean: Floats, rest: tuple[float, float], min_blocks: float, span: float, settings: Settings
) -> Bools:
    """Find the blocks that move away from rest (centre, scatter); none if too few are at rest."""
    good = np.isfinite(mean)
    nothing = np.zeros(mean.size, np.bool_)
    centre, scale = rest[0], _without_zero(rest[1], span)
    away = np.abs(mean - centre)
    is_at_rest = good & (away <= settings.rest_sigma * scale)
    for _ in range(REST_ROUNDS):
        if is_at_rest.sum() < min_blocks:
            return nothing
        away = np.abs(mean - np.median(mean[is_at_rest]))
        scale = _without_zero(MAD_TO_SIGMA * float(np.median(away[is_at_rest])), span)
        is_at_rest = good & (away <= settings.rest_sigma * scale)
    if not np.nanmax(away) > settings.motion_sigma * scale:
        return nothing
    is_moving = good & ~is_at_rest
    if is_moving.sum() < 2:  # a motion lasts; a single block is an outlier
        return nothing
    place = np.flatnonzero(good)  # neighbours are those among the blocks that are there
    has_left_rest = (away > NORMAL_95 * scale)[place]
    whole_motion = binary_propagation(is_moving[place], mask=has_left_rest)  # from rest to rest
    margins = np.ones(2 * settings.motion_margin_blocks + 1, np.bool_)
    is_near_motion = binary_dilation(whole_motion, margins)
    out = nothing.copy()
    out[place] = is_near_motion
    has_rest = (
        is_at_rest.sum() >= min_blocks
        and np.count_nonzero(~is_near_motion) >= settings.min_rest_blocks
    )
    return out if has_rest else nothing


def _without_zero(scale: float, span: float) -> float:
    """Return a scatter at rest, or a part of the range of the samples if all means are equal."""
    return scale if scale > ROUNDING * span else EQUAL_SCATTER * span


def _steadiest_stretch(mean: Floats, size: int) -> tuple[float, float]:
    """Return centre and scatter of the consecutive means that scatter least."""
    stretches = np.lib.stride_tricks.sliding_window_view(mean, size)
    steadiest = stretches[stretches.std(axis=1).argmin()]
    return float(np.median(steadiest)), float(steadiest.std(ddof=1))


def _closest_quarter(mean: Floats) -> tuple[float, float]:
    """Return centre and scatter of the quarter of the means that lie closest together."""
    ordered = np.sort(mean)
    size = int(np.ceil(CORE_SHARE * mean.size))
    width = ordered[size - 1 :] - ordered[: mean.size - size + 1]
    first = int(width.argmin())
    return float(np.median(ordered[first : first + size])), float(width[first]) / CORE_WIDTH_SIGMA


def without_motion(
    log: xr.Dataset,
    blocks: xr.Dataset,
    moving: Bools,
    *,
    restart_gap: Any = 5.0,
    progress: Stage = no_stage,
) -> xr.Dataset:
    """Reduce a log again, with options of `reduce_log`, without its moving blocks (axis, block).

    What these measured stays in variables ``measured_<name>``.
    """
    same = f"{blocks.attrs['block_samples']}samples"
    out = reduce_log(log, block=same, restart_gap=restart_gap, left_out=moving, progress=progress)
    out = out.drop_dims(["gap", "restart"]).assign(
        {f"measured_{name}": blocks[name] for name in _MEASURED_STATISTICS}
        | {name: blocks[name] for name in ("gap_begin", "gap_end", "restart_begin", "restart_end")}
    )
    out["moving"] = (
        ("axis", "block"),
        moving,
        {"long_name": "left out because the axis moves", "units": "1"},
    )
    return out
