"""Biases that wander by themselves: to and fro between two levels, held by a spring, or away with age."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from gyrostab.blindtest.generator.detection_limits import NATS, amplitude_for
from gyrostab.blindtest.generator.noise_floor import floor_psd
from gyrostab.blindtest.generator.scenario import AXES, Effect, World, to_samples
from gyrostab.blindtest.generator.shapes import mean_effect, named, on_axes

__all__ = ["ageing_bias", "gauss_markov", "telegraph", "wander_size"]

Array = NDArray[np.float64]


def wander_size(world: World, shares: Array, *, time: float, rms: float) -> tuple[float, float]:
    """Size of a bias with the correlation `time` [s] and `rms` [deg/h], in units of the limit, and its worth [nats].

    It is random, so only its power can be known: at the frequency ``k / 2T`` of the record T its
    share of the density changes the log variance of one number, and
    `gyrostab.blindtest.generator.detection_limits` says what that is worth.

    Parameters
    ----------
    world : World
    shares : ndarray, shape (axis,)
        Of the axes, beside `rms`.
    time : float
        Correlation time [s].
    rms : float
        Standard deviation [deg/h].
    """
    f = np.arange(1, min(world.size, math.ceil(20 * world.seconds / time) + 50)) / (
        2 * world.seconds
    )
    seen = float((~world.missing).mean())
    size = nats = 0.0
    for share, noise in zip(shares, world.noise, strict=True):
        density = 2 * (share * rms) ** 2 * time / (1 + (2 * math.pi * f * time) ** 2)
        ratio = 1 + seen * density / floor_psd(f, noise=noise, rate=world.rate)
        size += float((np.log(ratio) ** 2).sum())
        nats += 0.5 * float((ratio - 1 - np.log(ratio)).sum())
    return math.sqrt(size / 4 / NATS), nats


def _wandering(
    world: World,
    rng: np.random.Generator,
    waveform: Array,
    *,
    strength: float,
    name: str,
    time: float,
    form: str,
    differs: bool,
) -> Effect:
    shares = on_axes(rng)
    rms = amplitude_for(
        lambda a: wander_size(world, shares, time=time, rms=a)[0], strength, first=1e-4
    )
    size, nats = wander_size(world, shares, time=time, rms=rms)
    return Effect(
        name=name,
        axes=named(shares),
        driver=None,
        form=form,
        differs=differs,
        size=size,
        nats=nats,
        tau=(max(1.0, 0.2 * time), world.seconds / 3),
        mean=shares[:, None] * rms * to_samples(world, waveform)[None, :],
        parameters={"correlation_time": {"value": time, "unit": "s"}},
    )


def _time(world: World, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(10.0), np.log(max(20.0, 0.05 * world.seconds)))))


def gauss_markov(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A bias that a spring pulls back, in half of the cases with a mass as well, so that it is smoother."""
    time, heavy = _time(world, rng), bool(rng.random() < 0.5)
    keep, settle = math.exp(-1 / time), math.ceil(10 * time)
    size = world.temperature.size
    push = rng.standard_normal(size + settle)
    keep = math.exp(-2 / time) if heavy else keep
    for _ in range(2 if heavy else 1):
        push = lfilter([1.0], [1.0, -keep], push)
    waveform = push[settle:] / push.std()
    form = f"{'second' if heavy else 'first'} order, {time:.0f} s"
    return _wandering(
        world,
        rng,
        waveform,
        strength=strength,
        name="gauss_markov",
        time=time,
        form=form,
        differs=heavy,
    )


def telegraph(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A bias of two levels; it stays longer on one of them, in half of the cases for times that are no exponential law."""
    time, gamma = _time(world, rng), bool(rng.random() < 0.5)
    lean = rng.uniform(0.25, 0.75)
    dwell = np.array([time / lean, time / (1 - lean)])  # 1 / time is the sum of the rates
    size, t = world.temperature.size, 0.0
    waveform, level = np.zeros(size), int(rng.integers(2))
    while t < size:
        stay = rng.gamma(4.0, dwell[level] / 4) if gamma else rng.exponential(dwell[level])
        waveform[int(t) : int(t + stay) + 1] = level
        t, level = t + stay, 1 - level
    waveform = (waveform - waveform.mean()) / math.sqrt(lean * (1 - lean))
    form = f"two levels, {dwell[0]:.0f} and {dwell[1]:.0f} s" + (", of gamma law" if gamma else "")
    return _wandering(
        world,
        rng,
        waveform,
        strength=strength,
        name="telegraph",
        time=time,
        form=form,
        differs=gamma,
    )


def ageing_bias(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A bias that goes away from its first value: in proportion to time, to its logarithm, or to a power of it."""
    kind = str(rng.choice(["line", "logarithm", "power"]))
    t = np.arange(world.temperature.size, dtype=float)
    first, power = rng.uniform(0.02, 0.3) * world.seconds, float(rng.choice([0.5, 1.6, 2.0]))
    shape = {"line": t, "logarithm": np.log1p(t / first), "power": t**power}[kind]
    shares = on_axes(rng)
    effect = mean_effect(
        world,
        to_samples(world, shape),
        shares,
        strength=strength,
        name="ageing_bias",
        driver="time",
        form={
            "line": "a line",
            "logarithm": f"logarithm, {first:.0f} s",
            "power": f"power {power:g} of time",
        }[kind],
        differs=kind == "power",
    )
    if kind == "line" and effect.mean is not None:
        slope = (effect.mean[:, -1] - effect.mean[:, 0]) / world.seconds * 86400.0
        effect.parameters["slope"] = {
            "values": dict(zip(AXES, slope.tolist(), strict=True)),
            "unit": "deg/h/day",
        }
    return effect
