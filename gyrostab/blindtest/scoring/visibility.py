"""Visibility of an effect; sub-threshold effects show in neither raw trace nor Allan plot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.blindtest.generator.noise_floor import white_level
from gyrostab.blindtest.generator.scenario import AXES, Effect, Scenario
from gyrostab.blindtest.scoring.baseline_detectors import allan_band, band_excess

Array = NDArray[np.float64]

#: Separation d' below which an effect is invisible in a trace.
MAX_SEPARATION = 0.1
_NULLS = 50  # records of noise, for the band of the Allan plot


def trace_visibility(scenario: Scenario, effect: Effect) -> dict[str, float]:
    """Compute the separation d' of samples and of 1 s means with and without an effect.

    For a mean, d' is its rms over the standard deviation of the noise; for a noise effect, the
    change of the log variance over root 2. Both grow with the root of the samples averaged, and are
    those of the worst axis.
    """
    sample = second = 0.0
    every = max(1, round(scenario.rate))
    for i, noise in enumerate(scenario.noise):
        level = white_level(noise["N"])
        if effect.mean is not None and np.any(effect.mean[i]):
            present = ~scenario.missing
            values = effect.mean[i] - effect.mean[i][present].mean()
            means = values[: values.size // every * every].reshape(-1, every).mean(axis=1)
            sample = max(sample, float(values[present].std()) / (level * math.sqrt(scenario.rate)))
            second = max(second, float(means.std()) / level)
        change = 0.0
        if effect.variance is not None:
            logs = np.log(effect.variance[i])
            change = float((logs - logs.mean()).std())
        if effect.extra is not None:
            power = float((effect.extra[i] ** 2).mean()) / (level**2 * scenario.rate)
            busy = 1.0 if effect.active is None else max(float(effect.active.mean()), 1e-6)
            change = max(change, math.log1p(power / busy))
        sample = max(sample, change / math.sqrt(2))
        second = max(second, change / math.sqrt(2) * math.sqrt(every))
    return {"sample": sample, "second": second}


def find_visibility(
    scenario: Scenario,
    effects: Sequence[Effect],
    record: Array,
    *,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Test whether the effects of a record (axis, time) are sub-threshold.

    Return ``sub_threshold``, ``sample`` and ``second`` (the largest d', see `trace_visibility`),
    and ``allan`` (the largest deviation over its 99 % limit, per axis).
    """
    visible = [trace_visibility(scenario, effect) for effect in effects]
    worst = {key: max((d[key] for d in visible), default=0.0) for key in ("sample", "second")}
    if max(worst.values()) >= MAX_SEPARATION:
        return {"sub_threshold": False, **worst, "allan": {}}
    touched = {axis for effect in effects for axis in effect.axes}
    allan: dict[str, float] = {}
    for axis, row, noise in zip(AXES, record, scenario.noise, strict=True):
        if axis not in touched:
            continue
        band = allan_band(
            noise=noise,
            rate=scenario.rate,
            missing=np.isnan(row),
            rng=rng,
            nulls=_NULLS,
            flicker=scenario.flicker,
        )
        allan[axis] = band_excess(row, band) / band["limit"]
        if allan[axis] >= 1:
            break
    return {
        "sub_threshold": bool(all(value < 1 for value in allan.values())),
        **worst,
        "allan": allan,
    }
