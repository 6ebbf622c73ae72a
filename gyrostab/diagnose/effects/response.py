"""What a filter that is named does to every spectrum of the record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.effects.candidates import Variant, windows_of
from gyrostab.physics.base import Effect
from gyrostab.physics.registry import effects

__all__ = ["is_filter", "response_of", "straightened"]

Array = NDArray[np.float64]
_INSIDE = 24  # frequencies in a band
_STOPPED = 0.05  # of the largest response, below which what is seen is leakage from elsewhere


def is_filter(view: str, variant: Variant) -> bool:
    """Whether a variant multiplies the spectrum rather than adds to it."""
    return view == "power" and not variant.columns


def response_of(effect: Effect, reduced: xr.Dataset) -> Array:
    """Factor of the noise in the bands: the mean over the frequencies of each, for a filter is steep."""
    low, high = reduced["band_low"].values, reduced["band_high"].values
    place = (np.arange(_INSIDE) + 0.5) / _INSIDE
    frequency = (low[:, None] + (high - low)[:, None] * place).ravel()
    return np.asarray(_response(effect, reduced, frequency).reshape(low.size, _INSIDE).mean(axis=1))


def _response(effect: Effect, reduced: xr.Dataset, frequency: Array) -> Array:
    found = effect.explain(replace(windows_of(reduced, {}), frequency=frequency)).response
    return np.ones(frequency.size) if found is None else np.asarray(found)


def straightened(reduced: xr.Dataset, axis: str, effect: str, values: Mapping[str, Any]) -> tuple[xr.Dataset, NDArray[np.bool_]]:
    """The record with the line spectrum of an axis as it was before a filter, once only; and the lines that the filter stops."""
    frequency = reduced["line_frequency"].values
    response = _response(effects()[effect].example(**values), reduced, frequency)
    stopped = response < _STOPPED * response.max()
    done = str(reduced.attrs.get("straightened", "")).split()
    if axis in done:
        return reduced, stopped
    here = reduced["axis"] == axis
    factor = xr.DataArray(np.maximum(response, _STOPPED * response.max()), dims="line")
    power = reduced["line_power"]
    return reduced.assign(line_power=power.where(~here, power / factor)).assign_attrs(straightened=" ".join([*done, axis])), stopped
