"""What the words of a log do to the rate: rounding, a stop at the end of the range, a loop that sticks at zero."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.blindtest.generator import loop
from gyrostab.blindtest.generator.detection_limits import NATS
from gyrostab.blindtest.generator.noise_floor import white_level
from gyrostab.blindtest.generator.scenario import AXES, Effect, World
from gyrostab.blindtest.generator.shapes import variance_effect

__all__ = ["clipping", "dead_zone", "rate_quantization"]

Array = NDArray[np.float64]

#: What one sample is worth that noise alone would never give: the log of about a thousand.
_NEVER = math.log(1e3)


def _sample_sd(world: World, axis: int) -> float:
    return white_level(world.noise[axis]["N"]) * math.sqrt(world.rate)


def rate_quantization(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """The rate is rounded to steps, or cut off towards zero; the size is that of the white noise which the steps add."""
    cut = rng.random() < 0.5
    sd = np.array([_sample_sd(world, i) for i in range(len(AXES))])
    effect, step = variance_effect(
        world,
        lambda a: 1 + (a**2 / 12 / sd**2)[:, None],
        strength=strength,
        name="rate_quantization",
        axes=AXES,
        driver=None,
        form="cut off towards zero" if cut else "rounded to the nearest step",
        differs=cut,
        first=1e-3 * float(sd.min()),
        tau=(1 / world.rate, 30.0),
    )

    def after(record: Array) -> Array:
        return np.asarray((np.trunc if cut else np.rint)(record / step) * step)

    return replace(effect, after=after, parameters={"step": {"value": step, "unit": "deg/h"}})


def _stuck(strength: float) -> int:
    """Number of samples that noise alone would not give, for a strength."""
    return max(2, math.ceil(NATS * strength**2 / _NEVER))


def dead_zone(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """An axis that lies at zero rate, and a loop that holds what is nearest to zero and pulls at what is near."""
    axis = int(rng.integers(3))
    number = _stuck(strength)
    there = float((~world.missing).sum())
    width = (
        number / there * _sample_sd(world, axis) * math.sqrt(math.pi / 2)
    )  # so many normal samples lie within +- width

    def after(record: Array) -> Array:
        out = record.copy()
        out[axis] = loop.dead_zone(
            record[axis] - np.nanmean(np.where(world.missing, np.nan, record[axis])), width=width
        )
        return out

    return Effect(
        name="dead_zone",
        axes=(AXES[axis],),
        driver=None,
        form="held at zero, and pulled softly beyond",
        differs=True,
        size=strength,
        nats=NATS * strength**2,
        tau=(1 / world.rate, 10 / world.rate),
        after=after,
        parameters={"width": {"value": width, "unit": "deg/h"}},
    )


def clipping(world: World, rng: np.random.Generator, *, strength: float) -> Effect:
    """A range that ends too soon on one side or both, hard or with a soft knee."""
    axis = int(rng.integers(3))
    number = _stuck(strength)
    both, soft = bool(rng.random() < 0.5), bool(rng.random() < 0.4)

    def after(record: Array) -> Array:
        out = record.copy()
        row = np.where(world.missing, np.nan, record[axis])
        ends = np.nanquantile(
            row, [number / 2 / row.size, 1 - number / (2 if both else 1) / row.size]
        )
        low = ends[0] if both else -np.inf
        if soft:  # the last tenth of a standard deviation before the stop is squeezed
            knee = 0.1 * _sample_sd(world, axis)
            row = np.where(
                row > ends[1] - knee,
                ends[1] - knee / 2 + (row - ends[1] + knee) / 2 - knee / 2,
                row,
            )
        out[axis] = np.clip(row, low, ends[1])
        return out

    return Effect(
        name="clipping",
        axes=(AXES[axis],),
        driver=None,
        form=("on both sides" if both else "above") + (", with a soft knee" if soft else ""),
        differs=soft,
        size=strength,
        nats=NATS * strength**2,
        tau=(1 / world.rate, 10 / world.rate),
        after=after,
    )
