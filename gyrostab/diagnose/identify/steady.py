"""Check that effects without a driver are present all the time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture, disagreement_nats
from gyrostab.diagnose.reduce.accumulate import RECORD_PARTS
from gyrostab.physics.registry import effects


def intermittent_nats(component: Component, state: State) -> float:
    """Return by how much other sizes in the eighths of a record explain more than one [nats].

    Zero unless they do so clearly, and for effects that may be intermittent. Noise that is present
    only while the tool rotates has a broad spectrum too, but is neither a filter nor a wandering
    bias.

    Parameters
    ----------
    state : State
        With all other effects in the model.
    """
    if not (component.statistic.is_power and effects()[component.candidate.effect].is_steady):
        return 0.0
    state = replace(state, weight=condition_on(state, [component]).weight)
    size, error = np.array(
        [
            _fit_part(component, state, inside)
            for inside in np.array_split(np.arange(state.blocks.sizes["block"]), RECORD_PARTS)
        ]
    ).T
    weight = np.where(np.isfinite(size) & np.isfinite(error) & (error > 0.0), error, np.inf) ** -2.0
    size = np.where(weight > 0.0, size, 0.0)
    nats = disagreement_nats(size, weight)
    allowed = state.settings.disagreement_nats + state.settings.spectrum_error_share * max(
        component.evidence_nats, 0.0
    )
    return nats if nats > allowed else 0.0


def _fit_part(component: Component, state: State, inside: NDArray[np.int64]) -> tuple[float, float]:
    """Fit the first column to some blocks only; return its size and error."""
    outside = np.ones(state.masked.shape[1], np.bool_)
    outside[inside] = False
    row = state.axes.index(component.row[0])
    power = state.blocks["power"].isel(axis=row).values
    if not (np.isfinite(power).any(axis=1) & ~state.masked[row] & ~outside).any():
        return 0.0, np.inf
    mean, covariance = component_mixture(
        component, replace(state, masked=state.masked | outside)
    ).moments()
    return float(mean[0]), float(np.sqrt(covariance[0, 0]))
