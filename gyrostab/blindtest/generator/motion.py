"""Effects of vibration and rotation."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from gyrostab.arrays import Bools, Floats
from gyrostab.blindtest.generator import instrument, telemetry
from gyrostab.blindtest.generator.detection_limits import band_density, learned_nats
from gyrostab.blindtest.generator.noise import BANDS, white_level
from gyrostab.blindtest.generator.scenario import (
    AXES,
    ROTATION_STEP_S,
    HiddenEffect,
    Scenario,
    to_samples,
)
from gyrostab.blindtest.generator.shapes import (
    axes_with_share,
    draw_shares,
    make_mean_effect,
    make_variance_effect,
    scale_by_axis,
)


def vibration_rectification(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a vibration rectification: a power of the rms near 2, with saturation."""
    exponent = 2.0 if rng.random() < 0.4 else float(rng.uniform(1.6, 2.4))
    saturation = float(rng.choice([8.0, 15.0, np.inf, np.inf]))
    shape = instrument.rectify(scenario.vibration, exponent=exponent, saturation=saturation)
    return make_mean_effect(
        scenario,
        to_samples(scenario, shape),
        draw_shares(rng),
        strength=strength,
        form=f"power {exponent:.3g} of the rms, saturating at {saturation:g} g",
        form_differs=not (exponent == 2.0 and math.isinf(saturation)),
        active=scenario.busy,
        regressor=("sensitivity", to_samples(scenario, scenario.vibration**2), "deg/h/g^2"),
        unless=("quartic",),
    )


def _shake_axis(
    scenario: Scenario,
    rng: np.random.Generator,
    share: float,
    *,
    band: tuple[float, float],
    mount: tuple[Floats, Floats],
    kind: str,
) -> Floats:
    """Draw the logged angular vibration of one axis (time,) for 1 deg/h per g of rms."""
    out = np.zeros(scenario.size)
    for begin, end in telemetry.list_spans(scenario.busy).tolist() if share else []:
        first, last = round(begin * scenario.rate), min(round(end * scenario.rate), scenario.size)
        fast = instrument.band_noise(
            rng,
            round((last - first) * instrument.FAST_HZ / scenario.rate),
            low=band[0],
            high=band[1],
        )
        level = np.interp(
            np.arange(fast.size) / instrument.FAST_HZ + first / scenario.rate,
            np.arange(scenario.vibration.size),
            scenario.vibration,
        )
        logged = instrument.decimate(
            np.asarray(lfilter(*mount, fast * level)), rate=scenario.rate, kind=kind
        )
        out[first:last] = share * logged[: last - first]
    return out


def _make_shaking_noise(
    scenario: Scenario,
    rng: np.random.Generator,
    *,
    strength: float,
    in_band: bool,
    band: tuple[float, float],
    mount: tuple[Floats, Floats],
    kind: str,
    form: str,
) -> HiddenEffect:
    shares = draw_shares(rng, single_probability=0.4)
    f = (np.arange(BANDS) + 0.5) * scenario.rate / 2 / BANDS
    density = instrument.folded_psd(
        f, rate=scenario.rate, kind=kind, low=band[0], high=band[1], mount=mount
    )
    base = band_density(scenario)
    power = np.where(scenario.busy, scenario.vibration, 0.0) ** 2
    unit = shares[:, None, None] ** 2 * power[None, :, None] * (density / base)[:, None, :]
    effect, amplitude = make_variance_effect(
        scenario,
        lambda a: 1 + a**2 * unit,
        strength=strength,
        axes=axes_with_share(shares),
        form=form,
        form_differs=True,
        first=1e-3,
        active=scenario.busy,
    )
    extra = np.stack(
        [
            amplitude * _shake_axis(scenario, rng, share, band=band, mount=mount, kind=kind)
            for share in shares
        ]
    )
    parameters: dict[str, Any] = {"sensitivity_at_4_khz": {"value": amplitude, "unit": "deg/h/g"}}
    if in_band:  # a flat model should find white noise of the same power
        white = scale_by_axis(
            np.abs(shares), amplitude * math.sqrt(float(density.mean())) / white_level(1.0)
        )
        parameters["white"] = {
            "values": white,
            "unit": "deg/sqrt(h)/g",
            "unless": ["quantization", "exponent", "resonance"],
        }
    return replace(effect, extra=extra, parameters=parameters)


