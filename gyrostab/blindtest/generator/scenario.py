"""Scenario of one case (environment, missing samples, noise) and the contribution of an effect."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.blindtest.generator import environment, instrument, telemetry
from gyrostab.blindtest.generator.noise import URAD, MeasuredNoise

AXES = ("x", "y", "z")

#: Step of the rotation of the tool [s]; everything else around the gyros has one value a second.
ROTATION_STEP_S = 0.1

#: Labels under which some streams were first drawn. They stay, so that a published seed keeps
#: drawing the same cases.
STREAM_LABELS = {
    "scenario": "world",
    "degradation": "sever",
    "injection": "salt",
    "injected": "salted",
    "sub_threshold": "buried",
    "out_of_catalogue": "strange",
    "degraded_driver": "severed",
}


@dataclass(frozen=True)
class Scenario:
    """Environment, losses and noise coefficients of one case, without effects.

    `temperature` [degC], `vibration` [g rms], `busy`, `supply` [V] and `light` (relative) hold one
    value a second, `rotation` [deg/s] one every `ROTATION_STEP_S`; `cuts` are power cuts [s]
    (number, 2); `missing` marks missing samples; `noise` holds N, B, K, Q of every axis. For a real
    recording, `measured` is its measured noise, which then defines the limits.
    """

    rate: float
    size: int
    start: int
    noise: tuple[dict[str, float], ...]
    temperature: Floats
    vibration: Floats
    busy: Bools
    rotation: Floats
    supply: Floats
    light: Floats
    cuts: Floats
    missing: Bools
    flicker: str = "spectrum"
    measured: MeasuredNoise | None = None

    @property
    def seconds(self) -> float:
        """Length of the record [s]."""
        return self.size / self.rate


@dataclass(frozen=True)
class HiddenEffect:
    """Contribution of one effect to the record, and its ground truth.

    The catalogue sets `name`, `driver` and `strength`. `mean` (axis, time) [deg/h] is added;
    `variance` (axis, second) multiplies the white noise; `extra` (axis, time) [deg/h] is added
    noise; `common` (axis, time), shared by the axes, replaces as much of their white noise, in
    units of it; `after` is applied to the finished record. In units of the closed-form limit,
    `strength` is the size asked for, and `size` the one drawn. `nats` is the evidence expected with
    the truth known, and `learned_nats` over fitted noise where `mean` is not known, but random;
    `form_differs` is set where the diagnosis fits another form; `also_accepted` holds further names
    that are right for this case.
    """

    axes: tuple[str, ...]
    form: str
    form_differs: bool
    size: float
    nats: float
    tau: tuple[float, float]
    name: str = ""
    driver: str | None = None
    strength: float = 0.0
    learned_nats: float | None = None
    active: Bools | None = None
    mean: Floats | None = None
    variance: Floats | None = None
    extra: Floats | None = None
    common: Floats | None = None
    after: Callable[[Floats], Floats] | None = None
    ramp: Floats | None = None
    lost: Bools | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    also_accepted: tuple[str, ...] = ()


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Make a separate random generator for each purpose; drawing from one changes no other.

    Examples
    --------
    >>> bool(stream(1, "noise").random() == stream(1, "gaps").random())
    False
    """
    labels = (STREAM_LABELS.get(str(name), str(name)) for name in names)
    return np.random.default_rng([seed, *(zlib.crc32(label.encode()) for label in labels)])


def to_samples(scenario: Scenario, values: Floats, *, dt: float = 1.0) -> Floats:
    """Interpolate values every `dt` [s] linearly to the samples of the log."""
    return np.interp(np.arange(scenario.size) / scenario.rate, np.arange(values.size) * dt, values)


def count_per_second(scenario: Scenario) -> Ints:
    """Count the samples present in every second, shape (second,)."""
    at = (np.flatnonzero(~scenario.missing) / scenario.rate).astype(np.int64)
    return np.bincount(at, minlength=scenario.temperature.size)


