"""Random effects of a model on the means: exponentially correlated biases, and random walks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.reduce.schema import BASELINE, label_variables
from gyrostab.physics.prediction import Prediction

__all__ = ["Wandering", "add_up_wandering", "is_described_by_variance", "with_wandering"]

Array = NDArray[np.float64]


class Wandering(NamedTuple):
    """Random means of all axes."""

    square: Array  # (axis, process): variances of exponentially correlated biases [degree2 hour-2]
    time: Array  # (process,): their correlation times [s]
    walk: Array  # (axis, block): growth of the variance of random walks [degree2 hour-2 s-1]
    power: Array  # (axis, block): power of all of them in the lowest band [degree2 hour-2 Hz-1]


def is_described_by_variance(visible: Prediction) -> bool:
    """Return whether the variance fully describes what an effect does to the means at random.

    It does for a constant correlation time without steps.
    """
    return not visible.levels and all(_is_steady(*process) for process in visible.wander.values())


def _is_steady(time: float, variance: Array) -> bool:
    """Return whether a process has a constant variance, or is a walk."""
    return bool(np.isinf(time) or np.ptp(variance) == 0.0)


def add_up_wandering(
    effects: Sequence[tuple[Mapping[str, Array], Prediction]],
    *,
    bands: int,
    block_count: int,
    axes: int,
) -> Wandering:
    """Add up the random means of several effects.

    Parameters
    ----------
    effects : sequence of (mapping of str to ndarray of shape (axis,), Prediction)
        Squared sizes by parameter, 0 on axes without the effect, and its prediction; spectra at
        equally many frequencies in each band.
    """
    square, time = [], []
    walk, power = np.zeros((axes, block_count)), np.zeros((axes, block_count))
    for sizes, prediction in effects:
        for name, (memory, variance) in prediction.wander.items():
            if prediction.levels or not _is_steady(memory, variance):
                continue
            if np.isinf(memory):
                walk += sizes[name][:, None] * variance
            else:
                square.append(sizes[name] * variance[0])
                time.append(memory)
            if name in prediction.spectrum:
                lowest = np.asarray(prediction.spectrum[name]).reshape(
                    -1, block_count, bands, prediction.spectrum[name].shape[-1] // bands
                )[0, :, 0]
                power += sizes[name][:, None] * lowest.mean(axis=-1)
    return Wandering(np.array(square).reshape(-1, axes).T, np.array(time), walk, power)


def with_wandering(baseline: xr.Dataset, known: Wandering, spectrum: Array) -> xr.Dataset:
    """Add random processes of the means to a baseline.

    They are not white noise of the means, whatever they add to the lowest band.

    Parameters
    ----------
    spectrum : ndarray, shape (axis, block, band)
        Expected power with all effects [degree2 hour-2 Hz-1].
    """
    if not (known.square.any() or known.walk.any()):
        return baseline
    white = baseline["mean_variance"] * (1.0 - known.power / spectrum[..., 0])
    return baseline.assign(
        label_variables(
            {
                "mean_variance": white.values,
                "wander_square": known.square,
                "wander_time": known.time,
                "wander_walk": known.walk,
            },
            BASELINE,
        )
    )
