"""Candidates, components and identifications by hand, for tests of single steps of a diagnosis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.components import group_components
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.statistics.build_candidates import effect_candidates


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
    return group_components(compute_evidence(candidates, blocks, state), state.settings)


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
    examination = Examination(
        tuple(candidates),
        CountEvidence({}),
        8.0,
        state,  # type: ignore[arg-type]
        null_best=np.zeros(1),
        reasons=dict(reasons or {}),
    )
    return Identifications(examination, tuple(identified), (), state)  # type: ignore[arg-type]


def identify_by_hand(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    effect: str,
    statistic: str,
    columns: tuple[str, ...],
    *,
    axis: str = "x",
    evidence_nats: float = 500.0,
    **values: float,
) -> Identifications:
    """Return the identification of one effect on an axis, or on x and y if it belongs to the pair.

    The variant is the one nearest to the given values of its parameters.
    """
    candidates, reasons = effect_candidates(blocks, baseline["coefficient"])
    candidate = select_candidate(candidates, effect, statistic)
    variant = min(
        (variant for variant in candidate.variants if variant.columns == columns),
        key=lambda variant: sum(
            abs(1.0 / (1.0 + variant.values[name]) - 1.0 / (1.0 + size))
            for name, size in values.items()
        ),
    )
    row = ("x", "y") if statistic == "cross_spectrum" else (axis,)
    component = Component(candidate, variant, row, evidence_nats)
    identification = Selection(effect, candidate.driver, row, (component,), evidence_nats, 8.0)
    state = condition_on(initial_state(blocks, baseline), [component])
    return make_identifications([identification], state, candidates, reasons)
