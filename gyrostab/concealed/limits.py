"""How large an effect is, in units of the smallest that any method can see; and what knowing it is worth.

A mean that is known up to its size, in noise of known density S(f), changes the log-likelihood by ``1/2 sum |M(f)|^2 / S(f)``; the limit
is where that is `NATS`. In white noise and for a mean that is on for T_on of T this is ``a_min = N_s sqrt(2 c / T_eff)``. A change of the
log variance by v in n samples is worth ``n v^2 / 4``, which gives ``2 sqrt(c / n)``; noise common to the axes ``n / 2 sum of rho^2``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from gyrostab.concealed.floor import floor_psd
from gyrostab.concealed.world import World, per_second

__all__ = ["NATS", "amplitude_for", "mean_size", "shared_size", "variance_gain", "variance_size"]

Array = NDArray[np.float64]

#: Log-likelihood at the limit.
NATS = 5.7


def mean_size(world: World, mean: Array, *, white: bool = False) -> float:
    """Size of a mean (axis, time) [deg/h], in units of the limit; proportional to its amplitude.

    Parameters
    ----------
    world : World
    mean : ndarray, shape (axis, time)
    white : bool
        Leave out all noise but the white one: the limit in its simplest form.

    Returns
    -------
    float
        The square root of the expected log-likelihood over `NATS`.
    """
    there = ~world.missing
    nats = 0.0
    for values, noise in zip(mean, world.noise, strict=True):
        centred = values - values[there].mean()
        whole = float(((values - values.mean()) ** 2).sum())
        if whole == 0:
            continue
        lines = fft.dct(values - values.mean(), norm="ortho")[1:]
        f = np.arange(1, world.size) * world.rate / (2 * world.size)
        density = floor_psd(f, noise={"N": noise["N"]} if white else noise, rate=world.rate)
        seen = float((centred[there] ** 2).sum()) / whole
        nats += 0.5 * seen * float((lines**2 / density).sum()) / world.rate
    return math.sqrt(nats / NATS)


def _weights(world: World, ratio: Array) -> Array:
    count = per_second(world).astype(float)
    weight = count.reshape(1, -1, *(1,) * (ratio.ndim - 2))
    return weight / (ratio.shape[2] if ratio.ndim == 3 else 1)


def variance_size(world: World, ratio: Array) -> float:
    """Size of a change of the noise density, in units of the limit.

    Parameters
    ----------
    world : World
    ratio : ndarray, shape (axis, second) or (axis, second, frequency)
        Density with the effect over density without; frequencies share (0, rate / 2) equally. A second axis of length 1 stands for a
        change that lasts all the time and is then compared with no change; else with its own mean over time.

    Returns
    -------
    float
    """
    change = np.log(ratio)
    weight = _weights(world, ratio)
    if ratio.shape[1] > 1:
        change = change - (change * weight).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
    else:
        weight = weight.sum(axis=1, keepdims=True)
    return math.sqrt(float((weight * change**2).sum()) / 4 / NATS)


def variance_gain(world: World, ratio: Array, *, quiet: bool = True) -> float:
    """Expected log-likelihood [nats] of the truth over noise without the effect, for the `ratio` of `variance_size`.

    Without `quiet` times, in which the noise could be seen without the effect, it is compared with the mean level instead.
    """
    weight = _weights(world, ratio)
    if ratio.shape[1] == 1:
        weight = weight.sum(axis=1, keepdims=True)
    elif not quiet:
        ratio = ratio * weight.sum(axis=1, keepdims=True) / (ratio * weight).sum(axis=1, keepdims=True)
    return float((weight * (ratio - 1 - np.log(ratio))).sum()) / 2


def shared_size(world: World, correlations: Array, *, band: float = 1.0) -> float:
    """Size of noise common to pairs of axes with these `correlations`, over a share `band` of the frequencies."""
    n = float((~world.missing).sum()) * band
    return math.sqrt(n * float((np.asarray(correlations) ** 2).sum()) / 2 / NATS)


def amplitude_for(size_of: Callable[[float], float], strength: float, *, first: float = 1.0) -> float:
    """Amplitude at which a growing `size_of` reaches `strength`, to 0.1 %.

    Examples
    --------
    >>> round(amplitude_for(lambda a: 3 * a**2, 12.0), 2)
    2.0
    """
    low, high = 0.0, first
    for _ in range(60):
        if size_of(high) > strength:
            break
        low, high = high, 2 * high
    for _ in range(40):
        middle = 0.5 * (low + high)
        reached = size_of(middle)
        if abs(reached / strength - 1) < 1e-3:
            return middle
        low, high = (middle, high) if reached < strength else (low, middle)
    return 0.5 * (low + high)