def vibration_noise(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw angular vibration in the band of the log, through a resonant mount and a decimator."""
    low = rng.uniform(0.02, 0.1) * scenario.rate
    high = rng.uniform(0.3, 0.6) * scenario.rate
    resonance = rng.uniform(0.1, 0.4) * scenario.rate
    quality = rng.uniform(1.0, 6.0)
    kind = str(rng.choice(["fir", "cic2", "dump"]))
    mount = f"a mount of {resonance:.3g} Hz, Q {quality:.2g}"
    form = f"{low:.2g}-{high:.3g} Hz through {mount}, and a {kind} decimator"
    return _make_shaking_noise(
        scenario,
        rng,
        strength=strength,
        in_band=True,
        band=(low, high),
        mount=instrument.mount_filter(resonance, quality=quality),
        kind=kind,
        form=form,
    )


def aliased_vibration(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw angular vibration above the band of the log, aliased by an insufficient filter."""
    low = rng.uniform(max(1.3 * scenario.rate, 150.0), 900.0)
    high = low + rng.uniform(50.0, 300.0)
    resonance = rng.uniform(0.8 * low, 1.1 * high)
    kind = str(rng.choice(["point", "dump", "fir"]))
    band = f"{low:.0f}-{high:.0f} Hz"
    form = f"{band} through a mount of {resonance:.0f} Hz, folded by a {kind} decimator"
    return _make_shaking_noise(
        scenario,
        rng,
        strength=strength,
        in_band=False,
        band=(low, high),
        mount=instrument.mount_filter(resonance, quality=rng.uniform(3, 15)),
        kind=kind,
        form=form,
    )


def _draw_toolface(scenario: Scenario, rng: np.random.Generator) -> Floats:
    """Draw the toolface at the samples [rad]."""
    return to_samples(
        scenario,
        instrument.toolface(
            scenario.rotation, dt=ROTATION_STEP_S, first=rng.uniform(0, 2 * math.pi)
        ),
        dt=ROTATION_STEP_S,
    )


def _rotation_tau(scenario: Scenario) -> tuple[float, float]:
    fast = float(np.percentile(scenario.rotation[scenario.rotation > 0], 50)) / 360.0
    return max(1 / scenario.rate, 0.1 / fast), 3.0 / fast


def _is_turning(scenario: Scenario) -> Bools:
    return np.asarray(
        np.interp(
            np.arange(scenario.temperature.size),
            np.arange(scenario.rotation.size) * ROTATION_STEP_S,
            scenario.rotation,
        )
        > 1.0
    )


def earth_rate(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a residual earth rate on the cross axes; it is constant while the tool is at rest."""
    x, y = instrument.cross_axis(_draw_toolface(scenario, rng), across=1.0)
    effect = make_mean_effect(
        scenario,
        np.stack([x, y, np.zeros_like(x)]),
        np.array([1.0, 1.0, 0.0]),
        strength=strength,
        form="cosine and sine of the toolface",
        form_differs=False,
        tau=_rotation_tau(scenario),
    )
    assert effect.mean is not None
    across = float(np.hypot(effect.mean[0], effect.mean[1]).max())  # earth rate across the tool
    if across < instrument.EARTH_RATE:
        effect.parameters["latitude"] = {
            "value": math.degrees(math.acos(across / instrument.EARTH_RATE)),
            "unit": "deg",
        }
    return effect


def rotation_line(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw harmonics of the rotation with amplitudes proportional to its rate."""
    angle, shares = _draw_toolface(scenario, rng), draw_shares(rng)
    speed = to_samples(scenario, scenario.rotation / scenario.rotation.max(), dt=ROTATION_STEP_S)
    comb = sum(
        rng.uniform(0.3, 1.0) * np.sin(k * angle + rng.uniform(0, 6))
        for k in (1, 2, 3)[: int(rng.integers(1, 4))]
    )
    return make_mean_effect(
        scenario,
        np.asarray(comb * speed),
        shares,
        strength=strength,
        form="harmonics of the toolface, proportional to the speed",
        form_differs=True,
        tau=_rotation_tau(scenario),
        active=_is_turning(scenario),
    )


def scale_factor(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a scale factor error, in half of the cases nonlinear; the log excludes the rotation."""
    bend = rng.random() < 0.5
    w = scenario.rotation / scenario.rotation.max()
    shape = w + (rng.uniform(0.3, 1.0) * w**3 if bend else 0.0)
    return make_mean_effect(
        scenario,
        to_samples(scenario, shape, dt=ROTATION_STEP_S),
        np.array([0.0, 0.0, 1.0]),
        strength=strength,
        form="linear and cubic in the rotation rate"
        if bend
        else "proportional to the rotation rate",
        form_differs=bend,
        active=_is_turning(scenario),
        regressor=(
            "linear",
            to_samples(scenario, scenario.rotation, dt=ROTATION_STEP_S) * 3600.0 * 1e-6,
            "ppm",
        ),
        unless=("asymmetry", "cubic"),
    )


def misalignment(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a leak of the rate of z into another axis while the tool turns slowly about z."""
    seconds, t = scenario.seconds, np.arange(scenario.temperature.size, dtype=float)
    turn = np.zeros_like(t)
    for _ in range(int(rng.integers(2, 5))):
        begin, length = rng.uniform(0.05, 0.7) * seconds, rng.uniform(0.05, 0.25) * seconds
        turn += rng.choice([-1, 1]) * np.exp(-0.5 * ((t - begin - length / 2) / (length / 4)) ** 2)
    shape = to_samples(scenario, turn)
    shares = np.zeros(3)
    shares[rng.integers(2)] = 1.0
    leak = make_mean_effect(
        scenario,
        shape,
        shares,
        strength=strength,
        form="proportional to the rate of z",
        form_differs=False,
    )
    assert leak.mean is not None
    angle = float(rng.uniform(2e-4, 2e-3) * rng.choice([-1.0, 1.0]))
    mean = leak.mean.copy()
    mean[2] = mean[int(np.argmax(np.abs(shares)))] / angle
    parameters = leak.parameters | {
        "z": {"values": {AXES[int(np.argmax(shares))]: 1e3 * angle}, "unit": "mrad"}
    }
    return replace(
        leak,
        mean=mean,
        parameters=parameters,
        learned_nats=learned_nats(scenario, leak.mean),  # without the turn of z itself
        also_accepted=("real_motion", "scale_factor"),
    )
