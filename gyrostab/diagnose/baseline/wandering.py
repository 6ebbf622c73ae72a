"""What effects of a model do to the means at random: biases that wander and come back, and walks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.physics.prediction import Prediction

__all__ = ["Wandering", "told_in_full", "wandering", "with_wandering"]

Array = NDArray[np.float64]


class Wandering(NamedTuple):
    """Random means of all axes.

    Attributes
    ----------
    square : ndarray, shape (axis, process)
        Variances of what comes back [degree2 hour-2].
    time : ndarray, shape (process,)
        Its correlation times [s].
    walk : ndarray, shape (axis, block)
        Growth of the variance of what does not [degree2 hour-2 s-1].
    power : ndarray, shape (axis, block)
        What all of it has in the lowest band [degree2 hour-2 Hz-1].
    """

    square: Array
    time: Array
    walk: Array
    power: Array


def told_in_full(seen: Prediction) -> bool:
    """Whether what an effect does to the means at random is told by its variance: with a memory that does not change, and not in steps."""
    return not seen.levels and all(_steady(*one) for one in seen.wander.values())


def _steady(time: float, variance: Array) -> bool:
    return bool(np.isinf(time) or np.ptp(variance) == 0.0)


def wandering(
    effects: Sequence[tuple[Mapping[str, Array], Prediction]],
    *,
    bands: int,
    block_count: int,
    axes: int,
) -> Wandering:
    """Random means of several effects.

    Parameters
    ----------
    effects : sequence of (mapping of str to ndarray of shape (axis,), Prediction)
        Squared sizes by parameter, 0 on axes without the effect, and what it predicts; its spectra
        at as many frequencies in each band.
    bands, blocks, axes : int
    """
    square, time = [], []
    walk, power = np.zeros((axes, block_count)), np.zeros((axes, block_count))
    for sizes, seen in effects:
        for name, (memory, variance) in seen.wander.items():
            if seen.levels or not _steady(memory, variance):
                continue
            if np.isinf(memory):
                walk += sizes[name][:, None] * variance
            else:
                square.append(sizes[name] * variance[0])
                time.append(memory)
            if name in seen.spectrum:
                lowest = np.asarray(seen.spectrum[name]).reshape(
                    -1, block_count, bands, seen.spectrum[name].shape[-1] // bands
                )[0, :, 0]
                power += sizes[name][:, None] * lowest.mean(axis=-1)
    return Wandering(np.array(square).reshape(-1, axes).T, np.array(time), walk, power)


def with_wandering(baseline: xr.Dataset, known: Wandering, spectrum: Array) -> xr.Dataset:
    """A baseline whose means wander: what does so makes no white noise of the means, whatever it adds to the lowest band.

    Parameters
    ----------
    baseline : xarray.Dataset
    known : Wandering
    spectrum : ndarray, shape (axis, block, band)
        Expected power with all effects [degree2 hour-2 Hz-1].
    """
    if not (known.square.any() or known.walk.any()):
        return baseline
    white = baseline["mean_variance"] * (1.0 - known.power / spectrum[..., 0])
    return baseline.assign(
        mean_variance=white.assign_attrs(baseline["mean_variance"].attrs),
        wander_square=(("axis", "wander"), known.square, {"units": "degree2 hour-2"}),
        wander_time=("wander", known.time, {"units": "s"}),
        wander_walk=(("axis", "block"), known.walk, {"units": "degree2 hour-2 s-1"}),
    )
