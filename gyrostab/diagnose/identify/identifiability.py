"""Reject sizes that physics does not allow, and effects that another form explains better."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import mean_columns
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.sizes import component_mixture, component_size
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.statistics.base import Competitor
from gyrostab.diagnose.statistics.candidates import largest_size
from gyrostab.physics.registry import effects

Array = NDArray[np.float64]
_PPM = 1e6  # in one


def keep_physical(
    components: Sequence[Component], state: State, *, error: float = 0.0
) -> tuple[list[Component], tuple[str, float] | None]:
    """Return the components of an effect that no other form explains better, of possible sizes.

    Without an effect on an axis, chance may fit an impossible size. If no component is left, the
    second result is the form that excludes the effect, and by how much it explains more [nats], NaN
    for sizes that physics excludes.

    Parameters
    ----------
    components : sequence of Component
        Components of the effect, the strongest first.
    state : State
        With all other effects in the model.
    error : float
        What errors of the form of all other effects may leave to this one [nats].
    """
    by_statistic = {
        statistic: [component for component in components if component.statistic is statistic]
        for statistic in dict.fromkeys(component.statistic for component in components)
    }
    other_course = _find_winner(
        competitor
        for statistic, own in by_statistic.items()
        for competitor in statistic.competitors(own, state, error)
    )
    if other_course:
        return [], other_course
    possible = [_with_possible_size(component, state) for component in components]
    forms = [
        _find_winner(component.statistic.axis_competitors(component, state))
        if component
        else ("an impossible size", math.nan)
        for component in possible
    ]
    remaining = [
        component for component, form in zip(possible, forms, strict=True) if component and not form
    ]
    return remaining, next(iter(forms), None) if not remaining else None


def _with_possible_size(component: Component, state: State) -> Component | None:
    """Return the component in the best form that gives a possible size; None without any.

    Where the record leaves a nuisance parameter open, the best form has any size: a toolface, for
    example, shows in the mean of one axis only by the cosine of an angle.
    """
    forms = (replace(component, variant=variant) for variant in component.close[1:])
    return next((form for form in (component, *forms) if _is_possible(form, state)), None)


def _find_winner(competitors: Iterable[Competitor]) -> tuple[str, float] | None:
    """Return the first form that explains more than it needs, and by how much [nats]."""
    return next(
        (
            (competitor.name, competitor.nats)
            for competitor in competitors
            if competitor.nats > competitor.needed
        ),
        None,
    )


def find_plainer_effect(components: Sequence[Component], state: State) -> str | None:
    """Return the effect that explains the same more plainly, or None.

    An axis senses a real rotation by the cosine of its angle to it, which is rarely small; errors
    of the scale factor are, and physics excludes large ones.
    """
    effect = components[0].candidate.effect
    if effect == "real_motion" and all(
        _is_rotation(component)
        and _rotation_share(component, state) < state.settings.max_misalignment_share
        for component in components
    ):
        return "scale_factor"
    return next(iter(effects()[effect].look_alikes("limit")), None)


def _is_rotation(component: Component) -> bool:
    """Return whether a component is that of an axis that senses the rotation of the tool."""
    return (
        component.candidate.effect == "real_motion"
        and component.statistic.is_linear_in_means
        and component.variant.columns == ("spin",)
    )


def _rotation_share(component: Component, state: State) -> float:
    """Return the share of the rotation of the tool that an axis senses, or that an error is."""
    if _is_rotation(component):
        return abs(component_size(component, state)[0])
    row = state.axes.index(component.row[0])
    error = component_mixture(component, state).moments()[0] @ mean_columns(component.variant, row)
    per_ppm = next(
        mean_columns(variant, row)[0]
        for variant in component.candidate.variants
        if variant.columns == ("linear",)
    )
    return float(np.nanstd(error) / (_PPM * np.nanstd(per_ppm)))


def _is_possible(component: Component, state: State) -> bool:
    """Return whether physics allows the size of a component, and its cause is present."""
    effect, statistic, settings = component.candidate.effect, component.statistic, state.settings
    is_at_rest = (
        effect == "misalignment"
        and statistic.is_transfer
        and not _is_moving(component.candidate.reference[0], state)
    )
    if is_at_rest or (
        _is_rotation(component) and _rotation_share(component, state) < settings.min_rotation_share
    ):
        return False
    is_too_large = (
        effect == "scale_factor"
        and statistic.is_linear_in_means
        and _rotation_share(component, state) > settings.max_misalignment_share
    )
    is_added = component.variant.squared and statistic.is_power
    return (
        not is_too_large
        and _is_in_range(component, state)
        and not (is_added and component_size(component, state)[0] <= 0.0)
    )


def _is_in_range(component: Component, state: State) -> bool:
    """Return whether the sizes can lie in the ranges of the registry and the settings."""
    columns = component.variant.columns
    low, high = (
        np.array([_allowed_range(component, name, state) for name in columns]).reshape(-1, 2).T
    )
    if not (np.isfinite(low) | np.isfinite(high)).any():
        return True
    sizes, covariance = component_mixture(component, state).moments()
    error = state.settings.clear_sigma * np.sqrt(np.diagonal(covariance))
    # the parts of a complex size have the range of its column
    low, high = (np.repeat(ends, sizes.size // len(columns)) for ends in (low, high))
    return bool(((sizes + error >= low) & (sizes - error <= high)).all())


def _allowed_range(component: Component, column: str, state: State) -> tuple[float, float]:
    """Return the range of the size of a column.

    A mean may have either sign. A single noise level may not be below the least: ageing, for
    example, does not improve a gyro.
    """
    effect, statistic, variant = component.candidate.effect, component.statistic, component.variant
    largest = largest_size(effect, state.settings)
    parameters = {item.name: item for item in effects()[effect].parameters()}
    if column not in parameters:
        return -math.inf, math.inf
    item = parameters[column]
    if statistic.is_power:
        has_least = not variant.squared and len(variant.columns) == 1
        return item.low if has_least else -math.inf, math.inf
    if statistic.is_linear_in_means:
        largest = min(largest, max(abs(item.low), abs(item.high)))
    return -largest, largest


def _is_moving(axis: str, state: State) -> bool:
    """Return whether an axis exceeds its noise at some frequency; what is at rest cannot leak."""
    row = state.axes.index(axis)
    expected = state.baseline["spectrum"].values[row]
    return bool(
        np.nanmax(np.nanmean(measured(state.blocks, "power").values[row] / expected, axis=0))
        > state.settings.moving_power_ratio
    )
