"""Smooth curves through noisy values, with the smoothness chosen from the data."""

from __future__ import annotations

import math

import numpy as np

from gyrostab.arrays import Floats

_LEAST, _STEPS, _FEWEST = 0.7, 10, 8
_PRICE_OF_FREEDOM = 1.4  # Kim and Gu 2004; 1 smooths too little now and then
_DIFFERENCE = (1.0, -2.0, 1.0)


def smooth_curve(values: Floats, *, longest: float) -> Floats:
    """Remove white noise by least squares with a penalty on squared second differences.

    The penalty minimises the generalised cross-validation, with each degree of freedom counted 1.4
    times: its rate of change is what effects follow, and it has more noise than the curve. A curve
    with little noise is almost unchanged.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Equally spaced, all finite.
    longest : float
        Longest length over which the curve may be smoothed, in steps: the fourth root of the
        penalty.

    Returns
    -------
    ndarray, shape (n,)

    References
    ----------
    Whittaker 1923, Proc. Edinburgh Math. Soc. 41, 63; Golub, Heath and Wahba 1979, Technometrics
    21, 215; Kim and Gu 2004, J. R. Stat. Soc. B 66, 337 (the factor 1.4).

    Examples
    --------
    >>> t = np.arange(400) / 40.0
    >>> noise = 0.1 * np.random.default_rng(3).standard_normal(t.size)
    >>> float(np.std(smooth_curve(np.sin(t) + noise, longest=20.0) - np.sin(t)).round(2))
    0.02
    """
    from scipy.linalg import solveh_banded

    n = values.size
    if n < _FEWEST or np.abs(np.diff(values, 2)).max() <= 1e-12 * np.abs(values).max():
        return values
    bands = np.zeros((3, n))  # below the diagonal of D' D, for the second differences D
    for row, coefficient in enumerate(_DIFFERENCE):
        for offset, other in enumerate(_DIFFERENCE[row:]):
            bands[offset, row : row + n - 2] += coefficient * other
    stiffness = (2.0 - 2.0 * np.cos(math.pi * np.arange(n) / n)) ** 2
    best, best_curve = np.inf, values
    middle = values.mean()
    for length in np.geomspace(_LEAST, max(longest, _LEAST), _STEPS):
        ridge = length**4 * bands
        ridge[0] += 1.0
        curve = middle + solveh_banded(ridge, values - middle, lower=True, check_finite=False)
        freedom = float(np.mean(1.0 / (1.0 + length**4 * stiffness)))
        score = float(np.mean((values - curve) ** 2)) / (1.0 - _PRICE_OF_FREEDOM * freedom) ** 2
        if score < best:
            best, best_curve = score, np.asarray(curve)
    return best_curve
