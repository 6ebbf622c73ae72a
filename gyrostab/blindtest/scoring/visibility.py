"""Can the eye see it? An effect is buried when neither the raw trace nor the whole-record Allan plot shows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.blindtest.generator.noise_floor import white_level
from gyrostab.blindtest.generator.scenario import AXES, Effect, World
from gyrostab.blindtest.scoring.baseline_detectors import allan_band, band_excess

__all__ = ["FAINT", "is_buried", "trace_visibility"]

Array = NDArray[np.float64]

#: Separation d' below which nothing is seen in a trace.
FAINT = 0.1


def trace_visibility(world: World, effect: Effect) -> dict[str, float]:
    """Separation d' of samples, and of means over 1 s, with and without an effect, where the effect is at work.

    For a mean it is the rms of the mean over the standard deviation of the noise, for noise the
    change of the log variance over root 2, and both grow with the root of the number of samples
    that are averaged.

    Returns
    -------
    dict
        ``sample`` and ``second``, of the worst axis.
    """
    sample = second = 0.0
    every = max(1, round(world.rate))
    for i, noise in enumerate(world.noise):
        level = white_level(noise["N"])
        if effect.mean is not None and np.any(effect.mean[i]):
            there = ~world.missing
            values = effect.mean[i] - effect.mean[i][there].mean()
            means = values[: values.size // every * every].reshape(-1, every).mean(axis=1)
            sample = max(sample, float(values[there].std()) / (level * math.sqrt(world.rate)))
            second = max(second, float(means.std()) / level)
        change = 0.0
        if effect.variance is not None:
            logs = np.log(effect.variance[i])
            change = float((logs - logs.mean()).std())
        if effect.extra is not None:
            power = float((effect.extra[i] ** 2).mean()) / (level**2 * world.rate)
            busy = 1.0 if effect.active is None else max(float(effect.active.mean()), 1e-6)
            change = max(change, math.log1p(power / busy))
        sample = max(sample, change / math.sqrt(2))
        second = max(second, change / math.sqrt(2) * math.sqrt(every))
    return {"sample": sample, "second": second}


def is_buried(
    world: World,
    effects: Sequence[Effect],
    record: Array,
    *,
    rng: np.random.Generator,
    nulls: int = 50,
) -> dict[str, Any]:
    """Verify that no effect of a record (axis, time) can be seen, see `trace_visibility`; the Allan band is made of nulls of its own.

    Returns
    -------
    dict
        ``buried``, ``sample`` and ``second`` (the largest d'), and ``allan`` (the largest deviation
        over its 99 % limit, per axis).
    """
    seen = [trace_visibility(world, effect) for effect in effects]
    worst = {key: max((one[key] for one in seen), default=0.0) for key in ("sample", "second")}
    if max(worst.values()) >= FAINT:
        return {"buried": False, **worst, "allan": {}}
    touched = {axis for effect in effects for axis in effect.axes}
    allan: dict[str, float] = {}
    for axis, row, noise in zip(AXES, record, world.noise, strict=True):
        if axis not in touched:
            continue
        band = allan_band(
            noise=noise,
            rate=world.rate,
            missing=np.isnan(row),
            rng=rng,
            nulls=nulls,
            flicker=world.flicker,
        )
        allan[axis] = band_excess(row, band) / band["limit"]
        if allan[axis] >= 1:
            break
    return {"buried": bool(all(value < 1 for value in allan.values())), **worst, "allan": allan}
