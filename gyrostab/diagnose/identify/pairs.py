"""Find two effects that together explain more than a nuisance alternative."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement

from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifiability import keep_physical
from gyrostab.diagnose.identify.identification import form_error, make_selection
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State


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
    is_course = alternative[0].statistic.is_switching  # of levels, as jumps make it
    keys = [
        key
        for key in passing
        if not key.startswith("~")
        and (
            components[key][0].statistic is alternative[0].statistic
            or (is_course and components[key][0].statistic.is_linear_in_means)
        )
    ]
    companions = {
        key: _find_beside(examination, keys, components[key], required[key], state) for key in keys
    }
    totals = {
        (first, second): sum_evidence(components[first]) + sum_evidence(components_beside[second])
        for first, (_, components_beside) in companions.items()
        for second in components_beside
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
    with_second, beside_second = companions[second]
    first_components = beside_second[first]
    with_first, beside_first = _find_beside(
        examination, [second], first_components, required[first], state
    )
    if second not in beside_first:
        return []
    return [(first, first_components, with_second), (second, beside_first[second], with_first)]


def _find_beside(
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
    components_beside = {}
    for key, effect_components in examination.find_components(sought, with_first).items():
        error = form_error(effect_components, chosen, settings=examination.settings)
        physical, _ = keep_physical(effect_components, with_first, error=error)
        if sum_evidence(physical) > examination.threshold + error:
            components_beside[key] = physical
    return with_first, components_beside
