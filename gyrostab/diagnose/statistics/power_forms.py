"""Other forms of effects on the powers, which compete with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture, component_size, disagreement_nats
from gyrostab.diagnose.reduce.accumulate import RECORD_PARTS
from gyrostab.diagnose.statistics.base import Competitor
from gyrostab.physics.registry import effects


def parts_of_record(component: Component, state: State) -> Iterator[Competitor]:
    """Yield other sizes in the eighths of a record of an effect that acts all the time.

    Noise that is present only while the tool rotates has a broad spectrum too, but is neither a
    filter nor a wandering bias.
    """
    if not effects()[component.candidate.effect].is_steady:
        return
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
    yield Competitor("an effect in a part of the record", nats, allowed)


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


def separate_filters(components: Sequence[Component], state: State) -> Iterator[Competitor]:
    """Yield a filter for each axis.

    All axes pass the same logger, which takes the same share of the noise of each. The share of the
    strongest component is fitted on every axis, and once for all of them.
    """
    shown = [component for component in components if component.is_filter]
    if not shown:
        return
    first = max(shown, key=lambda component: component.evidence_nats)
    share, error = np.array(
        [component_size(replace(first, row=(axis,)), state) for axis in state.axes]
    ).T
    evidence = sum(max(component.evidence_nats, 0.0) for component in shown)
    nats = disagreement_nats(share, error**-2.0)
    allowed = state.settings.reject_nats + state.settings.spectrum_error_share * evidence
    yield Competitor("a filter on each axis", nats, allowed)
