"""Reduce effects of several terms to one where the data do not separate the terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture

__all__ = ["prefer_plainer"]


def prefer_plainer(component: Component, state: State) -> tuple[Component, str]:
    """Return a component with a single term where that explains as much, and a sentence about it.

    A component of one term gets the first of those that explain as much, but for 3 nats and an
    error of the form. Terms that rise and fall together, as g^2 and g^4 at one level of vibration,
    would otherwise get large and opposite sizes that are both wrong.

    Parameters
    ----------
    component : Component
        Of means or powers; any other is returned as it is.
    state : State
        With all other effects in the model.

    Returns
    -------
    component : Component
    sentence : str
        Empty when the component is unchanged.
    """
    if not (component.statistic.is_linear_in_means or component.statistic.is_power):
        return component, ""
    if len(component.variant.columns) == 1:
        return _prefer_first_term(component, state)
    mean, covariance = component_mixture(component, state).moments()
    error = np.sqrt(np.diagonal(covariance))
    correlation = float(np.abs(np.tril(covariance / np.outer(error, error), -1)).max())
    found = ((name, _single_term_variant(component, name)) for name in component.variant.columns)
    alone = {name: one for name, one in found if one is not None}
    if not alone:
        return component, ""
    gains = {
        name: _single_term_evidence(component, state, variant) for name, variant in alone.items()
    }
    needed, share = state.settings.reject_nats, state.settings.form_error_share
    best = max(gains.values())
    # the first that explains as much as the best
    name = next(
        name for name in component.variant.columns if gains.get(name, -np.inf) > best - needed
    )
    whole = 0.5 * float(mean @ np.linalg.solve(covariance, mean))
    if (
        correlation < state.settings.term_correlation
        and whole - gains[name] > needed + share * gains[name]
    ):
        return component, ""
    others = [other for other in component.variant.columns if other != name]
    return replace(component, variant=alone[name]), _describe_unseparated(name, others)


def _prefer_first_term(component: Component, state: State) -> tuple[Component, str]:
    """Return a component of one term with the first of the terms that explain as much.

    Rounding or chance may have put another one ahead.
    """
    names = dict.fromkeys(
        one.columns[0] for one in component.candidate.variants if len(one.columns) == 1
    )
    terms = [one for name in names if (one := _single_term_variant(component, name)) is not None]
    own = _single_term_evidence(component, state, component.variant)
    correlation = [
        one
        for one in terms
        if one.columns == component.variant.columns
        or _single_term_evidence(component, state, one)
        > own - state.settings.ambiguous_nats - state.settings.form_error_share * own
    ]
    if len(correlation) < 2:
        return component, ""
    first, *others = correlation
    return replace(component, variant=first), _describe_unseparated(
        first.columns[0], [one.columns[0] for one in others]
    )


def _single_term_evidence(component: Component, state: State, variant: Variant) -> float:
    """Return the evidence [nats] of a single term; zero where it would reduce the power."""
    size, spread = component_mixture(component, state, variant).moments()
    possible = max(float(size[0]), 0.0) if variant.squared else float(size[0])
    return 0.5 * possible**2 / float(spread[0, 0])


def _describe_unseparated(name: str, others: Sequence[str]) -> str:
    taken = "is" if len(others) == 1 else "are"
    return (
        f"The record does not separate its {name} from its {' and '.join(others)}, which {taken} "
        "taken as 0."
    )


def _single_term_variant(component: Component, name: str) -> Variant | None:
    """Return the variant of the same values with this term alone."""
    for one in component.candidate.variants:
        if (
            one.columns == (name,)
            and one.squared == component.variant.squared
            and one.values == component.variant.values
        ):
            return one
    return None
