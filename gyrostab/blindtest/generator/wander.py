"""Biases without a driver: telegraph, Gauss-Markov and ageing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.signal import lfilter

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    amplitude_for,
    learned_nats,
    learned_random_nats,
)
from gyrostab.blindtest.generator.noise import floor_psd
from gyrostab.blindtest.generator.scenario import (
    AXES,
    HiddenEffect,
    Scenario,
    count_per_second,
    to_samples,
)
from gyrostab.blindtest.generator.shapes import axes_with_share, draw_shares, make_mean_effect

_COST_DRAWS = 8  # of the noise, in the mean cost of a course; limits time


def wander_size(
    scenario: Scenario, shares: Floats, *, time: float, rms: float
) -> tuple[float, float]:
    """Compute size (in units of the limit) and evidence [nats] of a random bias.

    Only the power of a random bias can be known: at each frequency ``k / 2T`` of a record of length
    T, its density changes one log variance, and
    `gyrostab.blindtest.generator.detection_limits` gives the evidence for that. The bias has the
    correlation `time` [s], and the standard deviation `rms` [deg/h] times the share of an axis.
    """
    f = np.arange(1, min(scenario.size, math.ceil(20 * scenario.seconds / time) + 50)) / (
        2 * scenario.seconds
    )
    recorded_share = float((~scenario.missing).mean())
    size = nats = 0.0
    for share, noise in zip(shares, scenario.noise, strict=True):
        density = (share * rms) ** 2 * _lorentz_density(f, time)
        ratio = 1 + recorded_share * density / floor_psd(f, noise=noise, rate=scenario.rate)
        size += float((np.log(ratio) ** 2).sum())
        nats += 0.5 * float((ratio - 1 - np.log(ratio)).sum())
    return math.sqrt(size / 4 / NATS), nats


def _lorentz_density(f: Floats, time: float) -> Floats:
    """Return the two-sided density [1/Hz] of a bias of unit variance."""
    return 2 * time / (1 + (2 * math.pi * f * time) ** 2)


def _make_random_bias(
    scenario: Scenario,
    rng: np.random.Generator,
    waveform: Floats,
    *,
    strength: float,
    time: float,
    dwell: Floats | None = None,
    **description: Any,
) -> HiddenEffect:
    """Make a random bias: one of a normal law, or one of two levels with mean times `dwell` [s]."""
    shares = draw_shares(rng)
    rms = amplitude_for(
        lambda a: wander_size(scenario, shares, time=time, rms=a)[0], strength, first=1e-4
    )
    size, nats = wander_size(scenario, shares, time=time, rms=rms)
    mean = shares[:, None] * rms * to_samples(scenario, waveform)[None, :]
    learned = None
    if scenario.measured is None:
        learned = learned_random_nats(
            scenario, shares, lambda f: rms**2 * _lorentz_density(f, time)
        )
        if dwell is not None:
            cost = course_nats(scenario, rms * shares, waveform, dwell, rng.spawn(1)[0])
            learned = max(learned, learned_nats(scenario, mean) - cost)
    return HiddenEffect(
        axes=axes_with_share(shares),
        size=size,
        nats=nats,
        learned_nats=learned,
        tau=(max(1.0, 0.2 * time), scenario.seconds / 3),
        mean=mean,
        parameters={"correlation_time": {"value": time, "unit": "s"}},
        **description,
    )


def course_nats(
    scenario: Scenario,
    amplitude: Floats,
    waveform: Floats,
    dwell: Floats,
    rng: np.random.Generator,
) -> float:
    """Estimate the evidence that an unknown course of two levels costs [nats].

    It is the mutual information of the course and the record: how much more likely the record is
    with the course known than with only its law known, in the mean over the noise. The law is that
    of random switching with mean times `dwell` (2,) [s] on the lower and on the upper level. Only
    white noise counts, of means over seconds. `amplitude` (axis,) [deg/h] multiplies the `waveform`
    (second,).
    """
    is_upper = waveform > waveform.mean()
    step = amplitude * np.ptp(waveform)
    density = np.array(
        [
            floor_psd(np.ones(1), noise={"N": noise["N"]}, rate=scenario.rate)[0]
            for noise in scenario.noise
        ]
    )
    # the log odds of the upper level by the record of a second are normal, with this variance
    information = float((step**2 / density).sum()) * count_per_second(scenario) / scenario.rate
    odds = (is_upper - 0.5) * information + np.sqrt(information) * rng.standard_normal(
        (_COST_DRAWS, is_upper.size)
    )
    rises, falls = -np.expm1(-1.0 / dwell)
    upper, log_evidence = np.full(_COST_DRAWS, dwell[1] / dwell.sum()), np.zeros(_COST_DRAWS)
    for log_odds in odds.T:
        upper = upper * (1.0 - falls) + (1.0 - upper) * rises
        raised = np.logaddexp(np.log1p(-upper), np.log(upper) + log_odds)
        log_evidence += raised
        upper = np.exp(np.log(upper) + log_odds - raised)
    return float((odds @ is_upper - log_evidence).mean())


def _draw_correlation_time(scenario: Scenario, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(10.0), np.log(max(20.0, 0.05 * scenario.seconds)))))


def gauss_markov(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a Gauss-Markov bias, in half of the cases of second order."""
    time, heavy = _draw_correlation_time(scenario, rng), bool(rng.random() < 0.5)
    keep, settle = math.exp(-1 / time), math.ceil(10 * time)
    size = scenario.temperature.size
    push = rng.standard_normal(size + settle)
    keep = math.exp(-2 / time) if heavy else keep
    for _ in range(2 if heavy else 1):
        push = lfilter([1.0], [1.0, -keep], push)
    waveform = push[settle:] / push.std()
    form = f"{'second' if heavy else 'first'} order, {time:.0f} s"
    return _make_random_bias(
        scenario,
        rng,
        waveform,
        strength=strength,
        time=time,
        form=form,
        form_differs=heavy,
    )


