"""Collect the components of an effect: the rows of statistics in which it shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence, Component, Variant
from gyrostab.diagnose.predict.search import combine_rows
from gyrostab.diagnose.settings import Settings

#: The effect for a line of unknown cause.
PLAIN_LINE = "spectral_line"


def select_components(evidence: CandidateEvidence, settings: Settings) -> list[Component]:
    """Return the rows of a candidate with enough evidence, or the best one."""
    evidence_nats = evidence.evidence_nats[0]
    rows = [row for row, nats in enumerate(evidence_nats) if nats > settings.component_nats]
    rows = rows or [int(evidence_nats.argmax())]
    return [
        Component(
            evidence.candidate,
            evidence.best[number],
            evidence.rows[number],
            float(evidence_nats[number]),
            int(evidence.line_index[0, number]) if evidence.line_index.size else -1,
            close=_close_variants(evidence, number, settings),
        )
        for number in rows
    ]


def _close_variants(
    evidence: CandidateEvidence, row: int, settings: Settings
) -> tuple[Variant, ...]:
    """Return the variants that explain a row as well as the best, but for errors of its form."""
    if not evidence.variant_nats.size:
        return ()
    nats = evidence.variant_nats[:, row]
    order, best = np.argsort(-nats, kind="stable"), float(nats.max())
    good = nats[order] >= best - settings.allow_form_error(max(best, 0.0))
    return tuple(evidence.candidate.variants[place] for place in order[good].tolist())


def group_components(
    all_evidence: Sequence[CandidateEvidence], settings: Settings
) -> dict[str, list[Component]]:
    """Return the components of each effect with enough evidence, the strongest first."""
    out: dict[str, list[Component]] = {}
    for evidence in all_evidence:
        components = select_components(evidence, settings)
        out.setdefault(evidence.candidate.key, []).extend(components)
    for key, components in out.items():
        good = _drop_repeated_power(
            [
                component
                for component in components
                if component.evidence_nats > settings.component_nats
            ]
        )
        out[key] = sorted(good or components, key=lambda component: -component.evidence_nats)
    return out


def _drop_repeated_power(components: Sequence[Component]) -> list[Component]:
    """Drop the power of an effect on axes where its course within blocks is known.

    The course contains the same powers.
    """
    has_course = {
        component.row
        for component in components
        if component.statistic.is_switching and component.variant.inside.size
    }
    return [
        component
        for component in components
        if not component.statistic.is_power or component.row not in has_course
    ]


def merge_lines(components: dict[str, list[Component]]) -> dict[str, list[Component]]:
    """Let lines count only for the simplest effect, `spectral_line`.

    Any line has the form that a ripple of the supply or a sway would have, and does not show its
    cause. These effects are among its alternatives. Their other components count as before.
    """
    out = {}
    for key, effect_components in components.items():
        remaining = [
            component
            for component in effect_components
            if component.candidate.effect == PLAIN_LINE or not component.statistic.is_line
        ]
        if remaining:
            out[key] = remaining
    return out


def are_lines(components: Sequence[Component]) -> bool:
    """Return whether all components are lines."""
    return bool(components) and all(component.statistic.is_line for component in components)


def sum_evidence(components: Sequence[Component]) -> float:
    """Return the evidence of an effect from its components [nats]."""
    nats = [component.evidence_nats for component in components]
    return float(combine_rows(np.array(nats))) if nats else 0.0


def renew_component(component: Component, components: Sequence[Component]) -> Component:
    """Return a component with its evidence among `components`, and the course of its switching.

    These were found with all other effects in the model; the one with the same statistic, row and
    reference channel counts.
    """
    for other in components:
        if _slot_of(other) == _slot_of(component):
            is_switching = component.statistic.is_switching
            variant = other.variant if is_switching else component.variant
            return replace(component, evidence_nats=other.evidence_nats, variant=variant)
    return component


def _slot_of(component: Component) -> tuple[object, ...]:
    """Return what a layer of components has once: the statistic, the row and the reference."""
    return component.statistic, component.row, component.candidate.reference


def candidates_of(components: Sequence[Component]) -> list[Candidate]:
    """Return the candidates that the components come from, each once."""
    candidates = [component.candidate for component in components]
    by_statistic = {
        (candidate.key, candidate.statistic, candidate.reference): candidate
        for candidate in candidates
    }
    return list(by_statistic.values())


def axes_of(components: Sequence[Component], order: Sequence[str]) -> tuple[str, ...]:
    """Return the axes of components, in order."""
    named = {axis for component in components for axis in component.row}
    return tuple(sorted(named, key=lambda axis: (order.index(axis) if axis in order else 0, axis)))


def split_layers(components: Sequence[Component]) -> list[list[Component]]:
    """Split components by how often their statistic, row and reference channel occurred before."""
    out: list[list[Component]] = []
    occurrences: Counter[tuple[object, ...]] = Counter()
    for component in components:
        slot = _slot_of(component)
        if occurrences[slot] == len(out):
            out.append([])
        out[occurrences[slot]].append(component)
        occurrences[slot] += 1
    return out
