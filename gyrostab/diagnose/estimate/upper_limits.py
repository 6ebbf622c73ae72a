"""How large an effect may be that was not named."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from gyrostab.diagnose.estimate.nuisance import plain_places
from gyrostab.diagnose.identify.identification import Identifications
from gyrostab.diagnose.predict.condition import Component, mean_columns
from gyrostab.diagnose.predict.designs import Candidate, Variant
from gyrostab.diagnose.predict.linear_model import State, pair_rows
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.physics.registry import effects

__all__ = ["UpperLimit", "find_upper_limits", "mixture_limit"]

_LEVEL = 0.95
_MOST = 9  # variants
_ONE_SIDED = float(ndtri(_LEVEL))  # standard errors


@dataclass(frozen=True)
class UpperLimit:
    """An effect that was not found: how large it may be, at 95 %; NaN where the record cannot tell."""

    upper_limit: float
    unit: str
    reason: str


def find_upper_limits(identifications: Identifications) -> dict[str, UpperLimit]:
    """How large every effect that was not named may be.

    Returns
    -------
    dict of str to Limit
        95 % limit of the effect's first size, the largest over axes; of effects in means and
        powers.
    """
    named = {
        identification.effect
        for identification in (*identifications.expected, *identifications.identified)
    }
    out = {}
    for name, kind in effects().items():
        if name in named:
            continue
        unit = next(
            (item.unit for item in kind.parameters() if item.name in kind.size_parameters), "1"
        )
        if name in identifications.reasons:
            out[name] = UpperLimit(math.nan, unit, identifications.reasons[name])
            continue
        found = [
            _limit(one, identifications.state)
            for one in identifications.candidates
            if one.effect == name and one.statistic in ("mean", "power", "cross")
        ]
        known = [(value, column) for value, column in found if math.isfinite(value)]
        if not known:
            out[name] = UpperLimit(
                math.nan,
                unit,
                "not identifiable: free noise does as much" if found else "below limit",
            )
            continue
        value, column = max(known)
        unit = next((item.unit for item in kind.parameters() if item.name == column), unit)
        out[name] = UpperLimit(value, unit, "below limit")
    return out


def _limit(candidate: Candidate, state: State) -> tuple[float, str]:
    """Limit of the first parameter over the lags, times and plays of its grid, each as likely as the record says, largest over the rows."""
    if not candidate.variants[0].columns:
        return math.nan, ""
    family = _told_over(
        candidate,
        [one for one in candidate.variants if one.columns == candidate.variants[0].columns],
    )
    rows = (
        pair_rows(state.blocks)
        if candidate.statistic == "cross"
        else [(axis,) for axis in state.axes]
    )
    found = [_of_row(Component(candidate, family[0], row, 0.0), family, state) for row in rows]
    known = [bound for bound in found if math.isfinite(bound)]
    worst = max(known) if known else math.nan
    return (math.sqrt(worst) if family[0].squared else worst), family[0].columns[0]


def _told_over(candidate: Candidate, family: Sequence[Variant]) -> Sequence[Variant]:
    """Of means some plain variants, evenly over the grid; of others the one in its middle: the sizes of the rest have other meanings."""
    plain = (
        [family[place] for place in plain_places(candidate.effect, family)]
        if candidate.statistic == "mean"
        else []
    )
    every = -(-len(plain) // _MOST)
    return plain[every // 2 :: every] if plain else [family[len(family) // 2]]


def _of_row(component: Component, family: Sequence[Variant], state: State) -> float:
    """The number that the size, or its square, is below at 95 %, on an axis or a pair; NaN where the record cannot tell."""
    moves = [
        one
        for one in family
        if component.candidate.statistic != "mean"
        or np.ptp(mean_columns(one, state.axes.index(component.row[0]))[0]) > 0.0
    ]
    sizes = [component_mixture(component, state, one) for one in moves]
    moments = [
        (float(mean[0]), math.sqrt(max(float(square[0, 0]), 0.0)))
        for mean, square in (one.moments() for one in sizes)
    ]
    usable = [
        place
        for place, (mean, sd) in enumerate(moments)
        if math.isfinite(mean) and math.isfinite(sd) and sd > 0.0
    ]
    if not usable:
        return math.nan
    mean, sd = np.array([moments[place] for place in usable]).T
    evidence = np.array(
        [float(np.logaddexp.reduce(sizes[place].log_weight)) for place in usable]
    ) - np.log(sd)
    if not np.isfinite(evidence).any():
        return math.nan
    share = np.exp(evidence - np.logaddexp.reduce(evidence))
    one_sided = (
        component.variant.squared and component.candidate.statistic == "power"
    )  # a product of two axes has either sign
    size = np.maximum(mean, 0.0) if one_sided else np.abs(mean)
    return mixture_limit(size, sd, share)


def mixture_limit(
    size: NDArray[np.float64], sd: NDArray[np.float64], share: NDArray[np.float64]
) -> float:
    """Find the number that a mixture of normal laws is below with a probability of 95 %.

    Parameters
    ----------
    size, sd, share : ndarray, shape (law,)
        Mean, standard deviation and weight of each law.

    Examples
    --------
    >>> round(mixture_limit(np.array([1.0]), np.array([0.1]), np.array([1.0])), 3)
    1.164
    """

    def excess(bound: float) -> float:
        return float(share @ ndtr((bound - size) / sd)) - _LEVEL

    ends = size + _ONE_SIDED * sd
    low, high = float(ends.min()), float(ends.max())
    if excess(low) >= 0.0:  # by rounding: one law has all the weight, or all have one limit
        return low
    return high if excess(high) <= 0.0 else float(brentq(excess, low, high))
