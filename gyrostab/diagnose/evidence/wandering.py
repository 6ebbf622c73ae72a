"""Random processes in the means other than the noise: exponentially correlated ones and walks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.kernels.spectra.expected import interval_variance

Array = NDArray[np.float64]


class RandomProcesses(NamedTuple):
    """Random processes in the means of an axis in addition to flicker and random walk noise."""

    square: Array  # (process,): variances of exponentially correlated processes [degree2 hour-2]
    time: Array  # (process,): their correlation times [s]
    walk: Array  # (block,): growth of the variance of random walks [degree2 hour-2 s-1]


def expected_processes(baseline: xr.Dataset, axis: str | int) -> RandomProcesses:
    """Return the random processes expected in the mean of an axis, by name or index."""
    if "wander_square" not in baseline:
        return RandomProcesses(np.empty(0), np.empty(0), np.zeros(baseline.sizes["block"]))
    square = axis_values(baseline, "wander_square", axis)
    active = square > 0.0
    return RandomProcesses(
        square[active],
        baseline.variables["wander_time"].values[active],
        axis_values(baseline, "wander_walk", axis),
    )


def with_walk(baseline: xr.Dataset, axis: str, walk: Array) -> xr.Dataset:
    """Return the baseline with another random walk in the mean of an axis.

    The walk (block,) is the growth of its variance [degree2 hour-2 s-1].
    """
    axes = baseline["axis"].values.tolist()
    total = np.stack([expected_processes(baseline, name).walk for name in axes])
    total[axes.index(axis)] += walk
    values: dict[str, tuple[tuple[str, ...], Array]] = {"wander_walk": (("axis", "block"), total)}
    if "wander_square" not in baseline:
        values["wander_square"] = (("axis", "wander"), np.zeros((len(total), 0)))
        values["wander_time"] = (("wander",), np.zeros(0))
    return baseline.assign(values)


def allan_variance(tau: float, time: Array) -> Array:
    """Return the Allan variance at `tau` [s] of unit processes with correlation `time` [s].

    It is the variance of a mean over `tau` less the covariance of two adjacent means. IEEE Std
    952-1997, annex C, gives the same law.

    Examples
    --------
    >>> allan_variance(1.0, np.array([1e-3, 0.5, 1e3])).round(4)
    array([0.002 , 0.3808, 0.0007])
    """
    ratio = tau / time
    return np.asarray(interval_variance(ratio) - (np.expm1(-ratio) / ratio) ** 2)
