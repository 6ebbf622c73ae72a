"""Inject effects into real recordings, with three copies without the effect as controls."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy import fft

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator.catalogue import CATALOGUE
from gyrostab.blindtest.generator.detection_limits import white_shares
from gyrostab.blindtest.generator.noise import BANDS, MeasuredNoise, measure_noise, white_level
from gyrostab.blindtest.generator.record import add_channels, make_channels, make_gap_variables
from gyrostab.blindtest.generator.scenario import (
    AXES,
    HiddenEffect,
    Scenario,
    draw_scenario,
    stream,
    to_samples,
)
from gyrostab.blindtest.scenarios.case import describe_truth
from gyrostab.blindtest.scoring.baseline_detectors import allan_variance, octaves
from gyrostab.errors import FormatError, OptionError
from gyrostab.time.grid import first_stamp

_MAX_TRIES = 60
_EQUAL_RANGE_SHARE = 1e-9  # difference of equal values
_MAX_STEP_ERROR = 1e-3  # of multiples of the step

#: The injected recording, and its controls.
COPIES = ("injected", "untouched", "flipped", "reversed")


@dataclass(frozen=True)
class _Recording:
    """How to read a recording, and the longest piece to take [s]."""

    file: str
    columns: dict[str, str]
    units: dict[str, str] = field(default_factory=dict)
    longest: float = 900.0
    rate: float | None = None  # given where the file has no times


RECORDINGS: dict[str, _Recording] = {
    "fog-blueseis": _Recording(
        "fog-blueseis-ramp/fog_ramp.csv.gz", {"rate_counts": "gyro_z"}, {"gyro": "1 nrad/s"}
    ),
    "laser-gyros": _Recording(
        "rlg-static-30min/lasergyro.csv.gz",
        {"gx_deg_per_h": "gyro_x", "gy_deg_per_h": "gyro_y", "gz_deg_per_h": "gyro_z"},
        {"gyro": "deg/h"},
    ),
    "mems-ch104": _Recording(
        "mems-static-53min/ch104.csv.gz",
        {"gx_dps": "gyro_x", "gy_dps": "gyro_y", "gz_dps": "gyro_z"},
        {"gyro": "deg/s"},
        1200.0,
        100.0,
    ),
    "ring-laser-g": _Recording(
        "ringlaser-g-3h/ringlaser_g_3h.nc",
        {"BJZ": "gyro_z"},
        {"gyro": "1.5825038e-13 rad/s"},
        2400.0,
    ),
}

#: Effects that can be added to existing noise on one axis, and on three.
_ONE_AXIS_EFFECTS = (
    "vibration_rectification",
    "shupe",
    "temperature_bias",
    "thermal_hysteresis",
    "vibration_noise",
    "aliased_vibration",
    "temperature_noise",
    "light_power_noise",
    "ageing_noise",
    "spectral_line",
    "supply_bias",
    "spikes",
)
_THREE_AXIS_EFFECTS = (*_ONE_AXIS_EFFECTS, "shared_source", "earth_rate", "scale_factor")

#: In fitted noise. There are few injections: half of them have the strength from which most should
#: be named.
_STRENGTHS = (3.0, 5.0, 5.0, 8.0)


def estimate_noise(record: Floats, *, rate: float) -> dict[str, float]:
    """Estimate N and K of a real axis (time,) [deg/h] roughly, from its Allan variance.

    Examples
    --------
    >>> record = np.random.default_rng(0).normal(0, 1.8, 100_000)
    >>> round(estimate_noise(record, rate=100.0)["N"], 4)
    0.003
    """
    factors = octaves(record.size)
    variance = allan_variance(record, factors)
    tau = np.array(factors) / rate
    white = float(np.nanmin((variance * tau)[tau <= max(1.0, tau[0])]))
    last = int(np.flatnonzero(np.isfinite(variance))[-1])
    excess = max(0.0, float(variance[last]) - 1.5 * white / tau[last])
    return {
        "N": math.sqrt(white) / 60.0,
        "B": 0.0,
        "K": math.sqrt(3 * excess / (tau[last] / 3600.0)),
        "Q": 0.0,
    }


def _draw_around_log(
    log: xr.Dataset, record: Floats, measured: MeasuredNoise, rng: np.random.Generator
) -> Scenario:
    """Draw a scenario with the length, gaps and noise of a real log."""
    rate = float(log.attrs["sampling_rate_hz"])
    scenario = draw_scenario(rng, rate=rate, seconds=record.shape[1] / rate, cuts=0)
    noise = [estimate_noise(row, rate=rate) for row in record]
    noise += [noise[0]] * (3 - len(noise))
    gone = np.asarray(np.isnan(record).any(axis=0))
    return replace(
        scenario,
        size=record.shape[1],
        start=first_stamp(log),
        noise=tuple(noise[:3]),
        missing=gone,
        measured=measured,
    )


def _compute_addition(scenario: Scenario, effect: HiddenEffect, rng: np.random.Generator) -> Floats:
    """Compute what an effect adds (3, time); noise cannot be removed from a real record."""
    total = np.zeros((3, scenario.size))
    for part in (effect.mean, effect.extra):
        if part is not None:
            total += part
    sd = [60.0 * noise["N"] * math.sqrt(scenario.rate) for noise in scenario.noise]
    added = np.zeros_like(total)
    if effect.variance is not None:
        for i, ratio in enumerate(effect.variance):
            more = np.sqrt(to_samples(scenario, ratio / ratio.min()) - 1 + 1e-15)
            added[i] += more * sd[i] * rng.standard_normal(scenario.size) if np.ptp(ratio) else 0.0
    if effect.common is not None:
        added += effect.common * np.array(sd)[:, None]
    return total + _filter_like_record(scenario, added)


def _filter_like_record(scenario: Scenario, noise: Floats) -> Floats:
    """Remove from white noise (axis, time) what the logger's filter removed from the record."""
    assert scenario.measured is not None
    level = scenario.measured.level
    white = np.array([white_level(coefficients["N"]) ** 2 for coefficients in scenario.noise])
    response = np.minimum(white_shares(scenario) * level / white[:, None], 1.0)
    lines = fft.rfft(noise, axis=1)
    band = np.minimum(np.arange(lines.shape[1]) * BANDS // lines.shape[1], BANDS - 1)
    return np.asarray(fft.irfft(lines * np.sqrt(response[:, band]), noise.shape[1], axis=1))


def quantization_step(values: Floats) -> float:
    """Find the quantization step of values (time,); 0 where they are not quantized.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> quantization_step(rng.integers(-9, 9, 1000) * 0.25)
    0.25
    >>> round(quantization_step(rng.normal(0, 1, 1000).round(3)), 9)  # hardly two are equal
    0.001
    >>> quantization_step(rng.normal(0, 1, 1000))
    0.0
    """
    levels = np.unique(values[np.isfinite(values)])
    gaps = np.diff(levels)
    gaps = gaps[
        gaps > _EQUAL_RANGE_SHARE * max(float(np.ptp(levels)) if levels.size else 0.0, 1e-300)
    ]
    if gaps.size == 0:
        return 0.0
    step = float(gaps.min())
    step = float(np.ptp(levels)) / round(float(np.ptp(levels)) / step)
    return step if np.abs(gaps / step - np.rint(gaps / step)).max() < _MAX_STEP_ERROR else 0.0


def _quantize_like(record: Floats, values: Floats, dither: Floats) -> Floats:
    """Round values (axis, time) down to the steps of a record, after adding a dither in steps.

    Steps are counted from the value nearest to zero, so that zeros remain exact.
    """
    rounded = values.copy()
    for row, recorded in enumerate(record):
        step = quantization_step(recorded)
        if step > 0.0:
            good = recorded[np.isfinite(recorded)]
            level = float(good[np.abs(good).argmin()])
            rounded[row] = level + step * np.floor((values[row] - level) / step + dither[row])
    return rounded


def inject_effect(
    log: xr.Dataset, effect: str, strength: float, rng: np.random.Generator
) -> dict[str, tuple[xr.Dataset, dict[str, Any]]]:
    """Inject an effect into a real log of rates without channels, and make the controls.

    `strength` is the size in units of the limit in fitted noise, for the noise of this log as
    measured by `gyrostab.blindtest.generator.noise`. Return log and truth of each copy:
    ``injected``, and the controls ``untouched``, ``flipped`` (in sign) and ``reversed`` (in time).
    All have the same channels. An effect must not follow restarts; one that needs axes that the log
    does not have is an `OptionError`.
    """
    record = np.asarray(log["rate"].values[:3], dtype=float)
    axes = [str(name) for name in log["axis"].values[:3]]
    scenario, made = _draw_effect(log, record, effect, strength, rng)
    total = record + _compute_addition(scenario, made, rng)[: len(axes)]
    injected = _quantize_like(record, total, rng.random(record.shape))
    if made.after is not None:
        changed = made.after(injected)
        to_nearest = _quantize_like(record, changed, np.full(record.shape, 0.5))
        injected = np.where(changed == injected, injected, to_nearest)
        injected[np.isnan(record)] = np.nan
    channels = make_channels(scenario, [made], rng)
    names = dict(zip(AXES, axes, strict=False))
    truth, control_truth = (
        _rename_axes(describe_truth(scenario, effects), names) for effects in ([made], [])
    )
    copies = {
        "injected": injected,
        "untouched": record,
        "flipped": -record,
        "reversed": record[:, ::-1].copy(),
    }
    return {
        name: (
            _replace_record(log, values, channels, scenario),
            (truth if name == "injected" else control_truth)
            | {
                "plan": {"kind": "injected" if name == "injected" else "control", "copy": name},
                "visibility": None,
            },
        )
        for name, values in copies.items()
    }


def _rename_axes(truth: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Rename the axes of a truth to those of the log, and leave out others."""

    def rename(values: Mapping[str, Any]) -> dict[str, Any]:
        return {names[axis]: value for axis, value in values.items() if axis in names}

    effects = [
        effect
        | {
            "axes": [names[axis] for axis in effect["axes"] if axis in names],
            "waveform_10s": rename(effect["waveform_10s"]),
            "parameters": {
                name: entry | ({"values": rename(entry["values"])} if "values" in entry else {})
                for name, entry in effect["parameters"].items()
            },
        }
        for effect in truth["effects"]
    ]
    return truth | {"effects": effects, "noise": rename(truth["noise"])}


def _draw_effect(
    log: xr.Dataset, record: Floats, effect: str, strength: float, rng: np.random.Generator
) -> tuple[Scenario, HiddenEffect]:
    entry = CATALOGUE[effect]
    present = set("xyz"[: record.shape[0]])
    measured = measure_noise(record, rate=float(log.attrs["sampling_rate_hz"]), axes=3)
    for _ in range(_MAX_TRIES):
        scenario = _draw_around_log(log, record, measured, rng)
        if entry.needs == "rotation" and scenario.rotation.max() == 0:
            continue
        made = entry.make(scenario, rng, strength=strength, in_fitted_noise=True)
        if set(made.axes) <= present:
            return scenario, made
    raise OptionError(
        f"{effect} needs more axes than the {record.shape[0]} of this log; inject another effect"
    )


def _replace_record(
    log: xr.Dataset, record: Floats, channels: dict[str, tuple[Floats, float]], scenario: Scenario
) -> xr.Dataset:
    gone = np.asarray(np.isnan(record).all(axis=0))
    out = log.isel(axis=slice(0, record.shape[0])).drop_dims("gap", errors="ignore")
    out = out.assign(
        rate=(("axis", "time"), record, dict(log["rate"].attrs)),
        **make_gap_variables(gone, start=scenario.start, rate=scenario.rate),
    )
    return add_channels(out, channels, start=scenario.start, rate=scenario.rate)


def plan_injections(number: int, *, seed: int) -> list[dict[str, Any]]:
    """Plan `number` injections into real recordings, with four copies of each.

    Examples
    --------
    >>> [plan["copy"] for plan in plan_injections(1, seed=3)]
    ['injected', 'untouched', 'flipped', 'reversed']
    """
    out = []
    for index in range(number):
        rng = stream(seed, "injected", index)
        names = list(RECORDINGS)
        recording = names[(int(stream(seed, "injected").integers(len(names))) + index) % len(names)]
        effects = (
            _THREE_AXIS_EFFECTS
            if sum(name.startswith("gyro") for name in RECORDINGS[recording].columns.values()) == 3
            else _ONE_AXIS_EFFECTS
        )
        plan = {
            "index": index,
            "seed": seed,
            "recording": recording,
            "effect": str(rng.choice(effects)),
        }
        plan |= {"strength": float(rng.choice(_STRENGTHS)), "part": float(rng.random())}
        out += [
            plan | {"kind": "injected" if copy == "injected" else "control", "copy": copy}
            for copy in COPIES
        ]
    return out


def check_recordings(folder: Path) -> None:
    """Raise `FormatError` unless a folder has all real recordings."""
    for entry in RECORDINGS.values():
        if not (folder / entry.file).is_file():
            raise FormatError(
                f"{folder}: has no {entry.file}, which injections need; "
                "give the folder of the real recordings with --real DIR, or none"
            )


def _read_piece(recording: str, folder: Path, part: float) -> xr.Dataset:
    from gyrostab import read_log, regularise

    entry = RECORDINGS[recording]
    log = regularise(
        read_log(folder / entry.file, map=entry.columns, unit=entry.units, rate=entry.rate)
    )
    size = min(log.sizes["time"], round(entry.longest * float(log.attrs["sampling_rate_hz"])))
    first = round(part * (log.sizes["time"] - size))
    piece = log[["rate"]].isel(time=slice(first, first + size)).compute()
    # no attribute that identifies the recording
    piece.attrs = {name: log.attrs[name] for name in ("sampling_rate_hz", "kind")}
    return piece


def make_injection_case(plan: dict[str, Any], folder: Path) -> tuple[xr.Dataset, dict[str, Any]]:
    """Make one of the four logs of an injection into a recording of a folder, and its truth."""
    log = _read_piece(plan["recording"], folder, plan["part"])
    rng = np.random.default_rng(stream(plan["seed"], "injection", plan["index"]).integers(2**40))
    made, truth = inject_effect(log, plan["effect"], plan["strength"], rng)[plan["copy"]]
    return made, truth | {"plan": plan}
