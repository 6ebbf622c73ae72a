"""Predictions of effects for the blocks of a record, with the channels that they follow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Complexes, Ints
from gyrostab.diagnose.predict.candidates import (
    TIME_PARAMETER,
    Candidate,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.linear_model import State, with_correlated_powers
from gyrostab.diagnose.reduce.schema import read_as_measured
from gyrostab.physics.base import Effect, driver_error
from gyrostab.physics.prediction import Prediction, Windows
from gyrostab.physics.registry import effects

FREQUENCIES_PER_BAND = 48  # to average a response or a narrow peak; design choice
_SPLINE_KNOTS = 12  # of hat functions over the record; design choice
_MAX_DESIGN_DIFFERENCE = 1e-3  # of its size, up to which designs are equal; design choice
_MAX_TIMES = 240  # limits time
_MAX_STEPS = 20  # largest steps of the means among them: a step one block off does not fit
#: Restarts among them. Limits the time of a design with a step at each restart, which grows with
#: the cube of their number.
_MAX_RESTARTS = 60
_SIDE_BLOCKS = (2, 8, 32)  # blocks on either side that define a step; design choice


def channel_units(blocks: xr.Dataset) -> dict[str, str]:
    """Return the units of the channels of the log."""
    return {
        name.removeprefix("channel_"): str(blocks.variables[name].attrs.get("units", ""))
        for name in map(str, blocks.data_vars)
        if name.startswith("channel_")
    }


def make_windows(blocks: xr.Dataset, drivers: Mapping[str, str]) -> Windows:
    """Return the record in the form that effects take for their predictions.

    `drivers` has the channels of the log by channel of the effect.
    """
    variables = blocks.variables  # faster than arrays with their coordinates
    axes = tuple(str(axis) for axis in variables["axis"].values)
    means = dict(
        zip(axes, map(fill_linearly, read_as_measured(blocks, "mean").values), strict=True)
    )

    def spans(name: str) -> Array:
        return np.stack(
            [variables[f"{name}_begin"].values, variables[f"{name}_end"].values], axis=1
        ).astype(np.float64)

    return Windows(
        begin=variables["begin"].values.astype(np.float64),
        end=variables["end"].values.astype(np.float64),
        frequency=variables["frequency"].values,
        rate=float(blocks.attrs["sampling_rate_hz"]),
        axes=axes,
        drivers={
            inner: fill_linearly(variables[f"channel_{name}"].values)
            for inner, name in drivers.items()
        },
        fine={
            inner: variables[f"fine_{name}"].values
            for inner, name in drivers.items()
            if f"fine_{name}" in variables
        },
        own=means,
        gaps=spans("gap"),
        restarts=spans("restart"),
        phase=(np.arange(blocks.sizes["phase"]) + 0.5) / blocks.sizes["phase"]
        if "profile" in variables
        else np.empty(0),
        turns=variables["ramp_turns"].values if "ramp_turns" in variables else np.empty(0),
        turn_means=dict(zip(axes, variables["turn_mean"].values, strict=True))
        if "turn_mean" in variables and drivers.get("rotation_rate") == "rotation_rate"
        else {},
        bands={
            inner: band
            for inner, name in drivers.items()
            if (band := _rms_band(variables[f"channel_{name}"])) is not None
        },
    )


def _rms_band(channel: xr.Variable) -> tuple[float, float] | None:
    """Return the edges of the band of an rms channel [Hz]; None if it does not have any."""
    try:
        low, high = (float(edge) for edge in channel.attrs.get("band_hz", ()))
    except (TypeError, ValueError):
        return None
    return (low, high) if 0.0 <= low < high < np.inf else None


def fill_linearly(values: Array) -> Array:
    """Interpolate missing values linearly."""
    good = np.isfinite(values)
    if good.all() or not good.any():
        return np.asarray(values, np.float64)
    place = np.arange(values.size)
    return np.interp(place, place[good], values[good])


def predict_exogenous(effect: Effect, windows: Windows) -> Prediction:
    """Predict an effect without those means of an axis that follow its own noisy reading."""
    full = effect.explain(windows)
    if not full.mean:
        return full
    shape = (len(windows.axes), windows.begin.size)
    mean = {
        name: np.array(np.broadcast_to(np.atleast_2d(values), shape))
        for name, values in full.mean.items()
    }
    # the means depend neither on the bands nor on the phase of the ramp
    fewer = replace(windows, frequency=windows.frequency[:1], phase=np.empty(0))

    def explain_without(axes: Iterable[str]) -> Mapping[str, Array]:
        missing = dict.fromkeys(axes, np.full(windows.begin.size, np.nan))
        return effect.explain(replace(fewer, own=dict(windows.own) | missing)).mean

    without_any = explain_without(windows.axes)
    following = [
        name for name in mean if name not in without_any or not np.isfinite(without_any[name]).all()
    ]
    if following:
        for row, axis in enumerate(windows.axes):
            without_axis = explain_without([axis])
            for name in following:
                expected = np.broadcast_to(np.atleast_2d(without_axis[name]), shape)[row]
                if not np.array_equal(expected, mean[name][row]):
                    mean[name][row] = 0.0
    return replace(full, mean=mean)


def frequencies_in_bands(blocks: xr.Dataset) -> Array:
    """Return equally many evenly spaced frequencies in every band, band after band [Hz]."""
    low, high = blocks["band_low"].values, blocks["band_high"].values
    place = (np.arange(FREQUENCIES_PER_BAND) + 0.5) / FREQUENCIES_PER_BAND
    return np.asarray((low[:, None] + (high - low)[:, None] * place).ravel())


def find_drivers(effect: Effect) -> dict[str, str]:
    """Return the names in the log of an effect's channels."""
    return {role: effect.channel_names()[role] for role in effect.needs()}


