"""Block means of a random bias in one pass: whitening by a Kalman filter with a free constant.

The bias is a random walk from an unknown start (the free constant), plus Ornstein-Uhlenbeck
processes, plus white noise, plus the rate of white noise in the angle. The observations are means
over consecutive blocks, so the moments are those of means, not of points. Angle noise adds the
difference of the angles at both ends of a block by its length: two adjacent blocks have one
angle in common, and means that add it with opposite signs.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.arrays import Bools, Floats
from gyrostab.kernels.compiled import INNER, KERNEL

#: Ratio of neighbouring correlation times in `flicker_states`.
RATIO = 4.0
#: Longest correlation time, in lengths of the record: slower parts are a constant in it.
LONGEST = 4.0


def flicker_states(step: float, span: float) -> tuple[Floats, Floats, float]:
    """Approximate flicker noise with B = 1 by Ornstein-Uhlenbeck processes, up to a constant.

    Parameters
    ----------
    step, span : float
        Length of a block and of the record [s].

    Returns
    -------
    variance, time : ndarray, shape (p,)
        Variances and correlation times [s] of the processes; the times are evenly spaced in log.
    white : float
        Variance of a block mean from faster processes.

    Examples
    --------
    >>> variance, time, white = flicker_states(20.0, 3600.0)
    >>> time.round(1), float(variance[0].round(4))  # ln 4 / pi
    (array([1.44e+04, 3.60e+03, 9.00e+02, 2.25e+02, 5.62e+01, 1.41e+01]), 0.4413)
    """
    count = 1 + max(0, round(np.log(LONGEST * span / (0.7 * step)) / np.log(RATIO)))
    time = LONGEST * span * RATIO ** -np.arange(count, dtype=np.float64)
    variance = np.full(count, np.log(RATIO) / np.pi)
    faster = step / (time[-1] * RATIO ** -np.arange(1.0, 20.0))
    return (
        variance,
        time,
        float(variance[0] * (2.0 * (faster + np.expm1(-faster)) / faster**2).sum()),
    )


@njit(**INNER)
def _block_moments(step, K2, ou_variance, ou_time, decay, weight, drive, shared):  # type: ignore[no-untyped-def]
    """Compute the variance of a block mean over `step` seconds, given the states at its start.

    Also writes the decay of each state, its weight in the mean, the variance of its innovation, and
    the covariance of the innovation with the mean.
    """
    decay[0], weight[0], drive[0], shared[0] = 1.0, 1.0, K2 * step, K2 * step / 2.0
    mean_variance = K2 * step / 3.0
    for j in range(ou_variance.size):
        v, a = ou_variance[j], step / ou_time[j]
        lost = -np.expm1(-a)
        decay[j + 1] = 1.0 - lost
        weight[j + 1] = lost / a
        drive[j + 1] = v * lost * (2.0 - lost)
        shared[j + 1] = v * lost * lost / a
        if a < 1e-3:  # the differences below lose their digits
            mean_variance += v * a * (2.0 / 3.0 - a / 2.0 + 7.0 * a * a / 30.0)
        else:
            mean_variance += v * (2.0 * (a - lost) - lost * lost) / (a * a)
    return mean_variance


@njit(fastmath={"contract"}, **INNER)
def _advance_states(covariance, decay, drive, gain, F):  # type: ignore[no-untyped-def]
    """Advance the covariance of the states by a block, less what a mean of variance F tells.

    Only its lower triangle is used.
    """
    for j in range(decay.size):
        f, g = decay[j], gain[j] * F
        for k in range(j + 1):
            covariance[j, k] = f * decay[k] * covariance[j, k] - g * gain[k]
        covariance[j, j] += drive[j]


@njit(fastmath={"contract"}, **INNER)
def _project_covariance(covariance, weight, first, gain):  # type: ignore[no-untyped-def]
    """Project the covariance on the mean, from state `first` on; returns its variance."""
    total = 0.0
    for j in range(first, weight.size):
        h, projected = weight[j], 0.0
        for k in range(first, j):
            c = covariance[j, k]
            projected += c * weight[k]
            gain[k] += c * h
        total += h * (2.0 * projected + covariance[j, j] * h)
        gain[j] = projected + covariance[j, j] * h
    return total


@njit(fastmath={"contract"}, **INNER)
def _scale_innovations(row, state, weight, decay, gain, scale, out):  # type: ignore[no-untyped-def]
    """Write the scaled innovations of all columns to `out`, and advance their states by a block."""
    for c in range(row.size):
        out[c] = row[c] - state[0, c]
    for j in range(1, weight.size):
        h = weight[j]
        for c in range(row.size):
            out[c] -= h * state[j, c]
    for j in range(weight.size):
        f, g = decay[j], gain[j]
        for c in range(row.size):
            state[j, c] = f * state[j, c] + g * out[c]
    for c in range(row.size):
        out[c] *= scale


@njit(**KERNEL)
def whiten(
    columns: Floats,
    variance: Floats,
    step_seconds: Floats,
    present: Bools,
    K2: Floats,
    ou_variance: Floats,
    ou_time: Floats,
    angle: float = 0.0,
) -> tuple[Floats, float]:
    """Whiten columns of block means by the covariance V of their noise, with the constant removed.

    Products of whitened columns a, b are ``a' W b`` with ``W = V^-1 - V^-1 1 (1' V^-1 1)^-1 1'
    V^-1`` over the blocks present.

    Parameters
    ----------
    columns : ndarray, shape (n, m)
        Data and designs; all finite, with any value where not present.
    variance : ndarray, shape (n,)
        White variance of every block mean.
    step_seconds : ndarray, shape (n,)
        Length of every block, which ends where the next one begins [s].
    present : ndarray of bool, shape (n,)
        False for blocks that are missing or held out.
    K2 : ndarray, shape (n,)
        Growth of the variance of the random walk in a second, in every block.
    ou_variance, ou_time : ndarray, shape (p,)
        Variances and correlation times [s] of the Ornstein-Uhlenbeck processes.
    angle : float
        Variance of the angle noise where blocks meet [square of the unit of the columns times s].

    Returns
    -------
    whitened : ndarray, shape (n, m)
        Rows not present are zero, and so is the first row present, which the constant takes.
    log_determinant : float
        ``log det V + log(1' V^-1 1)`` over the blocks present; 0 without any.
    """
    n, width = columns.shape
    slow = ou_variance.size + 1
    m = slow + 1 if angle > 0.0 else slow  # the last state is the angle at the start of a block
    out = np.zeros((n, width))
    state = np.zeros((m, width))
    room = np.zeros((5, m))
    decay, weight, drive, shared, gain = room[0], room[1], room[2], room[3], room[4]
    covariance = np.zeros((m, m))
    for j in range(1, slow):
        covariance[j, j] = ou_variance[j - 1]
    if m > slow:
        covariance[slow, slow] = angle
    total, has_level, last, walked, mean_variance = 0.0, False, np.nan, np.nan, 0.0
    for i in range(n):
        if step_seconds[i] != last or K2[i] != walked:
            last, walked = step_seconds[i], K2[i]
            mean_variance = _block_moments(
                last, walked, ou_variance, ou_time, decay, weight, drive, shared
            )
            if m > slow:
                weight[slow], drive[slow], shared[slow] = -1.0 / last, angle, angle / last
                mean_variance += angle / last**2
        if not present[i]:
            for j in range(m):
                for c in range(width):
                    state[j, c] *= decay[j]
            _advance_states(covariance, decay, drive, gain, 0.0)
            continue
        # of the innovation; the level counts once known
        F = variance[i] + mean_variance
        F += _project_covariance(covariance, weight, 0 if has_level else 1, gain)
        if not has_level:  # the level becomes what the mean says, with the error of all the rest
            has_level = True
            _advance_states(covariance, decay, drive, gain, 0.0)
            covariance[0, 0] = F + drive[0] - 2.0 * shared[0]
            for j in range(1, m):
                covariance[j, 0] = -gain[j] * decay[j] - shared[j]
            state[0] = columns[i]
            continue
        for j in range(m):
            gain[j] = (decay[j] * gain[j] + shared[j]) / F
        _scale_innovations(columns[i], state, weight, decay, gain, 1.0 / np.sqrt(F), out[i])
        _advance_states(covariance, decay, drive, gain, F)
        total += np.log(F)
    return out, total


@njit(**KERNEL)
def products_on_grid(
    columns: Floats,
    variance: Floats,
    step_seconds: Floats,
    present: Bools,
    walk: Floats,
    K2: Floats,
    B2: Floats,
    flicker: tuple[Floats, Floats, float],
    ou_variance: Floats,
    ou_time: Floats,
    angle: float,
) -> tuple[Floats, Floats]:
    """Compute the products of whitened columns for many sizes of the random walk and the flicker.

    Parameters
    ----------
    columns, variance, step_seconds, present, ou_variance, ou_time, angle
        As for `whiten`; the processes are those in addition to the flicker.
    walk : ndarray, shape (n,)
        Growth of the variance in a second of a random walk of known size, in every block.
    K2, B2 : ndarray, shape (grid,)
        Growth of that of the random walk, and square of the flicker.
    flicker : tuple
        The `flicker_states`.

    Returns
    -------
    products : ndarray, shape (grid, m, m)
    log_determinant : ndarray, shape (grid,)
    """
    n, width = columns.shape
    share, flicker_time, white = flicker
    products = np.zeros((K2.size, width, width))
    log_determinant = np.zeros(K2.size)
    for g in range(K2.size):
        count = share.size if B2[g] > 0.0 else 0
        squares = np.concatenate((share[:count] * B2[g], ou_variance))
        times = np.concatenate((flicker_time[:count], ou_time))
        whitened, log_determinant[g] = whiten(
            columns,
            variance + B2[g] * white,
            step_seconds,
            present,
            walk + K2[g],
            squares,
            times,
            angle,
        )
        for i in range(n):
            for j in range(width):
                for k in range(j + 1):
                    products[g, j, k] += whitened[i, j] * whitened[i, k]
        for j in range(width):
            for k in range(j):
                products[g, k, j] = products[g, j, k]
    return products, log_determinant
