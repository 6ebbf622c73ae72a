"""Matched filters for boxcars in white noise, random walk and relaxing processes, in linear time.

For the covariance C of the series these kernels compute ``C^-1 y`` (the disturbance smoother of de
Jong) and ``x' C^-1 x`` for every boxcar x, so that the matched filter of a boxcar is a sum of
``C^-1 y`` over it. No array of the size of C is made.

References
----------
Durbin and Koopman, Time Series Analysis by State Space Methods, 2nd ed. (2012), sections 4.5 and
4.12.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import KERNEL


@njit(**KERNEL)
def filter_gains(variance, present, walk, ou_variance, decay, innovation, gain):  # type: ignore[no-untyped-def]
    """Run a Kalman filter that observes the sum of its states: innovation variances and gains.

    Parameters
    ----------
    variance : float64 (n,)
        White variance of each observation.
    present : bool (n,)
        False where there is no observation.
    walk : float64 (n,)
        Increase of the variance of the random walk until the next observation.
    ou_variance : float64 (p,)
        Variances of the relaxing processes.
    decay : float64 (n, p)
        Decay of each process until the next observation.
    innovation, gain : float64 (n,), (n, p + 1)
        Results; the random walk is the first state, and begins at zero.
    """
    n, p = decay.shape
    q = p + 1
    state = np.zeros((q, q))
    for i in range(p):
        state[i + 1, i + 1] = ou_variance[i]
    along = np.empty(q)
    for t in range(n):
        gain[t] = 0.0
        innovation[t] = np.inf
        if present[t]:
            total = variance[t]
            for i in range(q):
                along[i] = state[i].sum()
                total += along[i]
            innovation[t] = total
            for i in range(q):
                gain[t, i] = along[i] / total
            for i in range(q):
                for j in range(q):
                    state[i, j] -= gain[t, i] * along[j]
        for i in range(q):
            for j in range(q):
                left = 1.0 if i == 0 else decay[t, i - 1]
                right = 1.0 if j == 0 else decay[t, j - 1]
                state[i, j] *= left * right
        state[0, 0] += walk[t]
        for i in range(p):
            state[i + 1, i + 1] += ou_variance[i] * (1.0 - decay[t, i] ** 2)


@njit(**KERNEL)
def precision_times(columns, innovation, gain, decay, out):  # type: ignore[no-untyped-def]
    """Multiply each column by the inverse covariance, ``C^-1 y``; zero without an observation.

    Parameters
    ----------
    columns : float64 (m, n)
        The series, one per row; values at missing observations are not used.
    innovation, gain, decay : float64 (n,), (n, p + 1), (n, p)
        As in `filter_gains`.
    out : float64 (m, n)
        Result.
    """
    m, n = columns.shape
    q = gain.shape[1]
    state = np.empty(q)
    for row in range(m):
        state[:] = 0.0
        for t in range(n):
            if np.isfinite(innovation[t]):
                error = columns[row, t] - state.sum()
                out[row, t] = error / innovation[t]
                for i in range(q):
                    state[i] += gain[t, i] * error
            for i in range(1, q):
                state[i] *= decay[t, i - 1]
        state[:] = 0.0
        for back in range(n):
            t = n - 1 - back
            for i in range(1, q):
                state[i] *= decay[t, i - 1]
            if np.isfinite(innovation[t]):
                value = out[row, t]
                for i in range(q):
                    value -= gain[t, i] * state[i]
                out[row, t] = value
                for i in range(q):
                    state[i] += value
            else:
                out[row, t] = 0.0


@njit(**KERNEL)
def remaining_information(innovation, gain, decay, out):  # type: ignore[no-untyped-def]
    """Compute the information of all later observations about the states predicted at each.

    Parameters
    ----------
    innovation, gain, decay : float64 (n,), (n, p + 1), (n, p)
        As in `filter_gains`.
    out : float64 (n + 1, p + 1, p + 1)
        Result; the last is zero.
    """
    n, q = gain.shape
    out[n] = 0.0
    later = np.empty((q, q))
    for back in range(n):
        t = n - 1 - back
        for i in range(q):
            for j in range(q):
                left = 1.0 if i == 0 else decay[t, i - 1]
                right = 1.0 if j == 0 else decay[t, j - 1]
                later[i, j] = out[t + 1, i, j] * left * right
        if not np.isfinite(innovation[t]):
            out[t] = later
            continue
        along = np.zeros(q)
        information = 1.0 / innovation[t]
        for i in range(q):
            for j in range(q):
                along[i] += later[i, j] * gain[t, j]
            information += along[i] * gain[t, i]
        for i in range(q):
            for j in range(q):
                out[t, i, j] = later[i, j] - along[i] - along[j] + information


@njit(**KERNEL)
def boxcar_information(first, stop, innovation, gain, decay, remaining, out):  # type: ignore[no-untyped-def]
    """Compute ``x' C^-1 x`` of the boxcars x that are 1 from `first` up to `stop`.

    Parameters
    ----------
    first, stop : int64 (k,)
        Edges of the boxcars.
    innovation, gain, decay : float64 (n,), (n, p + 1), (n, p)
        As in `filter_gains`.
    remaining : float64 (n + 1, p + 1, p + 1)
        Result of `remaining_information`.
    out : float64 (k,)
        Result.
    """
    q = gain.shape[1]
    state = np.empty(q)
    for box in range(first.size):
        state[:] = 0.0
        total = 0.0
        for t in range(first[box], stop[box]):
            if np.isfinite(innovation[t]):
                error = 1.0 - state.sum()
                total += error * error / innovation[t]
                for i in range(q):
                    state[i] += gain[t, i] * error
            for i in range(1, q):
                state[i] *= decay[t, i - 1]
        for i in range(q):
            for j in range(q):
                total += state[i] * remaining[stop[box], i, j] * state[j]
        out[box] = total
