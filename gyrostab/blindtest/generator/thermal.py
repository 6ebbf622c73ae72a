"""Effects of temperature and age through the coil, the light and thermal hysteresis."""

from __future__ import annotations

from typing import Any

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator import instrument
from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.scenario import HiddenEffect, Scenario, to_samples
from gyrostab.blindtest.generator.shapes import (
    axes_with_share,
    draw_shares,
    make_mean_effect,
    make_variance_effect,
    signed_peaks,
)


def shupe(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a Shupe effect: heat conduction through the layers of a quadrupole winding."""
    layers = int(rng.choice([16, 24, 32]))
    weights = instrument.layer_weights(
        layers, trim=rng.normal(0, 3e-4), scatter=rng.normal(0, 2e-4, layers)
    )
    thickness = rng.uniform(0.004, 0.022)
    padded = np.concatenate([np.full(50, scenario.temperature[0]), scenario.temperature])
    speed = np.gradient(
        instrument.layer_temperatures(padded, dt=1.0, layers=layers, thickness=thickness), axis=1
    )[:, 50:]
    shape = to_samples(scenario, weights @ speed)
    slowest = instrument.diffusion_time(thickness, 2.2e-7)
    form = f"diffusion through {layers} layers, slowest mode {slowest:.0f} s"
    shares = draw_shares(rng)
    effect = make_mean_effect(
        scenario, shape, shares, strength=strength, form=form, form_differs=True
    )
    # steady response to 1 K/min over the largest value
    steady = float(weights.sum()) / 60.0 / float(np.abs(shape).max())
    values = {axis: steady * peak for axis, peak in signed_peaks(effect, shares).items()}
    effect.parameters["sensitivity"] = {"values": values, "unit": "deg/h/(degC/min)"}
    return effect


def temperature_bias(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a bias that follows the temperature, linearly or nonlinearly."""
    bend = rng.random() < 0.5
    t = scenario.temperature - scenario.temperature.mean()
    shape = np.tanh(t / (0.6 * np.abs(t).max())) if bend else t
    form = "tanh of the temperature" if bend else "proportional to the temperature"
    regressor = ("sensitivity", to_samples(scenario, t), "deg/h/degC")
    return make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        draw_shares(rng),
        strength=strength,
        form=form,
        form_differs=bend,
        regressor=regressor,
        unless=("quadratic", "cubic"),
    )


def _apply_dead_band(values: Floats, width: float) -> Floats:
    out = np.empty_like(values)
    last = values[0]
    for i, value in enumerate(values):
        last = min(max(last, value - width), value + width)
        out[i] = last
    return out


def thermal_hysteresis(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a temperature hysteresis with one dead band, or several of different widths."""
    many = rng.random() < 0.7
    span = float(np.ptp(scenario.temperature))
    widths = span * (np.linspace(0.04, 0.35, 8) if many else np.array([rng.uniform(0.05, 0.3)]))
    shares = rng.dirichlet(np.ones(widths.size))
    loop = sum(
        share * (scenario.temperature - _apply_dead_band(scenario.temperature, width))
        for share, width in zip(shares, widths, strict=True)
    )
    shares = draw_shares(rng)
    effect = make_mean_effect(
        scenario,
        to_samples(scenario, np.asarray(loop)),
        shares,
        strength=strength,
        form="eight dead bands of different widths" if many else "one dead band",
        form_differs=many,
    )
    if not many:
        largest = float(np.abs(np.asarray(loop)).max())
        slopes = {axis: peak / largest for axis, peak in signed_peaks(effect, shares).items()}
        effect.parameters["sensitivity"] = {"values": slopes, "unit": "deg/h/degC"}
        effect.parameters["width"] = {"value": float(widths[0]), "unit": "degC"}
    return effect


def _since_power_on(scenario: Scenario) -> Floats:
    """Compute the time since the last power-on [s], one value a second."""
    t = np.arange(scenario.temperature.size, dtype=float)
    since = t.copy()
    for _, end in scenario.cuts:
        since = np.where(t >= end, t - end, since)
    return since


def warm_up(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a bias that decays after every start: exponential, stretched, or a power of time."""
    kind = rng.choice(["exponential", "stretched", "power"])
    tau = float(np.exp(rng.uniform(np.log(0.015), np.log(0.25)))) * scenario.seconds
    x = _since_power_on(scenario) / tau
    shape = {
        "exponential": np.exp(-x),
        "stretched": np.exp(-(x**0.6)),
        "power": 1 / (1 + x) ** 1.5,
    }[str(kind)]
    shares = draw_shares(rng)
    effect = make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        shares,
        strength=strength,
        form=f"{kind}, {tau:.0f} s",
        form_differs=bool(kind != "exponential"),
        active=x < 2,
    )
    if kind == "exponential":
        effect.parameters["amplitude"] = {
            "values": signed_peaks(effect, shares),
            "unit": "deg/h",
            "unless": ["slow_amplitude"],
        }
        effect.parameters["time"] = {"value": tau, "unit": "s", "unless": ["slow_amplitude"]}
    return effect


def _make_light_noise(
    scenario: Scenario,
    rng: np.random.Generator,
    *,
    strength: float,
    loss: Floats,
    **description: Any,
) -> HiddenEffect:
    """Make a noise effect from a scalable `loss` of light [dB] by the budget of the detector."""
    shares = np.abs(draw_shares(rng, single_probability=0.4))
    power = 10 ** rng.uniform(-6.0, -4.6)
    budget = {"rin": 10 ** rng.uniform(-13.5, -12.3)}
    nominal = instrument.relative_psd(np.array([power]), **budget)[0]

    def ratio(amplitude: float) -> Floats:
        drop = np.clip(amplitude * shares[:, None] * loss[None, :], -20, 20)
        return np.asarray(instrument.relative_psd(power * 10 ** (-drop / 10), **budget) / nominal)

    effect, _ = make_variance_effect(
        scenario, ratio, strength=strength, axes=axes_with_share(shares), first=1e-4, **description
    )
    return effect


def temperature_noise(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a noise level that follows temperature through the loss of light."""
    t = scenario.temperature
    curved = rng.random() < 0.5
    loss = instrument.loss_db(
        t - t.mean() + 40.0,
        np.zeros(t.size),
        per_kelvin=1.0,
        curvature=rng.uniform(0.01, 0.05) if curved else 0.0,
    )
    form = (
        "loss of light with temperature and its square, detector budget"
        if curved
        else "loss of light with temperature, detector budget"
    )
    return _make_light_noise(
        scenario, rng, strength=strength, loss=loss, form=form, form_differs=curved
    )


def ageing_noise(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a noise level that grows with time as light is lost."""
    power = float(rng.choice([0.5, 1.0, 1.5]))
    hours = np.arange(scenario.temperature.size) / 3600.0
    loss = instrument.loss_db(
        np.full(hours.size, 40.0), hours, per_kelvin=0.0, per_hour=1.0, power=power
    )
    form = f"loss of light with the power {power:g} of time, detector budget"
    return _make_light_noise(
        scenario, rng, strength=strength, loss=loss, form=form, form_differs=power != 1.0
    )


def light_power_noise(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw the noise of a detector under varying light power, which is a channel."""
    loss = -10 * np.log10(lag(scenario.light, rng.uniform(0, 5)))
    form = "shot, thermal and excess noise"
    return _make_light_noise(
        scenario, rng, strength=strength, loss=loss, form=form, form_differs=True
    )
