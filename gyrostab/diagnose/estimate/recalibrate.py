"""The noise once more, with the named effects in the model: the first calibration took for noise what they do to its blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.calibrate import DRAWS, assemble_baseline
from gyrostab.diagnose.baseline.expected_statistics import (
    common_variance,
    noise_powers,
    white_variance,
)
from gyrostab.diagnose.baseline.known_effects import find_drivers
from gyrostab.diagnose.baseline.posterior import (
    Fit,
    Posterior,
    fit_squares,
    floor_square,
    noise_posterior,
)
from gyrostab.diagnose.estimate.joint_fit import FORM_ERROR, Fitted, fit_identifications
from gyrostab.diagnose.identify.identification import Identifications
from gyrostab.diagnose.predict.candidates import make_windows, rebuild_variant
from gyrostab.diagnose.predict.condition import (
    Component,
    condition_on,
    condition_on_component,
    find_anomalous_blocks,
)
from gyrostab.diagnose.predict.filter_response import band_response, is_filter
from gyrostab.diagnose.predict.linear_model import (
    State,
    initial_state,
    reference_channel_power,
    spread_by_gaps,
)
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.physics.base import Effect
from gyrostab.physics.phase import fold

__all__ = ["recalibrate", "remove_fast_switching", "with_noise"]

Array = NDArray[np.float64]
_GROUPS = 150  # of blocks of like level, over which powers are averaged
_LEAST = 24  # blocks
_BLURRED = 1e-4  # share of its information that N must keep beside the effects


@dataclass
class _Seen:
    """What effects do on one axis.

    Attributes
    ----------
    known : ndarray, shape (block, band)
        Power of a size that is known otherwise.
    free : list of ndarray, shape (block, band)
        Power per unit of a free size.
    response : ndarray, shape (band,)
        Factor of the noise.
    means : list of ndarray, shape (block,)
    doubt : float
        Error of `known`, as a share of it.
    """

    known: Array
    response: Array
    free: list[Array] = field(default_factory=list)
    means: list[Array] = field(default_factory=list)
    doubt: float = 2.0 * FORM_ERROR


def recalibrate(
    identifications: Identifications,
    baseline: xr.Dataset,
    fitted: Sequence[Fitted],
    known: NDArray[np.bool_] | None = None,
) -> xr.Dataset:
    """Calibrate the noise with the named effects in the model, those of free size free.

    An axis that no effect touches keeps its noise; so does one on which effects leave too little to
    tell it by. Where something is unknown the quiet blocks are used, else the whole record: the
    levels of an effect are told from noise by their course.

    Parameters
    ----------
    identifications : Naming
    baseline : xarray.Dataset
        That the naming started from; returned as it is unless it was calibrated on the recording.
    fitted : sequence of Fitted
        The effects with their numbers.
    known : ndarray of bool, shape (block,), optional
        Blocks that may be used; all by default.

    Returns
    -------
    xarray.Dataset
        As `gyrostab.diagnose.baseline.calibrate.calibrate_noise` has it; ``attrs["recalibrated"]``
        names the axes.
    """
    if baseline.attrs.get("source") != "calibrated" or not identifications.identified:
        return baseline
    blocks = identifications.state.blocks
    use = np.ones(blocks.sizes["block"], np.bool_) if known is None else np.asarray(known, np.bool_)
    state = initial_state(blocks, baseline)
    for identification in identifications.identified:
        state = condition_on(state, list(identification.components))
    found: list[Posterior] = []
    power = baseline["spectrum"].transpose("axis", "block", "band").values.copy()
    columns = noise_powers(blocks)
    changed, quiet = [], baseline["quiet"].transpose("axis", "block").values.copy()
    for row, axis in enumerate(state.axes):
        seen = _seen(identifications, baseline, fitted, axis)
        posterior = None
        if seen is not None:
            strange = any(axis in one.axes for one in identifications.unknown)
            chosen = use & ~state.masked[row] & (quiet[row] if strange else True)
            posterior = _posterior(state, row, seen, chosen)
            if posterior is not None:
                changed.append(axis)
                quiet[row] = chosen
                columns[row] = noise_powers(blocks, seen.response)[row]
                power[row] = columns[row] @ posterior.square + seen.known
        found.append(_kept(baseline, row) if posterior is None else posterior)
    if not changed:
        return baseline
    out = assemble_baseline(
        blocks,
        found,
        quiet=quiet,
        attrs={**baseline.attrs, "recalibrated": changed},
        spectrum=power,
    )
    out["columns"] = out["columns"].copy(data=columns)
    for row, axis in enumerate(state.axes):
        if axis not in changed:
            for name in _OF_AXIS:
                out[name][row] = baseline[name].transpose("axis", ...).values[row]
    return out


#: Variables of a baseline that an axis keeps whose noise is kept.
_OF_AXIS = (
    "coefficient", "stderr", "spectrum", "mean_variance", "square", "square_stderr", "posterior", "posterior_slow",
    "grid_K", "grid_B", "grid_prior", "grid_calibrated",
)  # fmt: skip


def remove_fast_switching(identifications: Identifications, baseline: xr.Dataset) -> xr.Dataset:
    """The noise beside biases that hop within blocks alone: with these for noise it is another one, to which nothing can be compared.

    Parameters
    ----------
    identifications : Naming
    baseline : xarray.Dataset
        That the naming started from; returned as it is unless it was calibrated on the recording,
        and such a bias is named.
    """
    hops = tuple(
        one
        for one in identifications.identified
        if any(component.variant.inside.size for component in one.components)
    )
    if not hops:
        return baseline
    alone = replace(identifications, identified=hops, unknown=())
    noise = recalibrate(alone, baseline, fit_identifications(alone, baseline))
    return noise if noise is baseline else noise.assign_attrs(recalibrated=[])


def _kept(baseline: xr.Dataset, row: int) -> Posterior:
    """A stand-in for an axis whose noise is kept."""
    one = baseline.isel(axis=row)
    K, B = one["grid_K"].values, one["grid_B"].values
    weight = np.exp(one["grid_calibrated"].values)
    draws = one["posterior"].transpose("draw", "noise").values
    slow = one["posterior_slow"].transpose("draw", "slow").values
    return Posterior(
        one["square"].values,
        one["square_stderr"].values,
        K,
        B,
        weight / weight.sum(),
        draws,
        slow,
        True,
    )


def _seen(
    identifications: Identifications, baseline: xr.Dataset, fitted: Sequence[Fitted], axis: str
) -> _Seen | None:
    """What all named effects do on an axis; None where they do nothing."""
    blocks = identifications.state.blocks
    shape = (blocks.sizes["block"], blocks.sizes["band"])
    out = _Seen(np.zeros(shape), np.ones(shape[1]))
    touched = False
    for identification in identifications.identified:
        components = [component for component in identification.components if axis in component.row]
        touched |= bool(components)
        for component in components:
            _add(out, component, identifications, baseline, axis)
        numbers = next(
            (one for one in fitted if one.identification is identification and axis in one.axes),
            None,
        )
        effect = None if numbers is None else numbers.effect
        in_power = any(
            component.candidate.statistic == "power" for component in components
        )  # which has it with a free size
        if (
            numbers is not None
            and effect is not None
            and not in_power
            and any(_only_said(component, blocks) for component in components)
        ):
            out.known += _said(effect, blocks, axis)
            out.doubt = max(
                [
                    out.doubt,
                    *(
                        2.0 * one.stderr / abs(one.value)
                        for one in numbers.parameters.values()
                        if one.value
                    ),
                ]
            )
        if effect is not None and any(
            is_filter(component.candidate.statistic, component.variant) for component in components
        ):
            out.response = out.response * band_response(effect, blocks)
    return out if touched else None


def _only_said(component: Component, blocks: xr.Dataset) -> bool:
    """Whether the power of a part is in no column, but only in what the effect says of itself; with odd samples it may be left out."""
    return component.candidate.statistic == "cross" or (
        component.candidate.statistic == "marks"
        and not find_anomalous_blocks(component, blocks).any()
    )


def _add(
    out: _Seen,
    component: Component,
    identifications: Identifications,
    baseline: xr.Dataset,
    axis: str,
) -> None:
    statistic = component.candidate.statistic
    state = initial_state(identifications.state.blocks, baseline)
    if is_filter(statistic, component.variant):
        return
    if statistic == "transfer":
        out.known += _followed(component, replace(state, weight=identifications.state.weight))
    elif statistic == "phase_locked":
        out.known += _comb(component, replace(state, weight=identifications.state.weight))
    elif statistic in ("mean", "levels", "power", "order", "line"):
        given = condition_on_component(state, component).given
        out.free += [
            np.broadcast_to(one, out.known.shape) for one in given.get(("power", axis), [])
        ]
        out.means += given.get(("mean", axis), [])


def _followed(component: Component, state: State) -> Array:
    """Power that follows a channel or another axis, (block, band)."""
    mean, _ = component_mixture(component, state).moments()
    transfer = np.tensordot(mean, component.variant.design, axes=1)
    return np.asarray(
        np.abs(transfer) ** 2
        * np.nan_to_num(reference_channel_power(component.candidate.witness[0], state.blocks))
    )


def _comb(component: Component, state: State) -> Array:
    """Power of what is locked to the ramp: the lines of its mean over a turn, folded as samples see them, (block, band)."""
    blocks = state.blocks
    mean, _ = component_mixture(component, state).moments()
    profile = np.tensordot(mean, component.variant.design, axes=1)
    square = np.abs(np.fft.rfft(profile)[1:] / profile.size) ** 2
    turns, rate = np.abs(blocks["ramp_turns"].values), float(blocks.attrs["sampling_rate_hz"])
    turns = np.where(np.isfinite(turns), turns, 0.0)
    low, high = blocks["band_low"].values, blocks["band_high"].values
    out = np.zeros((turns.size, low.size))
    for number, size in enumerate(square, start=1):
        place = fold(number * turns, rate)[:, None]
        out += np.where(
            (place >= low) & (place < high) & (turns > 0.0)[:, None], size / (high - low), 0.0
        )
    return out


def _said(effect: Effect, blocks: xr.Dataset, axis: str) -> Array:
    """Power that an effect says it has on an axis, (block, band)."""
    windows = replace(make_windows(blocks, find_drivers(effect)), axes=(axis,))
    out = np.zeros((blocks.sizes["block"], blocks.sizes["band"]))
    many = {item.name: item.many for item in effect.parameters()}
    for name, density in effect.explain(windows).spectrum.items():
        size = getattr(effect, name)
        if many[name]:
            size = size[effect.axes.index(axis)] if len(size) > 1 else size[0]
        rows = np.asarray(density)
        out = out + float(size) ** 2 * (rows[0] if rows.ndim == 3 else rows)
    return np.asarray(spread_by_gaps(out[None], blocks.sel(axis=[axis]))[0])


def _posterior(state: State, row: int, seen: _Seen, chosen: NDArray[np.bool_]) -> Posterior | None:
    """Noise of an axis beside effects; None where too little is left to tell it by."""
    blocks = state.blocks
    power, shape = (
        blocks[name].transpose("axis", "block", "band").values[row] for name in ("power", "shape")
    )
    chosen = chosen & (np.isfinite(power) & np.isfinite(shape)).any(axis=1)
    if chosen.sum() < _LEAST:
        return None
    columns = noise_powers(blocks, seen.response)[row]
    common, alone = (one[row] for one in common_variance(blocks))
    fit = _fit(power, _weights(shape, alone, common), columns, state.weight[row], seen, chosen)
    square, information = fit_squares(fit)
    plain = float(
        (
            (fit.weight / (fit.start if fit.start is not None else fit.power) ** 2)
            * fit.columns[:, 1] ** 2
        ).sum()
    )
    if not information[1, 1] > _BLURRED * plain or not square[1] > 0.0:
        return None
    square = np.maximum(square, [0.0, floor_square(fit), 0.0, 0.0])
    count = blocks.sizes["axis"]
    variance = white_variance(blocks, np.tile(square, (count, 1)))[row]
    variance = variance * np.maximum(state.weight[row, :, 0] / (columns[:, 0] @ square), 0.1)
    mean = blocks["mean"].transpose("axis", "block").values[row]
    effects_there = np.stack(seen.means, axis=1) if seen.means else None
    return noise_posterior(
        fit,
        mean,
        variance,
        chosen & np.isfinite(mean),
        step=float(blocks.attrs["block_s"]),
        draws=DRAWS,
        rng=np.random.default_rng(row),
        effects=effects_there,
    )


def _weights(shape: Array, alone: Array, common: Array) -> Array:
    """Shapes of the powers, less what the common part of a block takes from them together."""
    each = np.nansum(alone, axis=1)
    share = each / (1.0 + common * each) / np.maximum(np.nansum(shape, axis=1), 1e-300)
    return np.asarray(shape * np.minimum(share, 1.0)[:, None])


def _fit(
    power: Array,
    shape: Array,
    columns: Array,
    expected: Array,
    seen: _Seen,
    chosen: NDArray[np.bool_],
) -> Fit:
    """Powers averaged over blocks of like level."""
    level = np.where(chosen, np.log(expected.mean(axis=1)), np.inf)
    groups = np.array_split(
        np.argsort(level, kind="stable")[: int(chosen.sum())], min(_GROUPS, int(chosen.sum()))
    )
    size = [max(float(np.abs(one).max()), 1e-300) for one in seen.free]
    components = [
        power,
        columns,
        seen.known,
        expected,
        *[one / top for one, top in zip(seen.free, size, strict=True)],
    ]
    means: list[list[Array]] = [[] for _ in components]
    weights = []
    for block_count in groups:
        use = np.where(
            np.isfinite(power[block_count]) & np.isfinite(shape[block_count]),
            shape[block_count],
            0.0,
        )
        total = use.sum(axis=0)
        safe = np.where(total > 0.0, total, 1.0)
        weights.append(total)
        for place, one in enumerate(components):
            wide = use[..., None] if one.ndim == 3 else use
            by = safe[:, None] if one.ndim == 3 else safe
            means[place].append((wide * np.nan_to_num(one[block_count])).sum(axis=0) / by)
    weight = np.concatenate(weights)
    some = weight > 0.0
    flat = [np.concatenate(one)[some] for one in means]
    beside = np.stack(flat[4:], axis=1) if len(flat) > 4 else np.empty((int(some.sum()), 0))
    known = flat[2][:, None]
    precision = np.zeros(beside.shape[1])
    if np.any(known > 0.0):  # what an effect is said to have is not known better than so
        beside, precision = (
            np.concatenate([beside, known], axis=1),
            np.append(precision, 1.0 / seen.doubt**2),
        )
    return Fit(
        flat[0],
        flat[1],
        weight[some],
        known=flat[2],
        free_columns=beside,
        precision=precision,
        start=flat[3],
    )


def with_noise(identifications: Identifications, baseline: xr.Dataset) -> Identifications:
    """The naming with designs for another noise: a share of N^2 is a share of the new one.

    Parameters
    ----------
    identifications : Naming
    baseline : xarray.Dataset
        With the new noise.
    """
    blocks = identifications.state.blocks
    swapped = {}
    for component in (
        component
        for identification in identifications.identified
        for component in identification.components
    ):
        one = component.candidate
        if one.statistic == "power" and id(one) not in swapped:
            made = [
                rebuild_variant(one, variant, blocks, baseline["coefficient"]) or variant
                for variant in one.variants
            ]
            swapped[id(one)] = (one, replace(one, variants=tuple(made)))

    def part_of(component: Component) -> Component:
        if id(component.candidate) not in swapped:
            return component
        old, new = swapped[id(component.candidate)]
        place = next(number for number, one in enumerate(old.variants) if one is component.variant)
        return replace(component, candidate=new, variant=new.variants[place])

    identified = tuple(
        replace(
            identification,
            components=tuple(part_of(component) for component in identification.components),
        )
        for identification in identifications.identified
    )
    candidates = tuple(
        swapped[id(one)][1] if id(one) in swapped else one for one in identifications.candidates
    )
    return replace(identifications, identified=identified, candidates=candidates)
