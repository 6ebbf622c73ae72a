"""Estimate the constant rate and the noise of each axis of a model with its effects."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.baseline.expected_statistics import N_TERM, NOISE, PassedNoise, undo_transfer
from gyrostab.diagnose.baseline.from_model import expect_ramp, fit_noise_factor
from gyrostab.diagnose.baseline.known_effects import expect_known_effects
from gyrostab.diagnose.predict.windows import predict_effect
from gyrostab.diagnose.reduce.schema import weighted_mean
from gyrostab.physics.base import Effect
from gyrostab.simulate.model import read_model
from gyrostab.units import HOUR

_MIN_GAIN = 0.05  # of slow changes; with less, the record does not show them


def constant_rates(
    blocks: xr.Dataset,
    effects: Sequence[Effect],
    turning: str = "",
    ramp: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Return the rate that a simulation adds on each axis to have the mean of the recording.

    Where values are rounded, clipped or stuck at zero depends on the constant rate, which the
    comparison leaves free otherwise. It is by axis [degree hour-1], and 0 without a block mean.
    `effects` are all of the model, with their sizes; `turning` is the axis that feels the channel
    ``rotation_rate``, if any; `ramp` is R of the axes [degree hour-2].
    """
    axes = tuple(str(axis) for axis in blocks["axis"].values)
    slopes = np.array([(ramp or {}).get(axis, 0.0) for axis in axes])
    rate = blocks["mean"].values - expect_ramp(blocks, slopes)
    changed = _changed_rows(axes, effects)
    for effect in effects:
        if any(effect is other for _, other in changed):
            continue
        effect_axes = tuple(axis for axis in axes if not effect.axes or axis in effect.axes)
        rows = [axes.index(axis) for axis in effect_axes]
        for name, design in predict_effect(effect, blocks, effect_axes).mean.items():
            sizes = effect.expand_to_axes(name, effect_axes)
            rate[rows] -= sizes[:, None] * np.atleast_2d(design)
    if turning in axes and "channel_rotation_rate" in blocks:
        rate[axes.index(turning)] -= HOUR * blocks["channel_rotation_rate"].values
    for row, effect in changed:
        recorded = blocks["mean"].values[row]
        rate[row] += _noise_before(effect, blocks, row).mean - recorded
    means, _ = weighted_mean(rate, blocks["samples"].values, axis=1)
    return dict(zip(axes, means.tolist(), strict=True))


def undo_noise_loss(
    noise: Mapping[str, Mapping[str, float]], blocks: xr.Dataset, effects: Sequence[Effect]
) -> dict[str, dict[str, float]]:
    """Return the noise coefficients by axis and term, as before effects that reduce the noise.

    Truncation towards zero, limits and dead zones change each sample for itself. Rounding adds the
    square of the step over 12 to the variance, which is taken out of the noise.
    """
    out = {axis: dict(terms) for axis, terms in noise.items()}
    axes, rate = tuple(out), float(blocks.attrs["sampling_rate_hz"])
    for row, effect in _changed_rows(axes, effects):
        passed = _noise_before(effect, blocks, row)
        added = getattr(effect, "step", 0.0) ** 2 / 12.0
        lost = passed.variance - (_variance_of_axis(blocks, row) - added)
        terms = out[axes[row]]
        terms["N"] = float(f"{math.sqrt(max(terms['N'] ** 2 + lost / (HOUR * rate), 0.0)):.6g}")
        for term in ("B", "K"):
            terms[term] = float(f"{terms[term] / max(passed.gain, _MIN_GAIN):.6g}")
    return out


def fit_white_noise(
    tables: Mapping[str, Any], baseline: xr.Dataset, blocks: xr.Dataset, axes: Collection[str]
) -> dict[str, float]:
    """Return N of some recalibrated axes [degree hour-1/2] with the effects at their final sizes.

    The noise was calibrated with sizes that are free. The final ones, averaged over lags and noise,
    add another power, as would noise that is referred to a temperature far from the recorded ones.

    Parameters
    ----------
    tables : mapping
        Those of the model.
    baseline : xarray.Dataset
        The baseline with the noise of the model; its recalibrated axes have their blocks in
        ``quiet``.
    """
    model = read_model(dict(tables))
    all_axes = [str(axis) for axis in blocks["axis"].values]
    coefficients = [model.coefficients(axis) for axis in all_axes]
    square = np.array([[of_axis[term] ** 2 for term in NOISE] for of_axis in coefficients])
    others = square.copy()
    others[:, N_TERM] = 0.0
    spectrum, added = (
        expect_known_effects(blocks, model, part).spectrum for part in (square, others)
    )
    out = {}
    for axis in axes:
        row = all_axes.index(axis)
        chosen = baseline["quiet"].values[row]
        noise = spectrum[row] - added[row]
        fitted = fit_noise_factor(blocks.isel(axis=[row]), noise, added[row], chosen)
        if fitted is not None:
            out[axis] = math.sqrt(square[row, N_TERM] * fitted[0])
    return out


def _variance_of_axis(blocks: xr.Dataset, row: int) -> float:
    """Return the variance of the samples of an axis about their block means."""
    variance = blocks["variance"].values[row]
    return float(weighted_mean(variance, blocks["samples"].values[row])[0])


def _changed_rows(axes: tuple[str, ...], effects: Sequence[Effect]) -> list[tuple[int, Effect]]:
    """Return rows of the axes, and the effects that reduce their noise sample by sample."""
    return [
        (row, effect)
        for effect in effects
        if effect.transfer(np.zeros(1)) is not None
        for row, axis in enumerate(axes)
        if not effect.axes or axis in effect.axes
    ]


def _noise_before(effect: Effect, blocks: xr.Dataset, row: int) -> PassedNoise:
    mean = blocks["mean"].values[row]
    return undo_transfer(effect.transfer, mean, _variance_of_axis(blocks, row))
