"""Effects of supply, light source, feedback loop, logger and telemetry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import fft
from scipy.signal import lfilter

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator import instrument, telemetry
from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    NATS_PER_SAMPLE,
    amplitude_for,
    filtered_density,
    learned_filter_nats,
    shared_size,
)
from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.noise import BANDS
from gyrostab.blindtest.generator.scenario import AXES, HiddenEffect, Scenario, to_samples
from gyrostab.blindtest.generator.shapes import (
    axes_with_share,
    draw_shares,
    fit_lagged_driver,
    make_mean_effect,
    make_variance_effect,
    sample_sd,
    scale_by_axis,
)

_FREQUENCIES = 200 * BANDS  # of the spectrum of a source
_MAX_SHARE = math.sqrt(0.8)  # of a source in the noise of an axis, as an amplitude
_MAX_FILTER_WEIGHT = 0.45  # of the other samples in the output of a filter


def spectral_line(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a spectral line of constant phase, or one whose phase wanders slowly."""
    frequency = float(np.exp(rng.uniform(np.log(0.005), np.log(0.48)))) * scenario.rate
    wander = rng.random() < 0.5
    phase = 2 * math.pi * frequency * np.arange(scenario.size) / scenario.rate
    if wander:
        phase = phase + np.cumsum(
            rng.normal(0, math.sqrt(1.0 / (scenario.seconds * scenario.rate)), scenario.size)
        )
    shares = draw_shares(rng)
    effect = make_mean_effect(
        scenario,
        np.sin(phase + rng.uniform(0, 6)),
        shares,
        strength=strength,
        form="sine with a phase that wanders by a radian" if wander else "sine",
        form_differs=wander,
        tau=(max(1 / scenario.rate, 0.1 / frequency), 2 / frequency),
        parameters={
            "frequency": {
                "value": (phase[-1] - phase[0])
                / (2 * math.pi * (scenario.seconds - 1 / scenario.rate)),
                "unit": "Hz",
            }
        },
    )
    # A diagnosis states the amplitude of a sine whose means over the samples these values are.
    amplitude = float(effect.parameters["peak"]["value"]) / np.sinc(frequency / scenario.rate)
    effect.parameters["amplitude"] = {
        "values": scale_by_axis(np.abs(shares), amplitude),
        "unit": "deg/h",
    }
    return effect


def supply_bias(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias that follows the supply, in half of the cases slowly and nonlinearly."""
    slow = rng.random() < 0.5
    v = scenario.supply - scenario.supply.mean()
    shape = lag(v - 0.3 * np.minimum(v, 0) ** 2, rng.uniform(5, 120)) if slow else v
    effect = make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        draw_shares(rng),
        strength=strength,
        form="slow and bent" if slow else "proportional to the voltage",
        form_differs=slow,
        regressor=("voltage", to_samples(scenario, v), "deg/h/V"),
    )
    if slow and effect.mean is not None:  # the diagnosis fits a linear response with a lag
        fits = {
            axis: fit_lagged_driver(
                scenario, effect.mean[AXES.index(axis)], v, axis=AXES.index(axis)
            )
            for axis in effect.axes
        }
        effect.parameters["voltage"] = {
            "values": {axis: slope for axis, (slope, _) in fits.items()},
            "unit": "deg/h/V",
        }
        effect.parameters["lag"] = {
            "values": {axis: late for axis, (_, late) in fits.items()},
            "unit": "s",
        }
    return effect


def bias_jump(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias step after every power cut, in half of the cases with a settling tail."""
    tail = rng.random() < 0.5
    t = np.arange(scenario.temperature.size, dtype=float)
    shape = np.zeros_like(t)
    for _, end in scenario.cuts:
        jump = rng.choice([-1, 1]) * rng.uniform(0.4, 1.0)
        settle = 0.3 * np.exp(-np.maximum(t - end, 0) / 60.0) if tail else 0.0
        shape += np.where(t >= end, jump * (1 + settle), 0.0)
    return make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        draw_shares(rng),
        strength=strength,
        form="step with a settling tail at every start" if tail else "step at every start",
        form_differs=tail,
    )