def predict_effect(
    effect: Effect, blocks: xr.Dataset, axes: tuple[str, ...], frequency: Array | None = None
) -> Prediction:
    """Predict an effect on some axes, with many frequencies in each band for narrow peaks."""
    drivers = find_drivers(effect)
    present = list(channel_units(blocks))
    for role, name in drivers.items():
        if name not in present:
            raise driver_error(effect, role, present)
    return effect.explain(
        replace(
            make_windows(blocks, drivers),
            axes=axes,
            frequency=frequencies_in_bands(blocks) if frequency is None else frequency,
        )
    )


def complex_factors(effect: Effect, name: str, axes: tuple[str, ...]) -> Complexes:
    """Return the complex factor of a spectrum for each axis: size, direction, phase."""
    parameters = {parameter.name: parameter for parameter in effect.parameters()}
    factor = effect.expand_to_axes(name, axes).astype(np.complex128)
    if "direction" in parameters:
        factor *= effect.expand_to_axes("direction", axes)
    if "phase" in parameters and parameters["phase"].many:
        factor *= np.exp(1j * np.radians(effect.expand_to_axes("phase", axes)))
    return factor


def driver_names(candidate: Candidate) -> dict[str, str]:
    """Return the channels of the log that a candidate follows, by channel of its effect."""
    channels = effects()[candidate.effect].channels
    return {inner: name for inner, name in zip(channels, candidate.driver, strict=False) if name}


def rebuild_variant(
    candidate: Candidate, variant: Variant, state: State, windows: Windows | None = None
) -> Variant | None:
    """Rebuild a variant for other parameter values or windows; None if it vanishes.

    The windows are those of the blocks by default.
    """
    blocks, coefficient = state.blocks, state.baseline["coefficient"]
    if windows is None:
        windows = make_windows(blocks, driver_names(candidate))
    effect = effects()[candidate.effect].example(**variant.values)
    prediction = with_correlated_powers(predict_exogenous(effect, windows), blocks)
    prospect = Prospect(dict(variant.values), prediction, blocks, coefficient)
    built = [*candidate.statistic.design(prospect)]
    same = (rebuilt for rebuilt in built if rebuilt.has_columns_of(variant))
    cut_from_larger = (
        rebuilt.with_columns(variant.columns)
        for rebuilt in built
        if set(variant.columns) < set(rebuilt.columns) and rebuilt.squared == variant.squared
    )
    return next(chain(same, cut_from_larger), None)


def distinct_variants(variants: list[Variant]) -> tuple[Variant, ...]:
    """Drop variants with empty designs, or designs equal to others."""
    distinct: list[Variant] = []
    known_designs: set[tuple[Any, ...]] = set()
    for variant in variants:
        if variant.design.size:
            size = np.abs(variant.design).max(initial=0.0)
            if not (np.isfinite(size) and size > 0.0):
                continue
            mark: tuple[Any, ...] = (
                variant.columns,
                variant.time,
                np.round(variant.design / size / _MAX_DESIGN_DIFFERENCE).tobytes(),
            )
        else:
            mark = (variant.columns,)
        if mark not in known_designs:
            known_designs.add(mark)
            distinct.append(variant)
    return tuple(distinct)


def power_on_times(windows: Windows) -> Array:
    """Return the times at which power came back [s], after the longest power-offs if many."""
    if not windows.restarts.size:
        return np.empty(0)
    longest = np.argsort(-np.diff(windows.restarts)[:, 0], kind="stable")[:_MAX_RESTARTS]
    return np.asarray(np.sort(windows.restarts[longest, 1]))


