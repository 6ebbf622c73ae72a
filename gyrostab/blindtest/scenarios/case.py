"""One case: the recording that is handed over, and the truth that is not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.blindtest.generator import environment, telemetry
from gyrostab.blindtest.generator.catalogue import CATALOGUE, STRANGE, Entry
from gyrostab.blindtest.generator.detection_limits import learned_gain
from gyrostab.blindtest.generator.record import channels_of, lost, make_log, signal
from gyrostab.blindtest.generator.scenario import AXES, Effect, World, draw_world, stream
from gyrostab.blindtest.generator.telemetry import SHORTEST
from gyrostab.blindtest.scenarios.drivers import sever
from gyrostab.blindtest.scenarios.plan import STRENGTHS
from gyrostab.blindtest.scoring.visibility import is_buried
from gyrostab.errors import OptionError
from gyrostab.time.grid import grid_times

__all__ = ["BLOCK", "draw_effects", "make_case", "truth_of"]

#: Length of the means that the truth holds of every waveform [s].
BLOCK = 10.0

_TRIES = 40

#: Tries to bury an effect before it is made weaker.
_PATIENCE = 10


def _suits(world: World, entries: Sequence[Entry]) -> bool:
    needs = {entry.needs for entry in entries}
    warm = float(np.ptp(world.temperature)) > 2.0 or "heat" not in needs
    turns = world.rotation.max() > 0 or "turning" not in needs
    return bool(warm and turns)


def _world(plan: dict[str, Any], entries: Sequence[Entry], attempt: int) -> World:
    cuts = max([plan["cuts"], *(entry.cuts for entry in entries)])
    for trial in range(_TRIES):
        rng = stream(plan["seed"], "world", plan["index"], attempt, trial)
        buried = plan["kind"] == "buried"
        world = draw_world(
            rng,
            rate=plan["rate"],
            seconds=plan["seconds"],
            gaps=plan["gaps"],
            cuts=cuts,
            heavy=plan["heavy"],
            buried=buried,
        )
        if any(entry.needs == "dips" for entry in entries):
            world = replace(world, light=environment.light_monitor(rng, plan["seconds"], dips=True))
        if any(entry.cuts for entry in entries):
            world = replace(world, missing=_told_from_cuts(world))
        if any(entry.needs == "whole angle" for entry in entries):
            world = replace(world, noise=tuple(noise | {"Q": 0.0} for noise in world.noise))
        if _suits(world, entries):
            return world
    raise OptionError(
        f"case {plan['index']} of seed {plan['seed']}: no environment with {plan['names']} in it was drawn in {_TRIES} tries"
    )


def _told_from_cuts(world: World) -> NDArray[np.bool_]:
    """Losses of the line so short that nobody takes them for a power cut, where an effect hangs on the starts."""
    t = np.arange(world.size) / world.rate
    off = np.zeros(world.size, dtype=bool)
    for begin, end in world.cuts:
        off |= (t >= begin) & (t < end)
    longest = max(1, round((SHORTEST - 2.0) * world.rate))
    return np.asarray(
        off & world.missing | telemetry.shortened(world.missing & ~off, longest=longest)
    )


def _weaker(plan: dict[str, Any], attempt: int) -> dict[str, Any]:
    """A plan whose effect would not be buried in many tries, one step weaker."""
    if plan["kind"] != "buried" or attempt == 0 or attempt % _PATIENCE:
        return plan
    return plan | {
        "strengths": [
            max((s for s in STRENGTHS if s < strength), default=strength)
            for strength in plan["strengths"]
        ]
    }


def draw_effects(plan: dict[str, Any], world: World, *, attempt: int = 0) -> list[Effect]:
    """The effects of a plan in a world."""
    known = CATALOGUE | STRANGE
    return [
        known[name].make(
            world, stream(plan["seed"], "effect", plan["index"], attempt, name), strength=strength
        )
        for name, strength in zip(plan["names"], plan["strengths"], strict=True)
    ]


def make_case(plan: dict[str, Any]) -> tuple[xr.Dataset, dict[str, Any]]:
    """Make the log and the truth of a plan (see `gyrostab.blindtest.scenarios.plan.plan_case`).

    Parameters
    ----------
    plan : dict
        From `plan_case`; a hand-written one may name any effect of the catalogue.

    Returns
    -------
    log : xarray.Dataset
        A log of the contract; it holds nothing of the truth.
    truth : dict
        JSON-ready: ``effects`` with names, axes, intervals, averaging times, sizes, expected gains
        and mean waveforms, ``noise`` and more.

    Raises
    ------
    OptionError
        When a name is unknown, or a buried case cannot be drawn.

    Examples
    --------
    >>> from gyrostab.blindtest.scenarios.plan import plan_case
    >>> plan = plan_case(0, seed=5) | {"rate": 10.0, "seconds": 600, "kind": "single", "names": ["ageing_noise"], "strengths": [4.0]}
    >>> log, truth = make_case(plan)
    >>> truth["effects"][0]["name"], log.sizes["time"]
    ('ageing_noise', 6000)
    """
    known = CATALOGUE | STRANGE
    unknown = [name for name in plan["names"] if name not in known]
    if unknown:
        raise OptionError(f"no effect {unknown[0]!r} can be made; there are {', '.join(known)}")
    entries = [known[name] for name in plan["names"]]
    seed = int(stream(plan["seed"], "case", plan["index"]).integers(2**40))
    for attempt in range(_TRIES):
        plan = _weaker(plan, attempt)
        world = _world(plan, entries, attempt)
        effects = draw_effects(plan, world, attempt=attempt)
        record = signal(world, effects, seed=seed + attempt)
        proof = (
            is_buried(world, effects, record, rng=stream(seed, "band", attempt))
            if plan["kind"] == "buried"
            else None
        )
        if proof is None or proof["buried"]:
            break
    else:
        raise OptionError(
            f"case {plan['index']} of seed {plan['seed']}: {plan['names']} at {plan['strengths']} cannot be buried; lower it"
        )
    channels = channels_of(world, effects, stream(seed, "channels", attempt))
    if plan["severing"]:
        driver = entries[0].channel
        channels = sever(
            channels, str(driver), how=plan["severing"], rng=stream(seed, "sever", attempt)
        )
    log = make_log(record, channels, start=world.start, rate=world.rate)
    truth = truth_of(world, effects, strengths=plan["strengths"]) | {
        "plan": plan,
        "buried": proof,
        "attempts": attempt + 1,
    }
    return log, truth


def _iso(world: World, second: float) -> str:
    stamp = np.datetime64(int(world.start + round(second * 1e9)), "ns")
    return str(np.datetime_as_string(stamp, unit="ms"))


def intervals(world: World, active: NDArray[np.bool_] | None) -> list[list[str]]:
    """Where an effect is at work, ISO 8601; the whole record where nobody says."""
    if active is None:
        return [[_iso(world, 0.0), _iso(world, world.seconds)]]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]]))).reshape(-1, 2)
    return [[_iso(world, float(a)), _iso(world, min(float(b), world.seconds))] for a, b in edges]


def _block_means(world: World, values: NDArray[np.float64]) -> list[float]:
    length = round(BLOCK * world.rate)
    whole = math.ceil(values.size / length) * length
    padded = np.concatenate([values, np.full(whole - values.size, np.nan)]).reshape(-1, length)
    return [float(f"{value:.6g}") for value in np.nanmean(padded, axis=1)]


def _learned(world: World, effect: Effect) -> float:
    return float(
        effect.nats if effect.mean is None else min(effect.nats, learned_gain(world, effect.mean))
    )


def _told(world: World, effect: Effect, strength: float) -> dict[str, Any]:
    waveform = {}
    if effect.mean is not None:
        waveform = {
            axis: _block_means(world, row)
            for axis, row in zip(AXES, effect.mean, strict=True)
            if axis in effect.axes
        }
    return {
        "name": effect.name,
        "axes": list(effect.axes),
        "driver": effect.driver,
        "form": effect.form,
        "form_differs": bool(effect.differs),
        "strength": float(strength),
        "size": float(effect.size),
        "expected_nats": float(effect.nats),
        **(
            {} if world.own is not None else {"learned_nats": _learned(world, effect)}
        ),  # five terms say nothing of real noise
        "tau_min_s": float(effect.tau[0]),
        "tau_max_s": float(effect.tau[1]),
        "localised": effect.active is not None,
        "intervals": intervals(world, effect.active),
        "parameters": effect.parameters,
        "waveform_10s": waveform,
    }


def truth_of(
    world: World, effects: Sequence[Effect], *, strengths: Sequence[float]
) -> dict[str, Any]:
    """All that is true of a case, ready for JSON."""
    return {
        "schema": "gyrostab.concealed/1",
        "effects": [
            _told(world, effect, strength)
            for effect, strength in zip(effects, strengths, strict=True)
        ],
        "accepted": sorted({name for effect in effects for name in effect.beside}),
        "in_catalogue": all(effect.name in CATALOGUE for effect in effects),
        "noise": {axis: dict(noise) for axis, noise in zip(AXES, world.noise, strict=True)},
        "flicker": world.flicker,
        "sampling_rate_hz": world.rate,
        "start": str(
            np.datetime_as_string(
                grid_times(world.start, world.rate, 0).view("datetime64[ns]"), unit="ms"
            )
        ),
        "seconds": world.seconds,
        "missing_share": float(lost(world, effects).mean()),
        "power_cuts": world.cuts.tolist(),
    }
