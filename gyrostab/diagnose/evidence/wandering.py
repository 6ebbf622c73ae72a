"""Random processes in the means other than white, flicker and random walk noise.

Exponentially correlated ones and walks are effects. The angle also has motion that is faster than a
block: microseisms, waves, the dither of a laser gyro. Its spectrum lies within the blocks, but it
rarely comes back to the same angle at the end of a block. Every mean has the difference of the
angles at both ends of its block, divided by its length; the angle between two blocks is in both
means with opposite signs. Such noise moves means apart as quantization does, and nothing slow.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.reduce.schema import axis_values
from gyrostab.kernels.spectra.expected import interval_variance


class RandomProcesses(NamedTuple):
    """Random processes in the means of an axis in addition to flicker and random walk noise."""

    square: Floats  # (process,): variances of exponentially correlated processes [degree2 hour-2]
    time: Floats  # (process,): their correlation times [s]
    walk: Floats  # (block,): growth of the variance of random walks [degree2 hour-2 s-1]
    angle: Floats  # (): variance of the angle where blocks meet [arcsec2]


def expected_processes(baseline: xr.Dataset, axis: str | int) -> RandomProcesses:
    """Return the random processes expected in the mean of an axis, by name or index."""
    angle = axis_values(baseline, "angle_variance", axis)
    if "wander_square" not in baseline:
        return no_processes(baseline.sizes["block"])._replace(angle=angle)
    square = axis_values(baseline, "wander_square", axis)
    active = square > 0.0
    return RandomProcesses(
        square[active],
        baseline.variables["wander_time"].values[active],
        axis_values(baseline, "wander_walk", axis),
        angle,
    )


def no_processes(block_count: int) -> RandomProcesses:
    """Return no random processes, for so many blocks."""
    return RandomProcesses(np.empty(0), np.empty(0), np.zeros(block_count), np.zeros(()))


def add_correlated(processes: RandomProcesses, square: float, time: float) -> RandomProcesses:
    """Return the processes and one more, with this variance and correlation time."""
    return processes._replace(
        square=np.append(processes.square, square), time=np.append(processes.time, time)
    )


def with_process(
    baseline: xr.Dataset, axis: str, variance: Floats, time: float = np.inf
) -> xr.Dataset:
    """Return the baseline with another random process in the mean of an axis.

    The variance (block,) of a process with a correlation `time` [s] is the same in all blocks
    [degree2 hour-2]. A random walk has an infinite time, and a variance that grows by so much in a
    second [degree2 hour-2 s-1].
    """
    axes = baseline["axis"].values.tolist()
    row, shape = axes.index(axis), (len(axes), baseline.sizes["block"])
    square, times, walk = np.zeros((len(axes), 0)), np.zeros(0), np.zeros(shape)
    if "wander_square" in baseline:
        square, times, walk = (
            baseline.variables[name].values.copy()
            for name in ("wander_square", "wander_time", "wander_walk")
        )
        baseline = baseline.drop_vars(["wander_square", "wander_time"])
    if np.isinf(time):
        walk[row] += variance
    else:
        added = np.zeros((len(axes), 1))
        added[row] = variance[0]
        square, times = np.concatenate([square, added], axis=1), np.append(times, time)
    return baseline.assign(
        wander_square=(("axis", "wander"), square),
        wander_time=(("wander",), times),
        wander_walk=(("axis", "block"), walk),
    )


def process_allan_variance(tau: float, time: Floats) -> Floats:
    """Return the Allan variance at `tau` [s] of unit processes with correlation `time` [s].

    It is the variance of a mean over `tau` less the covariance of two adjacent means. IEEE Std
    952-1997, annex C, gives the same law.

    Examples
    --------
    >>> process_allan_variance(1.0, np.array([1e-3, 0.5, 1e3])).round(4)
    array([0.002 , 0.3808, 0.0007])
    """
    ratio = tau / time
    return np.asarray(interval_variance(ratio) - (np.expm1(-ratio) / ratio) ** 2)
