"""Rows of views in which an effect shows, put together by effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gyrostab.diagnose.predict.candidates import Candidate
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.search import CandidateEvidence, combine_rows

__all__ = [
    "LEAST",
    "PLAIN_LINE",
    "axes_of",
    "by_key",
    "evidence_of",
    "find_components",
    "lines_only",
    "sum_evidence",
    "tried_again",
    "without_lines",
]

#: What an axis must bring to be named with the others [nats].
LEAST = 2.0
#: The effect that says of a line no more than that it is there.
PLAIN_LINE = "spectral_line"


def find_components(found: CandidateEvidence) -> list[Component]:
    """Rows of a candidate that bring something."""
    evidence_nats = found.evidence_nats[0]
    rows = [number for number in range(evidence_nats.size) if evidence_nats[number] > LEAST]
    rows = rows or [int(evidence_nats.argmax())]
    return [
        Component(
            found.candidate,
            found.best[number],
            found.rows[number],
            float(evidence_nats[number]),
            int(found.place[0, number]) if found.place.size else -1,
        )
        for number in rows
    ]


def by_key(found: Sequence[CandidateEvidence]) -> dict[str, list[Component]]:
    """Parts of every effect, those that bring something, the strongest first."""
    out: dict[str, list[Component]] = {}
    for one in found:
        out.setdefault(one.candidate.key, []).extend(find_components(one))
    for key, components in out.items():
        good = _once([component for component in components if component.evidence_nats > LEAST])
        out[key] = sorted(good or components, key=lambda component: -component.evidence_nats)
    return out


def _once(components: Sequence[Component]) -> list[Component]:
    """Parts without the spectrum of an effect on axes whose course within blocks is known: that holds the same powers."""
    told = {
        component.row
        for component in components
        if component.candidate.statistic == "levels" and component.variant.inside.size
    }
    return [
        component
        for component in components
        if component.candidate.statistic != "power" or component.row not in told
    ]


def without_lines(components: dict[str, list[Component]]) -> dict[str, list[Component]]:
    """The same, where a line counts for the plainest name only.

    Any line has the form that a ripple of the supply or a sway would have, and nothing in the line
    itself tells of them; that they can be meant as well stands among the alternatives. What else
    such an effect does counts as before.
    """
    out = {}
    for key, several in components.items():
        plain = several[0].candidate.effect == PLAIN_LINE
        kept = (
            several
            if plain
            else [component for component in several if component.candidate.statistic != "line"]
        )
        if kept:
            out[key] = kept
    return out


def lines_only(components: Sequence[Component]) -> bool:
    """Whether all that these parts say is that lines are there."""
    return bool(components) and all(
        component.candidate.statistic == "line" for component in components
    )


def sum_evidence(components: Sequence[Component]) -> float:
    """Gain of an effect from its parts [nats]."""
    return (
        float(combine_rows(np.array([component.evidence_nats for component in components])))
        if components
        else 0.0
    )


def evidence_of(components: Sequence[Component], like: Component) -> float:
    """Gain of the part in the same view and row, and beside the same witness."""
    wanted = like.candidate.statistic, like.row, like.candidate.witness
    return next(
        (
            one.evidence_nats
            for one in components
            if (one.candidate.statistic, one.row, one.candidate.witness) == wanted
        ),
        like.evidence_nats,
    )


def tried_again(components: Sequence[Component]) -> list[Candidate]:
    """Candidates that parts come from, each once."""
    seen: dict[tuple[str, str, tuple[str, ...]], Candidate] = {}
    for component in components:
        seen[
            component.candidate.key, component.candidate.statistic, component.candidate.witness
        ] = component.candidate
    return list(seen.values())


def axes_of(components: Sequence[Component], order: Sequence[str]) -> tuple[str, ...]:
    """Axes of parts, in order."""
    named = {axis for component in components for axis in component.row}
    return tuple(sorted(named, key=lambda axis: (order.index(axis) if axis in order else 0, axis)))
