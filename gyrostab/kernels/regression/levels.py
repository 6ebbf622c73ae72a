"""Block means of a bias that switches between two levels, as a hidden Markov model.

The state is the level at the end of a block. A block is divided into parts with one level each, so
that the mean of a block with a switch inside has the right distribution.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import KERNEL

_TINY = 1e-290


def level_tables(low: Floats, high: Floats, parts: int) -> tuple[Floats, Floats]:
    """Compute the transition probabilities of a block of two levels.

    Parameters
    ----------
    low, high : ndarray, shape (record,)
        Mean durations on the levels [blocks].
    parts : int
        Parts of a block.

    Returns
    -------
    chance : ndarray, shape (record, 2, 2, parts + 1)
        Probability by level before, level at the end, and number of parts on the upper level.
    rises : ndarray, shape (record, 2, 2, parts + 1)
        Expected number of steps up, times the probability.

    Examples
    --------
    >>> chance, rises = level_tables(np.array([4.0]), np.array([2.0]), 5)
    >>> # after a block that starts low, and after one that starts high
    >>> chance[0].sum(axis=(1, 2)).round(9), chance[0, :, 1].sum(axis=1).round(3)
    (array([1., 1.]), array([0.176, 0.648]))
    """
    stay = np.exp(-(1.0 / low + 1.0 / high) / parts)
    up = high / (low + high) * (1.0 - stay)
    down = low / (low + high) * (1.0 - stay)
    to_low, to_high = (
        np.stack(move)[:, :, None, None] for move in ((1.0 - up, down), (up, 1.0 - down))
    )
    # by level at the end; chance and rises; then as they are returned
    low_end, high_end = np.zeros((2, 2, low.size, 2, parts + 1))
    low_end[0, :, 0, 0] = high_end[0, :, 1, 0] = 1.0
    for _ in range(parts):
        stepped = low_end.copy()
        stepped[1] += low_end[0]
        low_end = low_end * to_low[0] + high_end * to_low[1]
        moved = stepped * to_high[0] + high_end * to_high[1]
        high_end[..., 1:] = moved[..., :-1]
        high_end[..., 0] = 0.0
    chance, rises = np.stack([low_end, high_end], axis=3)
    return chance, rises


@njit(**KERNEL)
def levels_smooth(
    like: Floats, chance: Floats, rises: Floats, start: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Compute the evidence of block means, and the expected share of each on the upper level.

    Parameters
    ----------
    like : ndarray, shape (record, n, parts + 1)
        Likelihood of each block mean by the number of parts on the upper level, up to a factor;
        1 where it is missing.
    chance, rises : ndarray, shape (record, 2, 2, parts + 1)
        From `level_tables`.
    start : ndarray, shape (record, 2)
        Probabilities of the levels before the first block.

    Returns
    -------
    log : ndarray, shape (record,)
        Log likelihood.
    share, square : ndarray, shape (record, n)
        Expected share of the block on the upper level, and its square.
    up : ndarray, shape (record,)
        Expected steps up.
    """
    records, n, width = like.shape
    parts = width - 1
    log, up = np.zeros(records), np.zeros(records)
    share, square = np.zeros((records, n)), np.zeros((records, n))
    ahead, scale = np.empty((n, 2)), np.empty(n)  # at the start of every block
    for r in range(records):
        first, second = start[r, 0], start[r, 1]
        for t in range(n):
            ahead[t, 0], ahead[t, 1] = first, second
            to_low, to_high = 0.0, 0.0
            for m in range(width):
                to_low += (first * chance[r, 0, 0, m] + second * chance[r, 1, 0, m]) * like[r, t, m]
                to_high += (first * chance[r, 0, 1, m] + second * chance[r, 1, 1, m]) * like[
                    r, t, m
                ]
            scale[t] = max(to_low + to_high, _TINY)
            first, second = to_low / scale[t], to_high / scale[t]
            log[r] += np.log(scale[t])
        low, high = 1.0, 1.0  # what is behind, by the level at the end of the block
        for t in range(n):
            t = n - 1 - t
            from_low, from_high = 0.0, 0.0
            for m in range(width):
                part = like[r, t, m] / scale[t]
                below = part * (chance[r, 0, 0, m] * low + chance[r, 0, 1, m] * high)
                above = part * (chance[r, 1, 0, m] * low + chance[r, 1, 1, m] * high)
                from_low += below
                from_high += above
                weight = (ahead[t, 0] * below + ahead[t, 1] * above) * m
                share[r, t] += weight
                square[r, t] += weight * m
                stepped = ahead[t, 0] * (rises[r, 0, 0, m] * low + rises[r, 0, 1, m] * high)
                stepped += ahead[t, 1] * (rises[r, 1, 0, m] * low + rises[r, 1, 1, m] * high)
                up[r] += part * stepped
            low, high = from_low, from_high
            share[r, t] /= parts
            square[r, t] /= parts * parts
    return log, share, square, up
