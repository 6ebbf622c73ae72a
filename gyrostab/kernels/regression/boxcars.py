"""Matched filters for boxcars in white noise, random walk and relaxing processes, in linear time.

For the covariance C of the series these kernels compute ``C^-1 y`` (the disturbance smoother of de
Jong) and ``x' C^-1 x`` for every boxcar x, so that the matched filter of a boxcar is a sum of
``C^-1 y`` over it. No array of the size of C is made.

A series of n observations is the sum of q states and white noise: a random walk that begins at
zero, and q - 1 relaxing processes. ``decay`` (n, q) is the decay of each state until the next
observation, 1 for the random walk. ``innovation`` (n,) and ``gain`` (n, q) are results of
`filter_gains`, infinite and zero where there is no observation.

References
----------
Durbin and Koopman, Time Series Analysis by State Space Methods, 2nd ed. (2012), sections 4.5 and
4.12; Jong, P. de, Biometrika 76 (1989), 75-88, for noise that states and observations share.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gyrostab.kernels.compiled import KERNEL


@njit(**KERNEL)
def filter_gains(variance, present, walk, ou_variance, decay, shared):  # type: ignore[no-untyped-def]
    """Run a Kalman filter that observes the sum of its states: innovation variances and gains.

    The gains are those of the states at the next observation. `variance` (n,) is the white variance
    of each observation, ``present`` (n,) is False where it is missing, `walk` (n,) is the increase
    of the variance of the random walk until the next observation, `ou_variance` (q - 1,) are the
    variances of the relaxing processes, and `shared` (q,) is the covariance of the white noise of
    an observation with what drives each state until the next one.
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
                gain[t, i] = (decay[t, i] * along[i] + shared[i]) / total
        for i in range(q):
            for j in range(q):
                state[i, j] *= decay[t, i] * decay[t, j]
                if present[t]:
                    state[i, j] -= gain[t, i] * gain[t, j] * total
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
            error = 0.0
            if np.isfinite(innovation[t]):  # else the value may be missing too
                error = columns[row, t] - state.sum()
                out[row, t] = error / innovation[t]
            for i in range(q):
                state[i] = decay[t, i] * state[i] + gain[t, i] * error
        state[:] = 0.0
        for t in range(n - 1, -1, -1):
            value = out[row, t]
            for i in range(q):
                value -= gain[t, i] * state[i]
            out[row, t] = value
            for i in range(q):
                state[i] = decay[t, i] * state[i] + value
    return out


@njit(**KERNEL)
def remaining_information(innovation, gain, decay):  # type: ignore[no-untyped-def]
    """Compute the information of all later observations about the states predicted at each.

    The result is (n + 1, q, q); the last is zero.
    """
    n, q = gain.shape
    out = np.zeros((n + 1, q, q))
    along = np.empty(q)
    for t in range(n - 1, -1, -1):
        information = 1.0 / innovation[t]
        for i in range(q):
            total = 0.0
            for j in range(q):
                total += out[t + 1, i, j] * gain[t, j]
            information += total * gain[t, i]
            along[i] = decay[t, i] * total
        for i in range(q):
            for j in range(q):
                later = out[t + 1, i, j] * decay[t, i] * decay[t, j]
                out[t, i, j] = later - along[i] - along[j] + information
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
            error = 1.0 - state.sum()
            total += error * error / innovation[t]  # nothing without an observation
            for i in range(q):
                state[i] = decay[t, i] * state[i] + gain[t, i] * error
        for i in range(q):
            for j in range(q):
                total += state[i] * remaining[stop[box], i, j] * state[j]
        out[box] = total
    return out
