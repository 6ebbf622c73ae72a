"""Fit filters of the logger to the spectrum, and drop lines that are only the slope of a filter."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import State

Array = NDArray[np.float64]


def without_slopes(
    passing: list[str],
    components: Mapping[str, list[Component]],
    state: State,
    examination: Examination,
) -> list[str]:
    """Drop lines that a passing filter explains, or the filter if lines remain.

    A line is compared with its neighbours, so that the steep slope of a filter, or the lobes of an
    average, look like one. Lines that keep half of their evidence come before the filter: many of
    them together leave a broad form in the powers too. All that explains less than the filter then
    waits with it, because any other form would be named for the slope.
    """
    lines = [key for key in passing if components[key][0].candidate.statistic.is_line]
    filters = [key for key in passing if any(component.is_filter for component in components[key])]
    if not lines or not filters:
        return passing
    trial = condition_on(state, list(components[filters[0]]))
    line_evidence = examination.compute_evidence(
        [components[key][0].candidate for key in lines], trial
    )
    nats_after = {
        evidence.candidate.key: float(np.maximum(evidence.evidence_nats[0], 0.0).sum())
        for evidence in line_evidence
    }
    nats_before = {
        key: sum(max(component.evidence_nats, 0.0) for component in components[key])
        for key in lines
    }
    real = {
        key
        for key in lines
        if nats_after.get(key, 0.0) > state.settings.majority_share * nats_before[key]
    }
    if not real:
        return [key for key in passing if key not in lines]
    stronger = passing[: passing.index(filters[0])]
    return [key for key in passing if key in real or (key in stronger and key not in lines)]
