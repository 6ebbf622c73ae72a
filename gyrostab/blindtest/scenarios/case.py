"""Make one case: the recording for the diagnosis, and its ground truth, and commit both."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.blindtest.generator import environment, telemetry
from gyrostab.blindtest.generator.catalogue import CATALOGUE, OUT_OF_CATALOGUE, Entry
from gyrostab.blindtest.generator.detection_limits import fitted_nats
from gyrostab.blindtest.generator.record import find_missing, make_channels, make_log, make_record
from gyrostab.blindtest.generator.scenario import (
    AXES,
    HiddenEffect,
    Scenario,
    draw_scenario,
    stream,
)
from gyrostab.blindtest.scenarios.plan import STRENGTHS
from gyrostab.blindtest.scoring.baseline_detectors import find_visibility
from gyrostab.errors import FormatError, OptionError
from gyrostab.store.output import replace_file, write_text
from gyrostab.units import on_disk

Channels = dict[str, tuple[Floats, float]]

#: Length of the block means of a waveform in the truth [s].
WAVEFORM_BLOCK_S = 10.0

_MAX_TRIES = 40

#: Tries to draw a sub-threshold effect before its strength is reduced.
_TRIES_PER_STRENGTH = 10


def _make_substitute(driver: str, values: Floats, rng: np.random.Generator) -> tuple[str, Floats]:
    """Make a channel of another name that moves like `values`, with some independent wander."""
    wander = np.cumsum(rng.standard_normal(values.size))
    parts = [(part - part.mean()) / (float(part.std()) or 1.0) for part in (values, wander)]
    motion = parts[0] + 0.3 * parts[1]
    if driver == "supply_voltage":
        return "light_power", np.asarray(1e-5 * (1 + 0.01 * motion))
    return "supply_voltage", np.asarray(28.0 + 0.3 * motion)


def degrade_driver(
    channels: Channels, driver: str, *, how: str, rng: np.random.Generator
) -> Channels:
    """Degrade the channel that drives an effect.

    It is "withheld", "substituted" by a similar channel with other times, "lagged" by 30 to 180 s,
    "confounded" with another channel that moves with it, "noisy" by its standard deviation, or
    "clipped" at the middle of its range.

    Examples
    --------
    >>> channels = {"temperature": (np.arange(100.0), 1.0)}
    >>> rng = np.random.default_rng(0)
    >>> sorted(degrade_driver(channels, "temperature", how="confounded", rng=rng))
    ['supply_voltage', 'temperature']
    """
    remaining = dict(channels)
    values, rate = remaining[driver]
    if how == "withheld" or how == "substituted":
        del remaining[driver]
        if driver == "rotation_rate":
            remaining = {
                name: channel
                for name, channel in remaining.items()
                if not name.startswith("accel_")
            }
        if how == "substituted":
            name, like = _make_substitute(
                driver, np.roll(values[::-1], int(rng.integers(values.size))), rng
            )
            remaining[name] = (like, rate)
    elif how == "lagged":
        steps = min(round(rng.uniform(30, 180) * rate), values.size // 4)
        remaining[driver] = (np.append(np.full(steps, values[0]), values)[: values.size], rate)
    elif how == "confounded":
        name, like = _make_substitute(driver, values, rng)
        remaining[name] = (like, rate)
    elif how == "noisy":
        remaining[driver] = (values + rng.normal(0.0, float(values.std()), values.size), rate)
    else:  # clipped
        remaining[driver] = (np.minimum(values, 0.5 * (values.min() + values.max())), rate)
    return remaining


def draw_suitable(plan: dict[str, Any], entries: Sequence[Entry], attempt: int) -> Scenario:
    """Draw the environment of a plan until it contains what all of its effects need."""
    cuts = max([plan["cuts"], *(entry.cuts for entry in entries)])
    needs = {entry.needs for entry in entries}
    for trial in range(_MAX_TRIES):
        rng = stream(plan["seed"], "scenario", plan["index"], attempt, trial)
        scenario = draw_scenario(
            rng,
            rate=plan["rate"],
            seconds=plan["seconds"],
            gaps=plan["gaps"],
            cuts=cuts,
            heavy=plan["heavy"],
            sub_threshold=plan["kind"] == "sub_threshold",
        )
        if "dips" in needs:
            scenario = replace(
                scenario, light=environment.light_monitor(rng, plan["seconds"], dips=True)
            )
        if any(entry.cuts for entry in entries):
            scenario = replace(scenario, missing=_shorten_losses(scenario))
        if "unquantized angle" in needs:
            scenario = replace(
                scenario, noise=tuple(noise | {"Q": 0.0} for noise in scenario.noise)
            )
        is_warm = np.ptp(scenario.temperature) > 2.0 or "heat" not in needs
        if is_warm and (scenario.rotation.max() > 0 or "rotation" not in needs):
            return scenario
    raise OptionError(
        f"case {plan['index']} of seed {plan['seed']}: no environment with {plan['names']} "
        f"was drawn in {_MAX_TRIES} tries"
    )


def _shorten_losses(scenario: Scenario) -> Bools:
    """Shorten telemetry losses so that they cannot be mistaken for a power cut."""
    off = telemetry.mark_power_cuts(scenario.cuts, scenario.size, scenario.rate)
    longest = max(1, round((telemetry.MIN_POWER_CUT_S - 2.0) * scenario.rate))
    return np.asarray(
        off & scenario.missing | telemetry.limit_losses(scenario.missing & ~off, longest=longest)
    )


def _weaken_plan(plan: dict[str, Any], attempt: int) -> dict[str, Any]:
    """Reduce the strength of a plan whose effect was not sub-threshold in many tries."""
    if plan["kind"] != "sub_threshold" or attempt == 0 or attempt % _TRIES_PER_STRENGTH:
        return plan
    return plan | {
        "strengths": [
            max((s for s in STRENGTHS if s < strength), default=strength)
            for strength in plan["strengths"]
        ]
    }


def make_case(plan: dict[str, Any]) -> tuple[xr.Dataset, dict[str, Any]]:
    """Make the log and the truth of a plan (see `gyrostab.blindtest.scenarios.plan.plan_case`).

    A hand-written plan may name any effect of the catalogue; an unknown one, or a sub-threshold
    case that cannot be drawn, is an `OptionError`. With ``copy`` of `plan_counterparts`, the
    effects are left out of the record: noise, missing samples, channels and quantization are those
    of the case. The log has no information about the truth, which is ready for JSON.
    """
    catalogue = CATALOGUE | OUT_OF_CATALOGUE
    unknown = [name for name in plan["names"] if name not in catalogue]
    if unknown:
        raise OptionError(f"{unknown[0]!r} is not in the catalogue; it has {', '.join(catalogue)}")
    entries = [catalogue[name] for name in plan["names"]]
    seed = int(stream(plan["seed"], "case", plan["index"]).integers(2**40))
    for attempt in range(_MAX_TRIES):
        plan = _weaken_plan(plan, attempt)
        scenario = draw_suitable(plan, entries, attempt)
        effects = [
            catalogue[name].make(
                scenario,
                stream(plan["seed"], "effect", plan["index"], attempt, name),
                strength=strength,
                in_fitted_noise=plan["in_fitted_noise"],
            )
            for name, strength in zip(plan["names"], plan["strengths"], strict=True)
        ]
        record = make_record(scenario, effects, seed=seed + attempt)
        visibility = (
            find_visibility(scenario, effects, record, rng=stream(seed, "band", attempt))
            if plan["kind"] == "sub_threshold"
            else None
        )
        if visibility is None or visibility["sub_threshold"]:
            break
    else:
        raise OptionError(
            f"case {plan['index']} of seed {plan['seed']}: {plan['names']} at {plan['strengths']} "
            "cannot be made sub-threshold; reduce the strength"
        )
    channels = make_channels(scenario, effects, stream(seed, "channels", attempt))
    if plan["degradation"]:
        driver = entries[0].channel
        channels = degrade_driver(
            channels, str(driver), how=plan["degradation"], rng=stream(seed, "degradation", attempt)
        )
    if plan.get("copy") == "counterpart":
        missing = find_missing(scenario, effects)
        scenario, effects = replace(scenario, missing=missing), []
        record = make_record(scenario, effects, seed=seed + attempt)
        plan = plan | {"kind": "counterpart"}
    log = make_log(record, channels, start=scenario.start, rate=scenario.rate)
    truth = describe_truth(scenario, effects) | {
        "plan": plan,
        "visibility": visibility,
        "attempts": attempt + 1,
    }
    return log, truth


def _format_time(scenario: Scenario, second: float) -> str:
    stamp = np.datetime64(int(scenario.start + round(second * 1e9)), "ns")
    return str(np.datetime_as_string(stamp, unit="ms"))


def _list_intervals(scenario: Scenario, active: Bools | None) -> list[list[str]]:
    """List the ISO 8601 intervals in which an effect is active; without a mask the whole record."""
    if active is None:
        return [[_format_time(scenario, 0.0), _format_time(scenario, scenario.seconds)]]
    return [
        [_format_time(scenario, float(a)), _format_time(scenario, min(float(b), scenario.seconds))]
        for a, b in telemetry.list_spans(active)
    ]


def _block_means(scenario: Scenario, values: Floats) -> list[float]:
    length = round(WAVEFORM_BLOCK_S * scenario.rate)
    padded_size = math.ceil(values.size / length) * length
    padded = np.concatenate([values, np.full(padded_size - values.size, np.nan)]).reshape(
        -1, length
    )
    return [float(f"{value:.6g}") for value in np.nanmean(padded, axis=1)]


def _describe_effect(scenario: Scenario, effect: HiddenEffect) -> dict[str, Any]:
    waveform = {}
    if effect.mean is not None:
        waveform = {
            axis: _block_means(scenario, row)
            for axis, row in zip(AXES, effect.mean, strict=True)
            if axis in effect.axes
        }
    return {
        "name": effect.name,
        "axes": list(effect.axes),
        "driver": effect.driver,
        "form": effect.form,
        "form_differs": bool(effect.form_differs),
        "strength": float(effect.strength),
        "size": float(effect.size),
        "expected_nats": float(effect.nats),
        "learned_nats": fitted_nats(scenario, effect),
        "tau_min_s": float(effect.tau[0]),
        "tau_max_s": float(effect.tau[1]),
        "localised": effect.active is not None,
        "intervals": _list_intervals(scenario, effect.active),
        "parameters": effect.parameters,
        "waveform_10s": waveform,
    }


def describe_truth(scenario: Scenario, effects: Sequence[HiddenEffect]) -> dict[str, Any]:
    """Describe the ground truth of a case, ready for JSON."""
    return {
        "schema": "gyrostab.blindtest/2",
        "effects": [_describe_effect(scenario, effect) for effect in effects],
        "accepted": sorted({name for effect in effects for name in effect.also_accepted}),
        "in_catalogue": all(effect.name in CATALOGUE for effect in effects),
        "noise": {axis: dict(noise) for axis, noise in zip(AXES, scenario.noise, strict=True)},
        "flicker": scenario.flicker,
        "sampling_rate_hz": scenario.rate,
        "start": _format_time(scenario, 0.0),
        "seconds": scenario.seconds,
        "missing_share": float(find_missing(scenario, effects).mean()),
        "power_cuts": scenario.cuts.tolist(),
    }


def truth_text(truth: dict[str, Any]) -> str:
    """Format a truth as the text to commit: JSON with sorted keys, and a nonce against guessing.

    Examples
    --------
    >>> truth_text({"seconds": 1.0, "plan": {"seed": 1, "index": 0}})[:10]
    '{"nonce": '
    """
    plan = truth.get("plan") or {}
    nonce = stream(int(plan.get("seed", 0)), "nonce", int(plan.get("index", 0))).bytes(16).hex()
    text = json.dumps(
        {"nonce": nonce, **truth}, sort_keys=True, default=lambda value: value.tolist()
    )
    return text + "\n"


def fingerprint(text: str) -> str:
    """Compute the SHA-256 of a committed text."""
    return hashlib.sha256(text.encode()).hexdigest()


def commit_case(log: xr.Dataset, truth: dict[str, Any], directory: Path, *, name: str) -> str:
    """Write ``recordings/NAME.nc``, then ``truth/NAME.json``; return the SHA-256 of the latter.

    `gyrostab.read_log` reads the recording like any foreign NetCDF file. The name must not reveal
    the content, and the SHA-256 is to be published before the recording is diagnosed.
    """
    text, handed = truth_text(truth), log.copy()
    for variable in handed.variables.values():
        if "units" in variable.attrs:
            variable.attrs = {**variable.attrs, "units": on_disk(variable.attrs["units"])}
    packing: dict[Any, dict[str, Any]] = {
        str(key): {"zlib": True, "complevel": 1} for key in handed.data_vars if handed[key].ndim
    }
    packing |= {
        str(key): {"dtype": "int64", "units": "nanoseconds since 1970-01-01"}
        for key in handed.variables
        if np.issubdtype(handed[key].dtype, np.datetime64)
    }
    with replace_file(directory / "recordings" / f"{name}.nc") as temporary:
        handed.to_netcdf(temporary, engine="netcdf4", encoding=packing)
    write_text(directory / "truth" / f"{name}.json", text)
    return fingerprint(text)


def open_truth(path: Path, *, sha256: str) -> dict[str, Any]:
    """Read a truth; raise `FormatError` unless it is the one that was committed as `sha256`."""
    if not path.exists():
        raise FormatError(f"{path}: the truth was deleted after it was committed; restore it")
    text = path.read_text(encoding="utf-8")
    if fingerprint(text) != sha256:
        raise FormatError(
            f"{path}: the truth was changed after it was committed "
            f"(SHA-256 {fingerprint(text)[:12]}..., committed as {sha256[:12]}...)"
        )
    return dict(json.loads(text))
