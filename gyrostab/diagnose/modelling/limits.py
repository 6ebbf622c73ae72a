"""How large an effect may be that was not named."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gyrostab.diagnose.effects.cells import State, pair_rows
from gyrostab.diagnose.effects.designs import Candidate
from gyrostab.diagnose.effects.explained import Part, mean_columns
from gyrostab.diagnose.effects.sizes import part_mixture
from gyrostab.diagnose.naming.claims import Naming
from gyrostab.physics.registry import effects

__all__ = ["Limit", "limits"]

_ONE_SIDED = 1.644854  # standard errors


@dataclass(frozen=True)
class Limit:
    """An effect that was not found: how large it may be, at 95 %; NaN where the record cannot tell."""

    upper_limit: float
    unit: str
    reason: str


def limits(naming: Naming) -> dict[str, Limit]:
    """How large every effect that was not named may be.

    Returns
    -------
    dict of str to Limit
        95 % limit of the effect's first size, the largest over axes; of effects in means and powers.
    """
    named = {claim.effect for claim in (*naming.expected, *naming.claims)}
    out = {}
    for name, kind in effects().items():
        if name in named:
            continue
        unit = next((item.unit for item in kind.parameters() if item.name in kind.size_parameters), "1")
        if name in naming.reasons:
            out[name] = Limit(math.nan, unit, naming.reasons[name])
            continue
        found = [_limit(one, naming.state) for one in naming.candidates if one.effect == name and one.view in ("mean", "power", "cross")]
        known = [(value, column) for value, column in found if math.isfinite(value)]
        if not known:
            out[name] = Limit(math.nan, unit, "not identifiable: free noise does as much" if found else "below limit")
            continue
        value, column = max(known)
        unit = next((item.unit for item in kind.parameters() if item.name == column), unit)
        out[name] = Limit(value, unit, "below limit")
    return out


def _limit(candidate: Candidate, state: State) -> tuple[float, str]:
    """Limit of the first parameter at the middle of its nuisance grid, largest over the rows."""
    if not candidate.variants[0].columns:
        return math.nan, ""
    first = [one for one in candidate.variants if one.columns == candidate.variants[0].columns]
    variant = first[len(first) // 2]
    rows = pair_rows(state.reduced) if candidate.view == "cross" else [(axis,) for axis in state.axes]
    worst = -math.inf
    for row in rows:
        number = state.axes.index(row[0])
        if candidate.view == "mean" and not np.ptp(mean_columns(variant, number)[0]) > 0.0:
            continue
        mean, covariance = part_mixture(Part(candidate, variant, row, 0.0), state).moments()
        value, sd = float(mean[0]), math.sqrt(max(float(covariance[0, 0]), 0.0))
        if not math.isfinite(sd):
            continue
        size = max(value, 0.0) if variant.squared and candidate.view == "power" else abs(value)  # a product of two axes has either sign
        bound = size + _ONE_SIDED * sd
        worst = max(worst, math.sqrt(bound) if variant.squared else bound)
    return (worst if worst > -math.inf else math.nan), variant.columns[0]
