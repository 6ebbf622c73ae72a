"""Withdraw selections that others explain, and effects that leave structure in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.identify.components import split_layers, sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import (
    Selection,
    components_of,
    make_selection,
    reduce_selection,
)
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.jump_forms import is_free_jump
from gyrostab.diagnose.statistics.left_structure import (
    excess_low_frequency_noise,
    variance_fluctuation,
    with_neighbouring_variants,
)
from gyrostab.diagnose.statistics.telegraph import search_block_means
from gyrostab.physics.registry import effects

#: Arbitrary courses of the bias.
_DRIFTS = ("~bias(t)", "~levels")


def without_pulses(chosen: Sequence[Selection], settings: Settings) -> list[Selection]:
    """Drop spikes on axes that have a comb of lines or a profile of the feedback ramp.

    A comb is a periodic pulse, and the outliers are the pulse itself. Bad samples would make no
    lines.
    """
    lines: Counter[str] = Counter()
    for component in components_of(chosen):
        has_profile = component.statistic.is_phase_locked and not component.statistic.is_rotation
        weight = settings.min_comb_lines if has_profile else int(component.statistic.is_line)
        lines.update(dict.fromkeys(component.row, weight))
    out: list[Selection] = []
    for selection in chosen:
        if selection.effect != "spikes":
            out.append(selection)
            continue
        remaining = [
            component
            for component in selection.components
            if lines[component.row[0]] < settings.min_comb_lines
        ]
        if remaining:
            out.append(reduce_selection(selection, remaining))
    return out


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
            selection = reduce_selection(selection, remaining, evidence_nats)
        if remaining:
            out.append(selection)
    return out


def withdraw_effects(
    examination: Examination,
    state: State,
    identified: list[Selection],
    unidentified: Sequence[Selection],
) -> tuple[list[Selection], list[Selection]]:
    """Withdraw effects that leave structure in time, in the means or powers.

    `state` has all selections in the model. The second result is what is unidentified instead.
    """
    remaining = list(identified)
    withdrawn: list[Selection] = []
    for axis in state.axes:
        remaining, unexplained = _withdraw_in_means(
            examination, state, remaining, unidentified, axis
        )
        withdrawn += unexplained
    for axis in state.axes:
        on_axis = _identified_on(remaining, axis, in_means=False)
        if not on_axis:
            continue
        excess_nats = variance_fluctuation(
            examination.state_with([*remaining, *unidentified]), axis
        )
        weak, _ = _find_weak(examination, on_axis, excess_nats)
        if weak:
            remaining = [
                identification for identification in remaining if identification not in weak
            ]
            reduced_state = examination.state_with([*remaining, *unidentified])
            withdrawn += _find_fluctuation(examination, reduced_state, axis, weak)
    return remaining, withdrawn


def _withdraw_in_means(
    examination: Examination,
    state: State,
    remaining: list[Selection],
    unidentified: Sequence[Selection],
    axis: str,
) -> tuple[list[Selection], list[Selection]]:
    """Withdraw effects on the means of an axis that leave more slow noise than calibrated."""
    remaining = _without_part_of_drift(remaining, unidentified, axis, examination.threshold)
    on_axis = _identified_on(remaining, axis, in_means=True)
    has_alternative = any(
        selection.effect in (*_DRIFTS, "~S(f)", "~cov") and axis in selection.axes
        for selection in unidentified
    )
    # such an effect changes the white variance of the means, which the calibration then misjudges
    has_shape = any(
        effects()[component.candidate.effect].shapes_spectrum and axis in component.row
        for component in components_of(remaining)
    )
    if has_alternative or has_shape:
        return remaining, []
    excess_nats = excess_low_frequency_noise(
        with_neighbouring_variants(state, components_of(on_axis), axis), axis
    )
    weak, strength = _find_weak(examination, on_axis, excess_nats)
    if (
        not weak
        and excess_nats <= examination.threshold + examination.settings.form_error_share * strength
    ):
        return remaining, []
    names = tuple(identification.effect for identification in weak)
    unexplained = Selection("~red", (), (axis,), (), excess_nats, examination.threshold, names)
    return [identification for identification in remaining if identification not in weak], [
        unexplained
    ]


def _find_weak(
    examination: Examination, identified: Sequence[Selection], excess_nats: float
) -> tuple[list[Selection], float]:
    """Return the effects that explain too little for what they leave [nats], and their sum."""
    settings = examination.settings
    strength = sum(identification.evidence_nats for identification in identified)
    allowed = settings.component_nats + settings.form_error_share * strength
    share = settings.spectrum_error_share
    return [
        identification
        for identification in identified
        if excess_nats > max(allowed, share * identification.evidence_nats)
    ], strength


def _find_fluctuation(
    examination: Examination, state: State, axis: str, weak: Sequence[Selection]
) -> list[Selection]:
    """Return what a free noise level explains on an axis, instead of withdrawn effects."""
    free = [candidate for candidate in examination.candidates if candidate.effect == "~N(t)"]
    components_by_key = examination.find_components(free, state)
    components = [
        component
        for component in components_by_key.get("~N(t)", [])
        if component.row == (axis,) and component.evidence_nats > examination.threshold
    ]
    names = [identification.effect for identification in weak]
    if not components:
        return []
    return [make_selection(components, examination.threshold, alternatives=names)]


def _identified_on(
    identified: Sequence[Selection], axis: str, *, in_means: bool
) -> list[Selection]:
    """Return the identifications with a component in the means of an axis, or in its powers."""
    return [
        identification
        for identification in identified
        if any(
            (component.statistic.is_linear_in_means if in_means else component.statistic.is_power)
            and component.row == (axis,)
            for component in identification.components
        )
    ]


def _without_part_of_drift(
    identified: Sequence[Selection],
    unidentified: Sequence[Selection],
    axis: str,
    threshold: float,
) -> list[Selection]:
    """Return effects without what an unidentified drift of an axis may be there.

    An effect without a channel that explains less there may be a piece of the drift. It stays on
    other axes where it reaches the threshold.
    """
    drifts = [selection for selection in unidentified if selection.effect in _DRIFTS]
    drift_nats = sum(_evidence_on(selection, axis) for selection in drifts)
    remaining = []
    for identification in identified:
        is_part = not any(identification.driver) and any(
            component.statistic.is_linear_in_means and component.row == (axis,)
            for component in identification.components
        )
        if not is_part or _evidence_on(identification, axis) >= drift_nats:
            remaining.append(identification)
            continue
        elsewhere = [
            component for component in identification.components if axis not in component.row
        ]
        evidence_nats = sum(max(sum_evidence(layer), 0.0) for layer in split_layers(elsewhere))
        if evidence_nats >= threshold:
            remaining.append(reduce_selection(identification, elsewhere, evidence_nats))
    return remaining


def _evidence_on(selection: Selection, axis: str) -> float:
    """Return the evidence of a selection on one axis [nats]."""
    return sum(
        component.evidence_nats for component in selection.components if component.row == (axis,)
    )
