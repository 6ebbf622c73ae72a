"""Put identified effects, expected effects, or anomalous samples into the baseline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Complexes, Floats
from gyrostab.diagnose.baseline.known_effects import GRID_MARK
from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import (
    Selection,
    components_of,
    condition_on_selections,
    conditioned_states,
)
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import fit_powers
from gyrostab.diagnose.predict.filter_response import band_shape_factor
from gyrostab.diagnose.predict.linear_model import (
    State,
    cross_column,
    expected_cross,
    initial_state,
    pair_rows,
)
from gyrostab.diagnose.predict.sizes import component_mixture, mean_mixture
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.diagnose.settings import Settings
from gyrostab.noise import sampled_psd
from gyrostab.physics.registry import effects


def predict_baseline(
    identifications: Identifications,
    baseline: xr.Dataset,
    training: Bools | None = None,
    *,
    left_out: Sequence[Selection] = (),
) -> xr.Dataset:
    """Return the baseline with the identified effects in it, fitted to the blocks that may be used.

    Parameters
    ----------
    identifications : Identifications
        The effects, with those that were expected; their nuisance parameters are kept.
    training : ndarray of bool, shape (block,), optional
        Blocks that the sizes are fitted to; all by default.
    left_out : sequence of Selection, optional
        Effects that are fitted with the others and then taken out again. What a low-pass removed
        stays removed.

    Returns
    -------
    xarray.Dataset
        With ``spectrum`` and ``known_mean`` of the effects, ``cross`` (pair, block, band) of noise
        in common, and ``shape_factor`` (band,) on the degrees of freedom behind a filter.
    """
    blocks = identifications.state.blocks
    usable_blocks = blocks
    if training is not None:
        keep = xr.DataArray(training, dims="block")
        usable_blocks = blocks.assign(
            {name: blocks[name].where(keep) for name in ("mean", "power", "cross")}
        )
    state = initial_state(usable_blocks, baseline, settings=identifications.state.settings)
    # for each column in the model, whether it belongs to an effect that is left out
    is_left_out: dict[tuple[str, str], list[bool]] = {}
    identified = (*identifications.expected, *identifications.identified)
    states = conditioned_states(state, identified)
    for identification, state in zip(identified, states, strict=True):
        for place, columns in state.given.items():
            flags = is_left_out.setdefault(place, [])
            flags += [identification in left_out] * (len(columns) - len(flags))
    spectrum = _fit_spectrum(state, is_left_out)
    state = replace(state, blocks=usable_blocks, masked=identifications.state.masked)
    empty_state = replace(state, given={})
    mean = _fit_means(state, empty_state, baseline["known_mean"].values, is_left_out)
    predicted = state.baseline.assign(
        spectrum=baseline["spectrum"].copy(data=spectrum),
        known_mean=baseline["known_mean"].copy(data=mean),
    )
    remaining = [identification for identification in identified if identification not in left_out]
    filters = [component for component in components_of(remaining) if component.is_filter]
    if filters:  # one for all axes
        kind = effects()[filters[0].candidate.effect]
        factor = band_shape_factor(kind.example(**filters[0].variant.values), blocks)
        predicted = predicted.assign(shape_factor=("band", factor))
    shared = [
        component for component in components_of(remaining) if component.statistic.is_pairwise
    ]
    if not shared:
        return predicted
    cross = _cross_spectra(shared, empty_state) + expected_cross(baseline, blocks)
    return predicted.assign(cross=(("pair", "block", "band"), cross))


def _fit_spectrum(state: State, is_left_out: Mapping[tuple[str, str], list[bool]]) -> Floats:
    """Return the expected power (axis, block, band) without the columns that are left out."""
    spectrum = state.expected_power.copy()
    for row, axis in enumerate(state.axes):
        places = (("power", axis), ("added_power", axis))  # as in `State.power_columns`
        dropped = np.array([flag for at in places for flag in is_left_out.get(at, [])], np.bool_)
        if dropped.any():
            spectrum[row] = fit_powers(state, axis, dropped)
    return spectrum


def _fit_means(
    state: State,
    empty_state: State,
    known_mean: Floats,
    is_left_out: Mapping[tuple[str, str], list[bool]],
) -> Floats:
    """Add to the known means (axis, block) the fit of the columns that are not left out."""
    mean = known_mean.copy()
    for row, axis in enumerate(state.axes):
        columns = state.given.get(("mean", axis), [])
        is_kept = ~np.array(is_left_out.get(("mean", axis), []), np.bool_)
        if is_kept.any():
            size, _ = mean_mixture(empty_state, axis, columns).moments()
            mean[row] += np.tensordot(size[is_kept], np.stack(columns)[is_kept], axes=1)
    return mean


def _cross_spectra(components: Sequence[Component], state: State) -> Complexes:
    """Return the cross-spectra of noise that axes have in common, in a state without effects."""
    shape = state.expected_power.shape[1:]
    pairs = pair_rows(state.blocks)
    total = np.zeros((len(pairs), *shape), np.complex128)
    for component in components:
        row = pairs.index(component.row)
        mean, _ = component_mixture(component, state).moments()
        for size, design in zip(mean, component.variant.design, strict=True):
            total[row] += size * cross_column(design, row, state.blocks)
    return total


def expected_baseline(
    identifications: Identifications, baseline: xr.Dataset, training: Bools | None = None
) -> xr.Dataset:
    """Return the baseline with the expected effects only, fitted to the training blocks."""
    return (
        predict_baseline(replace(identifications, identified=()), baseline, training)
        if identifications.expected
        else baseline
    )


def without_expected(
    blocks: xr.Dataset, baseline: xr.Dataset, expected: Sequence[Selection], settings: Settings
) -> xr.Dataset:
    """Drop the blocks in which expected effects leave anomalous samples or move the rate."""
    if not expected:
        return blocks
    state = condition_on_selections(initial_state(blocks, baseline, settings=settings), expected)
    moved = xr.DataArray(state.masked, dims=("axis", "block"))
    return state.blocks.assign(power=state.blocks["power"].where(~moved))


def add_outlier_power(
    baseline: xr.Dataset, blocks: xr.Dataset, fitted: Sequence[Fitted]
) -> xr.Dataset:
    """Add the mean power of anomalous samples to a baseline, from their fitted sizes.

    The identification leaves their blocks out; a surface of the simulation must include them.
    Effects without anomalous samples are ignored.
    """
    axes = [str(axis) for axis in blocks["axis"].values]
    frequency, rate = blocks["frequency"].values, float(blocks.attrs["sampling_rate_hz"])
    spectrum = baseline["spectrum"]
    added = np.zeros(spectrum.shape)
    for effect_fit in fitted:
        if effect_fit.effect is None or not any(
            component.statistic.is_count for component in effect_fit.identification.components
        ):
            continue
        rows = [axes.index(axis) for axis in effect_fit.axes]
        prediction = effect_fit.effect.explain(
            replace(make_windows(blocks, {}), axes=tuple(effect_fit.axes))
        )
        if GRID_MARK in prediction.marks:
            continue
        for name, density in prediction.spectrum.items():
            added[rows] += getattr(effect_fit.effect, name) ** 2 * density
        for (term, name), share in prediction.level.items():
            square = baseline["coefficient"].sel(term=term, axis=list(effect_fit.axes)).values ** 2
            added_square = square[:, None] * getattr(effect_fit.effect, name) * share
            added[rows] += added_square[..., None] * sampled_psd(term, frequency, rate)
    return (
        baseline.assign(spectrum=spectrum.copy(data=spectrum.values + added))
        if added.any()
        else baseline
    )
