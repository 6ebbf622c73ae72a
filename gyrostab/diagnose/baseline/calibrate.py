"""Calibration of the stationary noise that a record is compared with, on its quiescent time.

Band powers of the quiescent blocks give Q, N and part of B and K; block means give the slow part of
B and K. The posterior is kept as draws, so that null records include the calibration error.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Bools, Floats
from gyrostab.diagnose.baseline.assemble import assemble_baseline
from gyrostab.diagnose.baseline.expected_statistics import (
    noise_powers,
    reduced_shape,
    white_variance,
)
from gyrostab.diagnose.baseline.foreign_bands import has_foreign_bands, keep_explained_bands
from gyrostab.diagnose.baseline.posterior import (
    BandPowers,
    Posterior,
    average_blocks,
    fit_filter_response,
    fit_squares,
    noise_posterior,
    with_floor,
)
from gyrostab.diagnose.baseline.quiescent import find_quiescent_blocks, find_quiescent_spans
from gyrostab.diagnose.predict.filter_response import logger_responses
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.errors import SchemaError


def calibrate_noise(
    blocks: xr.Dataset, *, quiet: Any = None, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Calibrate the noise of every axis on quiescent blocks.

    Parameters
    ----------
    quiet : (start, end) or several of these, optional
        Known quiescent time: seconds since the start, or ISO times. By default blocks with little
        vibration, steady temperature, no rotation, some time after a restart, and no more noise
        than most.

    Returns
    -------
    xarray.Dataset
        Variables of `gyrostab.diagnose.reduce.schema.BASELINE`. A ramp is an effect, so that R is
        0, with its error.

    Raises
    ------
    OptionError
        If `quiet` lies outside the record.
    SchemaError
        If an axis has no spectra to calibrate on.

    Examples
    --------
    >>> from gyrostab.diagnose.reduce.block_statistics import reduce_log
    >>> from gyrostab.simulate import simulate
    >>> model = {"log": {"axes": ["x"]}, "noise": {"N": 0.003}}
    >>> baseline = calibrate_noise(reduce_log(simulate(model, duration="1h", rate=10.0, seed=3)))
    >>> N = baseline.sel(axis="x", term="N")
    >>> error = (N.coefficient - 0.003) / N.stderr
    >>> bool(abs(error) < 4.0), baseline.attrs["source"]
    (True, 'calibrated')
    """
    quiescent = find_quiescent_blocks(blocks, quiet, settings=settings)
    attrs = {"source": "calibrated", "calibrated_on": find_quiescent_spans(blocks, quiescent)}
    posteriors = calibrate_axes(blocks, quiescent, settings)
    return assemble_baseline(
        blocks, posteriors, quiescent=quiescent, attrs=attrs, settings=settings
    )


def calibrate_on_training_blocks(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    training: Bools,
    *,
    responses: Callable[[], Floats] | None = None,
    settings: Settings = DEFAULTS,
) -> xr.Dataset:
    """Calibrate the noise again on the quiescent blocks among the training blocks (block,).

    A baseline that is not that of `calibrate_noise` is returned as it is, and so is one of which
    too few such blocks have a spectrum. `responses` gives the `logger_responses` of the blocks,
    which are the same for any training blocks; they are computed if it is not given.
    """
    has_spectrum = np.isfinite(blocks["power"].values).any(axis=-1)
    quiescent = baseline["quiet"].values & training & has_spectrum
    if (
        baseline.attrs.get("source") != "calibrated"
        or "recalibrated" in baseline.attrs
        or quiescent.sum(axis=1).min() < settings.min_quiescent_blocks
    ):
        return baseline
    posteriors = calibrate_axes(blocks, quiescent, settings, responses)
    return assemble_baseline(
        blocks, posteriors, quiescent=quiescent, attrs=baseline.attrs, settings=settings
    )


