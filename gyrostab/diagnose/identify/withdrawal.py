"""Withdraw selections that others explain, and effects that leave structure in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.posterior import visible_coefficients
from gyrostab.diagnose.evidence.held_out import noise_weight
from gyrostab.diagnose.evidence.mixture import products_mixture
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.identify.components import split_layers, sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identification import (
    Selection,
    components_of,
    make_selection,
    reduce_selection,
)
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import mean_mixture
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.jump_forms import is_free_jump
from gyrostab.diagnose.statistics.telegraph import search_block_means
from gyrostab.physics.registry import effects
from gyrostab.units import HOUR

Array = NDArray[np.float64]

#: Arbitrary courses of the bias.
_DRIFTS = ("~bias(t)", "~levels")
#: Flicker and random walk that are tried, as multiples of the least that the record can show.
_NOISE_STEPS = (1.0, 3.0, 10.0, 30.0)


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


def with_neighbouring_variants(state: State, components: Sequence[Component], axis: str) -> State:
    """Return the state with the neighbours of the fitted nuisance values in the model as well.

    A time constant lies between two points of its grid.
    """
    row = state.axes.index(axis)
    for component in components:
        if not (component.statistic.is_linear_in_means and component.row == (axis,)):
            continue
        family = [
            variant
            for variant in component.candidate.variants
            if variant.columns == component.variant.columns
        ]
        place = next(
            number for number, variant in enumerate(family) if variant is component.variant
        )
        for neighbour in family[max(place - 1, 0) : place] + family[place + 1 : place + 2]:
            state = state.with_columns("mean", axis, mean_columns(neighbour, row))
    return state


def excess_low_frequency_noise(state: State, axis: str) -> float:
    """Return the evidence [nats] of free random walk and flicker over the calibrated ones.

    All identified effects are in the model. It is zero where the record shows less slow noise than
    calibrated: a calibration on blocks with an effect takes the effect for noise.
    """
    span = state.blocks.sizes["block"] * float(state.blocks.attrs["block_s"])
    slow = (
        axis_values(state.baseline, "grid_K", axis) ** 2 * span / HOUR
        + axis_values(state.baseline, "grid_B", axis) ** 2
    )
    free, calibrated = (mean_mixture(state, axis, [], tier=tier) for tier in ("free", "calibrated"))
    free_prior, calibrated_prior = (
        noise_weight(state.baseline, axis, tier) for tier in ("free", "calibrated")
    )
    free_sum, calibrated_sum = map(np.logaddexp.reduce, (free_prior, calibrated_prior))
    if free.weights() @ slow <= np.exp(calibrated_prior - calibrated_sum) @ slow:
        return 0.0
    return float((free.evidence - free_sum) - (calibrated.evidence - calibrated_sum))


def variance_fluctuation(state: State, axis: str) -> float:
    """Return the evidence [nats] of a power level that wanders over one that is constant.

    The level is that of all bands of a block together, relative to the expected one with all
    identified effects. As in `excess_low_frequency_noise`, a large value shows that the noise
    changes in another way than the effects predict.
    """
    row = state.axes.index(axis)
    level, variance, columns = _power_levels(state, row, axis)
    present = np.isfinite(level) & np.isfinite(variance) & ~state.masked[row]
    if present.sum() < state.settings.min_rest_blocks:
        return 0.0
    step = float(state.blocks.attrs["block_s"])
    usual = float(np.median(variance[present]))
    smallest_coefficients = visible_coefficients(usual * step, present.sum() * step)
    K, B = (
        component.ravel()
        for component in np.meshgrid(
            *(
                [0.0, *(coefficient * np.array(_NOISE_STEPS))]
                for coefficient in smallest_coefficients
            ),
            indexing="ij",
        )
    )
    safe = np.where(present, variance, usual)
    limit = state.settings.max_level_sigma * np.sqrt(safe)
    values = np.clip(np.where(present, level, 0.0), -limit, limit)[:, None]
    products = mean_products(values, columns, variance=safe, step=step, K=K, B=B, present=present)
    log = products_mixture(products, np.zeros(K.size)).log_weight
    return float(np.logaddexp.reduce(log[1:]) - np.log(log.size - 1) - log[0])


def _power_levels(state: State, row: int, axis: str) -> tuple[Array, Array, Array]:
    """Return level and variance of each block, and what changes of size of the effects do to them.

    The level is relative to the expected one, less 1.
    """
    shape = axis_values(state.baseline, "shape_alone", axis)
    ratio = state.blocks["power"].values[row] / state.weight[row] - 1.0
    use = np.where(np.isfinite(shape) & np.isfinite(ratio), shape, 0.0)
    total = use.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = (use * np.nan_to_num(ratio)).sum(axis=1) / total
        variance = 1.0 / total + axis_values(state.baseline, "common", axis)
        named = [
            (use * column / state.weight[row]).sum(axis=1) / total
            for column in state.power_columns(axis)
        ]
    columns = np.nan_to_num(np.stack(named, axis=-1)) if named else np.empty((total.size, 0))
    largest = np.abs(columns).max(axis=0, initial=1e-300)
    moves = np.ptp(columns, axis=0) > 1e-9 * largest
    return level, variance, columns[:, moves] / largest[moves]
