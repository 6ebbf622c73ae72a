"""Effects of temperature and age: through the coil, through the light, through the memory of the parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.blindtest.generator import coil, light
from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.scenario import AXES, Effect, World, to_samples
from gyrostab.blindtest.generator.shapes import mean_effect, named, on_axes, variance_effect

__all__ = [
    "ageing_noise",
    "light_power_noise",
    "shupe",
    "temperature_bias",
    "temperature_noise",
    "thermal_hysteresis",
    "warm_up",
]

Array = NDArray[np.float64]


def shupe(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Heat that walks through the layers of a quadrupole winding."""
    layers = int(rng.choice([16, 24, 32]))
    weights = coil.layer_weights(
        layers, trim=rng.normal(0, 3e-4), scatter=rng.normal(0, 2e-4, layers)
    )
    thickness = rng.uniform(0.004, 0.022)
    padded = np.concatenate([np.full(50, world.temperature[0]), world.temperature])
    speed = np.gradient(
        coil.layer_temperatures(padded, dt=1.0, layers=layers, thickness=thickness), axis=1
    )[:, 50:]
    shape = to_samples(world, weights @ speed)
    form = f"diffusion through {layers} layers, slowest mode {coil.diffusion_time(thickness, 2.2e-7):.0f} s"
    shares = on_axes(rng)
    effect = mean_effect(
        world,
        shape,
        shares,
        strength=strength,
        name="shupe",
        driver="temperature",
        form=form,
        differs=True,
    )
    steady = (
        float(weights.sum()) / 60.0 / float(np.abs(shape).max())
    )  # what 1 K/min gives for good, beside the largest value
    largest = {axis: float(np.abs(row).max()) for axis, row in zip(AXES, effect.mean, strict=True)}  # type: ignore[arg-type]
    signs = {
        axis: float(np.sign(share)) * steady * largest[axis]
        for axis, share in zip(AXES, shares, strict=True)
        if share
    }
    effect.parameters["sensitivity"] = {"values": signs, "unit": "deg/h/(degC/min)"}
    return effect


