"""Environment of the gyros and its imperfect sensors: temperature, vibration, supply, light."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from gyrostab.arrays import Bools, Floats


def lag(values: Floats, tau: float, *, dt: float = 1.0) -> Floats:
    """Apply a first-order lag `tau` [s] to values every `dt` [s], starting in equilibrium.

    Examples
    --------
    >>> round(float(lag(np.r_[0.0, np.ones(300)], 100.0)[100]), 2)
    0.63
    """
    if tau <= 0:
        return np.asarray(values, dtype=float)
    keep = math.exp(-dt / tau)
    return np.asarray(values[0] + lfilter([1 - keep], [1, -keep], np.asarray(values) - values[0]))


def temperature(rng: np.random.Generator, seconds: float, *, still: bool = False) -> Floats:
    """Draw the temperature of the housing [degC], one value a second: ramps, plateaus, reversals.

    If `still`, there is only a slow wander.

    Examples
    --------
    >>> t = temperature(np.random.default_rng(0), 3600.0)
    >>> t.size, bool(np.ptp(t) > 3)
    (3601, True)
    """
    size = math.ceil(seconds) + 1
    wander = lag(np.cumsum(rng.normal(0, 0.004, size)), 30.0)
    if still:
        return np.asarray(rng.uniform(20, 90) + wander)
    pieces = int(rng.integers(4, 7))
    lengths = rng.dirichlet(np.full(pieces, 4.0)) * size
    turn = rng.choice([-1.0, 1.0])
    slopes = np.zeros(size)
    edges = np.concatenate([[0], np.cumsum(lengths)]).astype(int)
    for k in range(pieces):
        if k % 2 == 1 or rng.random() < 0.25:  # plateaus between the ramps
            fast = rng.random() < 0.5
            per_minute = rng.uniform(1, 2) if fast else rng.uniform(0.1, 0.4)
            slopes[edges[k] : edges[k + 1]] = turn * per_minute / 60.0
            turn = -turn
    limit = 60.0 / max(60.0, float(np.ptp(np.cumsum(slopes))))  # a day of ramps stays below 60 K
    return np.asarray(
        lag(rng.uniform(30, 70) + np.cumsum(slopes) * limit, rng.uniform(20, 120)) + wander
    )


def shaking(
    rng: np.random.Generator, seconds: float, *, bursts: int, longest: float = 600.0
) -> tuple[Floats, Bools]:
    """Draw the rms acceleration [g], one value a second, and the mask of its bursts.

    Each of the bursts has a separate level, and is at most `longest` [s].

    Examples
    --------
    >>> level, busy = shaking(np.random.default_rng(0), 3600.0, bursts=3)
    >>> bool(level[busy].mean() > 10 * level[~busy].mean())
    True
    """
    size = math.ceil(seconds) + 1
    t = np.arange(size)
    floor = rng.uniform(0.02, 0.08)
    level = floor * np.exp(lag(rng.normal(0, 0.8, size), 20.0))
    busy = np.zeros(size, dtype=bool)
    part = seconds / max(1, bursts)
    for k in range(bursts):
        length = min(rng.uniform(0.15, 0.55) * part, longest)
        begin = k * part + rng.uniform(0.1, 0.9) * (part - length)
        edge = rng.uniform(1, 8)
        shape = 1 / (
            1 + np.exp(np.clip((np.abs(t - begin - length / 2) - length / 2) / edge * 4, -50, 50))
        )
        level = level + rng.uniform(1.5, 10) * shape * np.exp(
            0.15 * lag(rng.normal(0, 3, size), 10.0)
        )
        busy |= shape > 0.5
    return np.asarray(level), busy


def supply(rng: np.random.Generator, seconds: float, *, load: Floats) -> Floats:
    """Draw the battery voltage [V], one value a second; it sags with time and `load` (0 to 1).

    Examples
    --------
    >>> v = supply(np.random.default_rng(0), 600.0, load=np.zeros(601))
    >>> bool(20 < v.min() < v.max() < 32)
    True
    """
    size = math.ceil(seconds) + 1
    steps = np.zeros(size)
    for _ in range(int(rng.integers(1, 5))):
        begin, length = rng.uniform(0, 0.8) * size, rng.uniform(0.05, 0.3) * size
        steps[int(begin) : int(begin + length)] -= rng.uniform(0.2, 1.5)
    sag = rng.uniform(0.0, 0.8) * np.linspace(0, 1, size) ** rng.uniform(0.5, 1.5)
    return np.asarray(rng.uniform(26, 30) - sag + lag(steps, 3.0) - rng.uniform(0.1, 0.5) * load)


def light_monitor(rng: np.random.Generator, seconds: float, *, dips: bool) -> Floats:
    """Draw the relative light power, one value a second: slow loss, and `dips` of connectors.

    Examples
    --------
    >>> p = light_monitor(np.random.default_rng(0), 600.0, dips=True)
    >>> bool(p.min() > 0), bool(p.min() < 0.95)
    (True, True)
    """
    size = math.ceil(seconds) + 1
    loss = lag(np.abs(np.cumsum(rng.normal(0, 2e-4, size))), 60.0)
    if dips:
        for _ in range(int(rng.integers(1, 4))):
            begin, length = rng.uniform(0.05, 0.7) * size, rng.uniform(0.1, 0.3) * size
            step = np.zeros(size)
            step[int(begin) : int(begin + length)] = rng.uniform(0.8, 3.0)
            loss = loss + lag(step, rng.uniform(1, 30))
    return np.asarray(10 ** (-loss / 10))


def read_sensor(
    rng: np.random.Generator,
    values: Floats,
    *,
    noise: float = 0.0,
    relative: float = 0.0,
    lsb: float = 0.0,
    tau: float = 0.0,
    dt: float = 1.0,
) -> Floats:
    """Apply a sensor to `values`: lag `tau` [s], additive and relative noise, steps of `lsb`.

    Examples
    --------
    >>> reading = read_sensor(np.random.default_rng(0), np.full(1000, 20.0), noise=0.03, lsb=0.0625)
    >>> bool(np.allclose(reading / 0.0625, np.rint(reading / 0.0625)))
    True
    """
    reading = lag(values, tau, dt=dt) * (
        1 + relative * rng.standard_normal(values.size)
    ) + noise * rng.standard_normal(values.size)
    return np.asarray(np.rint(reading / lsb) * lsb if lsb else reading)
