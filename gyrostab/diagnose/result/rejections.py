"""State for each effect that was examined and not named what explains more, and by how much."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from gyrostab.diagnose.identify.components import (
    axes_of,
    group_components,
    merge_lines,
    sum_evidence,
)
from gyrostab.diagnose.identify.forward_search import score_candidates
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.identify.settling import find_instead, sum_by_key
from gyrostab.diagnose.predict.candidates import NUISANCE_ALTERNATIVES, Component, is_nuisance

_NOISE = "noise"


class Rejection(NamedTuple):
    """An effect that was examined and not named, with the keys of its table in a diagnosis."""

    name: str  # in the registry
    axes: tuple[str, ...]
    beaten_by: str  # what explains more: an effect, "noise", or another form in words
    #: By how much it explains more [nats]; NaN where physics excludes the effect. Below zero, an
    #: order decides: anomalous samples and real motion come before their consequences.
    nats: float


def rejected_tables(rejections: Sequence[Rejection]) -> list[dict[str, Any]]:
    """Return the table of each rejection, the closest first."""
    closest_first = sorted(
        rejections,
        key=lambda rejection: (math.isnan(rejection.nats), rejection.nats, rejection.name),
    )
    return [rejection._asdict() for rejection in closest_first]


def find_unsupported(
    identified: Sequence[Selection], supported: Sequence[Selection]
) -> list[Rejection]:
    """Return the identified effects whose size may be zero: those that are not supported."""
    named = {identification.effect for identification in supported}
    return [
        Rejection(identification.effect, identification.axes, "a size of zero", math.nan)
        for identification in identified
        if identification.effect not in named
    ]


def find_rejections(identifications: Identifications) -> list[Rejection]:
    """Return for each effect that was not identified what beats it, and by how much.

    The noise beats an effect that lacks evidence both with all selections in the model and in
    place of any of them. A selection beats it if the effect has enough evidence in its place;
    among several, it is the one in whose place the evidence is largest. If the effect has enough
    evidence although all selections are in the model, what beat it in the selection does.
    """
    examination, state = identifications.examination, identifications.state
    all_evidence = score_candidates(examination, state, ())
    components = merge_lines(group_components(all_evidence, examination.settings))
    settled = [*identifications.identified, *identifications.unidentified]
    chosen = [*identifications.identified]
    for selection in identifications.unidentified:
        without = examination.state_with(settled, without=selection)
        instead_of_it, _ = find_instead(examination, selection, without)
        chosen.append(replace(selection, instead=sum_by_key(instead_of_it)))
    named = {
        selection.effect for selection in (*examination.expected, *chosen) if selection.is_named
    }
    out: dict[str, tuple[float, Rejection]] = {}
    for key, effect_components in components.items():
        effect = effect_components[0].candidate.effect
        if is_nuisance(key) or effect in named:
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
                or identifications.beaten.get(key)
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