def telegraph(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias that switches between two levels, in half of the cases with gamma dwell times."""
    time, gamma = _draw_correlation_time(scenario, rng), bool(rng.random() < 0.5)
    occupancy = rng.uniform(0.25, 0.75)
    dwell = np.array([time / occupancy, time / (1 - occupancy)])  # 1 / time is the sum of the rates
    size, t = scenario.temperature.size, 0.0
    waveform, level = np.zeros(size), int(rng.integers(2))
    while t < size:
        stay = rng.gamma(4.0, dwell[level] / 4) if gamma else rng.exponential(dwell[level])
        waveform[int(t) : int(t + stay) + 1] = level
        t, level = t + stay, 1 - level
    waveform = (waveform - waveform.mean()) / math.sqrt(occupancy * (1 - occupancy))
    form = f"two levels, {dwell[0]:.0f} and {dwell[1]:.0f} s" + (", of gamma law" if gamma else "")
    return _make_random_bias(
        scenario,
        rng,
        waveform,
        strength=strength,
        time=time,
        form=form,
        form_differs=gamma,
        dwell=dwell,
    )


def ageing_bias(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias that drifts linearly, logarithmically or with a power of time."""
    kind = str(rng.choice(["line", "logarithm", "power"]))
    t = np.arange(scenario.temperature.size, dtype=float)
    first, power = rng.uniform(0.02, 0.3) * scenario.seconds, float(rng.choice([0.5, 1.6, 2.0]))
    shape = {"line": t, "logarithm": np.log1p(t / first), "power": t**power}[kind]
    shares = draw_shares(rng)
    effect = make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        shares,
        strength=strength,
        form={
            "line": "a line",
            "logarithm": f"logarithm, {first:.0f} s",
            "power": f"power {power:g} of time",
        }[kind],
        form_differs=kind == "power",
    )
    if kind == "line" and effect.mean is not None:
        slope = (effect.mean[:, -1] - effect.mean[:, 0]) / scenario.seconds * 86400.0
        effect.parameters["slope"] = {
            "values": dict(zip(AXES, slope.tolist(), strict=True)),
            "unit": "deg/h/day",
        }
    return effect
