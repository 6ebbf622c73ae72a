"""Make one case: the recording for the diagnosis, and its ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.blindtest.generator import environment, telemetry
from gyrostab.blindtest.generator.catalogue import CATALOGUE, OUT_OF_CATALOGUE, Entry
from gyrostab.blindtest.generator.detection_limits import fitted_nats
from gyrostab.blindtest.generator.record import find_missing, make_channels, make_log, make_record
from gyrostab.blindtest.generator.scenario import AXES, Effect, Scenario, draw_scenario, stream
from gyrostab.blindtest.scenarios.drivers import degrade_driver
from gyrostab.blindtest.scenarios.plan import STRENGTHS
from gyrostab.blindtest.scoring.visibility import find_visibility
from gyrostab.errors import OptionError
from gyrostab.time.grid import grid_times

#: Length of the block means of a waveform in the truth [s].
WAVEFORM_BLOCK_S = 10.0

_MAX_TRIES = 40

#: Tries to draw a sub-threshold effect before its strength is reduced.
_TRIES_PER_STRENGTH = 10


def _is_suitable(scenario: Scenario, entries: Sequence[Entry]) -> bool:
    needs = {entry.needs for entry in entries}
    warm = float(np.ptp(scenario.temperature)) > 2.0 or "heat" not in needs
    turns = scenario.rotation.max() > 0 or "rotation" not in needs
    return bool(warm and turns)


def draw_suitable(plan: dict[str, Any], entries: Sequence[Entry], attempt: int) -> Scenario:
    """Draw the environment of a plan until it contains what all of its effects need."""
    cuts = max([plan["cuts"], *(entry.cuts for entry in entries)])
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
        if any(entry.needs == "dips" for entry in entries):
            scenario = replace(
                scenario, light=environment.light_monitor(rng, plan["seconds"], dips=True)
            )
        if any(entry.cuts for entry in entries):
            scenario = replace(scenario, missing=_shorten_losses(scenario))
        if any(entry.needs == "unquantized angle" for entry in entries):
            scenario = replace(
                scenario, noise=tuple(noise | {"Q": 0.0} for noise in scenario.noise)
            )
        if _is_suitable(scenario, entries):
            return scenario
    raise OptionError(
        f"case {plan['index']} of seed {plan['seed']}: no environment with {plan['names']} "
        f"was drawn in {_MAX_TRIES} tries"
    )


def _shorten_losses(scenario: Scenario) -> NDArray[np.bool_]:
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


def draw_effects(plan: dict[str, Any], scenario: Scenario, *, attempt: int = 0) -> list[Effect]:
    """Draw the effects of a plan in a scenario."""
    catalogue = CATALOGUE | OUT_OF_CATALOGUE
    return [
        catalogue[name].make(
            scenario,
            stream(plan["seed"], "effect", plan["index"], attempt, name),
            strength=strength,
            in_fitted_noise=plan["in_fitted_noise"],
        )
        for name, strength in zip(plan["names"], plan["strengths"], strict=True)
    ]


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
        effects = draw_effects(plan, scenario, attempt=attempt)
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


def _list_intervals(scenario: Scenario, active: NDArray[np.bool_] | None) -> list[list[str]]:
    """List the ISO 8601 intervals in which an effect is active; without a mask the whole record."""
    if active is None:
        return [[_format_time(scenario, 0.0), _format_time(scenario, scenario.seconds)]]
    return [
        [_format_time(scenario, float(a)), _format_time(scenario, min(float(b), scenario.seconds))]
        for a, b in telemetry.list_spans(active)
    ]


def _block_means(scenario: Scenario, values: NDArray[np.float64]) -> list[float]:
    length = round(WAVEFORM_BLOCK_S * scenario.rate)
    padded_size = math.ceil(values.size / length) * length
    padded = np.concatenate([values, np.full(padded_size - values.size, np.nan)]).reshape(
        -1, length
    )
    return [float(f"{value:.6g}") for value in np.nanmean(padded, axis=1)]


def _describe_effect(scenario: Scenario, effect: Effect) -> dict[str, Any]:
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


def describe_truth(scenario: Scenario, effects: Sequence[Effect]) -> dict[str, Any]:
    """Describe the ground truth of a case, ready for JSON."""
    return {
        "schema": "gyrostab.blindtest/2",
        "effects": [_describe_effect(scenario, effect) for effect in effects],
        "accepted": sorted({name for effect in effects for name in effect.also_accepted}),
        "in_catalogue": all(effect.name in CATALOGUE for effect in effects),
        "noise": {axis: dict(noise) for axis, noise in zip(AXES, scenario.noise, strict=True)},
        "flicker": scenario.flicker,
        "sampling_rate_hz": scenario.rate,
        "start": str(
            np.datetime_as_string(
                grid_times(scenario.start, scenario.rate, 0).view("datetime64[ns]"), unit="ms"
            )
        ),
        "seconds": scenario.seconds,
        "missing_share": float(find_missing(scenario, effects).mean()),
        "power_cuts": scenario.cuts.tolist(),
    }
