"""Effects of shaking and turning."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from gyrostab.blindtest.generator import tool, vibration
from gyrostab.blindtest.generator.detection_limits import band_density
from gyrostab.blindtest.generator.measured_noise import BANDS
from gyrostab.blindtest.generator.noise_floor import white_level
from gyrostab.blindtest.generator.scenario import AXES, QUICK, Effect, World, to_samples
from gyrostab.blindtest.generator.shapes import (
    by_axis,
    mean_effect,
    named,
    on_axes,
    variance_effect,
)

__all__ = [
    "aliased_vibration",
    "earth_rate",
    "misalignment",
    "rotation_line",
    "scale_factor",
    "vibration_noise",
    "vibration_rectification",
]

Array = NDArray[np.float64]


def vibration_rectification(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Mean that shaking leaves: not quite a square, and saturating."""
    exponent = 2.0 if rng.random() < 0.4 else float(rng.uniform(1.6, 2.4))
    saturation = float(rng.choice([8.0, 15.0, np.inf, np.inf]))
    shape = vibration.rectify(world.vibration, exponent=exponent, saturation=saturation)
    return mean_effect(
        world,
        to_samples(world, shape),
        on_axes(rng),
        strength=strength,
        name="vibration_rectification",
        driver="vibration",
        form=f"power {exponent:.3g} of the rms, saturating at {saturation:g} g",
        differs=not (exponent == 2.0 and math.isinf(saturation)),
        active=world.busy,
        regressor=("sensitivity", to_samples(world, world.vibration**2), "deg/h/g^2"),
        unless=("quartic",),
    )


