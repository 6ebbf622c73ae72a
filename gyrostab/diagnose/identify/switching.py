"""Order telegraph biases among the other effects: one that follows a channel comes first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.identify.components import axes_of
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import Selection, components_of, reduce_selection
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.statistics.jump_forms import is_free_jump
from gyrostab.diagnose.statistics.telegraph import search_block_means


def put_followers_first(
    passing: list[str], components: Mapping[str, Sequence[Component]], state: State
) -> list[str]:
    """Drop telegraph biases while a passing mean that follows a channel may be their cause.

    A channel that switches makes two levels as well, and because its form is not exact, what it
    leaves switches with it. Therefore the channel comes first where it explains more on the same
    axis, or half of the course of the switching.
    """
    led = [
        component
        for key in passing
        for component in components[key]
        if component.statistic.is_linear_in_means and any(component.candidate.driver)
    ]
    return [
        key
        for key in passing
        if not any(_has_possible_cause(component, led, state) for component in components[key])
    ]


def _has_possible_cause(component: Component, led: Sequence[Component], state: State) -> bool:
    others_on_axis = [
        other for other in led if component.statistic.is_switching and other.row == component.row
    ]
    return any(
        other.evidence_nats >= component.evidence_nats
        or _explained_share(component, other, state) > state.settings.majority_share
        for other in others_on_axis
    )


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

    An axis has one of them: with it in the model, more switching does not explain powers and
    tails that the first
    has left, and may be a jump.
    """
    return [
        key
        for key in put_followers_first(passing, components, state)
        if any(
            component.variant.inside.size and not state.given.get(("sub_block", component.row[0]))
            for component in components[key]
        )
    ]


def drop_explained_jumps(chosen: Sequence[Selection], examination: Examination) -> list[Selection]:
    """Drop jumps that a telegraph bias on their axis explains when fitted without them.

    The first and the last of a few switches are jumps of the same step, and a telegraph bias that
    is fitted with them in the model lacks these switches. The selections have the evidence with
    which they were selected.
    """
    out = list(chosen)
    for component in [
        component for component in components_of(chosen) if component.statistic.is_switching
    ]:
        jumps = [
            other
            for other in components_of(out)
            if other.row == component.row and is_free_jump(other, examination.start)
        ]
        for dropped_jumps in [jumps, *([jump] for jump in jumps if len(jumps) > 1)]:
            if not dropped_jumps or not {*dropped_jumps} <= {*components_of(out)}:
                continue
            with_jumps, without_jumps = (
                examination.state_with(_drop_components(out, left_out))
                for left_out in ([component], [component, *dropped_jumps])
            )
            # in block means: sub-blocks know more, and are not always available
            own_nats, nats_without = (
                float(search_block_means(state, component.row[0])[0][0])
                for state in (with_jumps, without_jumps)
            )
            if (
                np.isfinite(own_nats)
                and own_nats + sum(jump.evidence_nats for jump in dropped_jumps)
                < nats_without + examination.threshold
            ):
                (evidence,) = examination.compute_evidence([component.candidate], without_jumps)
                row = evidence.rows.index(component.row)
                instead = replace(
                    component,
                    variant=evidence.best[row],
                    evidence_nats=float(evidence.evidence_nats[0, row]),
                )
                out = [
                    replace(
                        selection,
                        components=tuple(
                            instead if other is component else other
                            for other in selection.components
                        ),
                    )
                    for selection in _drop_components(out, dropped_jumps)
                ]
                component = instead
    return out


def _drop_components(chosen: Sequence[Selection], left_out: Sequence[Component]) -> list[Selection]:
    """Drop some components from the selections, and selections that lose all."""
    out = []
    for selection in chosen:
        remaining = [component for component in selection.components if component not in left_out]
        if len(remaining) < len(selection.components):
            evidence_nats = (
                selection.evidence_nats
                - sum(component.evidence_nats for component in selection.components)
                + sum(component.evidence_nats for component in remaining)
            )
            axes = axes_of(remaining, selection.axes)
            selection = reduce_selection(selection, remaining, axes, evidence_nats)
        if remaining:
            out.append(selection)
    return out
