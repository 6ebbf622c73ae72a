"""Fit all identified effects together: sizes with errors, and the model with the effects in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.nuisance import average_sizes
from gyrostab.diagnose.estimate.shared_factors import estimate_shared_factors
from gyrostab.diagnose.estimate.telegraph_sizes import estimate_telegraph
from gyrostab.diagnose.identify.equivalents import prefer_plainer
from gyrostab.diagnose.identify.identification import Identification, Identifications, Unidentified
from gyrostab.diagnose.identify.logger_filters import fit_filter_sizes
from gyrostab.diagnose.identify.sample_sizes import estimate_from_counts, estimate_line
from gyrostab.diagnose.predict.condition import Component, condition_on, is_reversed
from gyrostab.diagnose.predict.filter_response import is_filter
from gyrostab.diagnose.predict.linear_model import State, harmonic_sets, initial_state
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.reduce.zero_bin import truncated_axes
from gyrostab.errors import GyrostabError
from gyrostab.noise import NORMAL_95
from gyrostab.physics.base import Effect
from gyrostab.physics.registry import effects
from gyrostab.physics.rotation import EarthRate

__all__ = ["Estimate", "Fitted", "fit_identifications"]

Array = NDArray[np.float64]
_ANGLE = "deg"
_PLACE = "line", "frequency"  # where a line is does not depend on what makes it
EARTH_RATE = 15.041067  # deg/h: 360 degrees in a sidereal day of 23.934470 h


@dataclass(frozen=True)
class Estimate:
    """A parameter with its standard error and the ends of its 95 % interval.

    Attributes
    ----------
    value, stderr, low, high : float
    unit : str
    """

    value: float
    stderr: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Fitted:
    """An effect with its sizes, on one axis or on several together.

    Attributes
    ----------
    identification : Identification
    axes : tuple of str
    parameters : mapping of str to Estimate
        Keys are ``name``, or ``name.axis`` for a size of each of several axes.
    effect : Effect or None
        With these sizes, as a model takes it; None where they make no effect.
    note : str
        What the sizes do not show.
    """

    identification: Identification
    axes: tuple[str, ...]
    parameters: Mapping[str, Estimate]
    effect: Effect | None
    note: str = ""

    def say(self) -> str:
        """Describe the effect with its sizes in one sentence; empty without sizes."""
        if self.effect is None or not self.parameters:
            return ""
        text = self.effect.say({name: one.stderr for name, one in self.parameters.items()})
        return f"{text} {self.note}" if self.note else text


def fit_identifications(identifications: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """Fit all identified effects, each with the others in the model.

    Parameters
    ----------
    identifications : Identifications
        From `gyrostab.diagnose.identify.forward_search.name_effects`.
    baseline : xarray.Dataset
        The baseline that the identification started from.

    Returns
    -------
    list of Fitted
        One entry per axis of an effect with a single size for all of its axes; one entry for all
        axes where each has its own size.
    """
    start = initial_state(
        identifications.state.blocks, baseline, settings=identifications.state.settings
    )
    found: list[Fitted] = []
    for identification in identifications.identified:
        state = start
        everything: list[Identification | Unidentified] = [
            *identifications.expected,
            *identifications.identified,
            *identifications.unknown,
        ]
        for one in everything:
            if one is not identification:
                state = condition_on(state, list(one.components))
        state = replace(
            state, weight=identifications.state.weight, masked=identifications.state.masked
        )
        found += _fit_identification(identification, state, identifications)
    return found


def _fit_identification(
    identification: Identification, state: State, identifications: Identifications
) -> list[Fitted]:
    statistics = {component.candidate.statistic for component in identification.components}
    kind = effects()[identification.effect]
    many = any(item.many for item in kind.parameters() if item.name in kind.size_parameters)
    filtered = any(
        is_filter(component.candidate.statistic, component.variant)
        for component in identification.components
    )  # all axes pass the filter of the one logger
    fitted_together = (
        many
        or filtered
        or "cross" in statistics
        or any(not component.candidate.each for component in identification.components)
    )
    if fitted_together:
        return [
            _fit_components(
                identification,
                _axes_shown(identification, components),
                components,
                state,
                identifications,
            )
            for components in _split_harmonics(identification, state)
        ]
    return [
        _fit_components(
            identification,
            (axis,),
            [component for component in identification.components if axis in component.row],
            state,
            identifications,
        )
        for axis in identification.axes
    ]


def _axes_shown(identification: Identification, components: Sequence[Component]) -> tuple[str, ...]:
    """Return the axes of the identification that the components are on."""
    return tuple(
        axis
        for axis in identification.axes
        if any(axis in component.row for component in components)
    )


def _split_harmonics(identification: Identification, state: State) -> list[list[Component]]:
    """Split the components of several harmonics of the rotation, each with its amplitude and phase.

    Harmonics other than the strongest are dropped when their amplitude is within two standard
    errors on every axis.
    """
    turning = [
        component
        for component in identification.components
        if component.candidate.statistic == "order" and component.candidate.each
    ]
    sets = harmonic_sets(state.blocks.sizes["harmonic"]) if turning else []
    there = sorted({k for component in turning for k in sets[component.place]})
    alone = [
        [replace(component, place=k) for component in turning if k in sets[component.place]]
        for k in there
    ]
    if len(alone) < 2:
        return [list(identification.components)]
    clear = [
        max(
            size / error
            for size, error, _ in (_fit_amplitude(component, state) for component in components)
        )
        for components in alone
    ]
    kept = [
        components
        for components, times in zip(alone, clear, strict=True)
        if times > state.settings.visible_sigma or times == max(clear)
    ]
    rest = [component for component in identification.components if component not in turning]
    return [[*kept[0], *rest], *kept[1:]]


def _fit_components(
    identification: Identification,
    axes: tuple[str, ...],
    components: list[Component],
    state: State,
    identifications: Identifications,
) -> Fitted:
    kind = effects()[identification.effect]
    units = {item.name: item.unit for item in kind.parameters()}
    values: dict[str, Any] = {}
    estimates: dict[str, Estimate] = {}
    by_statistic: dict[str, list[Component]] = {}
    for component in components:
        by_statistic.setdefault(component.candidate.statistic, []).append(component)
    statistic = max(
        by_statistic,
        key=lambda name: sum(component.evidence_nats for component in by_statistic[name]),
    )
    plain = [prefer_plainer(component, state) for component in by_statistic[statistic]]
    by_statistic[statistic] = [component for component, _ in plain]
    filtered = is_filter(statistic, by_statistic[statistic][0].variant)
    sizes: Mapping[str, tuple[float, ...]]
    if filtered:
        sizes, values = fit_filter_sizes(by_statistic[statistic], state)
    else:
        own = _SIZES.get(statistic, _linear_sizes)(
            by_statistic[statistic], axes, state, identifications
        )
        sizes = {
            **_sizes_on_other_axes(by_statistic, statistic, axes, state, identifications),
            **own,
        }
    for name, (mean, sd, *ends) in sizes.items():
        unit = units.get(name.split(".")[0], "1")
        # a low-pass of infinite bandwidth is not given; nor is an exponent that was not measured
        if math.isfinite(mean) and not math.isnan(sd):
            is_exact = unit == _ANGLE or (statistic, name) == _PLACE  # angles have it already
            form = 0.0 if is_exact else state.settings.size_error_share * mean
            estimates[name] = _make_estimate(
                mean, sd, unit, ends=ends, positive=_is_positive(kind, name), form=form
            )
        _store_value(values, name, mean, axes)
    values |= {
        name: value
        for name, value in by_statistic[statistic][0].variant.values.items()
        if name not in values
    }
    values |= _model_settings(identification, by_statistic[statistic][0], state)
    return Fitted(
        identification,
        axes,
        estimates,
        _make_effect(kind, values, axes, identification.driver),
        next((note for _, note in plain if note), ""),
    )


def _sizes_on_other_axes(
    by_statistic: Mapping[str, list[Component]],
    statistic: str,
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    """Return sizes on axes that the strongest statistic does not cover, from the next that does."""
    seen = {axis for component in by_statistic[statistic] for axis in component.row}
    found: dict[str, tuple[float, ...]] = {}
    for other in sorted(
        set(by_statistic) - {statistic},
        key=lambda name: -sum(component.evidence_nats for component in by_statistic[name]),
    ):
        lacking = {axis for component in by_statistic[other] for axis in component.row} - seen
        if lacking:
            sizes = _SIZES.get(other, _linear_sizes)(
                by_statistic[other], axes, state, identifications
            )
            found |= {
                name: size for name, size in sizes.items() if name.partition(".")[2] in lacking
            }
            seen |= lacking
    return found


def _is_positive(kind: type[Effect], name: str) -> bool:
    return next(
        (item.low >= 0.0 for item in kind.parameters() if item.name == name.split(".")[0]), False
    )


def _store_value(values: dict[str, Any], name: str, value: float, axes: tuple[str, ...]) -> None:
    """Store a value by its name; ``name.axis`` goes to its place in a list."""
    base, _, axis = name.partition(".")
    if not axis:
        values[base] = value
        return
    known = values.setdefault(base, [0.0] * len(axes))
    known[axes.index(axis)] = value


def _model_settings(
    identification: Identification, component: Component, state: State
) -> dict[str, Any]:
    """Return settings that the model needs in addition to the sizes."""
    if identification.effect == "rotation_line":
        return {"harmonics": 1.0}
    if identification.effect == "feedback_reset" and "ramp_turns" in state.blocks:
        low, high = (float(state.blocks["ramp_turns"].attrs[name]) for name in ("low", "high"))
        return {
            "phase": "channel",
            "full": float(component.variant.values.get("full", 1.0)) * (high - low),
        }
    if identification.effect == "held_samples":
        return {"fill": "zero" if component.variant.columns[0] == "filled" else "repeat"}
    if (
        identification.effect == "rate_quantization"
        and truncated_axes(state.blocks)[state.axes.index(component.row[0])]
    ):
        return {"mode": "zero"}
    if identification.effect == "spikes":
        return {"kind": "outlier"}
    if identification.effect == "earth_rate" and is_reversed(component):
        off, around = np.degrees(EarthRate.example().directions(identification.axes))
        return {"off": list(off), "around": list(-around)}
    return {}


def _make_effect(
    kind: type[Effect], values: Mapping[str, Any], axes: tuple[str, ...], driver: tuple[str, ...]
) -> Effect | None:
    known = {item.name: item for item in kind.parameters()}
    clean = {}
    for name, value in values.items():
        if name in known:
            item = known[name]
            clean[name] = (
                value if isinstance(value, str) else _clip_to_range(value, item.low, item.high)
            )
    named = tuple(driver) if driver and all(driver) else ()
    size = {name: 0.0 for name in kind.required() if name not in clean}
    try:
        return kind(axes=axes, driver=named, **{**size, **clean})
    except (GyrostabError, TypeError):
        return None


def _clip_to_range(value: Any, low: float, high: float) -> Any:
    if isinstance(value, list | tuple):
        return [min(max(float(one), low), high) for one in value]
    return min(max(float(value), low), high)


def _make_estimate(
    mean: float, sd: float, unit: str, *, positive: bool, form: float, ends: Sequence[float] = ()
) -> Estimate:
    """Return an estimate with the error of the form.

    `ends` are those of an asymmetric 95 % interval without it.
    """
    if sd <= 0.0:  # a count is exact
        return Estimate(mean, 0.0, mean, mean, unit)
    low, high = ends or (mean - NORMAL_95 * sd, mean + NORMAL_95 * sd)
    low, high = (
        mean - math.hypot(mean - low, NORMAL_95 * form),
        mean + math.hypot(high - mean, NORMAL_95 * form),
    )
    return Estimate(mean, math.hypot(sd, form), max(low, 0.0) if positive else low, high, unit)


# --------------------------------------------------------------------------------------------------
# -------------- sizes


def _linear_sizes(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    """Return parameters of means, powers, profiles and transfers; by axis if there are several."""
    out: dict[str, tuple[float, ...]] = {}
    for component in components:
        if component.variant.columns[:1] == ("any",):
            continue
        mean, covariance, nuisance = average_sizes(component, state, identifications)
        for number, name in enumerate(component.variant.columns):
            value, sd = float(mean[number]), float(math.sqrt(covariance[number, number]))
            if component.variant.squared:
                value, sd = _square_root(value, sd)
            out[name if len(axes) == 1 else f"{name}.{component.row[0]}"] = (value, sd)
        out |= nuisance
    return out


def _square_root(square: float, sd: float) -> tuple[float, float]:
    """Return a size and its error from those of its square."""
    value = math.sqrt(max(square, 0.0))
    return value, sd / (2.0 * value) if square > sd else math.sqrt(max(square, 0.0) + sd) - value


def _common_sizes(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    return estimate_shared_factors(components, axes, state)


def _rotation_sizes(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    """Return amplitude and phase of components locked to the rotation.

    For the earth rate these are latitude and tool face of a tool that points down. Angles get the
    error of the form of the amplitude: a share of an angle has no meaning.
    """
    out: dict[str, tuple[float, ...]] = {}
    for component in components:
        size, sd, angle = _fit_amplitude(component, state)
        error = math.hypot(sd / max(size, 1e-300), state.settings.size_error_share)
        if not component.candidate.each:
            across = size * float(np.abs(component.variant.design).max())
            return {
                "latitude": _latitude_from_rate(across, error * across),
                "toolface": (angle, math.degrees(error)),
            }
        label = "" if len(axes) == 1 else f".{component.row[0]}"
        out |= {f"amplitude{label}": (size, sd), f"phase{label}": (angle, math.degrees(error))}
        out["order"] = (
            float(
                state.blocks["harmonic"].values[component.place % state.blocks.sizes["harmonic"]]
            ),
            0.0,
        )
    return out


def _latitude_from_rate(across: float, error: float) -> tuple[float, float, float, float]:
    """Return the latitude of a tool that points down, from the earth rate across it [deg/h].

    The result [deg] has the standard error and the ends of the 95 % interval.
    """
    low, middle, high = (
        math.degrees(math.acos(min(max(rate, 0.0) / EARTH_RATE, 1.0)))
        for rate in (across + NORMAL_95 * error, across, across - NORMAL_95 * error)
    )
    return middle, max((high - low) / (2.0 * NORMAL_95), 1e-12), low, high


def _fit_amplitude(component: Component, state: State) -> tuple[float, float, float]:
    """Return amplitude, standard error and phase [deg] of the first harmonic of a component."""
    mean, covariance = component_mixture(component, state).moments()
    sd = float(math.sqrt(np.trace(covariance[:2, :2]) / 2.0))
    return float(math.hypot(mean[0], mean[1])), sd, math.degrees(math.atan2(mean[1], mean[0]))


def _line_sizes(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, float]]:
    name = {"real_motion": "sway"}.get(
        components[0].candidate.effect, components[0].variant.columns[0]
    )
    out: dict[str, tuple[float, float]] = {}
    for component in sorted(
        components, key=lambda component: component.evidence_nats
    ):  # the strongest of several lines of an axis is last
        amplitude, frequency = estimate_line(state.blocks, component.row[0], component.place)
        label = "" if len(axes) == 1 or name == "sway" else f".{component.row[0]}"
        out[f"{name}{label}"], out["frequency"] = amplitude, frequency
    return out


def _count_sizes(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, float]]:
    return estimate_from_counts(
        components[0].candidate.effect,
        components[0].variant.columns[0],
        components[0].row[0],
        state.blocks,
        identifications.count_evidence,
    )


def _telegraph_sizes(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, float]]:
    return estimate_telegraph(components, axes, state)


_SIZES: Mapping[str, Callable[..., Mapping[str, tuple[float, ...]]]] = {
    "cross": _common_sizes,
    "order": _rotation_sizes,
    "line": _line_sizes,
    "marks": _count_sizes,
    "levels": _telegraph_sizes,
}
