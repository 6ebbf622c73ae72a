"""Say for each effect that was examined and not named what explains the record better."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from gyrostab.diagnose.identify.components import axes_of, sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import Rejection, Selection
from gyrostab.diagnose.identify.nuisance_alternatives import NUISANCE_ALTERNATIVES
from gyrostab.diagnose.identify.settling import evidence_instead
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State

_NOISE = "noise"


def find_rejections(
    components: Mapping[str, Sequence[Component]],
    identified: Sequence[Selection],
    unidentified: Sequence[Selection],
    beaten: Mapping[str, tuple[str, float]],
    state: State,
    examination: Examination,
) -> list[Rejection]:
    """Return for each effect that was not named what beats it, and by how much.

    The noise beats an effect that lacks evidence both with all selections in the model and in
    place of any of them. A selection beats it if the effect has enough evidence in its place;
    among several, it is the one in whose place the evidence is largest. If the effect has enough
    evidence although all selections are in the model, what beat it in the selection does, by key in
    `beaten`. `components` of every candidate and `state` have all selections in the model.
    """
    settled: list[Selection] = [*identified, *unidentified]
    chosen: list[Selection] = [
        *identified,
        *(
            replace(selection, instead=evidence_instead(examination, selection, settled))
            if selection.components
            else selection
            for selection in unidentified
        ),
    ]
    named = {
        selection.effect for selection in (*examination.expected, *chosen) if selection.is_named
    }
    out: dict[str, tuple[float, Rejection]] = {}
    for key, effect_components in components.items():
        effect = effect_components[0].candidate.effect
        if key.startswith("~") or effect in named:
            continue
        added_nats = sum_evidence(effect_components)
        required = examination.required_nats(effect_components, chosen)
        winner = max(
            chosen, key=lambda selection: selection.instead.get(key, -math.inf), default=None
        )
        instead = winner.instead.get(key, -math.inf) if winner else -math.inf
        if added_nats > required:
            name, nats = (
                _find_withdrawn(effect, chosen)
                or beaten.get(key)
                or _find_strongest(effect_components, chosen)
            )
        elif winner and instead > examination.threshold:
            name, nats = _name_of(winner), winner.evidence_nats - instead
        else:
            name, nats = _NOISE, required - added_nats
        best = max(added_nats, instead)
        if effect not in out or best > out[effect][0]:
            out[effect] = (
                best,
                Rejection(effect, axes_of(effect_components, state.axes), name, nats),
            )
    return [rejection for _, rejection in out.values()]


def _find_withdrawn(effect: str, chosen: Sequence[Selection]) -> tuple[str, float] | None:
    """Return what is left of an effect that was withdrawn: with it, the noise still changes."""
    return next(
        (
            (_name_of(selection), selection.evidence_nats)
            for selection in chosen
            if not selection.is_named and not selection.instead and effect in selection.alternatives
        ),
        None,
    )


def _find_strongest(
    components: Sequence[Component], chosen: Sequence[Selection]
) -> tuple[str, float]:
    """Return the strongest selection in the statistics of an effect."""
    statistics = {component.statistic for component in components}
    rivals = [
        selection
        for selection in chosen
        if statistics & {component.statistic for component in selection.components}
    ]
    strongest = max(rivals, key=lambda selection: selection.evidence_nats, default=None)
    if strongest is None:
        return _NOISE, math.nan
    return _name_of(strongest), strongest.evidence_nats - sum_evidence(components)


def _name_of(selection: Selection) -> str:
    if selection.is_named:
        return selection.effect
    return NUISANCE_ALTERNATIVES[selection.effect]
