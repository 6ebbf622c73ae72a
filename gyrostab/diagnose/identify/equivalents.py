"""The plainer form of an effect, where the data do not hold its terms apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.predict.candidates import Variant
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture

__all__ = ["prefer_plainer"]

_ALIKE = 0.999  # correlation of the errors of two terms, from which on they are one to the data
_AMBIGUOUS = 3.0  # nats by which one term alone must be better than another
_NEEDED, _FORM = (
    6.0,
    0.01,
)  # nats that a second term must bring, and of the first one's, which an error of its form may leave


def prefer_plainer(component: Component, state: State) -> tuple[Component, str]:
    """The part with one of its terms, where that does as well as all, and a sentence about it; else the part as it is.

    A part of one term gets the first of those that alone do as well, but for 3 nats and an error of
    the form. Terms that rise and fall together, as g^2 and g^4 at one level of vibration, have
    sizes that are large, opposite and wrong.

    Parameters
    ----------
    component : Part
        Of means or powers.
    state : State
        With all else that is named.
    """
    if component.candidate.statistic not in ("mean", "power"):
        return component, ""
    if len(component.variant.columns) == 1:
        return _first_alike(component, state)
    mean, covariance = component_mixture(component, state).moments()
    error = np.sqrt(np.diagonal(covariance))
    alike = float(np.abs(np.tril(covariance / np.outer(error, error), -1)).max())
    found = ((name, _only(component, name)) for name in component.variant.columns)
    alone = {name: one for name, one in found if one is not None}
    if not alone:
        return component, ""
    gains = {name: _alone(component, state, variant) for name, variant in alone.items()}
    best = max(gains.values())
    name = next(
        name for name in component.variant.columns if gains.get(name, -np.inf) > best - _NEEDED
    )  # the first that will do
    whole = 0.5 * float(mean @ np.linalg.solve(covariance, mean))
    if alike < _ALIKE and whole - gains[name] > _NEEDED + _FORM * gains[name]:
        return component, ""
    others = [other for other in component.variant.columns if other != name]
    return replace(component, variant=alone[name]), _untold(name, others)


def _first_alike(component: Component, state: State) -> tuple[Component, str]:
    """A part of one term: by the first of the terms that alone do as well, whichever rounding or chance had put ahead."""
    names = dict.fromkeys(
        one.columns[0] for one in component.candidate.variants if len(one.columns) == 1
    )
    terms = [one for name in names if (one := _only(component, name)) is not None]
    own = _alone(component, state, component.variant)
    alike = [
        one
        for one in terms
        if one.columns == component.variant.columns
        or _alone(component, state, one) > own - _AMBIGUOUS - _FORM * own
    ]
    if len(alike) < 2:
        return component, ""
    first, *others = alike
    return replace(component, variant=first), _untold(
        first.columns[0], [one.columns[0] for one in others]
    )


def _alone(component: Component, state: State, variant: Variant) -> float:
    """What a single term gains over none [nats]; nothing where it would take power away."""
    size, spread = component_mixture(component, state, variant).moments()
    possible = max(float(size[0]), 0.0) if variant.squared else float(size[0])
    return 0.5 * possible**2 / float(spread[0, 0])


def _untold(name: str, others: Sequence[str]) -> str:
    taken = "is" if len(others) == 1 else "are"
    return f"The record does not tell its {name} from its {' and '.join(others)}, which {taken} taken as 0."


def _only(component: Component, name: str) -> Variant | None:
    """The variant of the same values with this term alone."""
    for one in component.candidate.variants:
        if (
            one.columns == (name,)
            and one.squared == component.variant.squared
            and one.values == component.variant.values
        ):
            return one
    return None
