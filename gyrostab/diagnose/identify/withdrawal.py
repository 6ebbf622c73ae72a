"""Withdraw what other selections explain, and effects that leave changes of the noise level."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.diagnose.baseline.posterior import visible_coefficients
from gyrostab.diagnose.evidence.mixture import products_mixture
from gyrostab.diagnose.evidence.products import mean_products
from gyrostab.diagnose.identify.components import split_layers, sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.selections import (
    Selection,
    components_of,
    make_selection,
    reduce_selection,
)
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.settings import Settings

#: Arbitrary courses of the bias.
_DRIFTS = ("~bias(t)", "~levels", "~red")
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
    pulsed = {axis for axis, count in lines.items() if count >= settings.min_comb_lines}
    out: list[Selection] = []
    for selection in chosen:
        remaining = [part for part in selection.components if not pulsed & {*part.row}]
        if selection.effect != "spikes" or len(remaining) == len(selection.components):
            out.append(selection)
        elif remaining:
            out.append(reduce_selection(selection, remaining))
    return out


def withdraw_effects(
    examination: Examination, identified: Sequence[Selection], unidentified: Sequence[Selection]
) -> tuple[list[Selection], list[Selection]]:
    """Withdraw parts of unidentified drifts, and noise levels that leave another course in time.

    An effect is withdrawn from an axis if it explains too little there for what it leaves. The
    second result is what is unidentified instead.
    """
    settings, threshold = examination.settings, examination.threshold
    remaining = list(identified)
    for axis in examination.start.axes:
        remaining = _without_part_of_drift(remaining, unidentified, axis, threshold)
    withdrawn: list[Selection] = []
    for axis in examination.start.axes:
        strengths = {
            identification: _evidence_on(identification, axis)
            for identification in remaining
            if any(
                component.statistic.is_power and component.row == (axis,)
                for component in identification.components
            )
        }
        if not strengths:
            continue
        excess_nats = measure_fluctuation(examination.state_with([*remaining, *unidentified]), axis)
        allowed = settings.component_nats + settings.form_error_share * sum(strengths.values())
        share = settings.spectrum_error_share
        weak = [
            identification
            for identification, strength in strengths.items()
            if excess_nats > max(allowed, share * strength)
        ]
        if weak:
            remaining = _without_axis(remaining, weak, axis, threshold)
            reduced_state = examination.state_with([*remaining, *unidentified])
            withdrawn += _find_fluctuation(examination, reduced_state, axis, weak)
    return remaining, withdrawn


def _find_fluctuation(
    examination: Examination, state: State, axis: str, weak: Sequence[Selection]
) -> list[Selection]:
    """Return what a free noise level explains on an axis, instead of withdrawn effects."""
    free = [candidate for candidate in examination.candidates if candidate.effect == "~N(t)"]
    components = [
        component
        for component in examination.find_components(free, state).get("~N(t)", [])
        if component.row == (axis,) and component.evidence_nats > examination.threshold
    ]
    if not components:
        return []
    names = [identification.effect for identification in weak]
    return [make_selection(components, examination.threshold, alternatives=names)]


def _without_part_of_drift(
    identified: Sequence[Selection], unidentified: Sequence[Selection], axis: str, threshold: float
) -> list[Selection]:
    """Return effects without what an unidentified drift of an axis may be there.

    An effect without a channel that explains less there may be a piece of the drift. It stays on
    other axes where it reaches the threshold.
    """
    drift_nats = sum(
        _evidence_on(selection, axis) for selection in unidentified if selection.effect in _DRIFTS
    )
    parts = [
        identification
        for identification in identified
        if not any(identification.driver)
        and _evidence_on(identification, axis) < drift_nats
        and any(
            component.statistic.is_linear_in_means and component.row == (axis,)
            for component in identification.components
        )
    ]
    return _without_axis(identified, parts, axis, threshold)


def _without_axis(
    identified: Sequence[Selection], reduced: Sequence[Selection], axis: str, threshold: float
) -> list[Selection]:
    """Return effects, some without an axis; these only if they reach the threshold elsewhere."""
    out = []
    for identification in identified:
        if identification not in reduced:
            out.append(identification)
            continue
        elsewhere = [part for part in identification.components if axis not in part.row]
        evidence_nats = sum(max(sum_evidence(layer), 0.0) for layer in split_layers(elsewhere))
        if evidence_nats >= threshold:
            out.append(reduce_selection(identification, elsewhere, evidence_nats))
    return out


def _evidence_on(selection: Selection, axis: str) -> float:
    """Return the evidence of a selection on one axis [nats]."""
    return sum(
        component.evidence_nats for component in selection.components if component.row == (axis,)
    )


def measure_fluctuation(state: State, axis: str) -> float:
    """Return the evidence [nats] of a power level that wanders over one that is constant.

    The level is that of all bands of a block together, relative to the expected one with all
    identified effects. A large value shows that the noise changes in another way than the effects
    predict.
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


def _power_levels(state: State, row: int, axis: str) -> tuple[Floats, Floats, Floats]:
    """Return level and variance of each block, and what changes of size of the effects do to them.

    The level is relative to the expected one, less 1.
    """
    shape = axis_values(state.baseline, "shape_alone", axis)
    ratio = state.blocks["power"].values[row] / state.expected_power[row] - 1.0
    use = np.where(np.isfinite(shape) & np.isfinite(ratio), shape, 0.0)
    total = use.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = (use * np.nan_to_num(ratio)).sum(axis=1) / total
        variance = 1.0 / total + axis_values(state.baseline, "common", axis)
        named = [
            (use * column / state.expected_power[row]).sum(axis=1) / total
            for column in state.power_columns(axis)
        ]
    columns = np.nan_to_num(np.stack(named, axis=-1)) if named else np.empty((total.size, 0))
    largest = np.abs(columns).max(axis=0, initial=1e-300)
    moves = np.ptp(columns, axis=0) > 1e-9 * largest
    return level, variance, columns[:, moves] / largest[moves]
