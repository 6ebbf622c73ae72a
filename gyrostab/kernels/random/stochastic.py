"""Noise of an ideal gyro: each sample is the mean rate over its interval.

All processes are exact in continuous time: their means over any number of samples have the Allan
variance of the continuous law, not of a sampled one. The results do not depend, bit for bit, on how
samples are divided into calls, because every sample uses its own random numbers, in order. All
strengths are one; the caller gives units.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import KERNEL

#: Ratio of neighbouring correlation times in `flicker_times`: the Allan variance of their sum
#: departs from flat by 0.2 %.
RATIO = 5.0
#: Shorter correlation times than this share of a sample are white noise to the samples.
SHORTEST = 1.0 / 12.0


def brownian_means(steps: Floats, inner: Floats, carry: float) -> tuple[Floats, float]:
    """Average a Brownian motion with the increments `steps` over the samples.

    The mean over an interval with the increment d is the start plus d / 2 plus an independent part
    of variance 1/12 of the increment's; so the mean over k samples has the Allan variance k / 3
    without a correction for sampling.

    Parameters
    ----------
    steps, inner : ndarray, shape (n,)
        Increment of every sample, and the part inside of it: standard normal numbers times the
        standard deviation of the increment.
    carry : float
        Position at the start of the first sample.

    Returns
    -------
    means : ndarray, shape (n,)
    carry : float
        Position at the end of the last sample.
    """
    position = np.cumsum(np.concatenate([[carry], steps]))
    return position[1:] - steps / 2.0 + inner / math.sqrt(12.0), float(position[-1])


@njit(**KERNEL)
def ornstein_uhlenbeck(
    normal: Floats, decay: Floats, weight: Floats, rest_deviation: float, position: Floats
) -> tuple[Floats, Floats]:
    """Sum the sample means of Ornstein-Uhlenbeck processes of unit variance.

    Parameters
    ----------
    normal : ndarray, shape (n, m + 1)
        Standard normal numbers for each sample: one for each process, one for what the means do
        beyond their ends.
    decay : ndarray, shape (m,)
        ``1 - exp(-1 / T)`` for the correlation times T [samples].
    weight : ndarray, shape (m,)
        Factor of each process's ends in its mean.
    rest_deviation : float
        Standard deviation of the sum of the means, given the ends.
    position : ndarray, shape (m,)
        State of the processes at the start of the first sample.

    Returns
    -------
    total : ndarray, shape (n,)
        Sum over the processes of ``weight * (start + end)``, and the rest.
    position : ndarray, shape (m,)
        State at the end of the last sample.
    """
    n, m = normal.shape[0], position.size
    total = np.empty(n)
    x = position.copy()
    kick = np.sqrt(decay * (2.0 - decay))
    for i in range(n):
        s = rest_deviation * normal[i, m]
        for j in range(m):
            start = x[j]
            x[j] = start - decay[j] * start + kick[j] * normal[i, j]
            s += weight[j] * (start + x[j])
        total[i] = s
    return total, x


def _mean_moments(samples: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute decay over a sample, weight of both ends in its mean, and variance of the rest."""
    a = 1.0 / samples
    decay = -np.expm1(-a)
    weight = np.tanh(a / 2.0) / a
    with np.errstate(over="ignore"):
        exact = 2.0 * (a - decay) / a**2 - 2.0 * weight * decay / a
    # the difference loses its digits where the process is slow
    rest_variance = np.where(a < 0.01, a / 6.0 - a**3 / 60.0, exact)
    return decay, weight, rest_variance


def ornstein_uhlenbeck_means(
    normal: Floats, samples: float, position: float
) -> tuple[Floats, float]:
    """Make sample means of an Ornstein-Uhlenbeck (first-order Gauss-Markov) process.

    Parameters
    ----------
    normal : ndarray, shape (n, 2)
        Standard normal numbers.
    samples : float
        Correlation time [samples].
    position : float
        State at the start; initially a standard normal number.

    Returns
    -------
    means : ndarray, shape (n,)
    position : float
        State at the end.

    Examples
    --------
    >>> means, position = ornstein_uhlenbeck_means(np.zeros((3, 2)), 1.0, 1.0)
    >>> means.round(4), round(position, 4)  # (1 - 1/e) e^-n and e^-3
    (array([0.6321, 0.2325, 0.0855]), 0.0498)
    """
    decay, weight, rest_variance = _mean_moments(np.array([float(samples)]))
    total, last = ornstein_uhlenbeck(
        normal, decay, weight, math.sqrt(rest_variance[0]), np.array([position])
    )
    return total, float(last[0])


def flicker_times(rate: float, *, low: float, high: float = math.inf) -> Floats:
    """Choose the correlation times [s] of the processes of flicker noise at `rate` [Hz].

    They are evenly spaced in log, beginning at ``1 / (2 pi low)`` [s], so that another `rate` adds
    or takes only the short ones. The sum has the two-sided density B^2 / (2 pi f) from about 3
    times `low` to a third of `high` [Hz].
    """
    longest = 1.0 / (2.0 * math.pi * low)
    shortest = max(1.0 / (2.0 * math.pi * high), SHORTEST / rate)
    count = 1 + max(0, math.ceil(math.log(longest / shortest) / math.log(RATIO)))
    return np.asarray(longest * RATIO ** -np.arange(count, dtype=np.float64))


def flicker_means(
    normal: Floats, times: Floats, rate: float, position: Floats, *, endless: bool = True
) -> tuple[Floats, Floats]:
    """Make sample means of flicker noise with B = 1.

    Parameters
    ----------
    normal : ndarray, shape (n, m + 1)
        Standard normal numbers.
    times : ndarray, shape (m,)
        From `flicker_times` [s].
    rate : float
        Sampling rate [Hz].
    position : ndarray, shape (m,)
        State of the processes; initially standard normal numbers.
    endless : bool
        The spectrum continues above that of `times`; processes faster than a sample are added as
        white noise.

    Returns
    -------
    means : ndarray, shape (n,)
    position : ndarray, shape (m,)
    """
    decay, weight, rest_variance = _mean_moments(times * rate)
    variance = math.log(RATIO) / math.pi  # of each process
    inner = rest_variance.sum()
    if endless:  # sum of 2 T over the correlation times that would follow; together they are white
        inner += 2.0 * times[-1] * rate / (RATIO - 1.0)
    total, last = ornstein_uhlenbeck(normal, decay, weight, math.sqrt(inner), position)
    return math.sqrt(variance) * total, last
