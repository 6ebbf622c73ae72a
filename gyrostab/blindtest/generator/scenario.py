"""The world of one case: what happens around the gyros, what the logger loses, how noisy the axes are; and what an effect adds."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.blindtest.generator import environment, telemetry, tool
from gyrostab.blindtest.generator.measured_noise import OwnNoise

__all__ = ["AXES", "QUICK", "Effect", "World", "draw_world", "per_second", "stream", "to_samples"]

Array = NDArray[np.float64]

AXES = ("x", "y", "z")

#: Step of the rotation of the tool [s]; everything else around the gyros has one value a second.
QUICK = 0.1


@dataclass(frozen=True)
class World:
    """What happens, without noise and without effects.

    `temperature` [degC], `vibration` [g rms], `busy`, `supply` [V] and `light` (relative) hold one
    value a second, `rotation` [deg/s] one every `QUICK`; `cuts` are power cuts [s] (number, 2);
    `missing` tells which samples are lost; `noise` holds N, B, K, Q of every axis. Where the noise
    is that of a real recording, `own` is what was measured of it, and limits go by that.
    """

    rate: float
    size: int
    start: int
    noise: tuple[dict[str, float], ...]
    temperature: Array
    vibration: Array
    busy: NDArray[np.bool_]
    rotation: Array
    supply: Array
    light: Array
    cuts: Array
    missing: NDArray[np.bool_]
    flicker: str = "spectrum"
    own: OwnNoise | None = None

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return self.size / self.rate


@dataclass(frozen=True)
class Effect:
    """What one effect does to the record, and what is true of it.

    `mean` (axis, time) [deg/h] is added; `variance` (axis, second) multiplies the white noise;
    `extra` (axis, time) [deg/h] is noise that is added; `white` (axis, time) of unit variance
    stands in for the white noise, of which `common` is the part that axes share; `after` is done to
    the finished record; `size` is in units of the closed-form limit; `nats` is the likelihood that
    knowing the truth is expected to gain.
    """

    name: str
    axes: tuple[str, ...]
    driver: str | None
    form: str
    differs: bool
    size: float
    nats: float
    tau: tuple[float, float]
    active: NDArray[np.bool_] | None = None
    mean: Array | None = None
    variance: Array | None = None
    extra: Array | None = None
    white: Array | None = None
    common: Array | None = None
    after: Callable[[Array], Array] | None = None
    ramp: Array | None = None
    lost: NDArray[np.bool_] | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    beside: tuple[str, ...] = ()


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Random numbers of their own for every purpose, so that drawing more of one kind changes none of another.

    Examples
    --------
    >>> bool(stream(1, "noise").random() == stream(1, "noise").random()), bool(stream(1, "noise").random() == stream(1, "gaps").random())
    (True, False)
    """
    return np.random.default_rng([seed, *(zlib.crc32(str(name).encode()) for name in names)])


def to_samples(world: World, values: Array, *, dt: float = 1.0) -> Array:
    """Values every `dt` [s] at the samples of the log, by straight lines."""
    return np.interp(np.arange(world.size) / world.rate, np.arange(values.size) * dt, values)


def per_second(world: World) -> NDArray[np.int64]:
    """Number of samples present in every second, shape (second,)."""
    at = (np.flatnonzero(~world.missing) / world.rate).astype(np.int64)
    return np.bincount(at, minlength=world.temperature.size)


def _noise(
    rng: np.random.Generator, rate: float, *, heavy: bool, calm: bool
) -> tuple[dict[str, float], ...]:
    base = {
        "N": 10 ** rng.uniform(-3.0, -2.0),
        "B": 10 ** rng.uniform(-3.0, -2.2),
        "K": 10 ** rng.uniform(-2.5, -1.3),
    }
    if heavy:
        base["K"] *= rng.uniform(3, 10)
        base["B"] *= rng.uniform(1, 4)
    if calm:
        base["K"] *= 0.2
    share = (
        0.0 if rng.random() < 0.5 else 10 ** rng.uniform(-2.5, -1.0)
    )  # of the steps in the variance at the shortest time
    axes = []
    for _ in AXES:
        own = {key: value * rng.uniform(0.8, 1.25) for key, value in base.items()}
        urad = math.degrees(1e-6) * 3600.0
        own["Q"] = math.sqrt(share / 3.0) * 60 * own["N"] / math.sqrt(rate) / urad
        axes.append(own)
    return tuple(axes)


def _missing(
    rng: np.random.Generator, size: int, rate: float, gaps: float, cuts: Array
) -> NDArray[np.bool_]:
    frame = max(1, int(rng.uniform(0.2, 4.0) * rate))
    lost = telemetry.lose(
        rng, size, share=gaps, frame=frame, burst=1.0 if rng.random() < 0.4 else rng.uniform(3, 30)
    )
    t = np.arange(size) / rate
    for begin, end in cuts:
        lost |= (t >= begin) & (t < end)
    lost[: round(5 * rate)] = False  # a log begins and ends with samples
    lost[-round(5 * rate) :] = False
    return lost


def draw_world(
    rng: np.random.Generator,
    *,
    rate: float,
    seconds: float,
    gaps: float = 0.0,
    cuts: int = 0,
    heavy: bool = False,
    buried: bool = False,
) -> World:
    """Draw what happens in one case.

    Parameters
    ----------
    rng : numpy.random.Generator
    rate : float
        Rate of the log [Hz].
    seconds : float
        Length [s].
    gaps : float
        Share of the samples that is lost, beside power cuts.
    cuts : int
        Power cuts.
    heavy : bool
        Whether flicker and random walk are unusually strong.
    buried : bool
        Long bursts and little random walk, so that effects can be small for a long time.

    Examples
    --------
    >>> world = draw_world(np.random.default_rng(0), rate=10.0, seconds=600.0, gaps=0.2)
    >>> world.size, bool(0.05 < world.missing.mean() < 0.4)
    (6000, True)
    """
    size = round(seconds * rate)
    vibration, busy = environment.shaking(
        rng, seconds, bursts=int(rng.integers(2, 5)), longest=2500.0 if buried else 300.0
    )
    fastest = min(rng.uniform(30, 120), 60.0 * rate / 8)
    turning = (
        tool.rotation(rng, seconds, dt=QUICK, fastest=fastest)
        if rng.random() < 0.7
        else np.zeros(math.ceil(seconds / QUICK) + 1)
    )
    when = telemetry.power_cuts(rng, seconds, number=cuts) if cuts else np.zeros((0, 2))
    day = int(rng.integers(0, 1000)) * 86400 + int(rng.integers(0, 86400))
    return World(
        rate=rate,
        size=size,
        start=(1_700_000_000 + day) * 10**9,
        noise=_noise(rng, rate, heavy=heavy, calm=buried),
        temperature=environment.temperature(rng, seconds, still=bool(rng.random() < 0.1)),
        vibration=vibration,
        busy=busy,
        rotation=turning,
        supply=environment.supply(rng, seconds, load=busy.astype(float)),
        light=environment.light_monitor(rng, seconds, dips=False),
        cuts=when,
        missing=_missing(rng, size, rate, gaps, when),
        flicker="spectrum" if rng.random() < 0.5 else "relaxations",
    )
