"""Known effects of a model in a record: means, band powers, cross-spectra, lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.expected_statistics import NOISE, band_columns
from gyrostab.diagnose.baseline.known_lines import average_in_bands, expect_lines, resonance_density
from gyrostab.diagnose.baseline.predicted_effects import complex_factors, predict_effect
from gyrostab.diagnose.baseline.sample_transfer import undo_transfer
from gyrostab.diagnose.predict.filter_response import band_response
from gyrostab.diagnose.predict.linear_model import (
    cross_without,
    moves_within_blocks,
    spread_by_gaps,
)
from gyrostab.diagnose.reduce.block_statistics import pair_indices
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.physics.base import Effect
from gyrostab.physics.logger_filter import LoggerFilter
from gyrostab.physics.prediction import Prediction
from gyrostab.simulate.model import Model
from gyrostab.units import HOUR

Array = NDArray[np.float64]
_EVERYWHERE = "lattice"  # the anomaly of every sample


class KnownEffects(NamedTuple):
    """Known effects of a model in the statistics of a record."""

    mean: Array  # (axis, block): [degree hour-1]
    #: (axis, block, band): expected power of noise and effects [degree2 hour-2 Hz-1].
    spectrum: Array
    #: (axis, block): share of the lowest band that is white noise of the means.
    white_share: Array
    #: Further variables of `gyrostab.diagnose.reduce.schema.BASELINE`, if there are any: the
    #: cross-spectrum, lines at full resolution, and random processes in the means.
    variables: dict[str, NDArray[Any]]
    left_out: list[str]  # effects that also show elsewhere


def expect_known_effects(blocks: xr.Dataset, model: Model, square: Array) -> KnownEffects:
    """Predict the known effects of a model in the record, given squares of the noise (axis, 4).

    Raises
    ------
    SchemaError
        If the recording lacks the channel of an effect.
    """
    acting = [_act_on_record(effect, model, blocks) for effect in model.effects]
    # Blocks with anomalous samples are found and left out.
    described = [active for active in acting if not _has_anomalous_samples(active)]
    powers = [power for active in described for power in _added_powers(active, blocks)]
    response = _filter_response(described, blocks)
    white_response = response[:, None, :, NOISE.index("N")]
    noise = np.einsum(
        "fn,afn,abn->abf",
        band_columns(blocks),
        response,
        np.maximum(_expected_squares(described, square, blocks), 0.0),
    )
    added = np.zeros(noise.shape)
    for extra in powers:
        added += extra.on_axes
    narrow = [
        (extra.acting.effect, extra.acting.rows, extra.on_axes)
        for extra in powers
        if extra.acting.prediction.line is not None and extra.factor.any()
    ]
    left = _share_left(acting, model, blocks)[..., None]
    spectrum = spread_by_gaps((noise + added * white_response) * left, blocks)
    variables = _shared_cross(powers, white_response, blocks)
    if narrow and "line_power" in blocks:
        variables |= expect_lines(blocks, narrow, white_response[:, 0])
    wandering, power = _add_up_wandering(described, blocks)
    return KnownEffects(
        mean=_expected_means(described, blocks),
        spectrum=spectrum,
        white_share=1.0 - power / spectrum[..., 0] if wandering else np.ones(power.shape),
        variables=variables | wandering,
        left_out=[
            active.effect.name
            for active in acting
            if _has_anomalous_samples(active) or _shows_elsewhere(active)
        ],
    )


class _ActingEffect(NamedTuple):
    """An effect of a model on a record."""

    effect: Effect
    rows: list[int]
    axes: tuple[str, ...]
    prediction: Prediction

    def sizes(self, name: str) -> Array:
        """Return a parameter on each of the axes."""
        return self.effect.expand_to_axes(name, self.axes)


class _AddedPower(NamedTuple):
    """Power added by an effect."""

    acting: _ActingEffect
    factor: NDArray[np.complex128]  # (axis,)
    density: Array  # (axis, block, band): for a factor of 1 [degree2 hour-2 Hz-1 per squared unit]

    @property
    def on_axes(self) -> Array:
        """Power on each axis, (axis, block, band) [degree2 hour-2 Hz-1]."""
        return np.asarray(np.abs(self.factor[:, None, None]) ** 2 * self.density)


def _act_on_record(effect: Effect, model: Model, blocks: xr.Dataset) -> _ActingEffect:
    """Predict an effect on the axes that it acts on, a filter at the rate of the instrument."""
    if isinstance(effect, LoggerFilter):
        effect = replace(effect, instrument=float(model.log.get("oversampling", 1)))
    axes = [str(axis) for axis in blocks["axis"].values]
    rows = [row for row, axis in enumerate(axes) if not effect.axes or axis in effect.axes]
    axis_names = tuple(axes[row] for row in rows)
    return _ActingEffect(effect, rows, axis_names, predict_effect(effect, blocks, axis_names))


def _has_anomalous_samples(active: _ActingEffect) -> bool:
    """Return whether an effect changes sample counts other than by a quantization grid."""
    return bool({*active.prediction.marks} - {_EVERYWHERE})


def _shows_elsewhere(active: _ActingEffect) -> bool:
    """Return whether an effect also shows outside means, powers and cross-spectra."""
    prediction = active.prediction
    # the variance describes random means of a constant correlation time without steps
    is_steady = not prediction.levels and all(
        _is_steady(*process) for process in prediction.wander.values()
    )
    elsewhere = prediction.marks or prediction.transfer or prediction.order
    if elsewhere or prediction.phase_locked or not is_steady:
        return True
    is_shown = prediction.mean or prediction.level or prediction.spectrum
    return not is_shown and not prediction.response


def _is_steady(time: float, variance: Array) -> bool:
    """Return whether a process has a constant variance, or is a walk."""
    return bool(np.isinf(time) or np.ptp(variance) == 0.0)


def _expected_means(acting: Sequence[_ActingEffect], blocks: xr.Dataset) -> Array:
    """Return the rates that effects add, (axis, block) [degree hour-1]."""
    mean = np.zeros((blocks.sizes["axis"], blocks.sizes["block"]))
    for active in acting:
        for name, values in active.prediction.mean.items():
            mean[active.rows] += active.sizes(name)[:, None] * values
    return mean


def _expected_squares(acting: Sequence[_ActingEffect], square: Array, blocks: xr.Dataset) -> Array:
    """Return squared noise coefficients including effects, (axis, block, noise)."""
    level = np.repeat(square[:, None], blocks.sizes["block"], axis=1)
    for active in acting:
        for (term, name), values in active.prediction.level.items():
            axis_square = square[active.rows, None, NOISE.index(term)]
            change = axis_square * active.sizes(name)[:, None] * values
            level[active.rows, :, NOISE.index(term)] += change
    return level


def _added_powers(active: _ActingEffect, blocks: xr.Dataset) -> list[_AddedPower]:
    """Return the powers that an effect adds, one for each of its spectra."""
    out, bands = [], blocks.sizes["band"]
    for name, values in active.prediction.spectrum.items():
        factor = np.zeros(blocks.sizes["axis"], np.complex128)
        factor[active.rows] = complex_factors(active.effect, name, active.axes)
        density = np.zeros((factor.size, blocks.sizes["block"], bands))
        peak = resonance_density(active.effect, name, blocks, active.axes)
        density[active.rows] = (
            values.reshape(*values.shape[:-1], bands, -1).mean(axis=-1)
            if peak is None
            else average_in_bands(peak, blocks)
        )
        out.append(_AddedPower(active, factor, density))
    return out


def _filter_response(acting: Sequence[_ActingEffect], blocks: xr.Dataset) -> Array:
    """Return the factors of filters on the noise terms, (axis, band, term)."""
    response = np.ones((blocks.sizes["axis"], blocks.sizes["band"], len(NOISE)))
    for active in acting:
        if active.prediction.response:
            response[active.rows] *= band_response(active.effect, blocks)
    return response


def _share_left(acting: Sequence[_ActingEffect], model: Model, blocks: xr.Dataset) -> Array:
    """Return the share of the noise that effects on single samples leave, (axis, block)."""
    share = np.ones((blocks.sizes["axis"], blocks.sizes["block"]))
    rate = float(blocks.attrs["sampling_rate_hz"]) * float(model.log.get("oversampling", 1))
    for active in acting:
        if active.effect.transfer(np.zeros(1)) is None:
            continue
        for row, axis in zip(active.rows, active.axes, strict=True):
            variance = model.coefficients(axis)["N"] ** 2 * HOUR * rate
            mean = blocks["mean"].values[row]
            share[row] *= undo_transfer(active.effect.transfer, mean, variance, known=True).share
    return share


def _shared_cross(
    powers: Sequence[_AddedPower], response: Array, blocks: xr.Dataset
) -> dict[str, NDArray[Any]]:
    """Return the cross-spectrum of coherent effects after a filter (axis, 1, band), if any."""
    if "cross" not in blocks:
        return {}
    pairs = pair_indices(blocks).T
    shared = np.zeros((len(pairs), blocks.sizes["block"], blocks.sizes["band"]), np.complex128)
    for power in (power for power in powers if power.acting.prediction.coherent):
        for number, (row, other_row) in enumerate(pairs):
            factor_product = power.factor[row] * np.conj(power.factor[other_row])
            shared[number] += factor_product * np.sqrt(
                power.density[row] * power.density[other_row]
            )
    for number, (row, other_row) in enumerate(pairs):
        shared[number] *= np.sqrt(response[row] * response[other_row])
    return {"cross": spread_by_gaps(shared, blocks, "pair")} if shared.any() else {}


def _add_up_wandering(
    acting: Sequence[_ActingEffect], blocks: xr.Dataset
) -> tuple[dict[str, NDArray[Any]], Array]:
    """Return the random means of all effects, if any, and their power in the lowest band.

    They are not white noise of the means, whatever they add to that band (axis, block).
    """
    axes, block_count, bands = (blocks.sizes[name] for name in ("axis", "block", "band"))
    square, time = [], []
    walk, power = np.zeros((axes, block_count)), np.zeros((axes, block_count))
    for active in acting:
        prediction = active.prediction
        for name, (memory, variance) in prediction.wander.items():
            if prediction.levels or not _is_steady(memory, variance):
                continue
            size = np.zeros(axes)
            size[active.rows] = active.sizes(name) ** 2
            if np.isinf(memory):
                walk += size[:, None] * variance
            else:
                square.append(size * variance[0])
                time.append(memory)
            if name in prediction.spectrum:
                density = np.asarray(prediction.spectrum[name])
                by_band = density.reshape(-1, block_count, bands, density.shape[-1] // bands)
                power += size[:, None] * by_band[0, :, 0].mean(axis=-1)
    squares = np.array(square).reshape(-1, axes).T
    if not (squares.any() or walk.any()):
        return {}, power
    return {"wander_square": squares, "wander_time": np.array(time), "wander_walk": walk}, power


def expect_known_motion(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> NDArray[np.bool_]:
    """Find the blocks in which a known mean moves far above its noise, (axis, block).

    None on an axis where most blocks move. The mean of such a block is known, but not the motion
    within it, whose spectrum would be compared with that of noise.
    """
    return moves_within_blocks(
        baseline["known_mean"].values, baseline["spectrum"].values[..., 0], blocks, settings
    )


def remove_known_motion(
    blocks: xr.Dataset, baseline: xr.Dataset, *, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Drop powers, kurtosis and cross-spectra of blocks in which a known mean moves."""
    moving = expect_known_motion(blocks, baseline, settings=settings)
    if not moving.any():
        return blocks
    still = xr.DataArray(~moving, dims=("axis", "block"))
    out = blocks.assign(
        {name: blocks[name].where(still) for name in ("power", "kurtosis") if name in blocks}
    )
    return out.assign(cross=cross_without(blocks, moving)) if "cross" in blocks else out
