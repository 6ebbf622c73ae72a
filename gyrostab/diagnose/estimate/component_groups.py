"""Group the components of an identification by the sizes that describe them together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import TIME_PARAMETER, Component, Variant
from gyrostab.diagnose.predict.condition import condition_on_components
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.statistics.rotation_order import fit_amplitude, harmonic_sets
from gyrostab.diagnose.statistics.sample_sizes import are_simultaneous
from gyrostab.physics.registry import effects

MAX_BLOCKS_OF_STEP = 2  # by which the times of a step on two axes may differ; design choice


def split_harmonics(identification: Selection, state: State) -> list[list[Component]]:
    """Split the components of several harmonics of the rotation, each with its amplitude and phase.

    Harmonics other than the strongest are dropped when their amplitude is within two standard
    errors on every axis.
    """
    turning = [
        component
        for component in identification.components
        if component.statistic.is_rotation and component.candidate.is_per_axis
    ]
    sets = harmonic_sets(state.blocks.sizes["harmonic"]) if turning else []
    harmonics = sorted({k for component in turning for k in sets[component.line_index]})
    by_harmonic = [
        [
            replace(component, line_index=k)
            for component in turning
            if k in sets[component.line_index]
        ]
        for k in harmonics
    ]
    if len(by_harmonic) < 2:
        return [list(identification.components)]
    clear = [
        max(
            size / error
            for size, error, _ in (fit_amplitude(component, state) for component in components)
        )
        for components in by_harmonic
    ]
    visible_harmonics = [
        components
        for components, times in zip(by_harmonic, clear, strict=True)
        if times > state.settings.visible_sigma or times == max(clear)
    ]
    rest = [component for component in identification.components if component not in turning]
    return [[*visible_harmonics[0], *rest], *visible_harmonics[1:]]


def split_steps(
    components: Sequence[Component], state: State
) -> list[tuple[list[Component], State]]:
    """Split the components of steps at several times, each with the other steps in the model.

    Steps of different axes are one if hardly any block lies between their times. The grid of times
    of each step ends half way to the others of its axis: at their times it could not be
    distinguished from them. Two steps of an axis at one time are one.
    """
    by_place: dict[tuple[object, float], Component] = {}
    for step in (step for component in components for step in _single_steps(component)):
        other = by_place.setdefault((step.row, step.step_time), step)
        if step.evidence_nats > other.evidence_nats:
            by_place[step.row, step.step_time] = step
    steps = list(by_place.values())
    groups = _group_steps(steps, state)
    if len(groups) < 2:
        return [([*steps, *(part for part in components if not part.is_step)], state)]
    out = []
    for group in groups:
        others = [step for other in groups if other is not group for step in other]
        with_others = condition_on_components(state, others)
        nearest = [_nearest_times(step, others) for step in group]
        out.append((nearest, replace(state, given=with_others.given)))
    return out


def group_simultaneous_axes(
    identification: Selection, blocks: xr.Dataset, count_evidence: CountEvidence
) -> list[list[str]]:
    """Group the axes on which an effect changes samples at the same instants; others are alone."""
    marks = {
        component.row[0]: component.variant.columns[0]
        for component in identification.components
        if component.statistic.is_count and effects()[identification.effect].is_simultaneous
    }
    groups: list[list[str]] = []
    for axis in identification.axes:
        own = [
            group
            for group in groups
            if axis in marks
            and marks.get(group[0]) == marks[axis]
            and are_simultaneous((group[0], axis), marks[axis], blocks, count_evidence)
        ]
        if own:
            own[0].append(axis)
        else:
            groups.append([axis])
    return groups


def _group_steps(steps: Sequence[Component], state: State) -> list[list[Component]]:
    """Group steps of different axes at the same time, in the order of time."""
    middle = (state.blocks["begin"].values + state.blocks["end"].values) / 2.0
    present = np.isfinite(state.blocks["mean"].values).any(axis=0)
    groups: list[list[Component]] = []
    for step in sorted(steps, key=lambda step: step.step_time):
        if groups:
            between = (middle > groups[-1][0].step_time) & (middle < step.step_time)
            is_other = (present & between).sum() > MAX_BLOCKS_OF_STEP
            if not is_other and all(step.row != other.row for other in groups[-1]):
                groups[-1].append(step)
                continue
        groups.append([step])
    return groups


def _nearest_times(step: Component, others: Sequence[Component]) -> Component:
    """Return a step with only those times that are nearer to it than to others of its axis."""
    other_times = [other.step_time for other in others if other.row == step.row]

    def is_nearest(variant: Variant) -> bool:
        time = float(variant.values[TIME_PARAMETER])
        return all(abs(time - step.step_time) < abs(time - other) for other in other_times)

    nearest = tuple(filter(is_nearest, step.candidate.variants))
    return replace(step, candidate=replace(step.candidate, variants=nearest))


def _single_steps(component: Component) -> list[Component]:
    """Return a component for each step of a component in the means; empty without one.

    The times of steps at every restart are known.
    """
    variant = component.variant
    if not component.is_step:
        return []
    if len(variant.columns) == 1:
        return [component]
    single = [other for other in component.candidate.variants if len(other.columns) == 1]
    return [
        replace(component, variant=other, candidate=replace(component.candidate, variants=(other,)))
        for column in variant.design
        for other in single
        if np.array_equal(other.design[0], column)
    ]
