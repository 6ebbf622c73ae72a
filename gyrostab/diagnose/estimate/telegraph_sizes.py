"""Estimate a telegraph bias: its step from the means, its dwell times from the switches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture

__all__ = ["estimate_telegraph"]


def estimate_telegraph(
    components: Sequence[Component], axes: tuple[str, ...], state: State
) -> dict[str, tuple[float, float]]:
    """Estimate the step of every axis [degree hour-1] and the dwell times of both levels [s].

    Parameters
    ----------
    components : sequence of Component
        In the statistic "levels", one for each axis.
    axes : tuple of str
        Axes of the effect.
    state : State
        With all other effects in the model.

    Returns
    -------
    dict of str to (float, float)
        Value and standard error. The lower level is that of the strongest axis; an axis that
        switches the other way has a negative step.
    """
    ranked = sorted(components, key=lambda component: -component.evidence_nats)
    name, first = ranked[0].variant.columns[0], ranked[0].variant
    course = first.design[0, 0]
    out: dict[str, tuple[float, float]] = {}
    for component in ranked:
        mean, covariance = component_mixture(component, state).moments()
        own = component.variant.design[0, 0]
        sign = 1.0 if component is ranked[0] or float(np.cov(own, course)[0, 1]) >= 0.0 else -1.0
        label = name if len(axes) == 1 else f"{name}.{component.row[0]}"
        out[label] = (sign * float(mean[0]), float(math.sqrt(covariance[0, 0])))
    stays = max(float(first.values["switches"]) / 2.0, 1.0)  # on either level
    return out | {
        time: (float(first.values[time]), float(first.values[time]) / math.sqrt(stays))
        for time in ("low", "high")
    }
