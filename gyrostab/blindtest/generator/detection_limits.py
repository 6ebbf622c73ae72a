"""How large an effect is, in units of the smallest that any method can see; and what knowing it is worth.

A mean that is known up to its size, in noise of known density S(f), changes the log-likelihood by
``1/2 sum |M(f)|^2 / S(f)``; the limit is where that is `NATS`. In white noise and for a mean that
is on for T_on of T this is ``a_min = N_s sqrt(2 c / T_eff)``. A change of the log variance by v in
n samples is worth ``n v^2 / 4``, which gives ``2 sqrt(c / n)``; noise common to the axes ``n / 2
sum of rho^2``.

In the noise of a real recording (`World.own`) the same counts against what was measured of it: S(f)
is its own spectrum, lines included; a change of the level, which counts as far as white noise makes
part of each band, stands beside what the level wanders by itself; and what axes share is that much
less of what each has.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import minimize

from gyrostab.blindtest.generator.measured_noise import BANDS
from gyrostab.blindtest.generator.noise_floor import floor_psd, white_level
from gyrostab.blindtest.generator.scenario import World, per_second
from gyrostab.errors import OptionError

__all__ = [
    "NATS", "amplitude_for", "band_density", "learned_gain", "line_density_of", "mean_size", "shared_size", "variance_gain",
    "variance_size",
]  # fmt: skip

Array = NDArray[np.float64]

#: Log-likelihood at the limit.
NATS = 5.7
_STRETCHES = 400  # of the spectrum


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
    nats = 0.0
    for axis, f, power in _mean_lines(world, mean):
        noise = world.noise[axis]
        density = (
            floor_psd(f, noise={"N": noise["N"]}, rate=world.rate)
            if white
            else line_density_of(world, axis=axis)
        )
        nats += 0.5 * float((power / density).sum())
    return math.sqrt(nats / NATS)


def line_density_of(world: World, *, axis: int) -> Array:
    """Two-sided density [(deg/h)2/Hz] of the noise of an axis at the frequencies ``k rate / (2 size)``, k from 1: known, or measured."""
    if world.own is not None:
        return np.asarray(world.own.lines[axis])
    f = np.arange(1, world.size) * world.rate / (2 * world.size)
    return floor_psd(f, noise=world.noise[axis], rate=world.rate)


def band_density(world: World, *, bands: int = BANDS) -> Array:
    """Two-sided density [(deg/h)2/Hz] of white noise and steps of the angle in equal bands (axis, band); of real noise the typical one."""
    if world.own is not None:
        return world.own.level
    f = (np.arange(bands) + 0.5) * world.rate / 2 / bands
    return np.stack(
        [floor_psd(f, noise={k: n[k] for k in "NQ"}, rate=world.rate) for n in world.noise]
    )


def _mean_lines(world: World, mean: Array) -> Iterator[tuple[int, Array, Array]]:
    """Of every axis that a mean is on: its number, frequencies [Hz], the power there as far as it is recorded [(deg/h)2/Hz]."""
    there = ~world.missing
    for axis, values in enumerate(mean):
        whole = float(((values - values.mean()) ** 2).sum())
        if whole == 0:
            continue
        lines = fft.dct(values - values.mean(), norm="ortho")[1:]
        f = np.arange(1, world.size) * world.rate / (2 * world.size)
        seen = float(((values[there] - values[there].mean()) ** 2).sum()) / whole
        yield axis, f, seen * lines**2 / world.rate


def learned_gain(world: World, mean: Array) -> float:
    """Expected log-likelihood [nats] of a known mean (axis, time) over noise that is fitted to the same record without it.

    Angle random walk, bias instability and rate random walk of each axis are what suits best where
    the mean is taken for noise: a slow mean is worth a part only of what it is where the noise is
    known beforehand.

    Parameters
    ----------
    world : World
    mean : ndarray, shape (axis, time)
    """
    return sum(
        _learned(f, power, world.noise[axis], world.rate)
        for axis, f, power in _mean_lines(world, mean)
    )


def _learned(f: Array, power: Array, noise: dict[str, float], rate: float) -> float:
    """Of one axis: the divergence of noise and mean from the nearest noise, over stretches of the spectrum in which noise is one level."""
    first = np.unique(np.geomspace(1, f.size, _STRETCHES).astype(np.int64)) - 1
    count = np.diff(np.append(first, f.size))
    f, power = (np.add.reduceat(values, first) / count for values in (f, power))
    known = floor_psd(f, noise=noise, rate=rate)
    alone = np.stack(
        [
            floor_psd(f, noise={"Q": noise.get("Q", 0.0)}, rate=rate),
            *(floor_psd(f, noise={one: 1.0}, rate=rate) for one in "NBK"),
        ]
    )

    def apart(logarithms: Array) -> float:
        ratio = known / (alone[0] + np.exp(logarithms) @ alone[1:])
        return 0.5 * float((count * (ratio * (1 + power / known) - 1 - np.log(ratio))).sum())

    white = known[-1] / alone[1, -1]
    meets = [
        known[place] / alone[2:, place] for place in range(0, f.size, max(1, f.size // 4))
    ]  # either is as loud as all that is known
    starts = [
        np.log([white, *np.where(chosen, level, level * 1e-3)])
        for level in meets
        for chosen in ([True, False], [False, True])
    ]
    found = [
        minimize(apart, start, method="Nelder-Mead", options={"maxiter": 400}).fun
        for start in starts
    ]
    return float(max(0.0, min(found)))


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
        Density with the effect over density without; frequencies share (0, rate / 2) equally. A
        second axis of length 1 stands for a change that lasts all the time and is then compared
        with no change; else with its own mean over time.

    Returns
    -------
    float
    """
    if world.own is not None:
        return math.sqrt(_own_nats(world, ratio) / NATS)
    change = np.log(ratio)
    weight = _weights(world, ratio)
    if ratio.shape[1] > 1:
        change = change - (change * weight).sum(axis=1, keepdims=True) / weight.sum(
            axis=1, keepdims=True
        )
    else:
        weight = weight.sum(axis=1, keepdims=True)
    return math.sqrt(float((weight * change**2).sum()) / 4 / NATS)