def select_step_times(values: Array, windows: Windows) -> list[float]:
    """Select the times to try among the possible ones, which rise [s].

    All if they are few. Otherwise some at equal intervals, those at which power came back, and
    those at which the means of an axis step most. Each has the prior probability of the time it
    represents, so that selecting by the means gives no advantage.

    Examples
    --------
    >>> begin = 20.0 * np.arange(1000)
    >>> walk = np.random.default_rng(1).standard_normal(1000)
    >>> walk[617:] += 5.0
    >>> windows = Windows(begin, begin + 20.0, np.ones(1), 10.0, ("x",), own={"x": walk})
    >>> tried = select_step_times(begin[1:], windows)
    >>> len(tried) < 300, 617 * 20.0 in tried
    (True, True)
    """
    if len(values) <= _MAX_TIMES:
        return [float(instant) for instant in values]
    every = -(-len(values) // (_MAX_TIMES - 3 * _MAX_STEPS))
    steps = _largest_steps(windows)
    near_steps = values[
        np.abs(values[:, None] - steps).min(axis=1, initial=np.inf)
        <= 0.5 * (windows.end[0] - windows.begin[0])
    ]
    return [
        float(instant)
        for instant in np.unique(
            np.concatenate([values[every // 2 :: every], power_on_times(windows), near_steps])
        )
    ]


def _largest_steps(windows: Windows) -> Array:
    """Return the starts of the blocks at which the means of an axis step most [s]."""
    steps_found: list[tuple[float, float]] = []
    for values in windows.own.values():
        if not np.isfinite(values).all():
            continue
        total = np.concatenate([[0.0], np.cumsum(values)])
        for length in _SIDE_BLOCKS:
            inner = np.arange(length, values.size - length + 1)
            if inner.size < 2 * length:
                continue
            size = np.abs(total[inner + length] - 2.0 * total[inner] + total[inner - length])
            wide = np.lib.stride_tricks.sliding_window_view(
                np.pad(size, length), 2 * length + 1
            ).max(axis=1)
            usual = max(float(np.median(size)), 1e-300)
            steps_found += [
                (float(size[k] / usual), float(windows.begin[inner[k]]))
                for k in np.flatnonzero(size == wide)
            ]
    largest = dict.fromkeys(begin for _, begin in sorted(steps_found, reverse=True))
    return np.array(list(largest)[:_MAX_STEPS])


def weigh_by_time(variants: tuple[Variant, ...], windows: Windows) -> tuple[Variant, ...]:
    """Weight variants by the prior probability of their time.

    Times at which power came back have the same total probability as all others, which have that of
    the interval they represent.
    """
    if not variants or not all(TIME_PARAMETER in variant.values for variant in variants):
        return variants
    at = np.array([variant.values[TIME_PARAMETER] for variant in variants])
    is_power_on = np.array(
        [bool(np.isclose(power_on_times(windows), instant).any()) for instant in at]
    )
    other_times, place = np.unique(at[~is_power_on], return_inverse=True)
    if other_times.size < 2:
        return variants
    weight = np.ones(at.size)
    span = np.gradient(other_times)[place]
    weight[~is_power_on] = span / span.mean()
    weight[is_power_on] = weight[~is_power_on].sum() / max(int(is_power_on.sum()), 1)
    return tuple(
        replace(variant, weight=float(share))
        for variant, share in zip(variants, weight, strict=True)
    )


def make_surrogates(component: Component, state: State, shifts: Ints) -> list[Variant | None]:
    """Return the variant for channels that are rotated in time by each shift, end to start."""
    candidate, blocks = component.candidate, state.blocks
    drivers = driver_names(candidate)
    windows = make_windows(blocks, drivers)
    channels = {inner: blocks[f"channel_{name}"].values for inner, name in drivers.items()}
    means = read_as_measured(blocks, "mean").values

    def shift_windows(shift: int) -> Windows:
        def rotate(values: Array) -> Array:
            return np.roll(values, shift, axis=0)

        shifted = replace(
            windows,
            drivers={inner: fill_linearly(rotate(values)) for inner, values in channels.items()},
            fine={inner: rotate(values) for inner, values in windows.fine.items()},
            turn_means={axis: rotate(values) for axis, values in windows.turn_means.items()},
        )
        if not effects()[candidate.effect].follows_axes:
            return shifted
        rotated_means = (fill_linearly(rotate(mean)) for mean in means)
        return replace(shifted, own=dict(zip(windows.axes, rotated_means, strict=True)))

    return [
        rebuild_variant(candidate, component.variant, state, shift_windows(int(shift)))
        for shift in shifts
    ]


def max_correlation(surrogate: Variant, true: Variant, row: int) -> float:
    """Return the largest correlation of the columns over time, of either sign."""

    def flat(design: Array) -> Array:
        rows = design[:, row if design.shape[1] > 1 else 0]
        rows = rows.reshape(rows.shape[0], rows.shape[1], -1).mean(axis=-1)
        return np.asarray(rows - rows.mean(axis=1, keepdims=True))

    a, b = flat(surrogate.design), flat(true.design)
    size = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return float(np.max(np.abs((a * b).sum(axis=1)) / np.where(size > 0, size, 1.0)))


def hat_functions(begin: Array, end: Array) -> Array:
    """Return piecewise linear hat functions over the record, (knot, block).

    Examples
    --------
    >>> hat_functions(np.arange(4.0), np.arange(1.0, 5.0)).sum(axis=0)
    array([1., 1., 1., 1.])
    """
    middle = (begin + end) / 2.0
    places = np.linspace(begin[0], end[-1], _SPLINE_KNOTS)
    return np.stack([np.interp(middle, places, row) for row in np.eye(_SPLINE_KNOTS)])
