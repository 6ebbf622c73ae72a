"""From a world and its effects to the log that a reader would give: noise, effects, steps of the words, lost samples, channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.blindtest.generator import noise_floor as floor
from gyrostab.blindtest.generator import tool
from gyrostab.blindtest.generator.environment import sense
from gyrostab.blindtest.generator.scenario import AXES, QUICK, Effect, World, stream, to_samples
from gyrostab.ingest.gap_table import gap_variables
from gyrostab.schema import check_log
from gyrostab.time.grid import time_coordinate

__all__ = [
    "base_noise",
    "channels_of",
    "gap_columns",
    "lost",
    "make_log",
    "signal",
    "with_channels",
]

Array = NDArray[np.float64]

#: Channel -> unit in memory.
UNITS = {
    "temperature": "degree_Celsius",
    "vibration": "g",
    "rotation_rate": "degree s-1",
    "supply_voltage": "V",
    "light_power": "W",
    "pressure": "Pa",
    "accel_x": "g",
    "accel_y": "g",
    "accel_z": "g",
    "ramp": "1",
}


def base_noise(world: World, rng: np.random.Generator, effects: Sequence[Effect] = ()) -> Array:
    """White noise, flicker and random walk of all axes (axis, time) [deg/h], the white one as the effects make it."""
    rows = []
    instead = next((effect.white for effect in effects if effect.white is not None), None)
    for i, noise in enumerate(world.noise):
        white = rng.standard_normal(world.size)
        white = (
            (white if instead is None else instead[i])
            * floor.white_level(noise["N"])
            * math.sqrt(world.rate)
        )
        for effect in effects:
            if effect.variance is not None and np.any(effect.variance[i] != 1):
                white = white * np.sqrt(to_samples(world, effect.variance[i]))
        slow = floor.flicker(rng, world.size, b=noise["B"], rate=world.rate, method=world.flicker)
        rows.append(
            white + slow + floor.random_walk(rng, world.size, k=noise["K"], rate=world.rate)
        )
    return np.stack(rows)


def signal(world: World, effects: Sequence[Effect], *, seed: int) -> Array:
    """Rates of all axes (axis, time) [deg/h], NaN where lost; the noise is the same with and without the effects."""
    record = base_noise(world, stream(seed, "noise"), effects) + stream(seed, "level").uniform(
        -14, 14, (3, 1)
    )
    for effect in effects:
        for part in (effect.mean, effect.extra):
            if part is not None:
                record = record + part
    for effect in effects:
        if effect.after is not None and effect.name == "logger_filter":
            record = effect.after(record)
    phase = stream(seed, "angle").random(3)
    record = np.stack(
        [
            floor.quantize_angle(row, q=n["Q"], rate=world.rate, first=p)
            for row, n, p in zip(record, world.noise, phase, strict=True)
        ]
    )
    for effect in effects:
        if effect.after is not None and effect.name != "logger_filter":
            record = effect.after(record)
    record[:, lost(world, effects)] = np.nan
    return record


def lost(world: World, effects: Sequence[Effect]) -> NDArray[np.bool_]:
    """Which samples are missing."""
    gone = world.missing.copy()
    for effect in effects:
        if effect.lost is not None:
            gone |= effect.lost
    return gone


def channels_of(
    world: World, effects: Sequence[Effect], rng: np.random.Generator
) -> dict[str, tuple[Array, float]]:
    """Channels as their sensors report them: name to values and rate [Hz].

    Temperature and vibration are always there; the others are there by chance, whatever the effects
    are, and where an effect needs one.
    """
    needed = {effect.driver for effect in effects}
    out: dict[str, tuple[Array, float]] = {
        "temperature": (
            sense(rng, world.temperature, noise=0.03, lsb=0.0625, tau=rng.uniform(0, 20)),
            1.0,
        ),
        "vibration": (np.abs(sense(rng, world.vibration, relative=0.05, noise=0.002)), 1.0),
    }
    chance = {
        name: rng.random()
        for name in ("rotation_rate", "supply_voltage", "light_power", "accel", "ramp")
    }
    if "rotation_rate" in needed or chance["rotation_rate"] < 0.5:
        out["rotation_rate"] = (
            sense(rng, world.rotation, noise=0.1, lsb=0.05, dt=QUICK),
            1 / QUICK,
        )
    if "supply_voltage" in needed or chance["supply_voltage"] < 0.5:
        out["supply_voltage"] = (sense(rng, world.supply, noise=0.01, lsb=0.005), 1.0)
    if "light_power" in needed or chance["light_power"] < 0.5:
        out["light_power"] = (1e-5 * sense(rng, world.light, relative=0.002), 1.0)
    if chance["accel"] < 0.3:
        angle = tool.toolface(world.rotation, dt=QUICK, first=rng.uniform(0, 6))
        parts = tool.gravity(angle, inclination=rng.uniform(2, 80))
        for axis, part in zip(AXES, parts, strict=True):
            out[f"accel_{axis}"] = (sense(rng, part, noise=0.002, dt=QUICK), 1 / QUICK)
    phase = next((effect.ramp for effect in effects if effect.ramp is not None), None)
    if phase is not None or chance["ramp"] < 0.15:
        idle = (rng.random() + rng.uniform(0.02, 0.1) * np.arange(world.size)) % 1.0
        out["ramp"] = (np.floor((idle if phase is None else phase) * 32768), world.rate)
    return out


def gap_columns(missing: NDArray[np.bool_], *, start: int, rate: float) -> dict[str, Any]:
    """The table of gaps of a log, from what is missing."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]))).reshape(-1, 2)
    length, none = edges[:, 1] - edges[:, 0], np.zeros(len(edges), dtype=np.int64)
    return gap_variables(np.column_stack([edges, length, none, none]), start, rate)


def make_log(
    record: Array, channels: dict[str, tuple[Array, float]], *, start: int, rate: float
) -> xr.Dataset:
    """A log of the contract from rates (axis, time) [deg/h] and channels; nothing in it but what an instrument knows.

    Examples
    --------
    >>> log = make_log(np.zeros((3, 100)), {"temperature": (np.full(11, 20.0), 1.0)}, start=0, rate=10.0)
    >>> sorted(log.sizes)
    ['axis', 'gap', 'time', 'time_temperature']
    """
    missing = np.asarray(np.isnan(record).all(axis=0))
    log = xr.Dataset(
        {
            "rate": (
                ("axis", "time"),
                record,
                {"units": "degree hour-1", "long_name": "rotation rate"},
            ),
            **gap_columns(missing, start=start, rate=rate),
        },
        coords=time_coordinate(start, rate, record.shape[1]),
        attrs={"sampling_rate_hz": float(rate), "kind": "rate"},
    ).assign_coords(axis=list(AXES[: record.shape[0]]))
    return with_channels(log, channels, start=start, rate=rate)


def with_channels(
    log: xr.Dataset, channels: dict[str, tuple[Array, float]], *, start: int, rate: float
) -> xr.Dataset:
    """Put channels, as `channels_of` gives them, into a log; each on its own times where it is slower."""
    for name, (values, own) in channels.items():
        dim = "time" if own == rate and values.size == log.sizes["time"] else f"time_{name}"
        if dim != "time":
            log = log.assign_coords(time_coordinate(start, own, values.size, name=dim))
        log[name] = ((dim,), values, {"units": UNITS[name]})
    check_log(log)
    return log
