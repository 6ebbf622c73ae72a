"""Effect of a named filter on every spectrum of the record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.predict.windows import (
    FREQUENCIES_PER_BAND,
    frequencies_in_bands,
    make_windows,
)
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.kernels.spectra.line_levels import local_level
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Effect
from gyrostab.physics.prediction import Prediction
from gyrostab.physics.registry import effects
from gyrostab.physics.sampling import LoggerFilter

_SIZE_COUNT = 50  # filter sizes that are tried; limits resolution
_MIN_PASSED_SHARE = 0.002  # smallest passed share that is tried, besides 0
_MAX_LINE_RATIO = 3.0  # of the local level; higher lines are cut
_MIN_RESPONSE = 0.05  # of the largest; below, the power is leakage from other frequencies


def _estimate_size(power: Floats, full: Floats) -> float:
    """Estimate the filter size by the likelihood of its power ratios, at any level."""
    # Lines do not belong to the shape of the spectrum.
    usual = np.minimum(power, _MAX_LINE_RATIO * local_level(power[None])[0])
    passed = full >= _MIN_RESPONSE * full.max()
    shares = 1.0 - np.append(np.geomspace(1.0, _MIN_PASSED_SHARE, _SIZE_COUNT), 0.0)
    form = 1.0 + shares[:, None] * (full[passed] - 1.0)
    return float(
        shares[np.argmin(np.log((usual[passed] / form).mean(axis=1)) + np.log(form).mean(axis=1))]
    )


def band_response(effect: Effect, blocks: xr.Dataset) -> Floats:
    """Return the factor (band, term) on the power of the noise terms Q, N, B and K in each band.

    It is averaged over the power of the term at the frequencies of the band.
    """
    frequency, rate = frequencies_in_bands(blocks), float(blocks.attrs["sampling_rate_hz"])
    factors = []
    for symbol, response in filter_factors(effect, blocks, frequency).items():
        power = sampled_psd(symbol, frequency, rate)
        passed = _split_into_bands(power * response).mean(axis=1)
        factors.append(passed / _split_into_bands(power).mean(axis=1))
    return np.stack(factors, axis=-1)


def logger_responses(blocks: xr.Dataset) -> Floats:
    """Return the responses (filter, band, term) of the filters that a logger may have."""
    points = LoggerFilter.example().points(make_windows(blocks, {}))
    return np.stack([band_response(LoggerFilter.example(**values), blocks) for values in points])


def with_band_response(prediction: Prediction, effect: Effect, blocks: xr.Dataset) -> Prediction:
    """Return a prediction with its response averaged over each band, which may hold a zero."""
    if not prediction.response:
        return prediction
    factors = band_response(effect, blocks).T
    return replace(prediction, response=dict(zip(prediction.response, factors, strict=True)))


def band_shape_factor(effect: Effect, blocks: xr.Dataset) -> Floats:
    """Return the factor on the gamma shape of white noise in each band.

    Lines of unequal power have fewer degrees of freedom together than equal ones.
    """
    response = _split_into_bands(filter_factors(effect, blocks, frequencies_in_bands(blocks))["N"])
    return np.asarray(response.mean(axis=1) ** 2 / (response**2).mean(axis=1))


def _split_into_bands(values: Floats) -> Floats:
    """Return values at `frequencies_in_bands` as (band, frequency)."""
    return values.reshape(-1, FREQUENCIES_PER_BAND)


def filter_factors(effect: Effect, blocks: xr.Dataset, frequency: Floats) -> Mapping[str, Floats]:
    """Return the factors of a filter at frequencies, by noise term."""
    return effect.explain(replace(make_windows(blocks, {}), frequency=frequency)).response


def undo_filter(
    blocks: xr.Dataset, axis: str, effect: str, values: Mapping[str, Any], expected: Floats
) -> tuple[xr.Dataset, Bools]:
    """Undo a filter in the line spectrum of an axis, once only; return the lines that it stops.

    A filter is named by the shape of its response, at any size: a weak one is undone by as much as
    the spectrum requires. `values` are its parameters at its full size, `expected` (line,) is the
    density without it, up to a factor.
    """
    frequency = blocks["line_frequency"].values
    full = filter_factors(effects()[effect].example(**values), blocks, frequency)["N"]
    weight = axis_values(blocks, "line_weight", axis)
    power = axis_values(blocks, "line_power", axis)
    good = (weight > 0) & np.isfinite(power).all(axis=1)
    response = full
    if good.any():
        response = 1.0 + _estimate_size(
            np.average(power[good], axis=0, weights=weight[good]) / np.maximum(expected, 1e-300),
            full,
        ) * (full - 1.0)
    stopped = response < _MIN_RESPONSE * response.max()
    done = str(blocks.attrs.get("straightened", "")).split()
    if axis in done:
        return blocks, stopped
    is_axis = blocks["axis"] == axis
    factor = xr.DataArray(np.maximum(response, _MIN_RESPONSE * response.max()), dims="line")
    line_power = blocks["line_power"]
    return blocks.assign(line_power=line_power.where(~is_axis, line_power / factor)).assign_attrs(
        straightened=" ".join([*done, axis])
    ), stopped
