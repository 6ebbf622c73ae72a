"""Covariance of means over overlapping windows, averaged into blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

Array = NDArray[np.float64]


def average_windows(block: NDArray[np.int64]) -> Any:
    """Make the sparse matrix (n_blocks, n) that averages windows into blocks 0, 1, ..."""
    sizes = np.bincount(block)
    return csr_array((1.0 / sizes[block], (block, np.arange(block.size))))


def white_covariance(mean: Any, time: Array, length: float, share: Array) -> Array:
    """Compute the covariance of the blocks in white noise of unit variance in a full window.

    Parameters
    ----------
    mean : sparse (n_blocks, n)
        Result of `average_windows`.
    time, length : float64 (n,), float
        Centres and length of the windows [s]; two windows share noise as far as they overlap.
    share : float64 (n,)
        Share of samples present in each window; its variance is inversely proportional.

    Returns
    -------
    float64 (n_blocks, n_blocks)
    """
    rows, columns = _find_overlaps(time, length)
    overlap = 1.0 - (time[columns] - time[rows]) / length
    return _average_pairs(mean, rows, columns, overlap / np.sqrt(share[rows] * share[columns]))


def slow_covariance(mean: Any, time: Array, length: float, memory: float) -> Array:
    r"""Compute the covariance of the blocks in an Ornstein-Uhlenbeck process of unit variance.

    With the autocovariance :math:`e^{-|d|/T}`, the means over two windows of length L with centres
    a distance d apart have the covariance

    .. math:: (2T/L)^2 \sinh^2(L/2T)\, e^{-d/T} - 2 (T/L)^2 (\sinh x - x),\quad x = \max(L-d, 0)/T,

    the second difference, over L, of the double integral of the autocovariance. The first part is a
    product of one factor for each window, so that its sums over blocks take time in proportion to
    the number of windows; the second is zero unless the windows overlap. A mean over windows with
    missing samples is taken as one over whole windows.

    Parameters
    ----------
    mean : sparse (n_blocks, n)
        Result of `average_windows`; the windows of a block are consecutive.
    time, length : float64 (n,), float
        Centres, in order, and length of the windows [s].
    memory : float
        Correlation time T [s].

    Returns
    -------
    float64 (n_blocks, n_blocks)
    """
    centre = np.asarray(mean @ time)
    block = np.repeat(np.arange(centre.size), np.diff(mean.indptr))
    grown = np.exp((time - centre[block]) / memory)
    ahead, behind = np.asarray(mean @ grown), np.asarray(mean @ (1.0 / grown))
    upper = np.triu(np.exp(-np.abs(np.subtract.outer(centre, centre)) / memory), 1)
    upper *= np.outer(ahead, behind)
    running_sum = np.cumsum(grown) - np.append(0.0, np.cumsum(grown))[mean.indptr[:-1]][block]
    size = np.diff(mean.indptr)
    within = (2.0 * np.asarray(mean @ (running_sum / grown)) - 1.0) / size
    distant = (2.0 * memory / length * np.sinh(0.5 * length / memory)) ** 2
    rows, columns = _find_overlaps(time, length)
    x = (length - (time[columns] - time[rows])) / memory
    shared = 2.0 * (memory / length) ** 2 * (np.sinh(x) - x)
    blocks = upper + upper.T + np.diag(within)
    return np.asarray(distant * blocks - _average_pairs(mean, rows, columns, shared))


def _find_overlaps(time: Array, length: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the pairs of overlapping windows, the earlier first, each window with itself too."""
    first = np.arange(time.size)
    count = np.searchsorted(time, time + length, side="left") - first
    rows = np.repeat(first, count)
    return rows, rows + np.arange(rows.size) - np.repeat(np.cumsum(count) - count, count)


def _average_pairs(
    mean: Any, rows: NDArray[np.int64], columns: NDArray[np.int64], values: Array
) -> Array:
    """Average a symmetric matrix, given by its upper triangle, over pairs of blocks."""
    n = mean.shape[1]
    halved = np.where(rows == columns, 0.5 * values, values)
    half = (mean @ csr_array((halved, (rows, columns)), shape=(n, n)) @ mean.T).toarray()
    return np.asarray(half + half.T)
