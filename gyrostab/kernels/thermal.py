"""Memory of temperature in a body: diffusion through a coil, and hysteresis by a dead band.

A winding of thickness d, insulated on one side and heated on the other, follows its surface with
modes of the relaxation times ``t_n = 4 d^2 / ((2 n - 1)^2 pi^2 kappa)``. The results do not depend,
bit for bit, on how time is divided into calls.

References
----------
Carslaw and Jaeger 1959, Conduction of Heat in Solids, section 3.4 (slab with one insulated face).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import KERNEL

#: Smaller numbers are zero: the processor is slow with those that it cannot normalise.
TINY = 1e-200


def slab(slowest: float, count: int) -> tuple[Floats, Floats, Floats]:
    """Compute the modes of a winding that is heated from outside.

    Parameters
    ----------
    slowest : float
        Relaxation time of the slowest mode [s].
    count : int
        Number of modes; the last one represents all faster modes.

    Returns
    -------
    times : ndarray, shape (count,)
        Relaxation times [s], falling.
    whole : ndarray, shape (count,)
        Share of each mode in the response of the mean of the winding; their sum is one.
    halves : ndarray, shape (count,)
        The same for the outer half minus the inner half; their sum is zero.

    Examples
    --------
    >>> times, whole, halves = slab(265.0, 3)
    >>> times.round(1), whole.round(3), halves.round(3)
    (array([265. ,  29.4,  10.6]), array([0.811, 0.09 , 0.099]), array([-0.671,  0.435,  0.237]))
    """
    odd: Floats = np.arange(1, 2 * count, 2, dtype=np.float64)
    root = odd * (math.pi / 2.0)
    sign = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    whole: Floats = np.asarray(2.0 / root**2, dtype=np.float64)
    halves = 4.0 * sign * (sign - 2.0 * np.sin(root / 2.0)) / root**2
    whole[-1] += 1.0 - whole.sum()
    halves[-1] -= halves.sum()
    times = np.asarray(slowest / odd**2, dtype=np.float64)
    return times, whole, halves


@njit(**KERNEL)
def _relax_mode(
    change: Floats, decay: Floats, gain: Floats, weight: Floats, carry: Floats
) -> tuple[Floats, Floats]:
    size, count = change.size, decay.size
    total = np.empty((weight.shape[0], size))
    position = carry.copy()
    for i in range(size):
        for k in range(count):
            value = decay[k] * position[k] + gain[k] * change[i]
            position[k] = 0.0 if abs(value) < TINY else value
        for row in range(weight.shape[0]):
            value = 0.0
            for k in range(count):
                value += weight[row, k] * position[k]
            total[row, i] = value
    return total, position


def relax(
    values: Floats, rate: float, times: Floats, weight: Floats, carry: tuple[float, Floats]
) -> tuple[Floats, tuple[float, Floats]]:
    """Differentiate samples with the delay of every mode: ``v' = (T' - v) / t``, T straight.

    Parameters
    ----------
    values : ndarray, shape (n,)
        T at the samples.
    rate : float
        Sampling rate [Hz].
    times : ndarray, shape (m,)
        Relaxation times [s].
    weight : ndarray, shape (k, m)
        Sums over modes that are wanted.
    carry : (float, ndarray of shape (m,))
        T and v at the previous sample; at the start, the first T and zeros.

    Returns
    -------
    rates : ndarray, shape (k, n)
        Sums of v at the samples [unit of T s-1].
    carry : (float, ndarray)
    """
    last, position = carry
    change = np.diff(values, prepend=last) * rate
    total, position = _relax_mode(
        change, np.exp(-1.0 / (rate * times)), -np.expm1(-1.0 / (rate * times)), weight, position
    )
    return total, (float(values[-1]), position)


def lag_values(
    values: Floats, rate: float, time: float, carry: tuple[float, Floats] | None = None
) -> tuple[Floats, tuple[float, Floats]]:
    """Apply a first-order lag [s] to samples at `rate` [Hz], linear between them.

    `carry` is what the call for the samples before returned; without it, from equilibrium.
    """
    carry = carry or (float(values[0]), np.zeros(1))
    speed, carry = relax(values, rate, np.array([time]), np.ones((1, 1)), carry)
    return values - time * speed[0], carry


@njit(**KERNEL)
def _follow_values(at: Floats, values: Floats, time: float) -> Floats:
    behind = 0.0
    out = np.empty(at.size)
    out[0] = values[0]
    for i in range(1, at.size):
        step = at[i] - at[i - 1]
        if step > 0.0:
            slope = (values[i] - values[i - 1]) / step
            decay = math.exp(-step / time)
            behind = behind * decay + slope * time * (1.0 - decay)
        out[i] = values[i] - behind
    return out


def mean_changes(
    value_times: Floats, values: Floats, begin: Floats, end: Floats, time: float
) -> Floats:
    """Average one mode of `relax` over intervals, with T straight between few values.

    Parameters
    ----------
    value_times, values : ndarray, shape (n,)
        Times, rising [s], and T; extrapolated linearly beyond the ends.
    begin, end : ndarray, shape (w,)
        Edges of the intervals [s]; T is constant before the first of them.
    time : float
        Relaxation time [s]; 0 for T' itself.

    Returns
    -------
    ndarray, shape (w,)
        Means of v [unit of T s-1].

    Examples
    --------
    >>> t, T = np.array([5.0, 15.0]), np.array([1.0, 3.0])
    >>> begin, end = np.array([0.0, 10.0]), np.array([10.0, 20.0])
    >>> mean_changes(t, T, begin, end, 0.01), mean_changes(t, T, begin, end, 0.0)
    (array([0.1998, 0.2   ]), array([0.2, 0.2]))
    """
    at, line = _polygon_corners(value_times, values, begin, end)
    return _average_growth(at, _follow_values(at, line, time) if time else line, begin, end)


def mean_followed(
    value_times: Floats, values: Floats, begin: Floats, end: Floats, time: float
) -> Floats:
    """Average what follows T with one relaxation time, ``y' = (T - y) / t``, as `mean_changes`.

    Examples
    --------
    >>> t, T = np.array([5.0, 15.0]), np.array([1.0, 3.0])
    >>> mean_followed(t, T, np.array([0.0, 10.0]), np.array([10.0, 20.0]), 0.5).round(4)
    array([0.905, 2.9  ])
    """
    at, line = _polygon_corners(value_times, values, begin, end)
    means = (line[1:] + line[:-1]) / 2.0
    # the integral of y is that of T less t times the growth of y
    integral = _integrate_steps(at, means) - time * _follow_values(at, line, time)
    return _average_growth(at, integral, begin, end)


def _polygon_corners(
    value_times: Floats, values: Floats, begin: Floats, end: Floats
) -> tuple[Floats, Floats]:
    """Find the corners of the polygon through the known values, and at the edges of intervals."""
    at = np.unique(np.concatenate([value_times, begin, end]))
    line = np.interp(at, value_times, values)
    if value_times.size > 1:
        for edge, outer, inner in ((at < value_times[0], 0, 1), (at > value_times[-1], -1, -2)):
            slope = (values[outer] - values[inner]) / (value_times[outer] - value_times[inner])
            line[edge] = values[outer] + slope * (at[edge] - value_times[outer])
    return at, line


def _average_growth(at: Floats, values: Floats, begin: Floats, end: Floats) -> Floats:
    """Average the slope of a curve over intervals, whose edges are among its corners."""
    return np.asarray(
        (values[np.searchsorted(at, end)] - values[np.searchsorted(at, begin)]) / (end - begin)
    )


def _integrate_steps(at: Floats, means: Floats) -> Floats:
    """Integrate a curve from its first corner to each, from its means between corners."""
    return np.concatenate([[0.0], np.cumsum(means * np.diff(at))])


@njit(**KERNEL)
def apply_dead_band(values: Floats, width: float, start: float) -> tuple[Floats, float]:
    """Apply a dead band of half-width `width`: the output moves only when `values` pushes it.

    Parameters
    ----------
    values : ndarray, shape (n,)
    width : float
        Half-width of the dead band.
    start : float
        Output before the first value.

    Returns
    -------
    slider : ndarray, shape (n,)
    last : float

    Examples
    --------
    >>> apply_dead_band(np.array([0.0, 5.0, 4.0, 0.0, -5.0]), 2.0, 0.0)
    (array([ 0.,  3.,  3.,  2., -3.]), -3.0)
    """
    out = np.empty(values.size)
    position = start
    for i in range(values.size):
        position = max(values[i] - width, min(values[i] + width, position))
        out[i] = position
    return out, position


def mean_dead_band_distance(
    value_times: Floats, values: Floats, begin: Floats, end: Floats, width: float
) -> Floats:
    """Average the distance of T from the output of `apply_dead_band`, as `mean_changes`.

    `width` is the half-width of the dead band, whose output begins at T at the first time.

    Examples
    --------
    >>> t, T = np.array([0.0, 10.0, 20.0]), np.array([0.0, 10.0, 0.0])
    >>> begin, end = np.array([0.0, 10.0]), np.array([10.0, 20.0])
    >>> mean_dead_band_distance(t, T, begin, end, 2.5).round(2)
    array([ 2.19, -1.25])
    """
    at, line = _polygon_corners(value_times, values, begin, end)
    distance = line - apply_dead_band(line, width, float(line[0]))[0]
    # between two corners the distance changes as T does, until it pushes the output
    change, growth = np.diff(line), np.diff(distance)
    share = np.divide(growth, change, out=np.zeros(change.size), where=change != 0.0)
    means = distance[1:] - share * growth / 2.0
    return _average_growth(at, _integrate_steps(at, means), begin, end)
