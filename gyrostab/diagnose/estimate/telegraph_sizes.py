"""Numbers of a bias of two levels: its step by the means, its times by the hops."""

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
    """Step of every axis [degree hour-1] and mean times on both levels [s], each with its error.

    Parameters
    ----------
    components : sequence of Part
        In the view "levels", one for each axis.
    axes : tuple of str
        Of the effect.
    state : State
        With all else that is named.

    Returns
    -------
    dict of str to (float, float)
        The lower level is that of the axis that shows most; where another axis hops the other way
        its step is negative.
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
    stays = max(float(first.values["hops"]) / 2.0, 1.0)  # on either level
    return out | {
        time: (float(first.values[time]), float(first.values[time]) / math.sqrt(stays))
        for time in ("low", "high")
    }
