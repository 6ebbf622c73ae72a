"""The baseline of a simulated log: its noise, with its level over time and other statistics."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.calibrate import MIN_BANDS, assemble_baseline, calibrate_axes
from gyrostab.diagnose.baseline.expected_statistics import noise_powers, sum_noise
from gyrostab.diagnose.baseline.noise_level import quiescent_level, scale_axes
from gyrostab.diagnose.baseline.posterior import Posterior
from gyrostab.diagnose.baseline.quiescent import (
    find_quiescent_blocks,
    find_quiescent_spans,
    given_quiescent_blocks,
    noise_level_excess,
)
from gyrostab.diagnose.baseline.simulated import (
    add_extra_statistics,
    measure_extra_statistics,
    worst_band,
)
from gyrostab.diagnose.settings import DEFAULTS, Settings

Array = NDArray[np.float64]


def baseline_from_simulation(
    blocks: xr.Dataset, simulated: xr.Dataset, *, quiet: Any = None, settings: Settings = DEFAULTS
) -> xr.Dataset:
    """Take the noise of a simulated log with its calibration error, and its level over time.

    Its stationary statistics other than the five noise terms are taken as measured: the shape of
    its spectrum, coherency of axes, steady lines. What a simulation does to the means over time is
    indistinguishable from its random walk and therefore not known; `baseline_from_model` knows it.
    Both have the same blocks and axes (`gyrostab.diagnose.inputs.read_simulation`).

    Parameters
    ----------
    quiet : (start, end) or several of these, optional
        Quiescent time of the recording: one factor for each axis fits the noise of the simulation
        to it.
    """
    chosen = find_quiescent_blocks(simulated, settings=settings)
    posteriors, level, unexplained = _calibrate_simulation(simulated, chosen, settings)
    squares = [posterior.square for posterior in posteriors]
    plain = sum_noise(noise_powers(simulated), squares) * level[..., None]
    shown = measure_extra_statistics(simulated, plain, unexplained, settings=settings)
    noise = sum_noise(noise_powers(blocks), squares)
    attrs = {
        "source": "simulation",
        "calibrated_on": find_quiescent_spans(simulated, chosen),
    }
    spectrum = noise * level[..., None] * shown.form[:, None]
    given_blocks = given_quiescent_blocks(blocks, quiet, settings=settings)
    if given_blocks is not None:
        chosen = given_blocks
        attrs["calibrated_on"] = find_quiescent_spans(blocks, chosen)
        factor, error = quiescent_level(blocks, spectrum, 0.0 * spectrum, chosen)
        posteriors = scale_axes(blocks, posteriors, factor, error)
        spectrum = spectrum * factor[:, None, None]
    baseline = assemble_baseline(
        blocks, posteriors, quiet=chosen, attrs=attrs, spectrum=spectrum, settings=settings
    )
    return add_extra_statistics(baseline, shown, blocks)


def _calibrate_simulation(
    simulated: xr.Dataset, chosen: NDArray[np.bool_], settings: Settings
) -> tuple[list[Posterior], Array, NDArray[np.bool_]]:
    """Calibrate a simulation on the bands that the noise terms explain.

    Returns the noise of every axis, its level over time (axis, block), and the unexplained bands
    (axis, band).
    """
    columns = noise_powers(simulated)
    unexplained = np.zeros((simulated.sizes["axis"], simulated.sizes["band"]), np.bool_)
    while True:
        explained = simulated.assign(
            power=simulated["power"].where(~xr.DataArray(unexplained, dims=("axis", "band")))
        )
        posteriors = calibrate_axes(explained, chosen, settings)
        plain = sum_noise(columns, [posterior.square for posterior in posteriors])
        level = _level_over_time(explained, plain, settings)
        newly_unexplained = worst_band(
            explained, plain * level[..., None], min_sigma=settings.excess_sigma
        ) & (unexplained.sum(axis=1, keepdims=True) < unexplained.shape[1] - MIN_BANDS)
        if not newly_unexplained.any():
            return posteriors, level, unexplained
        unexplained |= newly_unexplained


def _level_over_time(simulated: xr.Dataset, plain: Array, settings: Settings) -> Array:
    """Return the noise level of every block (axis, block); 1 if not significant."""
    power, shape = (simulated[name].values for name in ("power", "shape"))
    level = np.ones(plain.shape[:2])
    for row in range(len(plain)):
        risen, deviation = noise_level_excess(
            power[row] / plain[row] - 1.0, shape[row], settings=settings
        )
        level[row] = np.where(deviation > settings.excess_sigma, risen, 1.0)
    return level
