"""Calibrate the noise again with the identified effects in the model.

The first calibration takes what the effects do to its blocks for noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.baseline.assemble import MIN_MEAN_NOISE_FACTOR, assemble_baseline
from gyrostab.diagnose.baseline.expected_statistics import (
    N_TERM,
    NOISE,
    noise_powers,
    reduced_shape,
    white_variance,
)
from gyrostab.diagnose.baseline.known_effects import ProcessesOnRows, random_means
from gyrostab.diagnose.baseline.posterior import (
    BandPowers,
    Posterior,
    average_groups,
    fit_squares,
    noise_posterior,
    with_floor,
)
from gyrostab.diagnose.estimate.joint_fit import Fitted, fit_identifications
from gyrostab.diagnose.evidence.wandering import RandomProcesses, expected_processes
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import components_of, condition_on_selections
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.filter_response import band_response
from gyrostab.diagnose.predict.linear_model import State, spread_by_gaps
from gyrostab.diagnose.predict.windows import find_drivers, predict_effect, rebuild_variant
from gyrostab.diagnose.reduce.block_statistics import MIN_BLOCKS
from gyrostab.diagnose.reduce.schema import BASELINE, label_variables
from gyrostab.physics.base import Effect

LEVEL_GROUPS = 150  # of blocks of similar level, over which powers are averaged


@dataclass
class AxisEffects:
    """What the effects do on one axis."""

    fixed_power: Floats  # (block, band): power of fixed size
    response: Floats  # (band, term): factor of the noise
    doubt: float  # relative error of `fixed_power`
    free: list[Floats] = field(default_factory=list)  # (block, band): power per unit of a free size
    means: list[Floats] = field(default_factory=list)  # (block,): means per unit of a free size


def recalibrate(
    identifications: Identifications,
    baseline: xr.Dataset,
    fitted: Sequence[Fitted],
    training: Bools | None = None,
) -> xr.Dataset:
    """Calibrate the noise with the identified effects in the model, those of free size free.

    An axis without an effect keeps its noise; so does one on which the effects leave too little to
    determine it, or with a random walk that follows a channel. The course of an effect separates it
    from noise, so that the whole record is used; with something unidentified on the axis, only its
    quiescent blocks are.

    The baseline that the identification started from is returned as it is unless it was calibrated
    on the recording. The new one has the steady random processes of the effects in the means;
    ``attrs["recalibrated"]`` lists its axes. Only the blocks `training` (block,) are used, by
    default all.
    """
    if baseline.attrs.get("source") != "calibrated" or not identifications.identified:
        return baseline
    blocks = identifications.state.blocks
    use = True if training is None else training
    state = condition_on_selections(
        identifications.state_without_effects(baseline), identifications.identified
    )
    posteriors: list[Posterior] = []
    power = baseline["spectrum"].values.copy()
    columns = noise_powers(blocks)
    processes = _find_processes(fitted, blocks)
    with_processes = baseline.assign(processes)
    changed, quiescent = [], baseline["quiet"].values.copy()
    for row, axis in enumerate(state.axes):
        axis_effects = _collect_effects(identifications, baseline, fitted, axis)
        posterior = None
        has_walk = expected_processes(state.baseline, row).walk.any()
        if axis_effects is not None and not has_walk:
            has_unidentified = any(
                axis in selection.axes for selection in identifications.unidentified
            )
            chosen = ~state.masked[row] & use & (quiescent[row] if has_unidentified else True)
            wander = expected_processes(with_processes, row)
            posterior = _fit_noise(state, row, axis_effects, chosen, wander)
            if posterior is not None:
                changed.append(axis)
                quiescent[row] = chosen
                columns[row] = noise_powers(blocks, axis_effects.response)[row]
                power[row] = columns[row] @ posterior.square + axis_effects.fixed_power
        posteriors.append(_kept_posterior(baseline, row) if posterior is None else posterior)
    if not changed:
        return baseline
    out = assemble_baseline(
        blocks,
        posteriors,
        quiescent=quiescent,
        attrs={**baseline.attrs, "recalibrated": changed},
        spectrum=power,
        settings=state.settings,
    )
    out = out.assign(processes)
    out["columns"] = out["columns"].copy(data=columns)
    for row, axis in enumerate(state.axes):
        if axis not in changed:
            for name in _AXIS_VARIABLES:
                out[name][row] = baseline[name].values[row]
            for name in {"wander_square", "wander_walk"} & {*processes}:
                out[name][row] = 0.0  # the noise that is kept contains them
    return out


#: Variables of a baseline that an axis keeps with its noise. The grid follows from the posterior,
#: and has as many points on all axes.
_AXIS_VARIABLES = (
    "angle_variance", "coefficient", "stderr", "spectrum", "mean_variance", "square",
    "square_stderr", "posterior", "posterior_slow",
)  # fmt: skip


def remove_fast_switching(identifications: Identifications, baseline: xr.Dataset) -> xr.Dataset:
    """Calibrate the noise with only those biases in the model that switch within blocks.

    With their power taken for noise, nothing can be compared with the baseline. The baseline that
    the identification started from is returned as it is unless it was calibrated on the recording
    and such a bias is identified.
    """
    switching = tuple(
        identification
        for identification in identifications.identified
        if any(component.variant.inside.size for component in identification.components)
    )
    if not switching:
        return baseline
    switching_only = replace(identifications, identified=switching, unidentified=())
    noise = recalibrate(switching_only, baseline, fit_identifications(switching_only, baseline))
    return noise if noise is baseline else noise.assign_attrs(recalibrated=[])


def refer_to_kept_noise(
    fitted: Sequence[Fitted], noise: xr.Dataset, blocks: xr.Dataset
) -> list[Fitted]:
    """Refer changes of the noise to the channels at rest, on axes that keep their noise.

    The noise of such an axis is that of its quiescent blocks. Where the channel is far from the
    default reference of an effect, the noise there is not known, and neither is its share.
    """
    if noise.attrs.get("source") != "calibrated":
        return list(fitted)
    recalibrated = noise.attrs.get("recalibrated", ())
    quiescent = dict(zip(noise["axis"].values.tolist(), noise["quiet"].values, strict=True))
    out = []
    for effect_fit in fitted:
        kept_axes = [axis for axis in effect_fit.axes if axis not in recalibrated]
        if effect_fit.effect is None or effect_fit.effect.stage != "noise" or not kept_axes:
            out.append(effect_fit)
            continue
        at_rest = quiescent[kept_axes[0]]
        means = {
            role: float(np.nanmean(blocks[f"channel_{name}"].values[at_rest]))
            for role, name in find_drivers(effect_fit.effect).items()
        }
        effect = effect_fit.effect.refer_noise_to(means)
        shown = None if effect_fit.shown is None else effect_fit.shown.refer_noise_to(means)
        out.append(replace(effect_fit, effect=effect, shown=shown))
    return out


def _kept_posterior(baseline: xr.Dataset, row: int) -> Posterior:
    """Return the posterior of an axis whose noise is kept."""
    axis_baseline = baseline.isel(axis=row)
    square, error, K, B, draws, slow = (
        axis_baseline[name].values
        for name in ("square", "square_stderr", "grid_K", "grid_B", "posterior", "posterior_slow")
    )
    weight = np.exp(axis_baseline["grid_calibrated"].values)
    angle = float(axis_baseline["angle_variance"])
    weight /= weight.sum()
    return Posterior(
        square=square,
        error=error,
        K=K,
        B=B,
        weight=weight,
        draws=draws,
        slow=slow,
        joined=True,
        angle=angle,
    )


def _collect_effects(
    identifications: Identifications, baseline: xr.Dataset, fitted: Sequence[Fitted], axis: str
) -> AxisEffects | None:
    """Collect what all identified effects do on an axis; None without any."""
    blocks = identifications.state.blocks
    shape = (blocks.sizes["block"], blocks.sizes["band"])
    # twice the error of the size, because power grows with its square
    doubt = 2.0 * identifications.state.settings.size_error_share
    out = AxisEffects(np.zeros(shape), np.ones((shape[1], len(NOISE))), doubt)
    start = identifications.state_without_effects(baseline)
    touched = False
    for identification in identifications.identified:
        components = [component for component in identification.components if axis in component.row]
        touched |= bool(components)
        for component in components:
            if not component.is_filter:
                fixed_power, free, means = component.statistic.noise_shares(
                    component, axis, start, identifications.state.expected_power
                )
                out.fixed_power += fixed_power
                out.free += [np.broadcast_to(column, shape) for column in free]
                out.means += means
        effect_fit = next(
            (fit for fit in fitted if fit.identification is identification and axis in fit.axes),
            None,
        )
        if effect_fit is None or effect_fit.effect is None:
            continue
        # power in a statistic of powers has a free size
        is_in_power = any(component.statistic.is_power for component in components)
        if not is_in_power and any(
            component.statistic.has_power_of_effect(component, identifications.state)
            for component in components
        ):
            out.fixed_power += _effect_power(effect_fit.effect, blocks, axis)
            errors = [
                2.0 * estimate.stderr / abs(estimate.value)
                for estimate in effect_fit.parameters.values()
                if estimate.value
            ]
            out.doubt = max([out.doubt, *errors])
        if any(component.is_filter for component in components):
            out.response = out.response * band_response(effect_fit.effect, blocks)
    return out if touched else None


def _find_processes(fitted: Sequence[Fitted], blocks: xr.Dataset) -> dict[str, Any]:
    """Return the steady random processes of effects in the means, as variables of a baseline.

    The bias of two levels is one unless its course is in the model.
    """
    axes = [str(axis) for axis in blocks["axis"].values]
    processes_on_rows = []
    for effect_fit in fitted:
        effect = effect_fit.effect
        if effect is None:
            continue
        prediction = predict_effect(effect, blocks, effect_fit.axes, blocks["frequency"].values)
        if not any(component.statistic.is_switching for component in effect_fit.components):
            prediction = replace(prediction, levels="")
        sizes = partial(effect.expand_to_axes, axes=effect_fit.axes)
        rows = [axes.index(axis) for axis in effect_fit.axes]
        processes_on_rows.append(ProcessesOnRows(prediction, rows, sizes))
    shape = tuple(blocks.sizes[name] for name in ("axis", "block", "band"))
    return label_variables(random_means(processes_on_rows, shape)[0], BASELINE)


def _effect_power(effect: Effect, blocks: xr.Dataset, axis: str) -> Floats:
    """Return the power that an effect itself predicts on an axis, (block, band)."""
    prediction = predict_effect(effect, blocks, (axis,), blocks["frequency"].values)
    out = np.zeros((blocks.sizes["block"], blocks.sizes["band"]))
    for name, density in prediction.spectrum.items():
        size = effect.expand_to_axes(name, effect.axes)[effect.axes.index(axis)]
        rows = np.asarray(density)
        out += size**2 * (rows[0] if rows.ndim == 3 else rows)
    return np.asarray(spread_by_gaps(out[None], blocks.sel(axis=[axis]))[0])


def _fit_noise(
    state: State, row: int, axis_effects: AxisEffects, chosen: Bools, wander: RandomProcesses
) -> Posterior | None:
    """Fit the noise of an axis with the effects; None where too little is left to determine it."""
    blocks = state.blocks
    power, shape = blocks["power"].values[row], reduced_shape(blocks)[row]
    chosen = chosen & (np.isfinite(power) & np.isfinite(shape)).any(axis=1)
    if chosen.sum() < MIN_BLOCKS:
        return None
    columns = noise_powers(blocks, axis_effects.response)[row]
    bands = _average_powers(power, shape, columns, state.expected_power[row], axis_effects, chosen)
    square, information, _ = fit_squares(bands)
    assert bands.start is not None
    white_column = bands.columns[:, N_TERM]
    without_effects = float((bands.weight / np.square(bands.start) * white_column**2).sum())
    least_information = state.settings.min_information_share * without_effects
    if not information[N_TERM, N_TERM] > least_information or not square[N_TERM] > 0.0:
        return None
    square = with_floor(square, bands)
    variance = white_variance(blocks, square[None])[row]
    unfiltered = noise_powers(blocks)[row, :, 0] @ square
    variance = variance * np.maximum(
        state.expected_power[row, :, 0] / unfiltered, MIN_MEAN_NOISE_FACTOR
    )
    effect_means = np.stack(axis_effects.means, axis=1) if axis_effects.means else None
    return noise_posterior(
        bands, blocks, row, variance, chosen, effect_means, state.settings, wander
    )


def _average_powers(
    power: Floats,
    shape: Floats,
    columns: Floats,
    expected: Floats,
    axis_effects: AxisEffects,
    chosen: Bools,
) -> BandPowers:
    """Average the powers over blocks of similar level."""
    free_columns = [
        column / max(float(np.abs(column).max()), 1e-300) for column in axis_effects.free
    ]
    effect_columns = np.stack([axis_effects.fixed_power, expected, *free_columns], axis=-1)
    cells = np.nan_to_num(np.concatenate([columns, effect_columns], axis=-1))
    level = np.log(expected.mean(axis=1))
    bands = average_groups(power, shape, cells, level, chosen, LEVEL_GROUPS)
    columns, (fixed_power, start), free = (
        bands.columns[:, :4],
        bands.columns[:, 4:6].T,
        bands.columns[:, 6:],
    )
    precision = np.zeros(free.shape[1])
    if np.any(fixed_power > 0.0):  # the predicted power has an error too
        free = np.concatenate([free, fixed_power[:, None]], axis=1)
        precision = np.append(precision, 1.0 / axis_effects.doubt**2)
    return BandPowers(bands.power, columns, bands.weight, fixed_power, free, precision, start)


def with_noise(identifications: Identifications, baseline: xr.Dataset) -> Identifications:
    """Return the identifications with designs for another noise.

    A share of N^2 is a share of the new one.
    """
    state = replace(identifications.state, baseline=baseline)
    candidates: dict[Candidate, Candidate] = {}  # by the old one
    variants: dict[Variant, Variant] = {}
    for component in components_of(identifications.identified):
        old = component.candidate
        if old.statistic.is_power and old not in candidates:
            made = tuple(
                rebuild_variant(old, variant, state) or variant for variant in old.variants
            )
            candidates[old] = replace(old, variants=made)
            variants |= zip(old.variants, made, strict=True)

    def renew(component: Component) -> Component:
        old = component.candidate
        if old not in candidates:
            return component
        return replace(component, candidate=candidates[old], variant=variants[component.variant])

    return replace(
        identifications,
        identified=tuple(
            replace(identification, components=tuple(map(renew, identification.components)))
            for identification in identifications.identified
        ),
    )
