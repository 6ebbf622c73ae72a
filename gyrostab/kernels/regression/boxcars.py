"""Matched filters for boxcars in white noise, random walk and relaxing processes, in linear time.

For the covariance C of the series these kernels compute ``C^-1 y`` (the disturbance smoother of de
Jong) and ``x' C^-1 x`` for every boxcar x, so that the matched filter of a boxcar is a sum of
``C^-1 y`` over it. No array of the size of C is made.

A series of n observations is the sum of q states: a random walk that begins at zero, and q - 1
relaxing processes. ``decay`` (n, q) is the decay of each state until the next observation, 1 for
the random walk. ``innovation`` (n,) and ``gain`` (n, q) are results of `filter_gains`, infinite and
zero where there is no observation.

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
def filter_gains(variance, present, walk, ou_variance, decay):  # type: ignore[no-untyped-def]
    """Run a Kalman filter that observes the sum of its states: innovation variances and gains.

    `variance` (n,) is the white variance of each observation, ``present`` (n,) is False where it
    is missing, `walk` (n,) is the increase of the variance of the random walk until the next
    observation, and `ou_variance` (q - 1,) are the variances of the relaxing processes.
    """
    n, q = decay.shape
    innovation, gain = np.full(n, np.inf), np.zeros((n, q))
    state = np.zeros((q, q))
    for i in range(1, q):
        state[i, i] = ou_variance[i - 1]
    along = np.empty(q)
    for t in range(n):
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
                state[i, j] *= decay[t, i] * decay[t, j]
        state[0, 0] += walk[t]
        for i in range(1, q):
            state[i, i] += ou_variance[i - 1] * (1.0 - decay[t, i] ** 2)
    return innovation, gain


@njit(**KERNEL)
def precision_times(columns, innovation, gain, decay):  # type: ignore[no-untyped-def]
    """Multiply each row of `columns` (m, n) by the inverse covariance, ``C^-1 y``.

    Zero without an observation, whatever the value there.
    """
    m, n = columns.shape
    q = gain.shape[1]
    out, state = np.zeros((m, n)), np.empty(q)
    for row in range(m):
        state[:] = 0.0
        for t in range(n):
            if np.isfinite(innovation[t]):
                error = columns[row, t] - state.sum()
                out[row, t] = error / innovation[t]
                for i in range(q):
                    state[i] += gain[t, i] * error
            for i in range(q):
                state[i] *= decay[t, i]
        state[:] = 0.0
        for t in range(n - 1, -1, -1):
            for i in range(q):
                state[i] *= decay[t, i]
            if np.isfinite(innovation[t]):
                value = out[row, t]
                for i in range(q):
                    value -= gain[t, i] * state[i]
                out[row, t] = value
                for i in range(q):
                    state[i] += value
    return out


@njit(**KERNEL)
def remaining_information(innovation, gain, decay):  # type: ignore[no-untyped-def]
    """Compute the information of all later observations about the states predicted at each.

    The result is (n + 1, q, q); the last is zero.
    """
    n, q = gain.shape
    out = np.zeros((n + 1, q, q))
    later = np.empty((q, q))
    for t in range(n - 1, -1, -1):
        for i in range(q):
            for j in range(q):
                later[i, j] = out[t + 1, i, j] * decay[t, i] * decay[t, j]
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
    return out


@njit(**KERNEL)
def boxcar_information(first, stop, innovation, gain, decay, remaining):  # type: ignore[no-untyped-def]
    """Compute ``x' C^-1 x`` of the boxcars x that are 1 from `first` (k,) up to `stop` (k,).

    `remaining` is the result of `remaining_information`.
    """
    q = gain.shape[1]
    out, state = np.empty(first.size), np.empty(q)
    for box in range(first.size):
        state[:] = 0.0
        total = 0.0
        for t in range(first[box], stop[box]):
            if np.isfinite(innovation[t]):
                error = 1.0 - state.sum()
                total += error * error / innovation[t]
                for i in range(q):
                    state[i] += gain[t, i] * error
            for i in range(q):
                state[i] *= decay[t, i]
        for i in range(q):
            for j in range(q):
                total += state[i] * remaining[stop[box], i, j] * state[j]
        out[box] = total
    return out
