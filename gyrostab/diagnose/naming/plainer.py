"""The plainer form of an effect, where the data do not hold its terms apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gyrostab.diagnose.effects.candidates import Variant
from gyrostab.diagnose.effects.cells import State
from gyrostab.diagnose.effects.explained import Part
from gyrostab.diagnose.effects.sizes import part_mixture

__all__ = ["plainer"]

_ALIKE = 0.999  # correlation of the errors of two terms, from which on they are one to the data
_NEEDED, _FORM = 6.0, 0.01  # nats that a second term must bring, and of the first one's, which an error of its form may leave


def plainer(part: Part, state: State) -> tuple[Part, str]:
    """The part with one of its terms, where that does as well as all, and a sentence about it; else the part as it is.

    Terms that rise and fall together, as g^2 and g^4 at one level of vibration, have sizes that are large, opposite and wrong.

    Parameters
    ----------
    part : Part
        Of means or powers.
    state : State
        With all else that is named.
    """
    if part.candidate.view not in ("mean", "power") or len(part.variant.columns) < 2:
        return part, ""
    mean, covariance = part_mixture(part, state).moments()
    error = np.sqrt(np.diagonal(covariance))
    alike = float(np.abs(np.tril(covariance / np.outer(error, error), -1)).max())
    found = ((name, _only(part, name)) for name in part.variant.columns)
    alone = {name: one for name, one in found if one is not None}
    if not alone:
        return part, ""
    gains = {}
    for name, variant in alone.items():
        size, spread = part_mixture(part, state, variant).moments()
        gains[name] = 0.5 * float(size[0] ** 2 / spread[0, 0])
    best = max(gains.values())
    name = next(name for name in part.variant.columns if gains.get(name, -np.inf) > best - _NEEDED)  # the first that will do
    whole = 0.5 * float(mean @ np.linalg.solve(covariance, mean))
    if alike < _ALIKE and whole - gains[name] > _NEEDED + _FORM * gains[name]:
        return part, ""
    others = " and ".join(other for other in part.variant.columns if other != name)
    return replace(part, variant=alone[name]), f"The record does not tell its {name} from its {others}, which is taken as 0."


def _only(part: Part, name: str) -> Variant | None:
    """The variant of the same values with this term alone."""
    for one in part.candidate.variants:
        if one.columns == (name,) and one.squared == part.variant.squared and one.values == part.variant.values:
            return one
    return None
