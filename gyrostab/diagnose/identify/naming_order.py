"""Order the effects that pass the threshold: the first one that passes its tests is named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement

import numpy as np

from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifiability import find_plainer_effect, keep_physical
from gyrostab.diagnose.identify.selections import ambiguous_evidence, form_error, make_selection
from gyrostab.diagnose.predict.candidates import Candidate, Component, is_nuisance
from gyrostab.diagnose.predict.condition import condition_on, mean_columns
from gyrostab.diagnose.predict.linear_model import State


def order_passing(
    components: Mapping[str, list[Component]],
    required: Mapping[str, float],
    state: State,
    examination: Examination,
) -> list[str]:
    """Return the keys that are to be named next, in their order; all others wait.

    Anomalous samples come first, because they raise powers and means too, and not the other
    way round. Then motion that another sensor confirms, then a bias that switches within
    blocks: its spectrum, its tails and its changing noise level would be taken for others.
    """
    ranked = sorted(components, key=lambda key: -sum_evidence(components[key]))
    passing = [key for key in ranked if sum_evidence(components[key]) > required[key]]
    counts = [
        key
        for key in passing
        if components[key][0].candidate.statistic.is_count and not is_nuisance(key)
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
        or _on_other_axes(_without_slopes(passing, components, state, examination), components)
    )
    return drop_switching_with_a_cause(first, components, state)


def _on_other_axes(passing: list[str], components: Mapping[str, Sequence[Component]]) -> list[str]:
    """Return the effects on whose axes no nuisance alternative explains more; all without any.

    An axis that moves, for instance, has much that no effect explains. What another axis senses of
    it by its misalignment does not compete with that.
    """
    if not passing or not is_nuisance(passing[0]):
        return passing
    alternatives = [key for key in passing if is_nuisance(key)]
    first = []
    for key in passing:
        axes = {axis for component in components[key] for axis in component.row}
        rivals = [
            sum_evidence([other for other in components[alternative] if axes & {*other.row}])
            for alternative in alternatives
        ]
        if key not in alternatives and max(rivals) < sum_evidence(components[key]):
            first.append(key)
    return first or passing


def order_rivals(
    passing: Sequence[str],
    components: Mapping[str, list[Component]],
    state: State,
    examination: Examination,
) -> list[str]:
    """Return the effects that come close to the best, simpler ones first."""
    settings = examination.settings
    best = sum_evidence(components[passing[0]])
    rivals = [
        key
        for key in passing
        if not is_nuisance(key)
        and sum_evidence(components[key])
        >= ambiguous_evidence(components[key][:1], best, settings=settings)
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
    trial = condition_on(state, components[filters[0]])
    after = examination.find_components([components[key][0].candidate for key in lines], trial)
    real = {
        key
        for key in lines
        if sum_evidence(after.get(key, []))
        > state.settings.majority_share * sum_evidence(components[key])
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


def drop_switching_with_a_cause(
    passing: list[str], components: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Drop telegraph biases while a passing mean that follows a channel may be their cause.

    A channel that switches makes two levels as well, and because its form is not exact, what it
    leaves switches with it. Therefore the channel comes first where it explains more on the same
    axis, or half of the course of the switching.
    """
    driven_means = [
        component
        for key in passing
        for component in components[key]
        if component.statistic.is_linear_in_means and any(component.candidate.driver)
    ]
    return [
        key
        for key in passing
        if not any(
            component.statistic.is_switching
            and other.row == component.row
            and (
                other.evidence_nats >= component.evidence_nats
                or _explained_share(component, other, state) > state.settings.majority_share
            )
            for component in components[key]
            for other in driven_means
        )
    ]


def _explained_share(component: Component, other: Component, state: State) -> float:
    """Return the share of the variance of a course that another component explains."""
    row = state.axes.index(component.row[0])
    course = mean_columns(component.variant, row)[0]
    other_columns = np.stack(mean_columns(other.variant, row), axis=1)
    good = (
        np.isfinite(state.blocks["mean"].values[row])
        & np.isfinite(other_columns).all(axis=1)
        & np.isfinite(course)
    )
    course, other_columns = (
        course[good] - course[good].mean(),
        other_columns[good] - other_columns[good].mean(axis=0),
    )
    size, *_ = np.linalg.lstsq(other_columns, course, rcond=None)
    return float(
        1.0
        - np.square(course - other_columns @ size).sum()
        / max(float(np.square(course).sum()), 1e-300)
    )


