"""Effects that no catalogue holds: a diagnosis should see them and say that it does not know them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.scenario import Effect, World, stream, to_samples
from gyrostab.blindtest.generator.shapes import mean_effect, named, on_axes, variance_effect

__all__ = ["breathing_noise", "chirped_line", "informative_gaps", "slow_memory", "three_levels"]

Array = NDArray[np.float64]


def breathing_noise(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Noise that swells and sinks with a period that nothing else has."""
    period = rng.uniform(0.05, 0.2) * world.seconds
    t = np.arange(world.temperature.size)
    swell = np.sin(
        2 * math.pi * t / period
        + rng.uniform(0, 6)
        + 0.8 * np.sin(2 * math.pi * t / (3.7 * period))
    )
    shares = np.abs(on_axes(rng, alone=0.5))
    effect, _ = variance_effect(
        world,
        lambda a: np.exp(a * shares[:, None] * swell[None, :]),
        strength=strength,
        name="breathing_noise",
        axes=named(shares),
        driver=None,
        form=f"log variance as a wandering sine of {period:.0f} s",
        differs=True,
        first=1e-4,
    )
    return effect


def chirped_line(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A line that slides through a part of the band."""
    low, high = np.sort(rng.uniform(0.05, 0.4, 2)) * world.rate
    t = np.arange(world.size) / world.rate
    frequency = low + (high - low + 0.02 * world.rate) * (t / world.seconds) ** rng.uniform(
        0.6, 1.8
    )
    return mean_effect(
        world,
        np.sin(2 * math.pi * np.cumsum(frequency) / world.rate),
        on_axes(rng),
        strength=strength,
        name="chirped_line",
        driver=None,
        form=f"{low:.3g} to {high + 0.02 * world.rate:.3g} Hz",
        differs=True,
        tau=(1 / world.rate, 2 / low),
    )


def slow_memory(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A glue that keeps a dose of something unseen and lets it go as a power of time: no level, no rate, no start explains it."""
    dose = rng.random(world.temperature.size) < 4.0 / world.seconds
    dose[int(rng.uniform(0.1, 0.6) * dose.size)] = True
    age = np.arange(world.temperature.size, dtype=float)
    kernel = (1 + age / 30.0) ** -0.4 * (1 - np.exp(-age / 50.0))
    signs = np.where(rng.random(dose.size) < 0.5, -1.0, 1.0)
    shape = np.convolve(dose * signs, kernel)[: dose.size]
    return mean_effect(
        world,
        to_samples(world, shape),
        on_axes(rng),
        strength=strength,
        name="slow_memory",
        driver=None,
        form="slow rise and fall, power 0.4 of time, after hidden doses",
        differs=True,
    )


def three_levels(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A bias that hops between three levels."""
    dwell = rng.uniform(0.03, 0.1) * world.seconds
    hops = rng.random(world.temperature.size) < 1 / dwell
    hops[int(rng.uniform(0.3, 0.6) * hops.size)] = True
    levels, level = np.array([-1.0, 0.1, 1.0]), int(rng.integers(3))
    out = np.empty(hops.size)
    for i, hop in enumerate(hops):
        if hop:
            level = (level + int(rng.integers(1, 3))) % 3
        out[i] = levels[level]
    return mean_effect(
        world,
        to_samples(world, out),
        on_axes(rng),
        strength=strength,
        name="three_levels",
        driver=None,
        form=f"levels -1, 0.1, 1; {dwell:.0f} s on each",
        differs=True,
        beside=("telegraph",),
    )


def informative_gaps(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Noise that rises until frames are lost: the worst of it is never seen."""
    trouble = lag(
        np.abs(
            lag(
                stream(int(rng.integers(2**31)), "trouble").normal(0, 6, world.temperature.size),
                15.0,
            )
        ),
        10.0,
    )
    trouble = np.maximum(trouble - np.percentile(trouble, 60), 0.0)
    trouble /= trouble.max()
    shares = np.abs(on_axes(rng, alone=0.3))
    lost = np.repeat(rng.random(trouble.size) < 0.7 * trouble, math.ceil(world.rate))[: world.size]
    lost = lfilter(np.ones(3), [1.0], lost.astype(float)) > 0
    lost[: round(5 * world.rate)] = lost[-round(5 * world.rate) :] = False
    gone = replace(world, missing=world.missing | lost)
    effect, _ = variance_effect(
        gone,
        lambda a: 1 + a * shares[:, None] * trouble[None, :],
        strength=strength,
        name="informative_gaps",
        axes=named(shares),
        driver=None,
        form="variance and loss of frames rise together",
        differs=True,
        first=1e-4,
        active=trouble > 0.1,
    )
    return replace(effect, lost=lost)
