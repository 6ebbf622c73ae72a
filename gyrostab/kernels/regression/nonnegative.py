"""Non-negative least squares.

The solution is exact: of five terms there are at most 31 subsets, and all are tried.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def solve_nonnegative(normal: Array, right: Array) -> Array:
    """Minimise ``s^T normal s - 2 right^T s`` over ``s >= 0``.

    Parameters
    ----------
    normal, right : ndarray (n, n), (n,)
        Normal equations.

    Returns
    -------
    ndarray (n,)

    Examples
    --------
    >>> solve_nonnegative(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0]))
    array([0.5, 0. ])
    """
    solution = np.zeros(right.size)
    used = np.flatnonzero(np.diagonal(normal) > 0.0)
    scale = 1.0 / np.sqrt(np.diagonal(normal)[used])
    scaled_right = right[used] * scale
    every = np.arange(used.size)
    members = (np.arange(1 << used.size)[:, None] >> every & 1).astype(np.float64)
    systems = normal[np.ix_(used, used)] * np.outer(scale, scale)
    systems = systems * members[:, :, None] * members[:, None, :]
    systems[:, every, every] = 1.0 + 1e-12  # also of the terms that a subset lacks
    trials = np.linalg.solve(systems, (members * scaled_right)[..., None])[..., 0]
    gains = np.where((trials >= 0.0).all(axis=1), trials @ scaled_right, -np.inf)
    solution[used] = np.abs(trials[gains.argmax()]) * scale  # without a negative zero
    return solution