def identify_switching(
    passing: list[str], components: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Return the keys of biases that switch within blocks and have no possible cause.

    No other effect in the means of the same axis explains more. An axis has one of them: with it in
    the model, more switching does not explain powers and tails that the first has left, and may be
    a jump.
    """
    strongest: dict[tuple[str, ...], float] = {}
    for key in passing:
        for component in components[key]:
            if component.statistic.is_linear_in_means and not is_nuisance(key):
                best = strongest.get(component.row, 0.0)
                strongest[component.row] = max(best, component.evidence_nats)
    return [
        key
        for key in drop_switching_with_a_cause(passing, components, state)
        if not is_nuisance(key)
        and any(
            component.variant.inside.size
            and not state.given.get(("sub_block", component.row[0]))
            and component.evidence_nats > strongest.get(component.row, 0.0)
            for component in components[key]
        )
    ]


def find_pair(
    examination: Examination,
    passing: Sequence[str],
    components: Mapping[str, list[Component]],
    required: Mapping[str, float],
    state: State,
) -> list[tuple[str, list[Component], State]]:
    """Find two effects that together explain more than the nuisance alternative.

    Two jumps are such a pair if the alternative is a course of levels. An alternative of any form
    explains more than each of them while the other is not in the model. The evidence of a pair is
    the lower one of both orders: an effect that is fitted alone to both may have a form that the
    second one has to undo.

    Returns the key of each, what it explains with the other in the model, and the state with that
    other one; nothing without such a pair.
    """
    alternative = components[passing[0]]
    is_in_means = alternative[0].statistic.view == "mean"
    is_course = alternative[0].statistic.is_switching  # of levels, as jumps make it
    keys = [
        key
        for key in passing
        if not is_nuisance(key)
        and (
            components[key][0].statistic is alternative[0].statistic
            or (is_in_means and components[key][0].statistic.is_linear_in_means)
        )
    ]
    companions = {
        key: _find_companions(examination, keys, components[key], required[key], state)
        for key in keys
    }
    totals = {
        (first, second): sum_evidence(components[first])
        + sum_evidence(components_with_first[second])
        for first, (_, components_with_first) in companions.items()
        for second in components_with_first
    }
    pairs = {
        pair: min(totals[pair], totals[pair[::-1]])
        for pair in combinations_with_replacement(keys, 2)
        if pair in totals
        and pair[::-1] in totals
        and (pair[0] != pair[1] or (is_course and components[pair[0]][0].is_step))
    }
    best = max(pairs, key=lambda pair: pairs[pair], default=None)
    if best is None or pairs[best] <= sum_evidence(alternative):
        return []
    first, second = best
    state_with_second, components_with_second = companions[second]
    first_components = components_with_second[first]
    state_with_first, components_with_first = _find_companions(
        examination, [second], first_components, required[first], state
    )
    if second not in components_with_first:
        return []
    return [
        (first, first_components, state_with_second),
        (second, components_with_first[second], state_with_first),
    ]


def _find_companions(
    examination: Examination,
    keys: Sequence[str],
    components: list[Component],
    required: float,
    state: State,
) -> tuple[State, dict[str, list[Component]]]:
    """Return which of some effects pass with these components in the model."""
    chosen = [make_selection(components, required)]
    with_first = condition_on(state, components)
    sought = [candidate for candidate in examination.candidates if candidate.key in keys]
    companions = {}
    for key, effect_components in examination.find_components(sought, with_first).items():
        error = form_error(effect_components, chosen, settings=examination.settings)
        physical, _ = keep_physical(effect_components, with_first, error=error)
        if sum_evidence(physical) > examination.threshold + error:
            companions[key] = physical
    return with_first, companions
