"""Fit all named effects together: values with honest errors, and the model with the effects in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.nuisance import sizes_over
from gyrostab.diagnose.estimate.shared_factors import estimate_shared_factors
from gyrostab.diagnose.estimate.telegraph_sizes import estimate_telegraph
from gyrostab.diagnose.identify.equivalents import prefer_plainer
from gyrostab.diagnose.identify.forward_search import Identification, Identifications, Unidentified
from gyrostab.diagnose.identify.logger_filters import filter_sizes
from gyrostab.diagnose.identify.sample_sizes import line_size, sample_count_sizes
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

__all__ = ["FORM_ERROR", "Estimate", "Fitted", "fit_identifications"]

Array = NDArray[np.float64]
#: Error of the form of an effect, as a share of its size: no effect is exactly what its equation
#: says.
FORM_ERROR = 0.04
_ANGLE = "deg"
_PLACE = "line", "frequency"  # where a line is has nothing to do with what makes it
_EARTH = 15.041067  # deg/h


@dataclass(frozen=True)
class Estimate:
    """A parameter.

    Attributes
    ----------
    value, stderr : float
    low, high : float
        Ends of the 95 % interval.
    unit : str
    """

    value: float
    stderr: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Fitted:
    """A named effect with its numbers, on one axis or on several at once.

    Attributes
    ----------
    identification : Claim
    axes : tuple of str
    parameters : mapping of str to Estimate
        Of an effect with a number for each axis: name and axis, with a dot between, where there are
        several axes.
    effect : Effect or None
        With these numbers, as a model takes it; None where they make no effect.
    note : str
        What the numbers do not say.
    """

    identification: Identification
    axes: tuple[str, ...]
    parameters: Mapping[str, Estimate]
    effect: Effect | None
    note: str = ""

    def say(self) -> str:
        """Describe the effect with its numbers in one sentence; return an empty string where it has no numbers."""
        if self.effect is None or not self.parameters:
            return ""
        said = self.effect.say({name: one.stderr for name, one in self.parameters.items()})
        return f"{said} {self.note}" if self.note else said


def fit_identifications(identifications: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """Fit all named effects, each with the others in the model.

    Parameters
    ----------
    identifications : Naming
        From `gyrostab.diagnose.identify.forward_search.name_effects`.
    baseline : xarray.Dataset
        That the naming started from.

    Returns
    -------
    list of Fitted
        An entry for each axis of an effect with one number for all of its axes; one entry for all
        axes where each has its own number.
    """
    start = initial_state(identifications.state.blocks, baseline)
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
        found += _fit_claim(identification, state, identifications)
    return found


def _fit_claim(
    identification: Identification, state: State, identifications: Identifications
) -> list[Fitted]:
    statistics = {component.candidate.statistic for component in identification.components}
    kind = effects()[identification.effect]
    many = any(item.many for item in kind.parameters() if item.name in kind.size_parameters)
    filtered = any(
        is_filter(component.candidate.statistic, component.variant)
        for component in identification.components
    )  # one logger: its axes are filtered alike
    together = (
        many
        or filtered
        or "cross" in statistics
        or any(not component.candidate.each for component in identification.components)
    )
    if together:
        return [
            _fitted(
                identification,
                _axes(identification, components),
                components,
                state,
                identifications,
            )
            for components in _by_harmonic(identification, state)
        ]
    return [
        _fitted(
            identification,
            (axis,),
            [component for component in identification.components if axis in component.row],
            state,
            identifications,
        )
        for axis in identification.axes
    ]


def _axes(identification: Identification, components: Sequence[Component]) -> tuple[str, ...]:
    """Axes of the claim on which the parts are."""
    return tuple(
        axis
        for axis in identification.axes
        if any(axis in component.row for component in components)
    )


def _by_harmonic(identification: Identification, state: State) -> list[list[Component]]:
    """Parts of a claim; those of several harmonics of the rotation, each of which has a size and a phase of its own, one by one.

    A harmonic beside the strongest is left out where its amplitude is within two standard errors on
    every axis.
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
            for size, error, _ in (_amplitude(component, state) for component in components)
        )
        for components in alone
    ]
    kept = [
        components
        for components, times in zip(alone, clear, strict=True)
        if times > 2.0 or times == max(clear)
    ]
    rest = [component for component in identification.components if component not in turning]
    return [[*kept[0], *rest], *kept[1:]]