def temperature_bias(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Bias that follows the temperature, linearly or with a bend."""
    bend = rng.random() < 0.5
    t = world.temperature - world.temperature.mean()
    shape = np.tanh(t / (0.6 * np.abs(t).max())) if bend else t
    form = "tanh of the temperature" if bend else "proportional to the temperature"
    regressor = ("sensitivity", to_samples(world, t), "deg/h/degC")
    return mean_effect(
        world,
        to_samples(world, shape),
        on_axes(rng),
        strength=strength,
        name="temperature_bias",
        driver="temperature",
        form=form,
        differs=bend,
        regressor=regressor,
        unless=("quadratic", "cubic"),
    )


def _play(values: Array, width: float) -> Array:
    out = np.empty_like(values)
    last = values[0]
    for i, value in enumerate(values):
        last = min(max(last, value - width), value + width)
        out[i] = last
    return out


def thermal_hysteresis(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Bias that lags behind in temperature: one play, or many of different widths."""
    many = rng.random() < 0.7
    span = float(np.ptp(world.temperature))
    widths = span * (np.linspace(0.04, 0.35, 8) if many else np.array([rng.uniform(0.05, 0.3)]))
    shares = rng.dirichlet(np.ones(widths.size))
    loop = sum(
        share * (world.temperature - _play(world.temperature, width))
        for share, width in zip(shares, widths, strict=True)
    )
    shares = on_axes(rng)
    effect = mean_effect(
        world,
        to_samples(world, np.asarray(loop)),
        shares,
        strength=strength,
        name="thermal_hysteresis",
        driver="temperature",
        form="eight plays of different widths" if many else "one play",
        differs=many,
    )
    if not many and effect.mean is not None:
        largest = float(np.abs(np.asarray(loop)).max())
        slopes = {
            a: float(np.sign(r) * np.abs(row).max()) / largest
            for a, r, row in zip(AXES, shares, effect.mean, strict=True)
            if r
        }
        effect.parameters["sensitivity"] = {"values": slopes, "unit": "deg/h/degC"}
        effect.parameters["width"] = {"value": float(widths[0]), "unit": "degC"}
    return effect


def since_power_on(world: World) -> Array:
    """Time since the power came [s], one value a second; a cut of it begins a new count."""
    t = np.arange(world.temperature.size, dtype=float)
    since = t.copy()
    for _, end in world.cuts:
        since = np.where(t >= end, t - end, since)
    return since


def warm_up(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Bias that dies away after every start: exponential, stretched, or as a power of time."""
    kind = rng.choice(["exponential", "stretched", "power"])
    tau = float(np.exp(rng.uniform(np.log(0.015), np.log(0.25)))) * world.seconds
    x = since_power_on(world) / tau
    shape = {
        "exponential": np.exp(-x),
        "stretched": np.exp(-(x**0.6)),
        "power": 1 / (1 + x) ** 1.5,
    }[str(kind)]
    shares = on_axes(rng)
    effect = mean_effect(
        world,
        to_samples(world, shape),
        shares,
        strength=strength,
        name="warm_up",
        driver=None,
        form=f"{kind}, {tau:.0f} s",
        differs=bool(kind != "exponential"),
        active=x < 2,
    )
    if kind == "exponential" and effect.mean is not None:
        first = {
            axis: float(np.sign(share) * np.abs(row).max())
            for axis, share, row in zip(AXES, shares, effect.mean, strict=True)
            if share
        }
        effect.parameters["amplitude"] = {
            "values": first,
            "unit": "deg/h",
            "unless": ["slow_amplitude"],
        }
        effect.parameters["time"] = {"value": tau, "unit": "s", "unless": ["slow_amplitude"]}
    return effect


def _through_power(
    world: World,
    rng: np.random.Generator,
    *,
    strength: float,
    loss: Array,
    name: str,
    driver: str,
    form: str,
    differs: bool,
) -> Effect:
    """Noise of axes whose light has the `loss` [dB], in units of a wanted scale, and their white level by the budget of the detector."""
    shares = np.abs(on_axes(rng, alone=0.4))
    power = 10 ** rng.uniform(-6.0, -4.6)
    budget = {"rin": 10 ** rng.uniform(-13.5, -12.3)}
    before = light.relative_psd(np.array([power]), **budget)[0]

    def ratio(amplitude: float) -> Array:
        drop = np.clip(amplitude * shares[:, None] * loss[None, :], -20, 20)
        return np.asarray(light.relative_psd(power * 10 ** (-drop / 10), **budget) / before)

    effect, _ = variance_effect(
        world,
        ratio,
        strength=strength,
        name=name,
        axes=named(shares),
        driver=driver,
        form=form,
        differs=differs,
        first=1e-4,
    )
    return effect


def temperature_noise(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Light lost by heat, and the noise that this gives at the detector."""
    t = world.temperature
    curved = rng.random() < 0.5
    loss = light.loss_db(
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
    return _through_power(
        world,
        rng,
        strength=strength,
        loss=loss,
        name="temperature_noise",
        driver="temperature",
        form=form,
        differs=curved,
    )


def ageing_noise(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Light lost with time, as a power of it."""
    power = float(rng.choice([0.5, 1.0, 1.5]))
    hours = np.arange(world.temperature.size) / 3600.0
    loss = light.loss_db(
        np.full(hours.size, 40.0), hours, per_kelvin=0.0, per_hour=1.0, power=power
    )
    form = f"loss of light with the power {power:g} of time, detector budget"
    return _through_power(
        world,
        rng,
        strength=strength,
        loss=loss,
        name="ageing_noise",
        driver="time",
        form=form,
        differs=power != 1.0,
    )


def light_power_noise(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Noise of the detector under light that comes and goes; the power is a channel."""
    loss = -10 * np.log10(lag(world.light, rng.uniform(0, 5)))
    form = "shot, thermal and excess noise"
    return _through_power(
        world,
        rng,
        strength=strength,
        loss=loss,
        name="light_power_noise",
        driver="light_power",
        form=form,
        differs=True,
    )
