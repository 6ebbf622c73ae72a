"""The published algorithms: classical DAVAR and recursive fast DAVAR, for comparison and tests.

Both use the second differences of the angle ``theta`` of every window. With convention "paper",
theta has one point per sample and a window of W samples has ``W - 2k`` terms; otherwise W rate
samples have W + 1 angles and ``W - 2k + 1`` terms, as in allantools and in the R package wv.

References
----------
Wang et al., Sensors 16 (2016): Eq. 16-17 (classical), 19-20 (recursion), 21-22 (missing data).
Their Eq. 5 and 12 divide differences of averages by ``k^2 tau0^2`` once too often; Eq. 16-17, in
the angle, are correct.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gyrostab.kernels.compiled import INNER, KERNEL


def reference_theta(
    x: NDArray[np.generic], *, angle: bool, paper: bool
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
    """Integrate a whole record, with the mask of present angles and the count of missing samples.

    Parameters
    ----------
    x : ndarray (n,)
        Rates or cumulative angles, NaN where missing.
    angle : bool
        The samples are angles.
    paper : bool
        One angle per sample (the sum up to and with it) instead of n + 1.

    Returns
    -------
    theta : float64 (n or n + 1,)
        The integral of the rate in sample units; missing rates add nothing.
    present : bool (n or n + 1,)
        True if the angle is given (angles) or, with convention "paper", the sample that ends there
        (rates).
    missing : int64 (n or n + 1,)
        Missing rate samples before the angle; zeros for angles.
    """
    values = np.asarray(x, dtype=np.float64)
    is_finite = np.isfinite(values)
    if angle:
        return np.where(is_finite, values, 0.0), is_finite, np.zeros(values.size, dtype=np.int64)
    theta = np.cumsum(np.where(is_finite, values, 0.0))
    missing = np.cumsum(~is_finite)
    if paper:
        return theta, is_finite, missing
    return (
        np.concatenate(([0.0], theta)),
        np.ones(theta.size + 1, dtype=np.bool_),
        np.concatenate(([0], missing)),
    )


def direct_sums(
    theta: NDArray[np.float64],
    present: NDArray[np.bool_],
    missing: NDArray[np.int64],
    window_points: int,
    step: int,
    n_windows: int,
    ks: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Run the classical DAVAR (Eq. 16): sums and counts of every window, (n_windows, n_tau)."""
    sums = np.zeros((n_windows, ks.size))
    counts = np.zeros((n_windows, ks.size), dtype=np.int64)
    for j in range(n_windows):
        part = slice(j * step, j * step + window_points)
        angle, has_angle, lost = theta[part] - theta[j * step], present[part], missing[part]
        for i, k in enumerate(ks):
            d = angle[2 * k :] - 2.0 * angle[k:-k] + angle[: -2 * k]
            valid = (
                has_angle[2 * k :]
                & has_angle[k:-k]
                & has_angle[: -2 * k]
                & (lost[2 * k :] == lost[: -2 * k])
            )
            sums[j, i] = np.sum(d[valid] ** 2)
            counts[j, i] = np.count_nonzero(valid)
    return sums, counts


@njit(**INNER)
def _square_differences(theta, present, missing, k, squares, valid):  # type: ignore[no-untyped-def]
    """Compute the square of each second difference; zero where it is missing (Eq. 21-22)."""
    begin, middle, end = theta, theta[k:], theta[2 * k :]
    for m in range(end.size):
        has_angles = present[m] and present[m + k] and present[m + 2 * k]
        is_valid = has_angles and missing[m] == missing[m + 2 * k]
        difference = end[m] - 2.0 * middle[m] + begin[m]
        squares[m] = difference * difference if is_valid else 0.0
        valid[m] = is_valid


@njit(**KERNEL)
def recursive_sums(theta, present, missing, window_points, step, n_windows, ks):  # type: ignore[no-untyped-def]
    """Run the fast DAVAR (Eq. 19), which adds the newest and subtracts the oldest square.

    Parameters and results are those of `direct_sums`. Differences of nearly equal sums lose all
    precision after a shock of 10^6 sigma; this method is therefore only a reference.
    """
    sums = np.zeros((n_windows, ks.size))
    counts = np.zeros((n_windows, ks.size), np.int64)
    squares, valid = np.zeros(theta.size), np.zeros(theta.size, np.int8)
    for i in range(ks.size):
        length = window_points - 2 * ks[i]
        _square_differences(theta, present, missing, ks[i], squares, valid)
        total, count = 0.0, 0
        for m in range(length):  # the starting value, Eq. 20
            total += squares[m]
            count += valid[m]
        sums[0, i], counts[0, i] = total, count
        newest, newest_valid = squares[length:], valid[length:]
        for j in range(1, n_windows):
            for n in range((j - 1) * step, j * step):
                total += newest[n] - squares[n]
                count += newest_valid[n] - valid[n]
            sums[j, i], counts[j, i] = total, count
    return sums, counts