def calibrate_axes(
    blocks: xr.Dataset,
    quiescent: Bools,
    settings: Settings,
    responses: Callable[[], Floats] | None = None,
) -> list[Posterior]:
    """Compute the noise of every axis from its quiescent blocks (axis, block)."""
    posteriors = []
    responses = responses or partial(logger_responses, blocks)
    for row, bands in enumerate(_fit_quiescent_powers(blocks, quiescent, responses, settings)):
        explained = keep_explained_bands(bands, settings)
        square = with_floor(fit_squares(explained)[0], explained)
        variance = white_variance(blocks, square[None])[row]
        levels = _level_columns(quiescent[row], settings.min_quiescent_blocks)
        posterior = noise_posterior(bands, blocks, row, variance, quiescent[row], levels, settings)
        squares_for_means = None if explained is bands else square
        posteriors.append(posterior._replace(squares_for_means=squares_for_means))
    return posteriors


def _level_columns(quiescent: Bools, min_blocks: int) -> Floats:
    """Return steps that give each quiescent stretch its own level, (block, step).

    What moves the bias between two stretches, vibration for instance, is not noise of either. A
    stretch that is shorter than `min_blocks` continues with the next: the level of each costs one
    increment of the random walk in `min_blocks`.

    Examples
    --------
    >>> _level_columns(np.array([1, 1, 0, 1, 1, 0, 0, 1], bool), 2).T
    array([[0., 0., 0., 1., 1., 1., 1., 1.],
           [0., 0., 0., 0., 0., 0., 0., 1.]])
    >>> _level_columns(np.array([1, 1, 0, 1, 1, 0, 0, 1], bool), 3).T
    array([[0., 0., 0., 0., 0., 0., 0., 1.]])
    """
    starts = np.flatnonzero(quiescent & ~np.append(False, quiescent[:-1]))
    block = np.arange(quiescent.size)
    columns: list[Floats] = []
    last = 0
    for first in starts.tolist():
        if quiescent[last:first].sum() >= min_blocks:
            columns.append((block >= first).astype(np.float64))
            last = first
    return np.stack(columns, axis=1) if columns else np.empty((quiescent.size, 0))


def _fit_quiescent_powers(
    blocks: xr.Dataset, quiescent: Bools, responses: Callable[[], Floats], settings: Settings
) -> list[BandPowers]:
    """Return the powers of every axis as a sum of noise terms, behind a filter if it takes one.

    It does where some bands are foreign to the noise terms alone, and none behind the filter.
    """
    bands_by_axis = _average_quiescent(blocks, quiescent, noise_powers(blocks))
    if (
        not any(has_foreign_bands(bands, settings) for bands in bands_by_axis)
        or min(bands.power.size for bands in bands_by_axis) < blocks.sizes["band"]
    ):
        return bands_by_axis
    response = fit_filter_response(responses(), bands_by_axis, settings=settings)
    if response is None:
        return bands_by_axis
    filtered = _average_quiescent(blocks, quiescent, noise_powers(blocks, response))
    return (
        bands_by_axis if any(has_foreign_bands(bands, settings) for bands in filtered) else filtered
    )


def _average_quiescent(blocks: xr.Dataset, quiescent: Bools, columns: Floats) -> list[BandPowers]:
    """Average the quiescent powers of every axis; columns (axis, block, band, term)."""
    power, shape = blocks["power"].values, reduced_shape(blocks)
    bands_by_axis = []
    for row, axis in enumerate(blocks["axis"].values):
        use = quiescent[row]
        bands = average_blocks(power[row][use], shape[row][use], columns[row][use])
        band_count = np.count_nonzero(bands.power > 0.0)
        if band_count < 4:
            raise SchemaError(
                f"axis {axis}: the quiescent blocks hold noise in {band_count} bands, too few to "
                "calibrate on; give other stretches with --quiet, leave the axis out (--axis), or "
                "diagnose a part of the record with fewer gaps"
            )
        bands_by_axis.append(bands)
    return bands_by_axis
