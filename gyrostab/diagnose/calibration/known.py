"""What the effects of a model make of a record, as far as they are known beforehand: means, band powers, cross-spectra, lines."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.calibration.expected import NOISE, band_columns
from gyrostab.diagnose.effects.candidates import windows_of
from gyrostab.diagnose.effects.cells import effective, pair_rows
from gyrostab.diagnose.effects.response import inside_bands, response_of
from gyrostab.physics.base import Effect, driver_error
from gyrostab.physics.prediction import Prediction
from gyrostab.simulate.model import Model

__all__ = ["Known", "drivers_of", "known_effects"]

Array = NDArray[np.float64]


class Known(NamedTuple):
    """Effects of a model in the statistics of a record.

    Attributes
    ----------
    mean : ndarray, shape (axis, block)
        [degree hour-1]
    spectrum : ndarray, shape (axis, block, band)
        Expected power of noise and effects [degree2 hour-2 Hz-1].
    cross : ndarray of complex, shape (pair, block, band), or None
        Expected cross-spectrum [degree2 hour-2 Hz-1]; None where the axes share nothing.
    left_out : list of str
        Effects that show elsewhere too.
    """

    mean: Array
    spectrum: Array
    cross: NDArray[np.complex128] | None
    left_out: list[str]


def known_effects(reduced: xr.Dataset, model: Model, square: Array) -> Known:
    """What the effects of a model make of the record.

    Parameters
    ----------
    reduced : xarray.Dataset
    model : Model
    square : ndarray, shape (axis, 4)
        Squared noise coefficients.

    Raises
    ------
    SchemaError
        When the recording lacks the channel of an effect.
    """
    axes = [str(axis) for axis in reduced["axis"].values]
    blocks, bands = reduced.sizes["block"], reduced.sizes["band"]
    mean, level = np.zeros((len(axes), blocks)), np.repeat(square[:, None], blocks, axis=1)
    added, response, left_out = np.zeros((len(axes), blocks, bands)), np.ones((len(axes), 1, bands)), []
    pairs = [(axes.index(a), axes.index(b)) for a, b in pair_rows(reduced)] if "cross" in reduced else []
    shared = np.zeros((len(pairs), blocks, bands), np.complex128)
    for effect in model.effects:
        rows = [row for row, axis in enumerate(axes) if not effect.axes or axis in effect.axes]
        own = tuple(axes[row] for row in rows)
        seen = _explained(effect, reduced, own)
        for name, values in seen.mean.items():
            mean[rows] += _sizes(effect, name, own)[:, None] * values
        for (term, name), values in seen.level.items():
            level[rows, :, NOISE.index(term)] += square[rows, None, NOISE.index(term)] * _sizes(effect, name, own)[:, None] * values
        for name, values in seen.spectrum.items():
            factor = np.zeros(len(axes), np.complex128)
            factor[rows] = _factors(effect, name, own)
            density = np.zeros((len(axes), blocks, bands))
            density[rows] = values.reshape(*values.shape[:-1], bands, -1).mean(axis=-1)
            added += np.abs(factor[:, None, None]) ** 2 * density
            for number, (one, other) in enumerate(pairs if seen.coherent else ()):
                shared[number] += factor[one] * np.conj(factor[other]) * np.sqrt(density[one] * density[other])
        if seen.response is not None:
            response[rows] *= response_of(effect, reduced)
        elsewhere = seen.marks or seen.wander or seen.transfer or seen.order or seen.phase_locked
        if elsewhere or not (seen.mean or seen.level or seen.spectrum or seen.response is not None):
            left_out.append(effect.name)
    spectrum = (np.einsum("fn,abn->abf", band_columns(reduced), np.maximum(level, 0.0)) + added) * response
    for number, (one, other) in enumerate(pairs):
        shared[number] *= np.sqrt(response[one] * response[other])
    cross = effective(shared, reduced, "pair") if shared.any() else None
    return Known(mean, effective(spectrum, reduced), cross, left_out)


def drivers_of(effect: Effect) -> dict[str, str]:
    """Channel of the effect -> its name in the log."""
    return {role: effect.channel_names()[role] for role in effect.needs()}


def _explained(effect: Effect, reduced: xr.Dataset, axes: tuple[str, ...]) -> Prediction:
    """What an effect predicts for the record on some of its axes; spectra at many frequencies in each band, since a peak may be narrow."""
    drivers = drivers_of(effect)
    present = [str(name).removeprefix("channel_") for name in reduced.data_vars if str(name).startswith("channel_")]
    for role, name in drivers.items():
        if name not in present:
            raise driver_error(effect, role, present)
    return effect.explain(replace(windows_of(reduced, drivers), axes=axes, frequency=inside_bands(reduced)))


def _sizes(effect: Effect, name: str, axes: tuple[str, ...]) -> Array:
    """A parameter for each axis."""
    known = {one.name: one for one in effect.parameters()}
    return effect.each(name, axes) if known[name].many else np.full(len(axes), float(getattr(effect, name)))


def _factors(effect: Effect, name: str, axes: tuple[str, ...]) -> NDArray[np.complex128]:
    """Factor that each axis has of a spectrum: its size, the share of its direction, the phase of a steady line."""
    known = {one.name: one for one in effect.parameters()}
    factor = _sizes(effect, name, axes).astype(np.complex128)
    if "direction" in known:
        factor *= _sizes(effect, "direction", axes)
    if "phase" in known and known["phase"].many:
        factor *= np.exp(1j * np.radians(_sizes(effect, "phase", axes)))
    return factor
