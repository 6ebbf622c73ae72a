"""Candidates, components and identifications by hand, for tests of single steps of a diagnosis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.identify.components import group_components
from gyrostab.diagnose.identify.identification import Identifications, Selection
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence


def select_candidate(candidates: Iterable[Candidate], effect: str, statistic: str) -> Candidate:
    """Return the first candidate of an effect in a statistic."""
    return next(
        candidate
        for candidate in candidates
        if (candidate.effect, candidate.statistic.name) == (effect, statistic)
    )


def find_components(candidates: Sequence[Candidate], state: State) -> dict[str, list[Component]]:
    """Return the components of candidates by key, by their evidence on the blocks of a state."""
    blocks = state.blocks
    return group_components(compute_evidence(candidates, blocks, state, fold_blocks(blocks)))


def winning_forms(components: Sequence[Component], state: State, error: float = 0.0) -> set[str]:
    """Return the names of other forms that explain clearly more than components of one statistic.

    On all axes together, or on the axis of the first.
    """
    statistic = components[0].statistic
    competitors = [
        *statistic.competitors(components, state, error),
        *statistic.axis_competitors(components[0], state),
    ]
    return {item.name for item in competitors if item.nats > item.needed}


def make_identifications(
    identified: Iterable[Selection],
    state: State | None = None,
    candidates: Iterable[Candidate] = (),
    reasons: Mapping[str, str] | None = None,
) -> Identifications:
    """Return identifications as a selection would, with a threshold of 8 nats."""
    return Identifications(
        tuple(identified), (), 8.0, np.zeros(1), dict(reasons or {}), tuple(candidates), state
    )  # type: ignore[arg-type]