def feedback_reset(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw an error that follows every imperfect 2 pi reset of the ramp and decays with phase."""
    rate = rng.uniform(0.3, 1.0) * min(15.0, 15.0 * scenario.rate / 8)
    axis = int(rng.integers(3))
    wander = 1 + 0.02 * np.sin(
        2 * math.pi * np.arange(scenario.size) / scenario.rate / rng.uniform(100, 900)
    )
    phase = instrument.ramp_phase(rate * wander, dt=1 / scenario.rate, first=rng.random())
    settle = rng.uniform(0.03, 0.25)
    shares = np.zeros(3)
    shares[axis] = 1.0
    resets = float(instrument.reset_frequency(np.array(rate)))
    return make_mean_effect(
        scenario,
        instrument.reset_error(phase, settle=settle),
        shares,
        strength=strength,
        form=f"exponential in {settle:.2f} of the ramp, at {resets:.2f} resets a second",
        form_differs=True,
        tau=(1 / scenario.rate, 2 / resets),
        ramp=phase,
    )


def _low_pass(frequency: Floats, corner: float) -> Floats:
    """Compute the power gain at frequencies, like `corner` in units of the Nyquist frequency."""
    return np.asarray(1 / (1 + (frequency / corner) ** 4))


def _low_passed(rng: np.random.Generator, size: int, *, corner: float) -> Floats:
    frequency = np.arange(size // 2 + 1) / (size / 2)
    lines = fft.rfft(rng.standard_normal(size)) * np.sqrt(_low_pass(frequency, corner))
    common = fft.irfft(lines, size)
    return np.asarray(common / common.std())


def shared_source(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw excess noise of one source in all axes; no single axis shows it."""
    coloured = rng.random() < 0.5
    corner = rng.uniform(0.3, 0.8) if coloured else math.inf
    shares = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.6, 1.0, 3)
    if rng.random() < 0.3:
        shares[rng.integers(3)] = 0.0
    power = _low_pass((np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES, corner)
    power /= power.mean()

    def size_of(level: float) -> float:
        return shared_size(scenario, min(level, _MAX_SHARE) * shares, power)

    shares = shares * min(amplitude_for(size_of, strength, first=1e-2), _MAX_SHARE)
    size = shared_size(scenario, shares, power)
    return HiddenEffect(
        axes=axes_with_share(shares),
        form=f"common noise low-passed at {corner:.2f} of Nyquist"
        if coloured
        else "white common noise",
        form_differs=coloured,
        size=size,
        nats=NATS * size**2,
        tau=(1 / scenario.rate, 30.0),
        common=shares[:, None] * _low_passed(rng, scenario.size, corner=corner),
        parameters={
            "correlation": {
                "value": float(np.abs(np.triu(np.outer(shares, shares), 1)).max()),
                "unit": "1",
            },
            "N": {  # far below the corner
                "values": {
                    a: abs(float(r)) * n["N"] * math.sqrt(power[0])
                    for a, r, n in zip(AXES, shares, scenario.noise, strict=True)
                    if r
                },
                "unit": "deg/sqrt(h)",
            },
        },
    )


def logger_filter(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw an undocumented short smoothing filter in the logger."""
    kind = str(rng.choice(["three", "pole", "mean"]))

    def taps(a: float) -> Floats:
        a = min(a, _MAX_FILTER_WEIGHT)
        return {
            "three": np.array([a / 2, 1 - a, a / 2]),
            "pole": (1 - a) * a ** np.arange(25),
            "mean": np.array([1 - a, a]),
        }[kind]

    f = (np.arange(200) + 0.5) / 200 * math.pi
    unfiltered = filtered_density(scenario, np.ones(f.size))

    def power_gain(a: float) -> Floats:
        response = np.exp(-1j * f[:, None] * np.arange(taps(a).size)) @ taps(a)
        return np.asarray(np.maximum(np.abs(response) ** 2, 1e-12))

    def ratio(a: float) -> Floats:
        change = filtered_density(scenario, power_gain(a)) / unfiltered
        mean = np.exp(np.log(change).mean(axis=1, keepdims=True))
        return np.asarray((change / mean)[:, None, :])  # the level before the filter is unknown

    effect, amplitude = make_variance_effect(
        scenario,
        ratio,
        strength=strength,
        axes=AXES,
        form={
            "three": "three weights",
            "pole": "one pole",
            "mean": "mean of two neighbours, unequal",
        }[kind],
        form_differs=kind != "pole",
        first=1e-4,
        tau=(1 / scenario.rate, 10 / scenario.rate),
    )
    weights = taps(amplitude)

    def after(record: Floats) -> Floats:
        first = record[:, :1]
        return np.asarray(first + lfilter(weights, [weights.sum()], record - first, axis=1))

    weight = min(amplitude, _MAX_FILTER_WEIGHT)
    parameters = {"weight": {"value": weight, "unit": "1"}}
    if kind == "pole":
        parameters["cutoff"] = {
            "value": -math.log(weight) * scenario.rate / (2 * math.pi),
            "unit": "Hz",
            "unless": ["length"],
        }
    learned = (
        learned_filter_nats(scenario, power_gain(amplitude)) if scenario.measured is None else None
    )
    return replace(effect, after=after, parameters=parameters, learned_nats=learned)


def spikes(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw flipped bits; a spike is worth its chi-square less the log of its possible places."""
    axis = int(rng.integers(3))
    sd = sample_sd(scenario, axis)
    n = int((~scenario.missing).sum())
    number = int(rng.integers(2, 25))
    worth = NATS * strength**2 / number + math.log(n)
    lsb = sd * math.sqrt(2 * worth) / 2**12
    seed = int(rng.integers(2**31))

    def after(record: Floats) -> Floats:
        out = record.copy()
        gone = np.where(scenario.missing, np.nan, record[axis])
        flipped, where = telemetry.flip_bits(
            np.random.default_rng(seed), gone, number=number, lsb=lsb, bit=12
        )
        out[axis, where] = flipped[where]
        return out

    return HiddenEffect(
        axes=(AXES[axis],),
        form=f"{number} flips of bit 12",
        form_differs=True,
        size=strength,
        nats=NATS * strength**2,
        tau=(1 / scenario.rate, 10 / scenario.rate),
        after=after,
        parameters={
            "spike": {"value": lsb * 2**12, "unit": "deg/h"},
            "number": {"value": number, "unit": "1"},
            "per_hour": {"value": number / (n / scenario.rate / 3600.0), "unit": "1/h"},
        },
    )


def held_samples(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw repeated frames or samples; few suffice, as noise alone never repeats a value."""
    samples = max(1, round(NATS * strength**2 / NATS_PER_SAMPLE))
    number = max(1, round(samples / max(3, int(rng.uniform(0.05, 0.4) * scenario.rate))))
    frame = max(1, round(samples / number))
    hold = bool(rng.random() < 0.6)
    starts = telemetry.choose_frames(rng, scenario.missing, number=number, frame=frame)
    nats = starts.size * frame * NATS_PER_SAMPLE
    hours = float((~scenario.missing).sum()) / scenario.rate / 3600.0
    held = {
        "per_hour": {"value": starts.size / hours, "unit": "1/h"},
        "length": {"value": frame / scenario.rate, "unit": "s"},
    }
    return HiddenEffect(
        axes=AXES,
        form=f"{starts.size} frames of {frame} samples " + ("held" if hold else "sent twice"),
        form_differs=not hold,
        size=math.sqrt(nats / NATS),
        nats=nats,
        tau=(1 / scenario.rate, 2 * frame / scenario.rate),
        after=lambda record: telemetry.repeat_frames(record, starts, frame=frame, hold=hold),
        parameters={
            "number": {"value": int(starts.size), "unit": "1"},
            "frame": {"value": frame, "unit": "1"},
        }
        | (held if hold else {}),
    )
