"""Levels that differ, or are more than two, and compete with a bias of two levels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.telegraph import telegraph_evidence
from gyrostab.diagnose.evidence.visits import compare_visits
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.statistics.base import Competitor
from gyrostab.diagnose.statistics.fast_switching import add_fast_switching, fast_switching_evidence

Array = NDArray[np.float64]
_JUMP_CHANGES = 2  # from block to block, in the column of a jump within a block


def level_competitors(
    components: Sequence[Component], state: State, error: float
) -> Iterator[Competitor]:
    """Yield levels that differ at each visit.

    They win unless two levels explain clearly more, with enough switches: the bias may follow
    something that was not recorded. Axes of one course show the same visits: that these are equal
    counts once.
    """
    unequal = np.array([_unequal_nats(component, state) for component in components])
    nats = float(unequal.min() + np.maximum(unequal, 0.0)[unequal > unequal.min()].sum())
    yield Competitor("levels that differ", nats + error + state.settings.ambiguous_nats, 0.0)


def further_levels(component: Component, state: State) -> Iterator[Competitor]:
    """Yield a bias that still switches with two levels in the model, of three levels or more."""
    axis, settings = component.row[0], state.settings
    allowed = settings.ambiguous_nats + settings.form_error_share * component.evidence_nats
    if component.variant.inside.size:
        switching = fast_switching_evidence(
            state.blocks, add_fast_switching(state, component), axis
        )
        nats = switching.evidence_nats if switching is not None else 0.0
    else:
        given_columns = [*state.given.get(("mean", axis), []), component.variant.design[0, 0]]
        evidence_nats, _ = telegraph_evidence(
            state.blocks,
            state.baseline,
            axis=axis,
            given=np.stack(given_columns, axis=-1),
            settings=settings,
        )
        nats = float(evidence_nats[0])
    yield Competitor("more than two levels", nats, allowed)


def _unequal_nats(component: Component, state: State) -> float:
    """Return the evidence of an axis for levels that differ [nats], 0 or more with few switches.

    Jumps that were named first may be switches. The switches are therefore also found without them.
    """
    variant, axis = component.variant, component.row[0]
    given_columns = state.given.get(("mean", axis), [])
    share = variant.inside if variant.inside.size else variant.design[0, 0]
    courses = [(share, given_columns)]
    without_jumps = [
        column for column in given_columns if np.count_nonzero(np.diff(column)) > _JUMP_CHANGES
    ]
    if len(without_jumps) < len(given_columns) and not variant.inside.size:
        _, telegraph = telegraph_evidence(
            state.blocks,
            state.baseline,
            axis=axis,
            given=np.stack(without_jumps, axis=-1) if without_jumps else None,
            settings=state.settings,
        )
        courses.append((telegraph.share[0], without_jumps))
    return min(_compare_course(share, axis, columns, state) for share, columns in courses)


def _compare_course(share: Array, axis: str, given_columns: Sequence[Array], state: State) -> float:
    """Return the evidence of a course for levels that differ, at least 0 with few switches."""
    visits = compare_visits(
        axis_values(state.blocks, "mean", axis),
        state.baseline,
        share,
        axis=axis,
        block_s=float(state.blocks.attrs["block_s"]),
        given=np.stack(given_columns, axis=-1) if given_columns else None,
    )
    is_known = visits.switch_count >= state.settings.min_switches
    return visits.unequal_nats if is_known else max(visits.unequal_nats, 0.0)
