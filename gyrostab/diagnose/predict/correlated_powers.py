"""Powers of slow random processes in the bands of a block."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.predict.linear_model import average_in_bands
from gyrostab.kernels.spectra.expected import correlated_powers
from gyrostab.kernels.spectra.periodogram import ordinates, taper
from gyrostab.physics.prediction import Prediction

Array = NDArray[Any]


def with_correlated_powers(prediction: Prediction, blocks: xr.Dataset) -> Prediction:
    """Return a prediction with the powers that blocks show of exponentially correlated processes.

    A block is shorter than the correlation time, so that the steep spectrum leaks into all bands:
    up to 1.4 times the density of the process. Frequencies of the spectra are equally many in every
    band.
    """
    spectrum = dict(prediction.spectrum)
    for name, (time, variance) in prediction.wander.items():
        if name in spectrum and np.isfinite(time):
            power = correlated_band_powers(blocks, time)
            per_band = spectrum[name].shape[-1] // power.size
            spectrum[name] = np.asarray(variance)[:, None] * np.repeat(power, per_band)
    return replace(prediction, spectrum=spectrum)


def is_correlated_bias(name: str, prediction: Prediction, blocks: xr.Dataset) -> bool:
    """Return whether a random process is a bias of random course that the block means show.

    A process faster than half a block shows in the powers alone; one of two levels by its course.
    """
    time, _ = prediction.wander.get(name, (0.0, None))
    is_slow = float(blocks.attrs["block_s"]) / 2.0 <= time < np.inf
    return is_slow and not prediction.levels


def correlated_band_powers(blocks: xr.Dataset, time: float) -> Array:
    """Return the expected power (band,) of a process of unit variance [Hz-1]."""
    size, rate = int(blocks.attrs["block_samples"]), float(blocks.attrs["sampling_rate_hz"])
    return average_in_bands(correlated_powers(taper(size), rate, ordinates(size), time), blocks)
