"""When an identified effect acts: the blocks, and the stretches of time that they form."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.settings import DEFAULTS, Settings

MAX_SPANS = 6  # more intervals than that are reported as the whole record
_WHOLE_SHARE = 0.9  # of the blocks, above which an effect acts in the whole record; design choice
_PAUSES_IN_RECORD = 50  # a pause that fits this often into the record is bridged; design choice


def active_blocks(
    identification: Selection, blocks: xr.Dataset, *, settings: Settings = DEFAULTS
) -> Bools:
    """Return the blocks in which an effect acts, from its designs and the rotation of the tool.

    These are all blocks when neither depends on time.
    """
    block_count = blocks.sizes["block"]
    is_active = np.zeros(block_count, bool)
    for component in identification.components:
        design = component.variant.design
        if component.statistic.is_rotation:  # harmonics are measured while the tool rotates
            turn = np.abs(np.nan_to_num(blocks["channel_rotation_rate"].values))
            is_active |= turn > settings.rest_share * turn.max(initial=0.0)
            continue
        if not component.statistic.has_course or design.size == 0:
            return np.ones(block_count, bool)
        place = [axis for axis, length in enumerate(design.shape) if length == block_count]
        if not place:
            return np.ones(block_count, bool)
        size = np.asarray(np.moveaxis(np.asarray(design), place[0], 0).reshape(block_count, -1))
        if component.statistic.is_linear_in_means:
            size = size - _rest_level(size, settings)
        size = np.abs(size)
        largest = np.nanmax(size, axis=0, initial=0.0)
        min_size = settings.active_share * np.where(largest > 0, largest, np.inf)
        is_active |= (size > min_size).any(axis=1)
    return is_active if is_active.any() else np.ones(block_count, bool)


def _rest_level(size: Floats, settings: Settings) -> Floats:
    """Return the level of every column (block, column) at rest.

    It is zero where the column stays near zero for a while; else the median, because the constant
    is free.
    """
    still = np.abs(size) <= settings.rest_share * np.nanmax(np.abs(size), axis=0, initial=0.0)
    return np.where(still.mean(axis=0) >= settings.rest_share, 0.0, np.median(size, axis=0))


def active_spans(
    identification: Selection, blocks: xr.Dataset, *, settings: Settings = DEFAULTS
) -> list[tuple[float, float]]:
    """Return the stretches of time [s] in which an effect acts."""
    acting = active_blocks(identification, blocks, settings=settings)
    return join_blocks(acting, blocks["begin"].values, blocks["end"].values)


def join_blocks(is_inside: Bools, begin: Floats, end: Floats) -> list[tuple[float, float]]:
    """Join blocks to stretches of time [s], with short pauses bridged.

    An intermittent effect with many stretches gets the whole record.

    Examples
    --------
    >>> t = np.arange(10.0)
    >>> join_blocks(np.array([0, 0, 1, 1, 1, 0, 0, 0, 0, 0], bool), t, t + 1)
    [(2.0, 5.0)]
    """
    if is_inside.mean() > _WHOLE_SHARE:
        return [(float(begin[0]), float(end[-1]))]
    edges = np.flatnonzero(np.diff(is_inside, prepend=False, append=False)).reshape(-1, 2)
    joined: list[list[int]] = []
    for first, stop in edges.tolist():
        if joined and first - joined[-1][1] <= max(1, is_inside.size // _PAUSES_IN_RECORD):
            joined[-1][1] = stop
        else:
            joined.append([first, stop])
    if len(joined) > MAX_SPANS:
        return [(float(begin[0]), float(end[-1]))]
    return [(float(begin[first]), float(end[stop - 1])) for first, stop in joined]
