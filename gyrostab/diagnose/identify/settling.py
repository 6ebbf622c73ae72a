"""Test each selection again with all others in the model: evidence, axes and alternatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np

from gyrostab.diagnose.identify.components import (
    PLAIN_LINE,
    candidates_of,
    renew_component,
    split_layers,
    sum_evidence,
)
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifiability import (
    find_equivalent_effects,
    find_spectral_alternatives,
    keep_physical,
)
from gyrostab.diagnose.identify.selections import (
    Selection,
    ambiguous_evidence,
    components_of,
    with_axes_of,
)
from gyrostab.diagnose.predict.candidates import Component, is_nuisance
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State


def prune_selections(examination: Examination, chosen: list[Selection]) -> list[Selection]:
    """Drop what is unidentified and lacks the evidence that it needs with the others in the model.

    The weakest is tested first. Then identifications lose the axes that no longer show them.
    """
    for selection in sorted(
        chosen, key=lambda selection: (selection.is_named, selection.evidence_nats)
    ):
        others = [other for other in chosen if other is not selection]
        if not others:
            break
        components_by_key = examination.find_components(
            candidates_of(selection.components), examination.state_with(others)
        )
        best = max(map(sum_evidence, components_by_key.values()), default=0.0)
        if selection.is_named:
            reduced = with_axes_of(selection, components_by_key, examination.settings)
            chosen = [reduced if other is selection else other for other in chosen]
        elif best < examination.required_nats(selection.components, others):
            chosen = others
    return chosen


def settle_selections(
    examination: Examination, chosen: list[Selection]
) -> tuple[list[Selection], list[Selection]]:
    """Finish the identifications, and drop the weakest until all reach their threshold.

    Returns what is unidentified, and the finished identifications.
    """
    unidentified = [selection for selection in chosen if not selection.is_named]
    while True:
        named = [selection for selection in chosen if selection.is_named]
        identified = [_finish_identification(examination, item, chosen) for item in named]
        margins = []
        for identification in identified:
            others = [other for other in identified if other is not identification]
            required = examination.required_nats(identification.components, others)
            # whatever was named first
            margins.append(identification.evidence_nats - max(identification.threshold, required))
        if min(margins, default=0.0) >= 0.0:
            return unidentified, identified
        weakest = named[int(np.argmin(margins))]
        chosen = [selection for selection in chosen if selection is not weakest]


def _finish_identification(
    examination: Examination, identification: Selection, chosen: Sequence[Selection]
) -> Selection:
    """Return an identification with its evidence and its rivals, all others in the model."""
    state = examination.state_with(chosen, without=identification)
    key = identification.components[0].candidate.key
    on_axes, weighted = find_instead(examination, identification, state)
    layers = _find_layers_again(
        examination, identification.components, on_axes.get(key, []), weighted
    )
    evidence_nats = sum(max(sum_evidence(layer), 0.0) for layer in layers)
    instead = sum_by_key(on_axes)
    min_nats = ambiguous_evidence(identification.components, evidence_nats, examination.settings)
    rivals = [
        on_axes[other][0].candidate.effect
        for other, nats in instead.items()
        if other != key
        and not is_nuisance(other)
        and nats >= min_nats
        and sum_evidence(keep_physical(on_axes[other], state)[0]) >= min_nats
    ]
    lines = {
        component.line_index
        for component in components_of(chosen)
        if component.candidate.effect == PLAIN_LINE
    }
    rivals += find_equivalent_effects(identification.components, state, lines=len(lines))
    spectral_alternatives = find_spectral_alternatives([*chain(*layers)], weighted, examination)
    alternatives = dict.fromkeys([*identification.alternatives, *rivals, *spectral_alternatives])
    alternatives.pop(identification.effect, None)
    components = tuple(
        renew_component(component, layer_components)
        for layer, layer_components in zip(
            split_layers(identification.components), layers, strict=True
        )
        for component in layer
    )
    return replace(
        identification,
        evidence_nats=evidence_nats,
        alternatives=tuple(alternatives),
        components=components,
        # as probable as this effect, whatever their own form explains
        instead=instead | dict.fromkeys(spectral_alternatives, evidence_nats),
    )


def find_instead(
    examination: Examination, selection: Selection, state: State
) -> tuple[dict[str, list[Component]], State]:
    """Return the components of candidates that could take the place of a selection.

    They are in its statistics and on its axes. `state` has all others in the model; it is returned
    with the weights that it has with the selection.
    """
    weighted = replace(
        state, expected_power=condition_on(state, selection.components).expected_power
    )
    statistics = {component.statistic for component in selection.components}
    candidates = [
        candidate for candidate in examination.candidates if candidate.statistic in statistics
    ]
    axes = set(selection.axes)
    return {
        key: [component for component in components if set(component.row) & axes]
        for key, components in examination.find_components(candidates, weighted).items()
    }, weighted


def sum_by_key(components: Mapping[str, Sequence[Component]]) -> dict[str, float]:
    """Return the evidence of each effect from its components [nats]."""
    return {
        key: sum_evidence(effect_components)
        for key, effect_components in components.items()
        if effect_components
    }


def _find_layers_again(
    examination: Examination,
    components: Sequence[Component],
    first: Sequence[Component],
    state: State,
) -> list[list[Component]]:
    """Find the components of each layer again, with the layers before it in the model.

    The evidence of several variants together is not that of one of them: the first of two opposite
    jumps explains little alone. `first` was found with none of the identification in the model.
    """
    out = [list(first)]
    expected_power, key = state.expected_power, components[0].candidate.key
    axes = {axis for component in components for axis in component.row}
    for previous_layer, layer in pairwise(split_layers(components)):
        state = replace(condition_on(state, previous_layer), expected_power=expected_power)
        layer_components = examination.find_components(candidates_of(layer), state).get(key, [])
        out.append([component for component in layer_components if set(component.row) & axes])
    return out
