"""From a shape to an effect of a wanted strength: what the effects of this package share."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import minimize_scalar

from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    amplitude_for,
    line_density_of,
    mean_size,
    variance_gain,
    variance_size,
)
from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.scenario import AXES, Effect, World, to_samples

__all__ = [
    "by_axis",
    "following",
    "mean_effect",
    "named",
    "on_axes",
    "projection",
    "variance_effect",
]

Array = NDArray[np.float64]
_SHORTEST, _LAGS = 1.0, 24  # lags that are tried: the first [s], and how many


def on_axes(rng: np.random.Generator, *, alone: float = 0.6) -> Array:
    """Signed shares (axis,) of an effect: on one axis with probability `alone`, else on all, unequally."""
    shares = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.4, 1.0, 3)
    if rng.random() < alone:
        keep = np.zeros(3)
        keep[rng.integers(3)] = 1.0
        shares *= keep
    return np.asarray(shares / np.abs(shares).max())


def named(shares: Array) -> tuple[str, ...]:
    """Names of the axes that have a share."""
    return tuple(axis for axis, share in zip(AXES, shares, strict=True) if share != 0)


def by_axis(shares: Array, value: float) -> dict[str, float]:
    """`value` times the share of every axis that has one."""
    return {
        axis: float(value * share) for axis, share in zip(AXES, shares, strict=True) if share != 0
    }


def projection(world: World, mean: Array, driver: Array, *, axis: int) -> float:
    """Sensitivity of a mean (time,) to a driver (time,) by least squares in the noise of an axis: what a linear model should find."""
    return _nearest(world, mean, driver, axis=axis)[0]


def following(world: World, mean: Array, driver: Array, *, axis: int) -> tuple[float, float]:
    """Sensitivity and lag [s] of what follows a driver (second,) and comes nearest to a mean (time,), by least squares in the noise.

    The sensitivity is that to a driver that stands. To the driver at once a mean that is late has
    another one, less by as much as the noise makes of the steps of the driver: no number of the
    instrument's.

    Examples
    --------
    >>> from gyrostab.blindtest.generator.scenario import draw_world
    >>> world = draw_world(np.random.default_rng(0), rate=10.0, seconds=900.0)
    >>> mean = to_samples(world, 0.2 * lag(world.supply, 40.0))
    >>> [round(number, 2) for number in following(world, mean, world.supply, axis=0)]
    [0.2, 40.0]
    """

    def late(time: float) -> tuple[float, float]:
        return _nearest(world, mean, to_samples(world, lag(driver, time)), axis=axis)

    grid = np.append(0.0, np.geomspace(_SHORTEST, world.seconds, _LAGS))
    place = int(np.argmin([late(float(time))[1] for time in grid]))
    if place == 0:
        return late(0.0)[0], 0.0
    ends = math.log(grid[max(place - 1, 1)]), math.log(grid[min(place + 1, _LAGS)])
    time = math.exp(
        float(minimize_scalar(lambda log: late(math.exp(log))[1], bounds=ends, method="bounded").x)
    )
    return late(time)[0], time


def _nearest(world: World, mean: Array, driver: Array, *, axis: int) -> tuple[float, float]:
    """Sensitivity of a mean (time,) to a driver (time,), and the share of the mean that this leaves, by least squares in the noise."""
    there = ~world.missing
    x, y = (
        fft.dct(np.where(there, values - values[there].mean(), 0.0), norm="ortho")[1:]
        for values in (driver, mean)
    )
    weight = 1.0 / line_density_of(world, axis=axis)
    slope = float((weight * x * y).sum() / (weight * x * x).sum())
    return slope, float((weight * (y - slope * x) ** 2).sum() / (weight * y * y).sum())


def mean_effect(
    world: World,
    shape: Array,
    shares: Array,
    *,
    strength: float,
    name: str,
    driver: str | None,
    form: str,
    differs: bool,
    tau: tuple[float, float] | None = None,
    active: NDArray[np.bool_] | None = None,
    regressor: tuple[str, Array, str] | None = None,
    unless: tuple[str, ...] = (),
    **more: Any,
) -> Effect:
    """An effect that adds ``shape * shares``, scaled to `strength`.

    Parameters
    ----------
    world : World
    shape : ndarray, shape (time,) or (axis, time)
        Without unit; one for all axes, or one for each.
    shares : ndarray, shape (axis,)
        Signed shares of the axes.
    strength : float
        Size in units of the limit.
    name, driver, form, differs, tau, active
        See `Effect`.
    regressor : (str, ndarray, str), optional
        Name of a parameter, the driver it multiplies (time,) and its unit: its value on every axis
        is the projection of the mean.
    unless : tuple of str
        Terms that bend the response: where one of them is claimed beside the parameter, that is the
        slope at another place.

    Returns
    -------
    Effect
    """
    mean = np.asarray(shares[:, None] * (shape if shape.ndim == 2 else shape[None, :]))
    mean *= strength / mean_size(world, mean)
    parameters = dict(more.pop("parameters", {}))
    parameters["peak"] = {
        "value": float(np.abs(mean - np.median(mean, axis=1, keepdims=True)).max()),
        "unit": "deg/h",
    }
    parameters["size_white"] = {"value": mean_size(world, mean, white=True), "unit": "1"}
    if regressor is not None:
        values = {
            axis: projection(world, mean[i], regressor[1], axis=i)
            for i, axis in enumerate(AXES)
            if shares[i]
        }
        parameters[regressor[0]] = {"values": values, "unit": regressor[2]} | (
            {"unless": list(unless)} if differs and unless else {}
        )
    return Effect(
        name=name,
        axes=named(shares),
        driver=driver,
        form=form,
        differs=differs,
        size=strength,
        nats=NATS * strength**2,
        tau=tau or (max(1.0, 2 / world.rate), world.seconds / 3),
        active=active,
        mean=mean,
        parameters=parameters,
        **more,
    )


def variance_effect(
    world: World,
    ratio: Callable[[float], Array],
    *,
    strength: float,
    name: str,
    axes: tuple[str, ...],
    driver: str | None,
    form: str,
    differs: bool,
    first: float,
    tau: tuple[float, float] | None = None,
    active: NDArray[np.bool_] | None = None,
) -> tuple[Effect, float]:
    """An effect on the noise density, and the amplitude that gives it `strength`.

    Parameters
    ----------
    world : World
    ratio : callable
        Amplitude to density over density without effect, see `variance_size`; 1 at amplitude 0.
    strength : float
        Size in units of the limit.
    first : float
        A small amplitude.
    name, axes, driver, form, differs, tau, active
        See `Effect`.

    Returns
    -------
    Effect, float
    """
    amplitude = amplitude_for(lambda a: variance_size(world, ratio(a)), strength, first=first)
    final = ratio(amplitude)
    effect = Effect(
        name=name,
        axes=axes,
        driver=driver,
        form=form,
        differs=differs,
        size=variance_size(world, final),
        nats=variance_gain(world, final, quiet=active is not None),
        tau=tau or (1 / world.rate, 30.0),
        active=active,
        variance=final if final.ndim == 2 and final.shape[1] > 1 else None,
        parameters={"ratio": {"value": float(np.abs(final - 1).max()), "unit": "1"}},
    )
    return effect, amplitude
