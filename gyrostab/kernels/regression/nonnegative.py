"""Least squares with sizes that cannot be negative: all of a few, or some of many."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from gyrostab.arrays import Floats

#: Share of the square of a column that free ones leave, below which it counts as one of them. Above
#: rounding errors.
_MIN_APART = 1e-8
_UNIT = 1.0 + 1e-12  # square of a scaled column, so that a system can be solved


def solve_nonnegative(normal: Floats, right: Floats) -> Floats:
    """Minimise ``s^T normal s - 2 right^T s`` over ``s >= 0``.

    The solution is exact: it is that of any sizes if none of these is negative; otherwise all
    subsets are tried, at most 31 of five terms.

    Parameters
    ----------
    normal, right : ndarray (..., n, n), (..., n)
        Normal equations.

    Returns
    -------
    ndarray (..., n)

    Examples
    --------
    >>> solve_nonnegative(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0]))
    array([0.5, 0. ])
    """
    every = np.arange(right.shape[-1])
    square = normal[..., every, every]
    scale = np.where(square > 0.0, 1.0 / np.sqrt(np.where(square > 0.0, square, 1.0)), 0.0)
    scaled_right = right * scale
    scaled = normal * scale[..., None] * scale[..., None, :]
    scaled[..., every, every] = _UNIT
    sizes = np.linalg.solve(scaled, scaled_right[..., None])[..., 0]
    is_outside = ~(sizes >= 0.0).all(axis=-1)
    if is_outside.any():
        sizes[is_outside] = _solve_by_subsets(scaled[is_outside], scaled_right[is_outside])
    return np.asarray(np.abs(sizes) * scale)  # without a negative zero


def _solve_by_subsets(normal: Floats, right: Floats) -> Floats:
    """Try all subsets of terms of many systems, (system, n, n) and (system, n)."""
    every = np.arange(right.shape[-1])
    members = (np.arange(1 << every.size)[:, None] >> every & 1).astype(np.float64)
    systems = normal[:, None] * members[:, :, None] * members[:, None, :]
    systems[..., every, every] = _UNIT  # also of the terms that a subset lacks
    trials = np.linalg.solve(systems, (members * right[:, None])[..., None])[..., 0]
    gains = np.where((trials >= 0.0).all(axis=-1), (trials * right[:, None]).sum(axis=-1), -np.inf)
    best = gains.argmax(axis=-1)[:, None, None]
    return np.asarray(np.take_along_axis(trials, best, axis=1)[:, 0])


def solve_bounded(normal: Floats, right: Floats, low: Floats) -> Floats:
    """Minimise ``s^T normal s - 2 right^T s`` over ``s >= low``.

    Parameters
    ----------
    normal, right : ndarray (n, n), (n,)
        Normal equations; `normal` is positive definite.
    low : ndarray (n,)
        Least sizes; ``-inf`` for those of any size.

    Returns
    -------
    ndarray (n,)

    Examples
    --------
    >>> normal, right = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0])
    >>> solve_bounded(normal, right, np.array([0.0, -np.inf])).round(9)
    array([ 1., -1.])
    >>> solve_bounded(normal, right, np.array([-np.inf, -0.5])).round(9)
    array([ 0.75, -0.5 ])
    """
    solution = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
    if (solution >= low).all():
        return solution
    is_bounded = np.isfinite(low)
    free = ~is_bounded
    scale = 1.0 / np.sqrt(np.diagonal(normal))
    scaled = normal * np.outer(scale, scale)
    least = low[is_bounded] / scale[is_bounded]
    across = scaled[np.ix_(free, is_bounded)]
    sides = np.column_stack([across, (scale * right)[free]])
    from_bounded, from_data = np.split(np.linalg.solve(scaled[np.ix_(free, free)], sides), [-1], 1)
    bounded = scaled[np.ix_(is_bounded, is_bounded)] - across.T @ from_bounded
    above = (scale * right)[is_bounded] - across.T @ from_data[:, 0] - bounded @ least
    # what the free sizes do as well stays at its bound
    is_apart = np.diagonal(bounded) > _MIN_APART
    eigenvalues, vectors = np.linalg.eigh(bounded[np.ix_(is_apart, is_apart)])
    root = np.sqrt(np.maximum(eigenvalues, np.finfo(float).eps))
    sizes = least
    sizes[is_apart] += nnls(root[:, None] * vectors.T, vectors.T @ above[is_apart] / root)[0]
    solution[is_bounded] = scale[is_bounded] * sizes
    solution[free] = scale[free] * (from_data[:, 0] - from_bounded @ sizes)
    return solution
