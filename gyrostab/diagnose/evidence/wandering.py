"""What is known to wander in the means beside the noise: processes with an exponential memory, and walks that come and go."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

__all__ = ["Wander", "known_wander", "mean_share"]

Array = NDArray[np.float64]


class Wander(NamedTuple):
    """Random means of one axis, beside flicker and random walk of the noise.

    Attributes
    ----------
    square, time : ndarray, shape (process,)
        Variances [degree2 hour-2] and correlation times [s] of what comes back.
    walk : ndarray, shape (block,)
        Growth of the variance of what does not [degree2 hour-2 s-1].
    """

    square: Array
    time: Array
    walk: Array


def known_wander(baseline: xr.Dataset, axis: str | int) -> Wander:
    """What the mean of an axis is known to do.

    Parameters
    ----------
    baseline : xarray.Dataset
        Of `gyrostab.diagnose.baseline.calibrate.baseline_from_model`, with ``wander_square`` (axis,
        wander), ``wander_time`` (wander) and ``wander_walk`` (axis, block); nothing without these.
    axis : str or int
        Name, or number.
    """
    if "wander_square" not in baseline:
        return Wander(np.empty(0), np.empty(0), np.zeros(baseline.sizes["block"]))
    own = baseline[["wander_square", "wander_time", "wander_walk"]]
    own = own.isel(axis=axis) if isinstance(axis, int) else own.sel(axis=axis)
    there = own["wander_square"].values > 0.0
    return Wander(
        own["wander_square"].values[there],
        own["wander_time"].values[there],
        own["wander_walk"].values,
    )


def mean_share(step: float, time: Array) -> Array:
    """Variance of means over `step` seconds of processes of unit variance with these correlation times.

    Examples
    --------
    >>> mean_share(1.0, np.array([1e6, 1.0])).round(3)  # 2 / e
    array([1.   , 0.736])
    """
    a = step / np.maximum(time, 1e-300)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(a > 1e-3, 2.0 * (a + np.expm1(-a)) / a**2, 1.0 - a / 3.0)
