"""Choose one of the equivalent forms of an effect, for its noise, its sizes and its model alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.average_sizes import Point, choose_grid, refine_grid
from gyrostab.diagnose.predict.candidates import Component, Variant
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.physics.registry import effects
from gyrostab.wording import join_words


def choose_forms(identifications: Identifications, baseline: xr.Dataset) -> Identifications:
    """Return identifications with the forms that their models will have.

    Each component has a single term where that explains as much, and the exponent that its sizes
    are estimated with. All components of an effect have the same choice of each parameter that is a
    text. Noise that is calibrated with another form than the model has does not belong to that
    model.
    """

    def with_form(identification: Selection) -> Selection:
        state = identifications.state_without(identification, baseline)
        components = _share_choices(identification.components, state)
        return replace(
            identification,
            components=tuple(
                _choose_variant(prefer_plainer(component, state), state) for component in components
            ),
        )

    return replace(
        identifications,
        identified=tuple(map(with_form, identifications.identified)),
        expected=tuple(map(with_form, identifications.expected)),
    )


def _share_choices(components: Sequence[Component], state: State) -> list[Component]:
    """Return components with the same texts, those that explain most together.

    The default is preferred unless another text is clearly better.
    """
    tried: list[dict[str, str]] = []
    for component in components:
        for variant in component.candidate.variants:
            if variant.texts not in tried:
                tried.append(variant.texts)
    if len(tried) < 2:
        return [*components]
    parameters = effects()[components[0].candidate.effect].parameters()
    defaults = {item.name: item.default for item in parameters}.items()
    choices: list[tuple[float, bool, list[Component]]] = []
    for texts in tried:
        selected = [_select_texts(component, state, texts) for component in components]
        matching = [component for component in selected if component is not None]
        if len(matching) == len(components):
            nats = sum(_explained_nats(part, state) for part in matching if _has_forms(part))
            choices.append((nats, texts.items() <= defaults, matching))
    least = max((nats for nats, _, _ in choices), default=0.0) - state.settings.ambiguous_nats
    usual = [choice for choice in choices if choice[1] and choice[0] > least]
    best = max(usual or choices, key=lambda choice: choice[0], default=None)
    return [*components] if best is None else best[2]


def _select_texts(component: Component, state: State, texts: Mapping[str, str]) -> Component | None:
    """Return a component in its best variant with some texts; None if it has none."""
    if component.variant.texts == texts or not _has_forms(component):
        return component
    variants = component.candidate.family(replace(component.variant, values=texts))
    best = _best_variant(component, state, variants)
    return None if best is None else replace(component, variant=best)


def _choose_variant(component: Component, state: State) -> Component:
    """Return a component in its own variant, or in the best of those that its sizes are from."""
    if component.is_filter or component.is_step or not _has_forms(component):
        return component
    grid = choose_grid(component, state)
    if any(point.variant is component.variant for point in grid):
        return component
    return replace(component, variant=max(grid, key=lambda point: point.evidence).variant)


def _has_forms(component: Component) -> bool:
    """Return whether the variants of a component are columns of which the size is fitted."""
    statistic = component.statistic
    return bool(component.variant.columns) and (
        statistic.is_linear_in_means or statistic.is_power or statistic.is_pairwise
    )


def prefer_plainer(component: Component, state: State) -> Component:
    """Return a component with a single term where that explains as much, and a note about it.

    A component of neither means nor powers is returned as it is. The state has all other effects.
    Terms that explain nothing beyond the others are left out, if the record separates them. A
    component of one term gets the first of those that explain as much, but for 3 nats and an
    error of the form. Terms that rise and fall together, as g^2 and g^4 at one level of vibration,
    would otherwise get large and opposite sizes that are both wrong.
    """
    if not (component.statistic.is_linear_in_means or component.statistic.is_power):
        return component
    settings = state.settings
    if is_single := len(component.variant.columns) == 1:
        single = (part.columns for part in component.candidate.variants if len(part.columns) == 1)
        names = tuple(columns[0] for columns in single)
    else:
        names = component.variant.columns
    terms = {
        name: variant
        for name in dict.fromkeys(names)
        if (variant := _single_term_variant(component, state, name)) is not None
    }
    term_nats = {
        name: _explained_nats(component, state, variant) for name, variant in terms.items()
    }
    if is_single:  # rounding or chance may have put another term ahead
        own = component.variant.columns[0]
        own_nats = _explained_nats(component, state)
        needed_nats = own_nats - settings.allow_form_error(own_nats)
        close = [name for name in terms if name == own or term_nats[name] > needed_nats]
        if len(close) < 2:
            return component
        name, *other_names = close
    elif not terms:
        return component
    else:
        best = max(term_nats.values())
        # the first that explains as much as the best
        name = next(name for name in terms if term_nats[name] > best - settings.reject_nats)
        mean, covariance = component_mixture(component, state).moments()
        error = np.sqrt(np.diagonal(covariance))
        correlation = float(np.abs(np.tril(covariance / np.outer(error, error), -1)).max())
        total_nats = 0.5 * float(mean @ np.linalg.solve(covariance, mean))
        needed_nats = settings.reject_nats + settings.form_error_share * term_nats[name]
        if correlation < settings.term_correlation and total_nats - term_nats[name] > needed_nats:
            return _drop_needless_terms(component, state)
        other_names = [other for other in component.variant.columns if other != name]
    return replace(component, variant=terms[name], note=_describe_unseparated(name, other_names))


def _drop_needless_terms(component: Component, state: State) -> Component:
    """Return a component without the terms that explain hardly anything beyond the others.

    The term that adds least is dropped first, as long as it adds less than 3 nats.
    """
    needed = component.variant
    while len(needed.columns) > 1:
        fewer = [
            needed.with_columns(tuple(name for name in needed.columns if name != dropped))
            for dropped in needed.columns
        ]
        nats = [_explained_nats(component, state, variant) for variant in fewer]
        lost_nats = _explained_nats(component, state, needed) - max(nats)
        if lost_nats > state.settings.ambiguous_nats:
            break
        needed = fewer[int(np.argmax(nats))]
    if needed is component.variant:
        return component
    family = component.candidate.family(component.variant)
    reduced = tuple(variant.with_columns(needed.columns) for variant in family)
    variants = (*component.candidate.variants, *reduced)
    dropped_names = [name for name in component.variant.columns if name not in needed.columns]
    return replace(
        component,
        candidate=replace(component.candidate, variants=variants),
        variant=next((variant for variant in reduced if variant.values == needed.values), needed),
        note=_describe_dropped(dropped_names),
    )


def _explained_nats(component: Component, state: State, variant: Variant | None = None) -> float:
    """Return what the terms of a variant explain [nats]; zero where they would reduce the power."""
    variant = variant or component.variant
    size, spread = component_mixture(component, state, variant).moments()
    if variant.squared and not component.statistic.is_pairwise:
        size = np.maximum(size, 0.0)
    return 0.5 * float(size @ np.linalg.solve(spread, size))


def _describe_unseparated(name: str, other_names: Sequence[str]) -> str:
    terms, others = join_words([name, *other_names]), join_words(other_names)
    verb = "is" if len(other_names) == 1 else "are"
    return f"The record does not separate the terms {terms}; {others} {verb} taken as 0."


def _describe_dropped(names: Sequence[str]) -> str:
    terms, verb = ("term", "it is") if len(names) == 1 else ("terms", "they are")
    return f"The record shows no sign of the {terms} {join_words(names)}; {verb} taken as 0."


def _single_term_variant(component: Component, state: State, name: str) -> Variant | None:
    """Return the variant with this term alone, and the same texts, that explains most.

    That of a component of several terms may lie between the points of the grid: two terms of one
    point together can take the form of a single one between two points.
    """
    variants = component.candidate.family(replace(component.variant, columns=(name,)))
    if variants and len(component.variant.columns) > 1:
        grid = [
            Point(variant, component_mixture(component, state, variant)) for variant in variants
        ]
        variants = [point.variant for point in refine_grid(component, state, grid)]
    return _best_variant(component, state, variants)


def _best_variant(
    component: Component, state: State, variants: Sequence[Variant]
) -> Variant | None:
    """Return the variant that explains most; None without any."""
    return max(
        variants, key=lambda variant: _explained_nats(component, state, variant), default=None
    )
