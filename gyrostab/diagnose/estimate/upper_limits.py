"""Limit the sizes of effects that were not found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gyrostab.diagnose.evidence.mixture import Mixture
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.predict.average_sizes import plain_places
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.physics.base import Effect
from gyrostab.physics.registry import effects

BEYOND = 0.05  # probability of a larger size
MAX_VARIANTS = 9  # evenly spread over the grid of a mean: enough for a smooth mixture


def find_upper_limits(identifications: Identifications) -> dict[str, dict[str, Any]]:
    """Find how large each effect may be that was not identified.

    The ``upper_limit``, 95 %, is that of the effect's first size in means, powers or cross-spectra,
    the largest over the axes; NaN where the record has none, with its ``unit`` and the ``reason``.
    """
    named = {
        identification.effect
        for identification in (*identifications.expected, *identifications.identified)
    }
    return {
        name: _limit_effect(kind, identifications)
        for name, kind in effects().items()
        if name not in named
    }


def _limit_effect(kind: type[Effect], identifications: Identifications) -> dict[str, Any]:
    units = {item.name: item.unit for item in kind.parameters()}
    unit = next((units[name] for name in units if name in kind.size_parameters), "1")
    if kind.name in identifications.examination.reasons:
        reason = identifications.examination.reasons[kind.name]
        return {"upper_limit": math.nan, "unit": unit, "reason": reason}
    limits = [
        _limit_candidate(candidate, identifications.state)
        for candidate in identifications.examination.candidates
        if candidate.effect == kind.name
        and candidate.statistic.has_course
        and candidate.statistic.has_size
    ]
    by_column: dict[str, float] = {}  # the largest
    for value, column in limits:
        if math.isfinite(value):
            by_column[column] = max(value, by_column.get(column, value))
    if not by_column:
        reason = "not identifiable: free noise explains as much" if limits else "below limit"
        return {"upper_limit": math.nan, "unit": unit, "reason": reason}
    column = next((name for name in units if name in by_column), next(iter(by_column)))
    return {
        "upper_limit": by_column[column],
        "unit": units.get(column, unit),
        "reason": "below limit",
    }


def _limit_candidate(candidate: Candidate, state: State) -> tuple[float, str]:
    """Return the limit of the first parameter, the largest over the rows.

    It is over all lags, time constants and dead bands of the grid, weighted by their likelihood.
    """
    first = candidate.variants[0]
    if not first.columns:
        return math.nan, ""
    family = _select_variants(
        candidate, [variant for variant in candidate.variants if variant.columns == first.columns]
    )
    limits = (
        _limit_row(Component(candidate, family[0], row, 0.0), family, state)
        for row in candidate.statistic.rows(candidate, state)
    )
    worst = max(filter(math.isfinite, limits), default=math.nan)
    return (math.sqrt(worst) if family[0].squared else worst), first.columns[0]


def _select_variants(candidate: Candidate, family: Sequence[Variant]) -> Sequence[Variant]:
    """Return the variants that a limit covers: plain ones, or the middle of the grid.

    For means these are evenly spread over the grid. For other statistics, the sizes of other
    variants have other meanings.
    """
    plain = (
        [family[place] for place in plain_places(candidate.effect, family)]
        if candidate.statistic.is_linear_in_means
        else []
    )
    every = -(-len(plain) // MAX_VARIANTS)
    return plain[every // 2 :: every] if plain else [family[len(family) // 2]]


def _limit_row(component: Component, family: Sequence[Variant], state: State) -> float:
    """Return the 95 % limit of a size (or its square) on an axis or pair; NaN without one."""
    moving = [
        variant
        for variant in family
        if not component.statistic.is_linear_in_means
        or np.ptp(mean_columns(variant, state.axes.index(component.row[0]))[0]) > 0.0
    ]
    mixtures = [component_mixture(component, state, variant) for variant in moving]
    moments = [mixture.moments() for mixture in mixtures]
    mean = np.array([float(size[0]) for size, _ in moments])
    sd = np.sqrt([max(float(square[0, 0]), 0.0) for _, square in moments])
    is_usable = np.isfinite(mean) & np.isfinite(sd) & (sd > 0.0)
    mean, sd = mean[is_usable], sd[is_usable]
    evidence = np.array([mixture.evidence for mixture in mixtures])[is_usable] - np.log(sd)
    if not np.isfinite(evidence).any():
        return math.nan
    one_sided = (
        component.variant.squared and component.statistic.is_power
    )  # the product of two axes may have either sign
    size = np.maximum(mean, 0.0) if one_sided else np.abs(mean)
    joined = Mixture(evidence, size[:, None], np.square(sd)[:, None, None])
    return float(joined.quantiles(BEYOND)[1, 0])
