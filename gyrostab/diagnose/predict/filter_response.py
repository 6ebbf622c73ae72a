"""What a filter that is named does to every spectrum of the record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.spectral_lines import local_level
from gyrostab.diagnose.predict.candidates import Variant, windows_of
from gyrostab.physics.base import Effect
from gyrostab.physics.registry import effects

__all__ = ["inside_bands", "is_filter", "response_of", "straightened"]

Array = NDArray[np.float64]
_INSIDE = 48  # frequencies in a band
_SHARES, _PASSED = (
    50,
    0.002,
)  # sizes that are tried; least share that a filter of full form lets pass by
_LOUD = 3.0  # times the level about, beyond which a line is cut
_STOPPED = 0.05  # of the largest response, below which what is seen is leakage from elsewhere


def _share(power: Array, full: Array) -> float:
    """Share of what a filter takes at its full size, by the likelihood of powers over those without it, whatever their level."""
    usual = np.minimum(power, _LOUD * local_level(power[None])[0])  # a line is no part of the form
    passed = full >= _STOPPED * full.max()
    shares = 1.0 - np.append(np.geomspace(1.0, _PASSED, _SHARES), 0.0)
    form = 1.0 + shares[:, None] * (full[passed] - 1.0)
    return float(
        shares[np.argmin(np.log((usual[passed] / form).mean(axis=1)) + np.log(form).mean(axis=1))]
    )


def is_filter(statistic: str, variant: Variant) -> bool:
    """Whether a variant multiplies the spectrum rather than adds to it."""
    return statistic == "power" and not variant.columns


def response_of(effect: Effect, blocks: xr.Dataset) -> Array:
    """Factor of the noise in the bands: the mean over the frequencies of each, for a filter is steep."""
    return np.asarray(
        _response(effect, blocks, inside_bands(blocks)).reshape(-1, _INSIDE).mean(axis=1)
    )


def inside_bands(blocks: xr.Dataset) -> Array:
    """Frequencies evenly inside of every band, as many in each, one band after the other [Hz]."""
    low, high = blocks["band_low"].values, blocks["band_high"].values
    place = (np.arange(_INSIDE) + 0.5) / _INSIDE
    return np.asarray((low[:, None] + (high - low)[:, None] * place).ravel())


def _response(effect: Effect, blocks: xr.Dataset, frequency: Array) -> Array:
    found = effect.explain(replace(windows_of(blocks, {}), frequency=frequency)).response
    return np.ones(frequency.size) if found is None else np.asarray(found)


def straightened(
    blocks: xr.Dataset, axis: str, effect: str, values: Mapping[str, Any], expected: Array
) -> tuple[xr.Dataset, NDArray[np.bool_]]:
    """The record with the line spectrum of an axis as it was before a filter, once only; and the lines that the filter stops.

    A filter is named by the form of what it takes, of any size: a weak one is straightened by as
    much as the spectrum asks for.

    Parameters
    ----------
    blocks : xarray.Dataset
    axis : str
    effect : str
    values : mapping
        Of the filter at its full size.
    expected : ndarray, shape (line,)
        Density without it, but for a factor.
    """
    frequency = blocks["line_frequency"].values
    full = _response(effects()[effect].example(**values), blocks, frequency)
    weight, power = (
        blocks["line_weight"].sel(axis=axis).values,
        blocks["line_power"].sel(axis=axis).transpose("part", "line").values,
    )
    good = (weight > 0) & np.isfinite(power).all(axis=1)
    response = full
    if good.any():
        response = 1.0 + _share(
            np.average(power[good], axis=0, weights=weight[good]) / np.maximum(expected, 1e-300),
            full,
        ) * (full - 1.0)
    stopped = response < _STOPPED * response.max()
    done = str(blocks.attrs.get("straightened", "")).split()
    if axis in done:
        return blocks, stopped
    here = blocks["axis"] == axis
    factor = xr.DataArray(np.maximum(response, _STOPPED * response.max()), dims="line")
    before = blocks["line_power"]
    return blocks.assign(line_power=before.where(~here, before / factor)).assign_attrs(
        straightened=" ".join([*done, axis])
    ), stopped
