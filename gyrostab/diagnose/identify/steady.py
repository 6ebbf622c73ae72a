"""Effects that nothing drives: what they add to the spectrum is there all the time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.condition import Component, condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture

__all__ = ["is_always_present"]

_STEADY = ("gauss_markov", "telegraph", "logger_filter")
_PARTS, _LEAST = 8, 3  # of the record that are looked at one by one; blocks in each at least
_APART, _FORM = (
    8.0,
    0.1,
)  # nats by which they may differ by chance; and of the gain, what other effects may leave


def is_always_present(component: Component, state: State) -> bool:
    """Whether a part that has no course in time has the same size in all eighths of the record; true for what may come and go.

    What is loud while the tool turns, or for any other while, has a broad spectrum too, and is no
    filter and no wandering bias.

    Parameters
    ----------
    component : Part
    state : State
        With all else that is named.
    """
    if (
        component.candidate.effect not in _STEADY
        or component.candidate.statistic != "power"
        or state.blocks.sizes["block"] < _PARTS * _LEAST
    ):
        return True
    state = replace(state, weight=condition_on(state, [component]).weight)
    size, error = np.array(
        [
            _size(component, state, inside)
            for inside in np.array_split(np.arange(state.blocks.sizes["block"]), _PARTS)
        ]
    ).T
    weight = np.where(np.isfinite(size) & np.isfinite(error) & (error > 0.0), error, np.inf) ** -2.0
    size = np.where(weight > 0.0, size, 0.0)
    apart = 0.5 * float(
        (weight * (size - (weight * size).sum() / max(weight.sum(), 1e-300)) ** 2).sum()
    )
    return apart <= _APART + _FORM * max(component.evidence_nats, 0.0)


def _size(component: Component, state: State, inside: NDArray[np.int64]) -> tuple[float, float]:
    """Size of the first column by some blocks alone, and its error."""
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
