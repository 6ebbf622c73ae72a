"""Effects of digitisation and of the range: quantization, clipping and a dead zone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator import instrument
from gyrostab.blindtest.generator.detection_limits import NATS, NATS_PER_SAMPLE
from gyrostab.blindtest.generator.scenario import AXES, HiddenEffect, Scenario
from gyrostab.blindtest.generator.shapes import make_variance_effect, sample_sd


def rate_quantization(
    scenario: Scenario, rng: np.random.Generator, *, strength: float
) -> HiddenEffect:
    """Draw a rate that is rounded or truncated to steps, sized by the white noise the steps add.

    Every sample is on the grid of the steps, which shows them at any size.
    """
    cut = rng.random() < 0.5
    sd = np.array([sample_sd(scenario, i) for i in range(len(AXES))])
    effect, step = make_variance_effect(
        scenario,
        lambda a: 1 + (a**2 / 12 / sd**2)[:, None],
        strength=strength,
        axes=AXES,
        form="cut off towards zero" if cut else "rounded to the nearest step",
        form_differs=cut,
        first=1e-3 * float(sd.min()),
        tau=(1 / scenario.rate, 30.0),
    )

    def after(record: Floats) -> Floats:
        return np.asarray((np.trunc if cut else np.rint)(record / step) * step)

    return replace(effect, after=after, parameters={"step": {"value": step, "unit": "deg/h"}})


def dead_zone(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a closed loop that holds rates near zero at zero, on one axis at zero mean rate."""
    axis = int(rng.integers(3))
    share = NATS * strength**2 / NATS_PER_SAMPLE / float((~scenario.missing).sum())
    width = (
        share * sample_sd(scenario, axis) * math.sqrt(math.pi / 2)
    )  # expected share of normal samples within +- width

    def after(record: Floats) -> Floats:
        out = record.copy()
        out[axis] = instrument.apply_dead_zone(
            record[axis] - np.nanmean(np.where(scenario.missing, np.nan, record[axis])), width=width
        )
        return out

    return HiddenEffect(
        axes=(AXES[axis],),
        form="held at zero, and pulled softly beyond",
        form_differs=True,
        size=strength,
        nats=NATS * strength**2,
        tau=(1 / scenario.rate, 10 / scenario.rate),
        after=after,
        parameters={"width": {"value": width, "unit": "deg/h"}},
    )


def clipping(scenario: Scenario, rng: np.random.Generator, *, strength: float) -> HiddenEffect:
    """Draw a range that clips one axis on one side or both, with a hard edge or a soft knee."""
    axis = int(rng.integers(3))
    equal = max(1, round(NATS * strength**2 / NATS_PER_SAMPLE))  # to another one
    is_two_sided, soft = bool(rng.random() < 0.5), bool(rng.random() < 0.4)
    number = equal + (2 if is_two_sided else 1)  # the first at a limit could be noise

    def after(record: Floats) -> Floats:
        row = record[axis]
        present = row[np.isfinite(row) & ~scenario.missing]
        below = number // 2 if is_two_sided else 0
        ordered, above = np.sort(present), present.size - (number - below)
        low = ordered[below - 1 : below + 1].mean() if below else -np.inf
        high = ordered[above - 1 : above + 1].mean()
        if soft:  # compress the last tenth of a standard deviation before the limit
            bend = high - 0.1 * sample_sd(scenario, axis)
            row = np.where(row > bend, (row + bend) / 2, row)
            high = (high + bend) / 2
        out = record.copy()
        out[axis] = np.clip(row, low, high)
        return out

    return HiddenEffect(
        axes=(AXES[axis],),
        form=("on both sides" if is_two_sided else "above")
        + (", with a soft knee" if soft else ""),
        form_differs=soft,
        size=math.sqrt(equal * NATS_PER_SAMPLE / NATS),
        nats=equal * NATS_PER_SAMPLE,
        tau=(1 / scenario.rate, 10 / scenario.rate),
        after=after,
    )