def _own_nats(world: World, ratio: Array) -> float:
    """Of a change that lasts for a part of the time, in real noise [nats]."""
    assert world.own is not None
    if ratio.shape[1] == 1:
        raise OptionError(
            "what a change for good is worth in real noise nobody knows: it is there in the untouched recording too"
        )
    if ratio.ndim == 2:  # noise can only be added, and is white
        white = np.array([white_level(noise["N"]) ** 2 for noise in world.noise])
        more = ratio / ratio.min(axis=1, keepdims=True) - 1
        ratio = 1 + more[:, :, None] * (white[:, None] / world.own.level)[:, None, :]
    change = world.own.blocks(np.log(ratio))
    return sum(world.own.change_nats(rows, axis=axis) for axis, rows in enumerate(change))


def variance_gain(world: World, ratio: Array, *, quiet: bool = True) -> float:
    """Expected log-likelihood [nats] of the truth over noise without the effect, for the `ratio` of `variance_size`.

    Without `quiet` times, in which the noise could be seen without the effect, it is compared with
    the mean level instead.
    """
    if world.own is not None:
        return _own_nats(world, ratio)
    weight = _weights(world, ratio)
    if ratio.shape[1] == 1:
        weight = weight.sum(axis=1, keepdims=True)
    elif not quiet:
        ratio = (
            ratio * weight.sum(axis=1, keepdims=True) / (ratio * weight).sum(axis=1, keepdims=True)
        )
    return float((weight * (ratio - 1 - np.log(ratio))).sum()) / 2


def shared_size(world: World, correlations: Array, *, band: float = 1.0) -> float:
    """Size of white noise common to pairs of axes (xy, xz, yz) with these `correlations`, over a share `band` of the frequencies."""
    n = float((~world.missing).sum()) * band
    worth = np.asarray(correlations) ** 2
    if world.own is not None:  # the coherence falls where an axis has more than white noise
        white = np.array([white_level(noise["N"]) ** 2 for noise in world.noise])
        part = white[:, None] / world.own.level
        worth = worth * np.array([(part[i] * part[j]).mean() for i, j in ((0, 1), (0, 2), (1, 2))])
    return math.sqrt(n * float(worth.sum()) / 2 / NATS)


def amplitude_for(
    size_of: Callable[[float], float], strength: float, *, first: float = 1.0
) -> float:
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
