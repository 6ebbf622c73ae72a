"""Predictions of the known effects of a model, and their factors on each axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.filter_response import frequencies_in_bands
from gyrostab.diagnose.predict.windows import channel_units, make_windows
from gyrostab.physics.base import Effect, driver_error
from gyrostab.physics.prediction import Prediction

Array = NDArray[np.float64]


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


def complex_factors(effect: Effect, name: str, axes: tuple[str, ...]) -> NDArray[np.complex128]:
    """Return the complex factor of a spectrum for each axis: size, direction, phase."""
    parameters = {parameter.name: parameter for parameter in effect.parameters()}
    factor = effect.expand_to_axes(name, axes).astype(np.complex128)
    if "direction" in parameters:
        factor *= effect.expand_to_axes("direction", axes)
    if "phase" in parameters and parameters["phase"].many:
        factor *= np.exp(1j * np.radians(effect.expand_to_axes("phase", axes)))
    return factor