def _spans(active: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _shaken(
    world: World,
    rng: np.random.Generator,
    share: float,
    *,
    band: tuple[float, float],
    mount: tuple[Array, Array],
    kind: str,
) -> Array:
    """Angular shaking of one axis (time,) for 1 deg/h per g of rms, made at `vibration.FAST` where it shakes and logged."""
    out = np.zeros(world.size)
    for begin, end in _spans(world.busy) if share else []:
        first, last = round(begin * world.rate), min(round(end * world.rate), world.size)
        fast = vibration.band_noise(
            rng, round((last - first) * vibration.FAST / world.rate), low=band[0], high=band[1]
        )
        level = np.interp(
            np.arange(fast.size) / vibration.FAST + first / world.rate,
            np.arange(world.vibration.size),
            world.vibration,
        )
        logged = vibration.decimate(
            np.asarray(lfilter(*mount, fast * level)), rate=world.rate, kind=kind
        )
        out[first:last] = share * logged[: last - first]
    return out


def _shaking_noise(
    world: World,
    rng: np.random.Generator,
    *,
    strength: float,
    name: str,
    band: tuple[float, float],
    mount: tuple[Array, Array],
    kind: str,
    form: str,
) -> Effect:
    shares = on_axes(rng, alone=0.4)
    f = (np.arange(BANDS) + 0.5) * world.rate / 2 / BANDS
    density = vibration.folded_psd(
        f, rate=world.rate, kind=kind, low=band[0], high=band[1], mount=mount
    )
    base = band_density(world)
    power = np.where(world.busy, world.vibration, 0.0) ** 2
    unit = shares[:, None, None] ** 2 * power[None, :, None] * (density / base)[:, None, :]
    effect, amplitude = variance_effect(
        world,
        lambda a: 1 + a**2 * unit,
        strength=strength,
        name=name,
        axes=named(shares),
        driver="vibration",
        form=form,
        differs=True,
        first=1e-3,
        active=world.busy,
    )
    extra = np.stack(
        [
            amplitude * _shaken(world, rng, share, band=band, mount=mount, kind=kind)
            for share in shares
        ]
    )
    parameters: dict[str, Any] = {"sensitivity_at_4_khz": {"value": amplitude, "unit": "deg/h/g"}}
    if name == "vibration_noise":  # white noise of the same power is what a flat model should find
        white = by_axis(
            np.abs(shares), amplitude * math.sqrt(float(density.mean())) / white_level(1.0)
        )
        parameters["white"] = {
            "values": white,
            "unit": "deg/sqrt(h)/g",
            "unless": ["quantization", "exponent"],
        }
    return replace(effect, extra=extra, parameters=parameters)


def vibration_noise(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Angular shaking inside the band of the log, through a resonant mount and the logger's own filter."""
    low = rng.uniform(0.02, 0.1) * world.rate
    high = rng.uniform(0.3, 0.6) * world.rate
    resonance = rng.uniform(0.1, 0.4) * world.rate
    quality = rng.uniform(1.0, 6.0)
    kind = str(rng.choice(["fir", "cic2", "dump"]))
    form = f"{low:.2g}-{high:.3g} Hz through a mount of {resonance:.3g} Hz, Q {quality:.2g}, and a {kind} decimator"
    return _shaking_noise(
        world,
        rng,
        strength=strength,
        name="vibration_noise",
        band=(low, high),
        mount=vibration.mount_filter(resonance, quality=quality),
        kind=kind,
        form=form,
    )


def aliased_vibration(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Angular shaking far above the band of the log, folded down by a filter that does not stop it."""
    low = rng.uniform(max(1.3 * world.rate, 150.0), 900.0)
    high = low + rng.uniform(50.0, 300.0)
    resonance = rng.uniform(0.8 * low, 1.1 * high)
    kind = str(rng.choice(["point", "dump", "fir"]))
    form = f"{low:.0f}-{high:.0f} Hz through a mount of {resonance:.0f} Hz, folded by a {kind} decimator"
    return _shaking_noise(
        world,
        rng,
        strength=strength,
        name="aliased_vibration",
        band=(low, high),
        mount=vibration.mount_filter(resonance, quality=rng.uniform(3, 15)),
        kind=kind,
        form=form,
    )


def _angle(world: World, rng: np.random.Generator) -> Array:
    """Toolface at the samples [rad]."""
    return to_samples(
        world, tool.toolface(world.rotation, dt=QUICK, first=rng.uniform(0, 2 * math.pi)), dt=QUICK
    )


def _turn_tau(world: World) -> tuple[float, float]:
    fast = float(np.percentile(world.rotation[world.rotation > 0], 50)) / 360.0
    return max(1 / world.rate, 0.1 / fast), 3.0 / fast


def _turning(world: World) -> NDArray[np.bool_]:
    return np.asarray(
        np.interp(
            np.arange(world.temperature.size),
            np.arange(world.rotation.size) * QUICK,
            world.rotation,
        )
        > 1.0
    )


def earth_rate(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """What is left of the earth's rate on the two turning axes, a quarter of a turn apart; at rest it stays, at any angle."""
    x, y = tool.cross_axis(_angle(world, rng), across=1.0)
    effect = mean_effect(
        world,
        np.stack([x, y, np.zeros_like(x)]),
        np.array([1.0, 1.0, 0.0]),
        strength=strength,
        name="earth_rate",
        driver="rotation_rate",
        form="cosine and sine of the toolface",
        differs=False,
        tau=_turn_tau(world),
    )
    assert effect.mean is not None
    across = float(
        np.hypot(effect.mean[0], effect.mean[1]).max()
    )  # the earth's rate across the tool, of 15.041 deg/h at most
    if across < tool.EARTH_RATE:
        effect.parameters["latitude"] = {
            "value": math.degrees(math.acos(across / tool.EARTH_RATE)),
            "unit": "deg",
        }
    return effect


def rotation_line(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Harmonics of the turning that wax with its rate."""
    angle, shares = _angle(world, rng), on_axes(rng)
    speed = to_samples(world, world.rotation / world.rotation.max(), dt=QUICK)
    comb = sum(
        rng.uniform(0.3, 1.0) * np.sin(k * angle + rng.uniform(0, 6))
        for k in (1, 2, 3)[: int(rng.integers(1, 4))]
    )
    return mean_effect(
        world,
        np.asarray(comb * speed),
        shares,
        strength=strength,
        name="rotation_line",
        driver="rotation_rate",
        form="harmonics of the toolface, proportional to the speed",
        differs=True,
        tau=_turn_tau(world),
        active=_turning(world),
    )


def scale_factor(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """Error in proportion to the rotation rate, with a bend in half of the cases; the rotation itself has been taken out of the log."""
    bend = rng.random() < 0.5
    w = world.rotation / world.rotation.max()
    shape = w + (rng.uniform(0.3, 1.0) * w**3 if bend else 0.0)
    return mean_effect(
        world,
        to_samples(world, shape, dt=QUICK),
        np.array([0.0, 0.0, 1.0]),
        strength=strength,
        name="scale_factor",
        driver="rotation_rate",
        form="linear and cubic in the rotation rate"
        if bend
        else "proportional to the rotation rate",
        differs=bend,
        active=_turning(world),
        regressor=("linear", to_samples(world, world.rotation, dt=QUICK) * 3600.0 * 1e-6, "ppm"),
        unless=("asymmetry", "cubic"),
    )


def misalignment(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """The rate of z leaks into another axis; z itself shows a real, slow turning of the tool."""
    seconds, t = world.seconds, np.arange(world.temperature.size, dtype=float)
    turn = np.zeros_like(t)
    for _ in range(int(rng.integers(2, 5))):
        begin, length = rng.uniform(0.05, 0.7) * seconds, rng.uniform(0.05, 0.25) * seconds
        turn += rng.choice([-1, 1]) * np.exp(-0.5 * ((t - begin - length / 2) / (length / 4)) ** 2)
    shape = to_samples(world, turn)
    shares = np.zeros(3)
    shares[rng.integers(2)] = 1.0
    leak = mean_effect(
        world,
        shape,
        shares,
        strength=strength,
        name="misalignment",
        driver="other axes",
        form="in proportion to the rate of z",
        differs=False,
    )
    assert leak.mean is not None
    angle = float(rng.uniform(2e-4, 2e-3) * rng.choice([-1.0, 1.0]))
    mean = leak.mean.copy()
    mean[2] = mean[int(np.argmax(np.abs(shares)))] / angle
    parameters = leak.parameters | {
        "z": {"values": {AXES[int(np.argmax(shares))]: 1e3 * angle}, "unit": "mrad"}
    }
    return replace(leak, mean=mean, parameters=parameters, beside=("real_motion", "scale_factor"))
