"""Sums along paths through spectra that follow one another, as a drifting line takes them."""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Floats, Ints
from gyrostab.kernels.compiled import KERNEL


@njit(**KERNEL)
def largest_path_sums(
    cells: Floats,
    low: Ints,
    high: Ints,
    first: Ints,
    stop: Ints,
    step: Ints,
    move: Ints,
    sections: int,
    limit: float,
) -> Floats:
    """Find the largest sum along paths from each section of the spectrum to each other one.

    A path of a shape that begins at line i covers, in each part, the lines from i + low to i + high
    - 1; their sum, divided by the root of their number, contributes at most `limit`.

    Parameters
    ----------
    cells : ndarray, shape (series, part, line)
    low, high : ndarray, shape (shape, part)
        Lines that a path of each shape covers, relative to its first line.
    first, stop, step, move : ndarray, shape (shape,)
        Lines at which paths of a shape begin, and lines from the begin of a path to its end.
    sections : int
        Number of equal parts of the spectrum.
    limit : float

    Returns
    -------
    ndarray, shape (series, sections ** 2)
        By section of the begin, then of the end; minus infinity without a path.
    """
    series, parts, lines = cells.shape
    largest = np.full((series, sections * sections), -np.inf)
    total = np.zeros((parts, lines + 1))
    sums = np.empty(lines)
    for number in range(series):
        for part in range(parts):
            for line in range(lines):
                total[part, line + 1] = total[part, line] + cells[number, part, line]
        for shape in range(first.size):
            begin, every = first[shape], step[shape]
            count = (stop[shape] - begin + every - 1) // every
            sums[:count] = 0.0
            for part in range(parts):
                upper, lower = begin + high[shape, part], begin + low[shape, part]
                scale = 1.0 / np.sqrt(upper - lower)
                for place in range(count):
                    inside = total[part, upper + place * every] - total[part, lower + place * every]
                    sums[place] += min(inside * scale, limit)
            for place in range(count):
                line = begin + place * every
                column = (
                    line * sections // lines * sections + (line + move[shape]) * sections // lines
                )
                largest[number, column] = max(largest[number, column], sums[place])
    return largest