def _fitted(
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
    by_view: dict[str, list[Component]] = {}
    for component in components:
        by_view.setdefault(component.candidate.statistic, []).append(component)
    statistic = max(
        by_view, key=lambda name: sum(component.evidence_nats for component in by_view[name])
    )
    plain = [prefer_plainer(component, state) for component in by_view[statistic]]
    by_view[statistic] = [component for component, _ in plain]
    filtered = is_filter(statistic, by_view[statistic][0].variant)
    sizes: Mapping[str, tuple[float, ...]]
    if filtered:
        sizes, values = filter_sizes(by_view[statistic], state)
    else:
        own = _SIZES.get(statistic, _linear)(by_view[statistic], axes, state, identifications)
        sizes = {**_elsewhere(by_view, statistic, axes, state, identifications), **own}
    for name, (mean, sd, *ends) in sizes.items():
        unit = units.get(name.split(".")[0], "1")
        if math.isfinite(mean) and not math.isnan(
            sd
        ):  # a low-pass of infinite bandwidth is none; an exponent may be told, not measured
            form = (
                0.0 if unit == _ANGLE or (statistic, name) == _PLACE else FORM_ERROR * mean
            )  # angles have that of the size already
            estimates[name] = _estimate(
                mean, sd, unit, ends=ends, positive=_positive(kind, name), form=form
            )
        _put(values, name, mean, axes)
    values |= {
        name: value
        for name, value in by_view[statistic][0].variant.values.items()
        if name not in values
    }
    values |= _words(identification, by_view[statistic][0], state)
    return Fitted(
        identification,
        axes,
        estimates,
        _instance(kind, values, axes, identification.driver),
        next((note for _, note in plain if note), ""),
    )


def _elsewhere(
    by_view: Mapping[str, list[Component]],
    statistic: str,
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    """Sizes on axes that the strongest view says nothing of, from the strongest of the others that does."""
    seen = {axis for component in by_view[statistic] for axis in component.row}
    found: dict[str, tuple[float, ...]] = {}
    for other in sorted(
        set(by_view) - {statistic},
        key=lambda name: -sum(component.evidence_nats for component in by_view[name]),
    ):
        lacking = {axis for component in by_view[other] for axis in component.row} - seen
        if lacking:
            sizes = _SIZES.get(other, _linear)(by_view[other], axes, state, identifications)
            found |= {
                name: size for name, size in sizes.items() if name.partition(".")[2] in lacking
            }
            seen |= lacking
    return found


def _positive(kind: type[Effect], name: str) -> bool:
    return next(
        (item.low >= 0.0 for item in kind.parameters() if item.name == name.split(".")[0]), False
    )


def _put(values: dict[str, Any], name: str, value: float, axes: tuple[str, ...]) -> None:
    """A value by its name; "name.axis" goes to its place in a list."""
    base, _, axis = name.partition(".")
    if not axis:
        values[base] = value
        return
    known = values.setdefault(base, [0.0] * len(axes))
    known[axes.index(axis)] = value


def _words(identification: Identification, component: Component, state: State) -> dict[str, Any]:
    """What the model needs beside the numbers."""
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


def _instance(
    kind: type[Effect], values: Mapping[str, Any], axes: tuple[str, ...], driver: tuple[str, ...]
) -> Effect | None:
    known = {item.name: item for item in kind.parameters()}
    clean = {}
    for name, value in values.items():
        if name in known:
            item = known[name]
            clean[name] = value if isinstance(value, str) else _within(value, item.low, item.high)
    named = tuple(driver) if driver and all(driver) else ()
    size = {name: 0.0 for name in kind.required() if name not in clean}
    try:
        return kind(axes=axes, driver=named, **{**size, **clean})
    except (GyrostabError, TypeError):
        return None


def _within(value: Any, low: float, high: float) -> Any:
    if isinstance(value, list | tuple):
        return [min(max(float(one), low), high) for one in value]
    return min(max(float(value), low), high)


def _estimate(
    mean: float, sd: float, unit: str, *, positive: bool, form: float, ends: Sequence[float] = ()
) -> Estimate:
    """With the error of the `form` in it; `ends` are those of the 95 % interval without it, where that is not symmetric."""
    if sd <= 0.0:  # what is counted, not measured, is exact
        return Estimate(mean, 0.0, mean, mean, unit)
    low, high = ends or (mean - NORMAL_95 * sd, mean + NORMAL_95 * sd)
    low, high = (
        mean - math.hypot(mean - low, NORMAL_95 * form),
        mean + math.hypot(high - mean, NORMAL_95 * form),
    )
    return Estimate(mean, math.hypot(sd, form), max(low, 0.0) if positive else low, high, unit)


# --------------------------------------------------------------------------------
# sizes


def _linear(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    """Parameters of means, powers, profiles and transfers; by axis where there are several."""
    out: dict[str, tuple[float, ...]] = {}
    for component in components:
        if component.variant.columns[:1] == ("any",):
            continue
        mean, covariance, nuisance = sizes_over(component, state, identifications)
        for number, name in enumerate(component.variant.columns):
            value, sd = float(mean[number]), float(math.sqrt(covariance[number, number]))
            if component.variant.squared:
                value, sd = _root(value, sd)
            out[name if len(axes) == 1 else f"{name}.{component.row[0]}"] = (value, sd)
        out |= nuisance
    return out


def _root(square: float, sd: float) -> tuple[float, float]:
    """Size and its error from those of the square."""
    value = math.sqrt(max(square, 0.0))
    return value, sd / (2.0 * value) if square > sd else math.sqrt(max(square, 0.0) + sd) - value


def _common(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    return estimate_shared_factors(components, axes, state)


def _turning(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, ...]]:
    """Amplitude and phase of what is locked to the rotation; of the earth, the latitude of a tool that points down.

    Angles have the error of the form that the amplitude has: a share of an angle would be none.
    """
    out: dict[str, tuple[float, ...]] = {}
    for component in components:
        size, sd, angle = _amplitude(component, state)
        error = math.hypot(sd / max(size, 1e-300), FORM_ERROR)
        if not component.candidate.each:
            across = size * float(np.abs(component.variant.design).max())
            return {
                "latitude": _latitude(across, error * across),
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


def _latitude(across: float, error: float) -> tuple[float, float, float, float]:
    """Latitude [deg], its standard error and the ends of its 95 % interval, by the earth's rate across a tool that points down [deg/h]."""
    low, middle, high = (
        math.degrees(math.acos(min(max(rate, 0.0) / _EARTH, 1.0)))
        for rate in (across + NORMAL_95 * error, across, across - NORMAL_95 * error)
    )
    return middle, max((high - low) / (2.0 * NORMAL_95), 1e-12), low, high


def _amplitude(component: Component, state: State) -> tuple[float, float, float]:
    """Amplitude of the first harmonic of a part, its standard error, and the phase [deg]."""
    mean, covariance = component_mixture(component, state).moments()
    sd = float(math.sqrt(np.trace(covariance[:2, :2]) / 2.0))
    return float(math.hypot(mean[0], mean[1])), sd, math.degrees(math.atan2(mean[1], mean[0]))


def _line(
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
    ):  # of several lines of an axis the strongest
        amplitude, frequency = line_size(state.blocks, component.row[0], component.place)
        label = "" if len(axes) == 1 or name == "sway" else f".{component.row[0]}"
        out[f"{name}{label}"], out["frequency"] = amplitude, frequency
    return out


def _odd(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, float]]:
    return sample_count_sizes(
        components[0].candidate.effect,
        components[0].variant.columns[0],
        components[0].row[0],
        state.blocks,
        identifications.count_evidence,
    )


def _levels(
    components: list[Component],
    axes: tuple[str, ...],
    state: State,
    identifications: Identifications,
) -> dict[str, tuple[float, float]]:
    return estimate_telegraph(components, axes, state)


_SIZES: Mapping[str, Callable[..., Mapping[str, tuple[float, ...]]]] = {
    "cross": _common,
    "order": _turning,
    "line": _line,
    "marks": _odd,
    "levels": _levels,
}