def _draw_noise(
    rng: np.random.Generator, rate: float, *, heavy: bool, quiescent: bool
) -> tuple[dict[str, float], ...]:
    base = {
        "N": 10 ** rng.uniform(-3.0, -2.0),
        "B": 10 ** rng.uniform(-3.0, -2.2),
        "K": 10 ** rng.uniform(-2.5, -1.3),
    }
    if heavy:
        base["K"] *= rng.uniform(3, 10)
        base["B"] *= rng.uniform(1, 4)
    if quiescent:
        base["K"] *= 0.2
    share = (
        0.0 if rng.random() < 0.5 else 10 ** rng.uniform(-2.5, -1.0)
    )  # of the steps in the variance at the shortest time
    axes = []
    for _ in AXES:
        coefficients = {key: value * rng.uniform(0.8, 1.25) for key, value in base.items()}
        coefficients["Q"] = math.sqrt(share / 3.0) * 60 * coefficients["N"] / math.sqrt(rate) / URAD
        axes.append(coefficients)
    return tuple(axes)


def _draw_missing(
    rng: np.random.Generator, size: int, rate: float, gaps: float, cuts: Floats
) -> Bools:
    frame = max(1, int(rng.uniform(0.2, 4.0) * rate))
    lost = telemetry.draw_losses(
        rng, size, share=gaps, frame=frame, burst=1.0 if rng.random() < 0.4 else rng.uniform(3, 30)
    )
    lost |= telemetry.mark_power_cuts(cuts, size, rate)
    lost[: round(5 * rate)] = False  # a log begins and ends with samples
    lost[-round(5 * rate) :] = False
    return lost


def draw_scenario(
    rng: np.random.Generator,
    *,
    rate: float,
    seconds: float,
    gaps: float = 0.0,
    cuts: int = 0,
    heavy: bool = False,
    sub_threshold: bool = False,
) -> Scenario:
    """Draw the scenario of one case, for a log of `rate` [Hz] and `seconds`.

    `gaps` is the share of samples that is missing, in addition to `cuts` power cuts. In a `heavy`
    scenario flicker and random walk are unusually strong; a `sub_threshold` one has long bursts and
    little random walk, as small, long effects need.

    Examples
    --------
    >>> scenario = draw_scenario(np.random.default_rng(0), rate=10.0, seconds=600.0, gaps=0.2)
    >>> scenario.size, bool(0.05 < scenario.missing.mean() < 0.4)
    (6000, True)
    """
    size = round(seconds * rate)
    vibration, busy = environment.shaking(
        rng, seconds, bursts=int(rng.integers(2, 5)), longest=2500.0 if sub_threshold else 300.0
    )
    fastest = min(rng.uniform(30, 120), 60.0 * rate / 8)
    turning = (
        instrument.rotation(rng, seconds, dt=ROTATION_STEP_S, fastest=fastest)
        if rng.random() < 0.7
        else np.zeros(math.ceil(seconds / ROTATION_STEP_S) + 1)
    )
    when = telemetry.draw_power_cuts(rng, seconds, number=cuts) if cuts else np.zeros((0, 2))
    day = int(rng.integers(0, 1000)) * 86400 + int(rng.integers(0, 86400))
    return Scenario(
        rate=rate,
        size=size,
        start=(1_700_000_000 + day) * 10**9,
        noise=_draw_noise(rng, rate, heavy=heavy, quiescent=sub_threshold),
        temperature=environment.temperature(rng, seconds, still=bool(rng.random() < 0.1)),
        vibration=vibration,
        busy=busy,
        rotation=turning,
        supply=environment.supply(rng, seconds, load=busy.astype(float)),
        light=environment.light_monitor(rng, seconds, dips=False),
        cuts=when,
        missing=_draw_missing(rng, size, rate, gaps, when),
        flicker="spectrum" if rng.random() < 0.5 else "relaxations",
    )
