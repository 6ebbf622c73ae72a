"""Effects that are in no catalogue: a diagnosis should detect them and leave them unidentified."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.scenario import HiddenEffect, Scenario, stream, to_samples
from gyrostab.blindtest.generator.shapes import (
    axes_with_share,
    draw_shares,
    make_mean_effect,
    make_variance_effect,
)


def breathing_noise(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a periodic noise level without a driver."""
    period = rng.uniform(0.05, 0.2) * scenario.seconds
    t = np.arange(scenario.temperature.size)
    swell = np.sin(
        2 * math.pi * t / period
        + rng.uniform(0, 6)
        + 0.8 * np.sin(2 * math.pi * t / (3.7 * period))
    )
    shares = np.abs(draw_shares(rng, single_probability=0.5))
    effect, _ = make_variance_effect(
        scenario,
        lambda a: np.exp(a * shares[:, None] * swell[None, :]),
        strength=strength,
        axes=axes_with_share(shares),
        form=f"log variance as a wandering sine of {period:.0f} s",
        form_differs=True,
        first=1e-4,
    )
    return effect


def chirped_line(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a line that drifts through a part of the band."""
    low, high = np.sort(rng.uniform(0.05, 0.4, 2)) * scenario.rate
    t = np.arange(scenario.size) / scenario.rate
    frequency = low + (high - low + 0.02 * scenario.rate) * (t / scenario.seconds) ** rng.uniform(
        0.6, 1.8
    )
    return make_mean_effect(
        scenario,
        np.sin(2 * math.pi * np.cumsum(frequency) / scenario.rate),
        draw_shares(rng),
        strength=strength,
        form=f"{low:.3g} to {high + 0.02 * scenario.rate:.3g} Hz",
        form_differs=True,
        tau=(1 / scenario.rate, 2 / low),
    )


def slow_memory(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias that follows hidden doses and decays as a power of time."""
    dose = rng.random(scenario.temperature.size) < 4.0 / scenario.seconds
    dose[int(rng.uniform(0.1, 0.6) * dose.size)] = True
    age = np.arange(scenario.temperature.size, dtype=float)
    kernel = (1 + age / 30.0) ** -0.4 * (1 - np.exp(-age / 50.0))
    signs = np.where(rng.random(dose.size) < 0.5, -1.0, 1.0)
    shape = np.convolve(dose * signs, kernel)[: dose.size]
    return make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        draw_shares(rng),
        strength=strength,
        form="slow rise and fall, power 0.4 of time, after hidden doses",
        form_differs=True,
    )


def three_levels(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias that switches between three levels."""
    dwell = rng.uniform(0.03, 0.1) * scenario.seconds
    switches = rng.random(scenario.temperature.size) < 1 / dwell
    switches[int(rng.uniform(0.3, 0.6) * switches.size)] = True
    levels, level = np.array([-1.0, 0.1, 1.0]), int(rng.integers(3))
    out = np.empty(switches.size)
    for i, switch in enumerate(switches):
        if switch:
            level = (level + int(rng.integers(1, 3))) % 3
        out[i] = levels[level]
    return make_mean_effect(
        scenario,
        to_samples(scenario, out),
        draw_shares(rng),
        strength=strength,
        form=f"levels -1, 0.1, 1; {dwell:.0f} s on each",
        form_differs=True,
        also_accepted=("telegraph",),
    )


def informative_gaps(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a noise level that rises together with the loss of frames."""
    trouble = lag(
        np.abs(
            lag(
                stream(int(rng.integers(2**31)), "trouble").normal(0, 6, scenario.temperature.size),
                15.0,
            )
        ),
        10.0,
    )
    trouble = np.maximum(trouble - np.percentile(trouble, 60), 0.0)
    trouble /= trouble.max()
    shares = np.abs(draw_shares(rng, single_probability=0.3))
    lost = np.repeat(rng.random(trouble.size) < 0.7 * trouble, math.ceil(scenario.rate))[
        : scenario.size
    ]
    lost = lfilter(np.ones(3), [1.0], lost.astype(float)) > 0
    lost[: round(5 * scenario.rate)] = lost[-round(5 * scenario.rate) :] = False
    gone = replace(scenario, missing=scenario.missing | lost)
    effect, _ = make_variance_effect(
        gone,
        lambda a: 1 + a * shares[:, None] * trouble[None, :],
        strength=strength,
        axes=axes_with_share(shares),
        form="variance and loss of frames rise together",
        form_differs=True,
        first=1e-4,
        active=trouble > 0.1,
    )
    return replace(effect, lost=lost)
