"""Biases of two levels, whose course the means themselves determine."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.diagnose.evidence.fast_switching import SwitchingEvidence, switching_powers
from gyrostab.diagnose.evidence.telegraph import (
    PARTS_PER_BLOCK,
    TelegraphCourses,
    telegraph_evidence,
)
from gyrostab.diagnose.evidence.visits import compare_visits
from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.linear_model import State, power_column
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.diagnose.statistics.base import Competitor, SizeFit, Sizes
from gyrostab.diagnose.statistics.fast_switching import (
    add_fast_switching,
    is_resolved,
    search_sub_blocks,
)
from gyrostab.diagnose.statistics.level_forms import further_levels, level_competitors
from gyrostab.diagnose.statistics.mean import BlockMeanStatistic, condition_means

_LEVELS = "~levels"  # nuisance alternative: an arbitrary course
_MAX_NULL_BLOCKS = 20_000  # of null records that are searched for two levels; limits time


class Telegraph(BlockMeanStatistic):
    """A bias that switches between two levels, in block means or within blocks."""

    name = "telegraph"
    is_in_means = True
    is_switching = True

    def competitors(
        self, components: Sequence[Component], state: State, error: float
    ) -> Iterator[Competitor]:
        """Yield levels that differ."""
        return level_competitors(components, state, error)

    def axis_competitors(self, component: Component, state: State) -> Iterator[Competitor]:
        """Yield more than two levels."""
        return further_levels(component, state)

    def nuisance_alternatives(self, blocks: xr.Dataset) -> list[Candidate]:
        """Return any course of levels, which the means determine."""
        return [Candidate(_LEVELS, self, (), (Variant({}, ("0",), np.empty(0)),))]

    def design(self, case: Prospect) -> Iterator[Variant]:
        """Yield two levels; the means determine the course and its times."""
        if case.prediction.levels:
            yield Variant({}, (case.prediction.levels,), np.empty(0))

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Compute the evidence of a bias of two levels, by axis.

        It is a lower bound of a log Bayes factor, which exceeds x nats by chance in at most exp(-x)
        of all records. Some of the null records are therefore enough if records are long.
        """
        records = trial.data.sizes.get("record", 1)
        searched = (
            trial.data.isel(record=slice(max(1, _MAX_NULL_BLOCKS // trial.data.sizes["block"])))
            if "record" in trial.data.dims
            else trial.data
        )
        rows: list[tuple[str, ...]] = [(axis,) for axis in trial.state.axes]
        evidence_nats = np.full((records, len(rows)), -np.inf)
        courses: list[tuple[TelegraphCourses, SwitchingEvidence | None]] = []
        for row, axis in enumerate(trial.state.axes):
            axis_nats, course = telegraph_evidence(
                searched,
                trial.state.baseline,
                axis=axis,
                given=trial.state.given_to("mean", axis),
                settings=trial.state.settings,
            )
            evidence_nats[: axis_nats.size, row] = axis_nats
            within, refuted = _search_fast_switching(
                searched, trial.state, axis, course, float(axis_nats[0])
            )
            if refuted:
                evidence_nats[0, row] = -np.inf
            if within is not None:
                evidence_nats[0, row] = max(within.evidence_nats, evidence_nats[0, row])
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
            return condition_means(state, component)
        axis = component.row[0]
        row = state.axes.index(axis)
        attrs = state.blocks.attrs
        low, high = (float(component.variant.values[name]) for name in ("low", "high"))
        power = switching_powers(
            inside, low, high, int(attrs["block_samples"]), float(attrs["sampling_rate_hz"])
        )
        state = add_fast_switching(state, component)
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
        name, first = ranked[0].variant.columns[0], ranked[0].variant
        course = first.design[0, 0]
        out: dict[str, tuple[float, float]] = {}
        for component in ranked:
            mean, covariance = component_mixture(component, fit.state).moments()
            component_course = component.variant.design[0, 0]
            sign = (
                1.0
                if component is ranked[0] or float(np.cov(component_course, course)[0, 1]) >= 0.0
                else -1.0
            )
            label = name if len(fit.axes) == 1 else f"{name}.{component.row[0]}"
            out[label] = (sign * float(mean[0]), float(math.sqrt(covariance[0, 0])))
        stays = max(float(first.values["switches"]) / 2.0, 1.0)  # on either level
        return out | {
            time: (float(first.values[time]), float(first.values[time]) / math.sqrt(stays))
            for time in ("low", "high")
        }


def _search_fast_switching(
    data: xr.Dataset, state: State, axis: str, course: TelegraphCourses, evidence_nats: float
) -> tuple[SwitchingEvidence | None, bool]:
    """Find switching within blocks, if better than in block means; and whether it refutes it."""
    switching, block = search_sub_blocks(data, state, axis), float(state.blocks.attrs["block_s"])
    if switching is None:
        return None, False
    if not is_resolved(switching, block):
        return None, switching.refuted and float(
            course.times[0].min()
        ) < state.settings.refuted_blocks
    deviation = float(np.sqrt(np.nanmedian(axis_values(state.baseline, "mean_variance", axis))))
    # in block means the share of a block on a level is known to half of one of its parts
    error = float(course.step[0]) / (2.0 * PARTS_PER_BLOCK)
    coarse = np.isfinite(evidence_nats) and error < state.settings.visible_sigma * deviation
    is_slow = switching.times.min() > state.settings.fast_blocks * block
    return (None if coarse and is_slow else switching), False


def _with_free_levels(evidence: CandidateEvidence, trial: Trial) -> CandidateEvidence:
    """Return the evidence of an arbitrary course of levels instead of two [nats].

    Each visit to a level has its own height. In null records it is that of two levels.
    """
    if "record" in trial.data.dims:
        return evidence
    evidence_nats, best = evidence.evidence_nats.copy(), list(evidence.best)
    for row, (axis,) in enumerate(evidence.rows):
        if not np.isfinite(evidence_nats[0, row]):
            continue
        inside = best[row].inside
        visits = compare_visits(
            axis_values(trial.data, "mean", axis),
            trial.state.baseline,
            inside if inside.size else best[row].design[0, 0],
            axis=axis,
            block_s=float(trial.state.blocks.attrs["block_s"]),
            given=trial.state.given_to("mean", axis),
        )
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
