"""Sizes of an effect over the grid of what else is free in it, and what is told of that: lags, exponents, instants."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.grid_refinement import Point, refined
from gyrostab.diagnose.identify.forward_search import AMBIGUOUS, FORM
from gyrostab.diagnose.identify.identification import Identifications
from gyrostab.diagnose.predict.candidates import Variant
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import Mixture, component_mixture
from gyrostab.physics.registry import effects

__all__ = ["plain_places", "sizes_over"]

Array = NDArray[np.float64]
_AT_ONCE = 1e-2  # s: a lag that is as good as none
_TAILS = (0.025, 0.975)


def sizes_over(
    component: Component, state: State, identifications: Identifications
) -> tuple[Array, Array, dict[str, tuple[float, ...]]]:
    """Sizes of a part, averaged over the noise and over what else is free.

    An exponent has its default and a lag is none, unless other values are better by 3 nats and an
    error of the form. The scatter of the sizes holds all lags that the record allows also where
    none is told; of an exponent the size is another one, in another unit.

    Parameters
    ----------
    component : Part
    state : State
        With all else that is named.
    identifications : Naming
        Its candidates have the grid.

    Returns
    -------
    mean : ndarray, shape (column,)
    covariance : ndarray, shape (column, column)
        About that mean.
    nuisance : dict of str to (float, float) or (float, float, float, float)
        Value and standard deviation of the others, and the ends of the 95 % interval where that is
        not symmetric; NaN for one that is told, but not measured.
    """
    grid = [
        Point(variant, component_mixture(component, state, variant))
        for variant in _family(component, identifications)
    ]
    usual = _usual(component, [point.variant for point in grid], [point.evidence for point in grid])
    points = refined(component, state, [grid[place] for place in usual])
    family = [point.variant for point in points]
    evidence = np.array([point.evidence for point in points])
    mean, covariance = _merged(points).moments()
    at_once = _at_once(family)
    told = [
        place
        for place in at_once
        if evidence[place] > evidence.max() - AMBIGUOUS - FORM * max(component.evidence_nats, 0.0)
    ]
    if told:
        middle, _ = _merged([points[place] for place in told]).moments()
        mean, covariance = middle, covariance + np.outer(middle - mean, middle - mean)
    weighed = evidence + np.log([point.share for point in points])
    share = np.exp(weighed - np.logaddexp.reduce(weighed))
    nuisance: dict[str, tuple[float, ...]] = {}
    for name in {
        key for one in family for key, value in one.values.items() if not isinstance(value, str)
    }:
        tried = np.array([float(one.values[name]) for one in family])
        if not np.isfinite(tried).all():
            continue
        if np.ptp(tried) == 0.0:
            nuisance[name] = (float(tried[0]), math.nan)
            continue
        none = bool(told) and _is_lag(name)
        middle_of = 0.0 if none else float(share @ tried)
        spread = max(
            math.sqrt(float(share @ (tried - middle_of) ** 2)), 0.3 * _spacing(tried, middle_of)
        )
        nuisance[name] = (
            (middle_of, spread) if none else (middle_of, spread, *_ends(tried, share, middle_of))
        )
    return mean, covariance, nuisance


def _merged(points: Sequence[Point]) -> Mixture:
    several = [point.weighed() for point in points]
    return Mixture(
        *(
            np.concatenate([getattr(one, name) for one in several])
            for name in ("log_weight", "mean", "covariance")
        )
    )


def _family(component: Component, identifications: Identifications) -> list[Variant]:
    """Variants of the part with the same columns: the grid."""
    candidate = next(
        (
            one
            for one in identifications.candidates
            if one.key == component.candidate.key and one.statistic == component.candidate.statistic
        ),
        component.candidate,
    )
    return [
        one
        for one in candidate.variants
        if one.columns == component.variant.columns and one.squared == component.variant.squared
    ]


def plain_places(effect: str, family: Sequence[Variant]) -> list[int]:
    """Places of the variants with the default of every parameter that the grid has it of, but lags: their sizes are of one unit."""
    known = {item.name: item.default for item in effects()[effect].parameters()}
    tried = {
        name
        for name in known
        if not _is_lag(name) and any(one.values.get(name) == known[name] for one in family)
    }
    return [
        place
        for place, one in enumerate(family)
        if all(one.values.get(name, known[name]) == known[name] for name in tried)
    ]


def _usual(component: Component, family: Sequence[Variant], evidence: Sequence[float]) -> list[int]:
    """Places of the plain variants, unless others are clearly better."""
    plain, top = plain_places(component.candidate.effect, family), max(evidence)
    return (
        plain
        if plain and max(evidence[place] for place in plain) > top - AMBIGUOUS
        else list(range(len(family)))
    )


def _at_once(family: Sequence[Variant]) -> list[int]:
    """Places of the variants without any lag; none where nothing lags at all."""
    lags = [_lags(one.values) for one in family]
    return (
        [place for place, mine in enumerate(lags) if mine and max(mine.values()) <= _AT_ONCE]
        if any(lags)
        else []
    )


def _lags(values: Mapping[str, float | str]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items() if _is_lag(name)}


def _is_lag(name: str) -> bool:
    return name == "lag" or name.endswith("_lag")


def _ends(tried: Array, share: Array, middle: float) -> tuple[float, float]:
    """Ends of the 95 % interval: every value stands for all that are nearer to it than to the next, and for as much beyond the last.

    Lags, times and plays are known to a factor, so that there is more room above than below.
    """
    known, place = np.unique(tried, return_inverse=True)
    between = np.where(
        known[:-1] > known[1:] / 100.0,
        np.sqrt(known[:-1] * known[1:]),
        0.5 * (known[:-1] + known[1:]),
    )
    first, last = known[0] - (between[0] - known[0]), known[-1] + (known[-1] - between[-1])
    edge = np.concatenate([[max(first, 0.0)], between, [last]])
    below = np.append(0.0, np.cumsum(np.bincount(place, weights=share)))
    low, high = np.interp(_TAILS, below / below[-1], edge)
    return min(float(low), middle), max(float(high), middle)


def _spacing(grid: Array, place: float) -> float:
    """Distance of the grid's values about a place."""
    known = np.unique(grid)
    nearest = int(np.abs(known - place).argmin())
    return float(np.diff(known[max(nearest - 1, 0) : nearest + 2]).mean())
