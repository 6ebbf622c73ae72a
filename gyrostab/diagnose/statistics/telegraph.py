"""Biases of two levels, whose course the means themselves determine."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.fast_switching import (
    SwitchingEvidence,
    switching_evidence,
    switching_powers,
)
from gyrostab.diagnose.evidence.telegraph import (
    PARTS_PER_BLOCK,
    TelegraphCourses,
    Visits,
    compare_visits,
    telegraph_evidence,
)
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State, power_column
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.predict.sizes import component_size
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.statistics.base import Competitor, SizeFit, Sizes
from gyrostab.diagnose.statistics.mean import BlockMeanStatistic, mean_inputs

_LEVELS = "~levels"  # nuisance alternative: an arbitrary course
_MAX_NULL_BLOCKS = 20_000  # of null records that are searched for two levels; limits time
_JUMP_CHANGES = 2  # from block to block, in the column of a jump within a block


class TelegraphStatistic(BlockMeanStatistic):
    """A bias that switches between two levels, in block means or within blocks."""

    name = "telegraph"
    error_shows_in = ("mean",)
    is_in_means = True
    is_switching = True
    is_random_bias = True

    def competitors(
        self, components: Sequence[Component], state: State, error: float
    ) -> Iterator[Competitor]:
        """Yield levels that differ at each visit.

        They win unless two levels explain clearly more, with enough switches: the bias may follow
        something that was not recorded. Axes of one course show the same visits: that these are
        equal counts once.
        """
        unequal = np.array([_unequal_nats(component, state) for component in components])
        nats = float(unequal.min() + np.maximum(unequal, 0.0)[unequal > unequal.min()].sum())
        yield Competitor("levels that differ", nats + error + state.settings.ambiguous_nats, 0.0)

    def axis_competitors(self, component: Component, state: State) -> Iterator[Competitor]:
        """Yield three levels or more: a bias that still switches with two in the model."""
        axis, allowed = component.row[0], state.settings.allow_form_error(component.evidence_nats)
        if component.variant.inside.size:
            within = _search_sub_blocks(state.blocks, _add_fast_switching(state, component), axis)
            nats = (
                within.evidence_nats if within is not None and _is_resolved(within, state) else 0.0
            )
        else:
            with_two = state.with_columns("mean", axis, [component.variant.design[0, 0]])
            nats = float(search_block_means(with_two, axis)[0][0])
        yield Competitor("more than two levels", nats, allowed)

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return any course of levels, which the means determine."""
        return [Candidate(_LEVELS, self, (), (Variant({}, ("0",), np.empty(0)),))]

    def design(self, prospect: Prospect) -> Iterator[Variant]:
        """Yield two levels; the means determine the course and its times."""
        if prospect.prediction.levels:
            yield Variant({}, (prospect.prediction.levels,), np.empty(0))

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Compute the evidence of a bias of two levels, by axis.

        It is a lower bound of a log Bayes factor, which exceeds x nats by chance in at most exp(-x)
        of all records. Some of the null records are therefore enough if records are long.
        """
        searched, records = trial.data, trial.data.sizes.get("record", 1)
        if trial.is_null:
            searched = searched.isel(
                record=slice(max(1, _MAX_NULL_BLOCKS // searched.sizes["block"]))
            )
        rows = self.rows(group[0], trial.state)
        evidence_nats = np.full((records, len(rows)), -np.inf)
        courses: list[tuple[TelegraphCourses, SwitchingEvidence | None]] = []
        for row, axis in enumerate(trial.state.axes):
            axis_nats, course, within = trial.recall(
                partial(_search_axis, searched, trial.state, axis),
                group,
                *mean_inputs(trial, axis),
                trial.state.given_to("sub_block", axis),
                *(
                    axis_values(searched, name, axis)
                    for name in ("samples", "sub_block_samples", "sub_block_mean")
                ),
            )
            evidence_nats[: axis_nats.size, row] = axis_nats
            courses.append((course, within))
        out = []
        for candidate in group:
            plain = candidate.variants[0]
            best = tuple(_variant_with_course(plain, *pair, trial.state) for pair in courses)
            evidence = CandidateEvidence(candidate, rows, evidence_nats, best)
            is_free = candidate.effect == _LEVELS
            out.append(_with_free_levels(evidence, trial) if is_free else evidence)
        return out

    def condition(self, state: State, component: Component) -> State:
        """Condition on a bias of two levels.

        If it switches within blocks, its course is the power there and invalidates their kurtosis.
        """
        inside = component.variant.inside
        if not inside.size:
            return super().condition(state, component)
        axis = component.row[0]
        row = state.axes.index(axis)
        attrs = state.blocks.attrs
        low, high = (float(component.variant.values[name]) for name in ("low", "high"))
        power = switching_powers(
            inside, low, high, int(attrs["block_samples"]), float(attrs["sampling_rate_hz"])
        )
        state = _add_fast_switching(state, component)
        state = state.with_columns("power", axis, [power_column(power[None], row, state)])
        moves = xr.DataArray(np.ptp(inside, axis=1) > state.settings.rest_share, dims="block") & (
            state.blocks["axis"] == axis
        )
        blank = {
            name: state.blocks[name].where(~moves, replacement)
            for name, replacement in (("kurtosis", np.nan), ("outliers", 0))
        }
        return replace(state, blocks=state.blocks.assign(blank))

    def estimate(self, fit: SizeFit) -> Sizes:
        """Estimate the step of every axis [degree hour-1] and the dwell times of both levels [s].

        The lower level is that of the strongest axis; an axis that switches the other way has a
        negative step.
        """
        ranked = sorted(fit.components, key=lambda component: -component.evidence_nats)
        first = ranked[0].variant
        out: dict[str, tuple[float, float]] = {}
        for component in ranked:
            size, error = component_size(component, fit.state)
            is_alike = np.cov(component.variant.design[0, 0], first.design[0, 0])[0, 1] >= 0.0
            key = fit.key(first.columns[0], component.row[0])
            out[key] = (size if is_alike else -size, error)
        stays = max(float(first.values["switches"]) / 2.0, 1.0)  # on either level
        return out | {
            time: (float(first.values[time]), float(first.values[time]) / math.sqrt(stays))
            for time in ("low", "high")
        }


def _search_axis(
    data: xr.Dataset, state: State, axis: str
) -> tuple[Floats, TelegraphCourses, SwitchingEvidence | None]:
    """Search an axis for two levels in block means, and then within blocks.

    Return the evidence (record,), the courses of block means, and the switching within blocks,
    which is None unless it is better.
    """
    evidence_nats, course = search_block_means(state, axis, data)
    switching, block = _search_sub_blocks(data, state, axis), float(state.blocks.attrs["block_s"])
    if switching is None:
        return evidence_nats, course, None
    if not _is_resolved(switching, state):
        if switching.refuted and float(course.times[0].min()) < state.settings.refuted_blocks:
            evidence_nats[0] = -np.inf
        return evidence_nats, course, None
    deviation = float(np.sqrt(np.nanmedian(axis_values(state.baseline, "mean_variance", axis))))
    # in block means the share of a block on a level is known to half of one of its parts
    error = float(course.step[0]) / (2.0 * PARTS_PER_BLOCK)
    coarse = np.isfinite(evidence_nats[0]) and error < state.settings.visible_sigma * deviation
    if coarse and switching.times.min() > state.settings.fast_blocks * block:
        return evidence_nats, course, None
    evidence_nats[0] = max(switching.evidence_nats, evidence_nats[0])
    return evidence_nats, course, switching


def _with_free_levels(evidence: CandidateEvidence, trial: Trial) -> CandidateEvidence:
    """Return the evidence of an arbitrary course of levels instead of two [nats].

    Each visit to a level has its own height. In null records it is that of two levels.
    """
    if trial.is_null:
        return evidence
    evidence_nats, best = evidence.evidence_nats.copy(), list(evidence.best)
    for row, (axis,) in enumerate(evidence.rows):
        if not np.isfinite(evidence_nats[0, row]):
            continue
        visits = _compare_visits(_course_of(best[row]), axis, trial.state)
        evidence_nats[0, row] += visits.unequal_nats
        best[row] = replace(
            best[row],
            columns=tuple(str(number) for number in range(len(visits.columns))),
            # the sum of all visits is the course itself
            design=np.concatenate([best[row].design, visits.columns[:-1, None]]),
        )
    return replace(evidence, evidence_nats=evidence_nats, best=tuple(best))


def _variant_with_course(
    variant: Variant, course: TelegraphCourses, within: SwitchingEvidence | None, state: State
) -> Variant:
    """Return the variant with the course of the first record, and its mean times [s]."""
    if within is not None:
        (low, high), count = within.times, within.switch_count
        variant, share = replace(variant, inside=within.share), within.share.mean(axis=1)
    else:
        low, high = course.times[0] * float(state.blocks.attrs["block_s"])
        count, share = float(course.switch_count[0]), course.share[0]
    values = {"low": float(low), "high": float(high), "switches": count}
    return replace(variant, values=values, design=share[None, None])


def _unequal_nats(component: Component, state: State) -> float:
    """Return the evidence of an axis for levels that differ [nats], 0 or more with few switches.

    Jumps that were named first may be switches. The switches are therefore also found without them.
    """
    variant, axis = component.variant, component.row[0]
    given_columns = state.given.get(("mean", axis), [])
    courses = [(_course_of(variant), state)]
    without_jumps = [
        column for column in given_columns if np.count_nonzero(np.diff(column)) > _JUMP_CHANGES
    ]
    if len(without_jumps) < len(given_columns) and not variant.inside.size:
        state_tried = replace(state, given={**state.given, ("mean", axis): without_jumps})
        courses.append((search_block_means(state_tried, axis)[1].share[0], state_tried))
    nats = []
    for share, state_tried in courses:
        visits = _compare_visits(share, axis, state_tried)
        is_known = visits.switch_count >= state.settings.min_switches
        nats.append(visits.unequal_nats if is_known else max(visits.unequal_nats, 0.0))
    return min(nats)


def _course_of(variant: Variant) -> Floats:
    """Return the share on the upper level of each block, or of its sub-blocks if it is known."""
    return variant.inside if variant.inside.size else np.asarray(variant.design[0, 0])


def _compare_visits(share: Floats, axis: str, state: State) -> Visits:
    return compare_visits(
        axis_values(state.blocks, "mean", axis),
        state.baseline,
        share,
        axis=axis,
        block_s=float(state.blocks.attrs["block_s"]),
        given=state.given_to("mean", axis),
    )


def _add_fast_switching(state: State, component: Component) -> State:
    """Add the course of a bias that switches within blocks to the block and sub-block means."""
    axis = component.row[0]
    return state.with_columns("mean", axis, mean_columns(component.variant, 0)).with_columns(
        "sub_block", axis, [component.variant.inside]
    )


def _is_resolved(switching: SwitchingEvidence, state: State) -> bool:
    """Return whether sub-blocks resolve two levels; anything shorter is a spike."""
    sub_block = float(state.blocks.attrs["block_s"]) / switching.share.shape[1]
    return bool(np.isfinite(switching.evidence_nats)) and float(switching.times.min()) >= sub_block


def search_block_means(
    state: State, axis: str, data: xr.Dataset | None = None
) -> tuple[Floats, TelegraphCourses]:
    """Return evidence and courses of two levels in block means, by default those of the state."""
    return telegraph_evidence(
        state.blocks if data is None else data,
        state.baseline,
        axis=axis,
        given=state.given_to("mean", axis),
        settings=state.settings,
    )


def _search_sub_blocks(data: xr.Dataset, state: State, axis: str) -> SwitchingEvidence | None:
    """Search sub-blocks; None if more is named in block means than is known in sub-blocks."""
    if len(state.given.get(("sub_block", axis), [])) < len(state.given.get(("mean", axis), [])):
        return None
    return switching_evidence(
        data,
        state.baseline,
        axis=axis,
        given=state.given_to("sub_block", axis),
        settings=state.settings,
    )
