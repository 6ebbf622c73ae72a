"""Make the log of a scenario: noise, effects, digitisation, missing samples and channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.blindtest.generator import instrument, telemetry
from gyrostab.blindtest.generator import noise as floor
from gyrostab.blindtest.generator.environment import read_sensor
from gyrostab.blindtest.generator.scenario import (
    AXES,
    ROTATION_STEP_S,
    HiddenEffect,
    Scenario,
    stream,
    to_samples,
)
from gyrostab.ingest import gap_variables
from gyrostab.schema import check_log
from gyrostab.time.grid import time_coordinate

#: Channel -> unit in memory.
UNITS = {
    "temperature": "degree_Celsius",
    "vibration": "g",
    "rotation_rate": "degree s-1",
    "supply_voltage": "V",
    "light_power": "W",
    "accel_x": "g",
    "accel_y": "g",
    "accel_z": "g",
    "ramp": "1",
}


def draw_base_noise(
    scenario: Scenario, rng: np.random.Generator, effects: Sequence[HiddenEffect] = ()
) -> Floats:
    """Draw the base noise (axis, time) [deg/h], with the white noise that the effects imply."""
    rows = []
    for i, noise in enumerate(scenario.noise):
        white = rng.standard_normal(scenario.size)
        for effect in effects:
            if effect.common is not None:  # in place of as much of the noise of the axis
                white = math.sqrt(1 - effect.common[i].var()) * white + effect.common[i]
        white = white * floor.white_level(noise["N"]) * math.sqrt(scenario.rate)
        for effect in effects:
            if effect.variance is not None and np.any(effect.variance[i] != 1):
                white = white * np.sqrt(to_samples(scenario, effect.variance[i]))
        slow = floor.flicker(
            rng, scenario.size, b=noise["B"], rate=scenario.rate, method=scenario.flicker
        )
        rows.append(
            white + slow + floor.random_walk(rng, scenario.size, k=noise["K"], rate=scenario.rate)
        )
    return np.stack(rows)


def make_record(scenario: Scenario, effects: Sequence[HiddenEffect], *, seed: int) -> Floats:
    """Make the rates (axis, time) [deg/h]; for one seed the noise is the same without effects."""
    record = draw_base_noise(scenario, stream(seed, "noise"), effects) + stream(
        seed, "level"
    ).uniform(-14, 14, (3, 1))
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
            floor.quantize_angle(row, q=n["Q"], rate=scenario.rate, first=p)
            for row, n, p in zip(record, scenario.noise, phase, strict=True)
        ]
    )
    for effect in effects:
        if effect.after is not None and effect.name != "logger_filter":
            record = effect.after(record)
    record[:, find_missing(scenario, effects)] = np.nan
    return record


def find_missing(scenario: Scenario, effects: Sequence[HiddenEffect]) -> Bools:
    """Mark the missing samples."""
    gone = scenario.missing.copy()
    for effect in effects:
        if effect.lost is not None:
            gone |= effect.lost
    return gone


def make_channels(
    scenario: Scenario, effects: Sequence[HiddenEffect], rng: np.random.Generator
) -> dict[str, tuple[Floats, float]]:
    """Make the channels as their sensors report them: name to values and rate [Hz].

    Temperature and vibration are always present. Other channels are present at random, independent
    of the effects, and where an effect needs one.
    """
    needed = {effect.driver for effect in effects}
    out: dict[str, tuple[Floats, float]] = {
        "temperature": (
            read_sensor(rng, scenario.temperature, noise=0.03, lsb=0.0625, tau=rng.uniform(0, 20)),
            1.0,
        ),
        "vibration": (
            np.abs(read_sensor(rng, scenario.vibration, relative=0.05, noise=0.002)),
            1.0,
        ),
    }
    chance = {
        name: rng.random()
        for name in ("rotation_rate", "supply_voltage", "light_power", "accel", "ramp")
    }
    if "rotation_rate" in needed or chance["rotation_rate"] < 0.5:
        out["rotation_rate"] = (
            read_sensor(rng, scenario.rotation, noise=0.1, lsb=0.05, dt=ROTATION_STEP_S),
            1 / ROTATION_STEP_S,
        )
    if "supply_voltage" in needed or chance["supply_voltage"] < 0.5:
        out["supply_voltage"] = (read_sensor(rng, scenario.supply, noise=0.01, lsb=0.005), 1.0)
    if "light_power" in needed or chance["light_power"] < 0.5:
        out["light_power"] = (1e-5 * read_sensor(rng, scenario.light, relative=0.002), 1.0)
    if chance["accel"] < 0.3:
        angle = instrument.toolface(scenario.rotation, dt=ROTATION_STEP_S, first=rng.uniform(0, 6))
        parts = instrument.gravity(angle, inclination=rng.uniform(2, 80))
        for axis, part in zip(AXES, parts, strict=True):
            out[f"accel_{axis}"] = (
                read_sensor(rng, part, noise=0.002, dt=ROTATION_STEP_S),
                1 / ROTATION_STEP_S,
            )
    phase = next((effect.ramp for effect in effects if effect.ramp is not None), None)
    if phase is not None or chance["ramp"] < 0.15:
        idle = (rng.random() + rng.uniform(0.02, 0.1) * np.arange(scenario.size)) % 1.0
        out["ramp"] = (np.floor((idle if phase is None else phase) * 32768), scenario.rate)
    return out


def make_gap_variables(missing: Bools, *, start: int, rate: float) -> dict[str, Any]:
    """Make the gap table of a log from the missing samples."""
    edges = telemetry.list_spans(missing)
    length, none = edges[:, 1] - edges[:, 0], np.zeros(len(edges), dtype=np.int64)
    return gap_variables(np.column_stack([edges, length, none, none]), start, rate)


def make_log(
    record: Floats, channels: dict[str, tuple[Floats, float]], *, start: int, rate: float
) -> xr.Dataset:
    """Make a log from rates (axis, time) [deg/h] and channels; it holds only instrument data.

    Examples
    --------
    >>> channels = {"temperature": (np.full(11, 20.0), 1.0)}
    >>> log = make_log(np.zeros((3, 100)), channels, start=0, rate=10.0)
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
            **make_gap_variables(missing, start=start, rate=rate),
        },
        coords=time_coordinate(start, rate, record.shape[1]),
        attrs={"sampling_rate_hz": float(rate), "kind": "rate"},
    ).assign_coords(axis=list(AXES[: record.shape[0]]))
    return add_channels(log, channels, start=start, rate=rate)


def add_channels(
    log: xr.Dataset, channels: dict[str, tuple[Floats, float]], *, start: int, rate: float
) -> xr.Dataset:
    """Add the channels of `make_channels` to a log, slower ones with a separate time coordinate."""
    for name, (values, channel_rate) in channels.items():
        dim = (
            "time" if channel_rate == rate and values.size == log.sizes["time"] else f"time_{name}"
        )
        if dim != "time":
            log = log.assign_coords(time_coordinate(start, channel_rate, values.size, name=dim))
        log[name] = ((dim,), values, {"units": UNITS[name]})
    check_log(log)
    return log
