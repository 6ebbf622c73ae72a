"""Order the effects that pass the threshold: the first one that passes its tests is named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifiability import find_plainer_effect
from gyrostab.diagnose.identify.switching import identify_switching, put_followers_first
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State


def order_passing(
    components: Mapping[str, list[Component]],
    required: Mapping[str, float],
    state: State,
    examination: Examination,
) -> list[str]:
    """Return the keys that pass, in the order in which they are to be named.

    Anomalous samples come first, because they raise powers and means too, and not the other
    way round. Then motion that another sensor confirms, then a bias that switches within
    blocks: its spectrum, its tails and its changing noise level would be taken for others.
    """
    ranked = sorted(components, key=lambda key: -sum_evidence(components[key]))
    passing = [key for key in ranked if sum_evidence(components[key]) > required[key]]
    counts = [
        key
        for key in passing
        if components[key][0].candidate.statistic.is_count and not key.startswith("~")
    ]
    confirmed = [
        key
        for key in passing
        if sum_evidence(_confirmed_components(components[key], state)) > required[key]
    ]
    switching = identify_switching(passing, components, state)
    first_count = min(map(passing.index, counts), default=0)
    if switching and passing.index(switching[0]) < first_count:
        counts = []
    first = (
        counts
        or confirmed
        or switching
        or _without_slopes(
            _without_locked_lines(passing, components, state),
            components,
            state,
            examination,
        )
    )
    return put_followers_first(first, components, state)


def order_rivals(
    passing: Sequence[str],
    components: Mapping[str, list[Component]],
    state: State,
    examination: Examination,
) -> list[str]:
    """Return the effects that come close to the best, plainer ones first."""
    settings = examination.settings
    best = sum_evidence(components[passing[0]])
    min_nats = best - settings.ambiguous_nats - settings.form_error_share * best
    rivals = [
        key
        for key in passing
        if not key.startswith("~") and sum_evidence(components[key]) >= min_nats
    ]
    effects = {components[key][0].candidate.effect for key in rivals}
    is_later = {
        key: _is_on_single_axis(components[key], examination.candidates)
        or find_plainer_effect(components[key], state) in effects
        for key in rivals
    }
    return sorted(
        rivals,
        key=lambda key: settings.ambiguous_nats * is_later[key] - sum_evidence(components[key]),
    )


def _without_locked_lines(
    passing: list[str], components: Mapping[str, list[Component]], state: State
) -> list[str]:
    """Drop lines that a passing phase-locked effect explains."""
    locked = [
        key
        for key in passing
        if any(component.statistic.is_phase_locked for component in components[key])
    ]
    lines = [key for key in passing if components[key][0].candidate.statistic.is_line]
    if not lines:
        return passing
    masks = [
        mask
        for key in locked
        for mask in condition_on(state, components[key]).given.get(("line", "all"), [])
    ]
    return [
        key
        for key in passing
        if key not in lines or not any(mask[components[key][0].place] for mask in masks)
    ]


def _without_slopes(
    passing: list[str],
    components: Mapping[str, list[Component]],
    state: State,
    examination: Examination,
) -> list[str]:
    """Drop lines that a passing filter explains, or the filter if lines remain.

    A line is compared with its neighbours, so that the steep slope of a filter, or the lobes of an
    average, look like one. Lines that keep half of their evidence come before the filter: many of
    them together leave a broad form in the powers too. All that explains less than the filter then
    waits with it, because any other form would be named for the slope.
    """
    lines = [key for key in passing if components[key][0].candidate.statistic.is_line]
    filters = [key for key in passing if any(component.is_filter for component in components[key])]
    if not lines or not filters:
        return passing
    trial = condition_on(state, list(components[filters[0]]))
    line_evidence = examination.compute_evidence(
        [components[key][0].candidate for key in lines], trial
    )
    nats_after = {
        evidence.candidate.key: float(np.maximum(evidence.evidence_nats[0], 0.0).sum())
        for evidence in line_evidence
    }
    nats_before = {
        key: sum(max(component.evidence_nats, 0.0) for component in components[key])
        for key in lines
    }
    real = {
        key
        for key in lines
        if nats_after.get(key, 0.0) > state.settings.majority_share * nats_before[key]
    }
    if not real:
        return [key for key in passing if key not in lines]
    stronger = passing[: passing.index(filters[0])]
    return [key for key in passing if key in real or (key in stronger and key not in lines)]


def _is_on_single_axis(components: Sequence[Component], candidates: Sequence[Candidate]) -> bool:
    """Return whether an effect that should be one process on all axes shows on one only."""
    key = components[0].candidate.key
    is_common = any(
        candidate.key == key and candidate.statistic.is_pairwise for candidate in candidates
    )
    return is_common and len({axis for component in components for axis in component.row}) == 1


def _confirmed_components(components: Sequence[Component], state: State) -> list[Component]:
    """Return the components that a channel other than an axis of the gyro sees as well."""
    return [
        component
        for component in components
        if component.statistic.is_transfer and component.candidate.reference[0] not in state.axes
    ]
