"""Levels of the noise around the lines of a spectrum."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gyrostab.arrays import Array

#: Lines on each side that a steady line leaks into; of the taper.
LEAK_LINES = 3
#: Lowest lines, without lines below them.
EDGE_LINES = 2
_LEVEL_LINES = 50  # that define a level; design choice
_SIDE_LINES = 8  # next to a line, on either side, that it must exceed; design choice
_MIN_LEVEL_RATIO = 1e-3  # of the median level, a lower limit of the level; design choice


def level_around(power: Array, lines: int = _LEVEL_LINES, side: int = _SIDE_LINES) -> Array:
    """Return the level around each line, (..., line), at least that of the adjacent lines.

    Parameters
    ----------
    power : ndarray, shape (..., line)
    lines, side : int
        Number of lines of an interval, and of those next to a line.

    Examples
    --------
    >>> level_around(np.ones(100))[50].item()
    1.0
    """
    count = power.shape[-1]
    level = local_level(power, lines)
    level = np.maximum(level, _MIN_LEVEL_RATIO * np.median(level, axis=-1, keepdims=True))
    group_count = count // side
    if group_count < 3:
        return level
    medians = _find_median(
        power[..., : group_count * side].reshape(*power.shape[:-1], group_count, side)
    )
    group = np.minimum(np.arange(count) // side, group_count - 1)
    right = np.take(medians, np.minimum(group + 1, group_count - 1), axis=-1)
    left = np.take(medians, np.maximum(group - 1, 0), axis=-1)
    # The first lines have only the lines below them.
    below = np.cumsum(power[..., :side], axis=-1) / np.arange(1, side + 1)
    left[..., :side] = below[..., np.maximum(np.arange(side) - LEAK_LINES, 0)]
    left[..., :EDGE_LINES] = 0.0
    last = group == group_count - 1
    right[..., last] = 0.0
    return np.asarray(np.maximum(level, np.maximum(left, right)))


def local_level(total: Array, lines: int = _LEVEL_LINES) -> Array:
    """Interpolate linearly between medians over intervals of so many lines.

    Examples
    --------
    >>> local_level(np.arange(100.0))[[0, 50, 99]].tolist()
    [24.5, 50.0, 74.5]
    """
    count = total.shape[-1]
    ends = np.linspace(0, count, max(1, count // lines) + 1).astype(int)
    medians = np.stack(
        [_find_median(total[..., low:high]) for low, high in pairwise(ends)], axis=-1
    )
    middle = (ends[1:] + ends[:-1] - 1) / 2.0
    place = np.clip(
        np.interp(np.arange(count), middle, np.arange(middle.size)), 0.0, middle.size - 1.0
    )
    low = np.minimum(place.astype(int), max(middle.size - 2, 0))
    below = np.take(medians, low, axis=-1)
    above = np.take(medians, np.minimum(low + 1, middle.size - 1), axis=-1)
    return np.asarray(below + (place - low) * (above - below))


def _find_median(values: Array) -> Array:
    """Find the median over the last dimension; of tens of values, faster than `numpy.median`."""
    ordered, half = np.sort(values, axis=-1), values.shape[-1] // 2
    middle = ordered[..., half]
    if values.shape[-1] % 2 == 0:
        middle = (ordered[..., half - 1] + middle) / 2.0
    return np.asarray(np.where(np.isnan(ordered[..., -1]), np.nan, middle))
