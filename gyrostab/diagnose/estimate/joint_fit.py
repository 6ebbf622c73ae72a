"""Fit all identified effects together: sizes with errors, and the model with the effects in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import ndtr, ndtri

from gyrostab.diagnose.estimate.component_groups import (
    group_simultaneous_axes,
    split_harmonics,
    split_steps,
)
from gyrostab.diagnose.estimate.filter_sizes import fit_filter_sizes
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.components import axes_of
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.average_sizes import Size
from gyrostab.diagnose.predict.candidates import TIME_PARAMETER, Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.reduce.zero_bin import truncated_axes
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics import Statistic
from gyrostab.diagnose.statistics.base import SizeFit, Sizes
from gyrostab.diagnose.statistics.rotation_order import is_reversed
from gyrostab.diagnose.statistics.sample_sizes import centre_of_range, has_empty_zone
from gyrostab.diagnose.statistics.spectral_line import line_quality
from gyrostab.errors import GyrostabError
from gyrostab.noise import NORMAL_95
from gyrostab.physics.base import Effect
from gyrostab.physics.earth_rate import EarthRate
from gyrostab.physics.prediction import Windows
from gyrostab.physics.registry import effects

_ANGLE = "deg"
_TAIL = float(ndtr(-NORMAL_95))  # beyond either end of an interval
#: Settings of effects that are the same in every model.
_FIXED_SETTINGS: Mapping[str, dict[str, Any]] = {
    "rotation_line": {"harmonics": 1.0},
    "misalignment": {"motion": "recorded"},
    "spikes": {"kind": "outlier"},
}
_FREQUENCY = "frequency"  # of a line, which does not depend on what makes it


@dataclass(frozen=True)
class Estimate:
    """A parameter with its standard error and the ends of its 95 % interval."""

    value: float
    stderr: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Fitted:
    """An effect with its sizes, on one axis or on several together."""

    identification: Selection
    axes: tuple[str, ...]
    #: Keys are ``name``, or ``name.axis`` for a size of each of several axes.
    parameters: Mapping[str, Estimate]
    #: As a model takes it, with values that belong together: those at the likeliest point of a grid
    #: where the sizes are averages over it. None where they make no effect.
    effect: Effect | None
    note: str = ""  # what the sizes do not show
    shown: Effect | None = None  # the same with the sizes, if they differ
    components: tuple[Component, ...] = ()  # that the sizes are those of

    def say(self, windows: Windows | None = None) -> str:
        """Describe the effect with its sizes in one sentence; empty without sizes.

        With the windows of the record, only by what the record determines; without, all is known.
        """
        if self.effect is None or not self.parameters:
            return ""
        effect = self.shown or self.effect
        errors = {name: estimate.stderr for name, estimate in self.parameters.items()}
        text = effect.say(errors) if windows is None else effect.say_in_record(windows, errors)
        return f"{text} {self.note}" if self.note else text


def fit_identifications(identifications: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """Fit all identified effects, each with the others in the model.

    An effect whose class takes one number as its size is fitted on each axis alone, and has one
    entry per axis. It has one entry for all axes if its size has one value per axis, if it is a
    filter or noise that axes have in common, or if it changes samples at the same instants.
    """
    return [
        fitted
        for identification in identifications.identified
        for fitted in _fit_identification(
            identification,
            identifications.state_without(identification, baseline),
            identifications.examination.count_evidence,
        )
    ]


def fit_expected(identifications: Identifications, baseline: xr.Dataset) -> list[Fitted]:
    """Fit the expected effects with all identified ones in the model."""
    # fit_identifications fits what is identified, with what is expected in the model
    swapped = replace(
        identifications, identified=identifications.expected, expected=identifications.identified
    )
    return fit_identifications(swapped, baseline)


def _fit_identification(
    identification: Selection, state: State, count_evidence: CountEvidence
) -> list[Fitted]:
    """Fit one identification: all axes together, or each group of axes alone."""
    kind = effects()[identification.effect]
    fitted_together = any(
        item.many for item in kind.parameters() if item.name in kind.size_parameters
    ) or any(
        component.is_filter  # all axes pass the filter of the one logger
        or component.statistic.is_pairwise
        or not component.candidate.is_per_axis
        for component in identification.components
    )
    parts = (
        [
            part
            for harmonic in split_harmonics(identification, state)
            for part in split_steps(harmonic, state)
        ]
        if fitted_together
        else [
            ([part for part in identification.components if set(axes) & set(part.row)], state)
            for axes in group_simultaneous_axes(identification, state.blocks, count_evidence)
        ]
    )
    return [
        _fit_components(identification, components, with_others, count_evidence)
        for components, with_others in parts
    ]


def _fit_components(
    identification: Selection,
    components: list[Component],
    state: State,
    count_evidence: CountEvidence,
) -> Fitted:
    """Fit the components of one entry, in the statistic that shows its size best."""
    kind, axes = effects()[identification.effect], axes_of(components, identification.axes)
    values: dict[str, Any] = {}
    likeliest: dict[str, Any] = {}
    by_statistic: dict[Statistic, list[Component]] = {}
    for component in components:
        by_statistic.setdefault(component.statistic, []).append(component)
    statistic = _strongest_statistic(by_statistic)
    sizes: Sizes
    if by_statistic[statistic][0].is_filter:
        sizes, values = fit_filter_sizes(by_statistic[statistic], state)
    else:
        fit = SizeFit(by_statistic[statistic], axes, state, count_evidence)
        own_sizes = statistic.estimate(fit)
        for name, value in fit.likeliest.items():
            _store_value(likeliest, name, value, axes)
        sizes = {**_sizes_on_other_axes(by_statistic, statistic, fit), **own_sizes}
    for name, (value, *_) in sizes.items():
        _store_value(values, name, value, axes)
    values |= {
        name: value
        for name, value in by_statistic[statistic][0].variant.values.items()
        if name not in values
    }
    settings = _model_settings(identification, by_statistic[statistic][0], state)
    if settings.get("phase") == "channel":
        rising = (values | likeliest).get("full", 1.0)  # a sign, or an average of signs
        turns = state.blocks["ramp_turns"].attrs
        settings["full"] = math.copysign(float(turns["high"]) - float(turns["low"]), rising)
    averaged = _make_effect(kind, values | settings, axes, identification.driver)
    effect = _make_effect(kind, values | likeliest | settings, axes, identification.driver)
    return Fitted(
        identification,
        axes,
        _make_estimates(sizes, kind, statistic, state.settings),
        averaged if effect is None else effect,
        next((component.note for component in by_statistic[statistic] if component.note), ""),
        averaged,
        tuple(components),
    )


def _strongest_statistic(by_statistic: Mapping[Statistic, list[Component]]) -> Statistic:
    """Return the statistic with the most evidence, if possible with one size for all axes."""
    return max(
        by_statistic,
        key=lambda statistic: (
            not by_statistic[statistic][0].candidate.is_per_axis,
            sum(component.evidence_nats for component in by_statistic[statistic]),
        ),
    )


def _make_estimates(
    sizes: Sizes, kind: type[Effect], statistic: Statistic, settings: Settings
) -> dict[str, Estimate]:
    """Return the estimates of all sizes that were measured, with the error of the form."""
    parameters = {item.name: item for item in kind.parameters()}
    estimates: dict[str, Estimate] = {}
    for name, (mean, sd, *ends) in sizes.items():
        # a low-pass of infinite bandwidth is not given; nor is an exponent that was not measured
        if not math.isfinite(mean) or math.isnan(sd):
            continue
        parameter = parameters.get(name.split(".")[0])
        unit = parameter.unit if parameter else "1"
        # the error of an angle contains it, and the origin of a time means nothing
        is_exact = (
            unit == _ANGLE or name == TIME_PARAMETER or (statistic.is_line and name == _FREQUENCY)
        )
        form = 0.0 if is_exact else settings.size_error_share * mean
        positive = parameter is not None and parameter.low >= 0.0
        estimates[name] = _make_estimate(mean, sd, unit, ends=ends, positive=positive, form=form)
    return estimates


def _sizes_on_other_axes(
    by_statistic: Mapping[Statistic, list[Component]], statistic: Statistic, fit: SizeFit
) -> dict[str, Size]:
    """Return sizes on axes that the strongest statistic does not cover, from the next that does.

    `fit` is that of the strongest.
    """
    covered_axes = {axis for component in by_statistic[statistic] for axis in component.row}
    added_sizes: dict[str, Size] = {}
    for other_statistic in sorted(
        set(by_statistic) - {statistic},
        key=lambda other: -sum(component.evidence_nats for component in by_statistic[other]),
    ):
        lacking = {
            axis for component in by_statistic[other_statistic] for axis in component.row
        } - covered_axes
        if lacking:
            components = by_statistic[other_statistic]
            sizes = other_statistic.estimate(replace(fit, components=components, likeliest={}))
            added_sizes |= {
                name: size for name, size in sizes.items() if name.partition(".")[2] in lacking
            }
            covered_axes |= lacking
    return added_sizes


def _store_value(values: dict[str, Any], name: str, value: Any, axes: tuple[str, ...]) -> None:
    """Store a value by its name; ``name.axis`` goes to its place in a list."""
    base, _, axis = name.partition(".")
    if not axis:
        values[base] = value
        return
    axis_values = values.setdefault(base, [0.0] * len(axes))
    axis_values[axes.index(axis)] = value


def _model_settings(
    identification: Selection, component: Component, state: State
) -> dict[str, Any]:
    """Return settings that the model needs in addition to the sizes."""
    if identification.effect == "spectral_line" and component.statistic.is_line:
        return {
            "quality": line_quality(
                state.blocks, state.baseline, component.row[0], component.line_index
            )
        }
    if identification.effect == "feedback_reset" and "ramp_turns" in state.blocks:
        return {"phase": "channel"}
    if identification.effect == "held_samples":
        if component.variant.columns[0] == "filled":
            return {"fill": "zero"}
        counts = state.blocks.sel(axis=component.row[0])
        are_frames = 2.0 * float(counts["resent"].sum()) > float(counts["repeats"].sum())
        return {"fill": "frame" if are_frames else "repeat"}
    if identification.effect == "clipping":
        return {"centre": centre_of_range(state.blocks.sel(axis=component.row[0]))}
    if (
        identification.effect == "rate_quantization"
        and truncated_axes(state.blocks)[state.axes.index(component.row[0])]
    ):
        return {"mode": "zero"}
    if identification.effect == "dead_zone":
        axis = component.row[0]
        centre = float(np.nan_to_num(state.blocks["zone_centre"].sel(axis=axis)))
        edge = "jump" if has_empty_zone(state.blocks, axis) else "offset"
        return {"centre": centre, "edge": edge}
    if identification.effect == "warm_up" and state.blocks.sizes["restart"]:
        return {"gap": float(state.blocks.attrs["restart_gap_s"])}
    if identification.effect == "earth_rate" and is_reversed(component):
        off, around = np.degrees(EarthRate.example().directions(identification.axes))
        return {"off": list(off), "around": list(-around)}
    return {**_FIXED_SETTINGS.get(identification.effect, {})}


def _make_effect(
    kind: type[Effect], values: Mapping[str, Any], axes: tuple[str, ...], driver: tuple[str, ...]
) -> Effect | None:
    parameters = {item.name: item for item in kind.parameters()}
    clean = {
        name: value
        if isinstance(value, str)
        else np.clip(value, parameters[name].low, parameters[name].high).tolist()
        for name, value in values.items()
        if name in parameters
    }
    named = tuple(driver) if driver and all(driver) else ()
    size = {name: 0.0 for name in kind.required() if name not in clean}
    try:
        return kind(axes=axes, driver=named, **{**size, **clean})
    except (GyrostabError, TypeError):
        return None


def _make_estimate(
    mean: float, sd: float, unit: str, *, positive: bool, form: float, ends: Sequence[float] = ()
) -> Estimate:
    """Return an estimate with the error of the form.

    `ends` are those of an asymmetric 95 % interval without it, half of which is 1.96 standard
    errors at most: a point of the grid that hardly determines the size has a large variance, and
    little weight. What cannot be negative has a normal law cut off at zero, if the interval reaches
    it.
    """
    if sd <= 0.0:  # a count is exact
        return Estimate(mean, 0.0, mean, mean, unit)
    low, high = ends or (mean - NORMAL_95 * sd, mean + NORMAL_95 * sd)
    sd = min(sd, 0.5 * (high - low) / NORMAL_95)
    low = mean - math.hypot(mean - low, NORMAL_95 * form)
    high = mean + math.hypot(high - mean, NORMAL_95 * form)
    sd = math.hypot(sd, form)
    if positive and low < 0.0:
        low, high = 0.0, max(high, mean - sd * float(ndtri(_TAIL * ndtr(mean / sd))))
        mean = max(mean, 0.0)
    return Estimate(mean, sd, low, high, unit)
