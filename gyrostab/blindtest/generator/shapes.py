"""Scale a shape to an effect of the wanted strength."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import fft
from scipy.optimize import minimize_scalar

from gyrostab.arrays import Floats
from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    amplitude_for,
    line_density_of,
    mean_size,
    variance_nats,
    variance_size,
)
from gyrostab.blindtest.generator.environment import lag
from gyrostab.blindtest.generator.noise import white_level
from gyrostab.blindtest.generator.scenario import AXES, HiddenEffect, Scenario, to_samples

_MIN_LAG_S, _LAG_COUNT = 1.0, 24


def draw_shares(rng: np.random.Generator, *, single_probability: float = 0.6) -> Floats:
    """Draw signed shares (axis,): one axis with `single_probability`, else all, unequally."""
    shares = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.4, 1.0, 3)
    if rng.random() < single_probability:
        keep = np.zeros(3)
        keep[rng.integers(3)] = 1.0
        shares *= keep
    return np.asarray(shares / np.abs(shares).max())


def axes_with_share(shares: Floats) -> tuple[str, ...]:
    """List the names of the axes with a nonzero share."""
    return tuple(axis for axis, share in zip(AXES, shares, strict=True) if share != 0)


def scale_by_axis(shares: Floats, value: float) -> dict[str, float]:
    """Multiply `value` by the share of every axis with a nonzero share."""
    return {
        axis: float(value * share) for axis, share in zip(AXES, shares, strict=True) if share != 0
    }


def signed_peaks(effect: HiddenEffect, shares: Floats) -> dict[str, float]:
    """Find the largest mean of every axis with a nonzero share [deg/h], with the share's sign."""
    assert effect.mean is not None
    return {
        axis: float(np.sign(share) * np.abs(row).max())
        for axis, share, row in zip(AXES, shares, effect.mean, strict=True)
        if share
    }


def sample_sd(scenario: Scenario, axis: int) -> float:
    """Compute the standard deviation of white noise that one sample must exceed [deg/h]."""
    measured = scenario.measured
    return (
        white_level(scenario.noise[axis]["N"]) * math.sqrt(scenario.rate)
        if measured is None
        else float(measured.outlier_sigma[axis])
    )


def fit_lagged_driver(
    scenario: Scenario, mean: Floats, driver: Floats, *, axis: int
) -> tuple[float, float]:
    """Fit a first-order response to a driver (second,) to a mean (time,): sensitivity, lag [s].

    The sensitivity is the static one. The sensitivity of a lagged mean to the instantaneous driver
    would be smaller, and would depend on the noise.
    """

    def late(time: float) -> tuple[float, float]:
        return _fit_driver(scenario, mean, to_samples(scenario, lag(driver, time)), axis=axis)

    grid = np.append(0.0, np.geomspace(_MIN_LAG_S, scenario.seconds, _LAG_COUNT))
    place = int(np.argmin([late(float(time))[1] for time in grid]))
    if place == 0:
        return late(0.0)[0], 0.0
    ends = math.log(grid[max(place - 1, 1)]), math.log(grid[min(place + 1, _LAG_COUNT)])
    time = math.exp(
        float(minimize_scalar(lambda log: late(math.exp(log))[1], bounds=ends, method="bounded").x)
    )
    return late(time)[0], time


def _fit_driver(
    scenario: Scenario, mean: Floats, driver: Floats, *, axis: int
) -> tuple[float, float]:
    """Fit a driver (time,) to a mean (time,); return the sensitivity and the unexplained share."""
    present = ~scenario.missing
    x, y = (
        fft.dct(np.where(present, values - values[present].mean(), 0.0), norm="ortho")[1:]
        for values in (driver, mean)
    )
    weight = 1.0 / line_density_of(scenario, axis=axis)
    slope = float((weight * x * y).sum() / (weight * x * x).sum())
    return slope, float((weight * (y - slope * x) ** 2).sum() / (weight * y * y).sum())


def make_mean_effect(
    scenario: Scenario,
    shape: Floats,
    shares: Floats,
    *,
    strength: float,
    form_differs: bool,
    tau: tuple[float, float] | None = None,
    parameters: Mapping[str, Any] | None = None,
    regressor: tuple[str, Floats, str] | None = None,
    unless: tuple[str, ...] = (),
    **description: Any,
) -> HiddenEffect:
    """Make an effect that adds ``shape * shares``, scaled to `strength`.

    The shape (time,), or (axis, time), may have any unit; `shares` (axis,) are signed. A
    `regressor` is the name of a parameter, the driver (time,) it multiplies, and its unit; its true
    value on every axis is the least-squares fit to the mean. Where the diagnosis fits one of the
    nonlinear terms `unless`, that parameter is not comparable. All else are fields of
    `HiddenEffect`.
    """
    mean = np.asarray(shares[:, None] * (shape if shape.ndim == 2 else shape[None, :]))
    mean *= strength / mean_size(scenario, mean)
    peak = float(np.abs(mean - np.median(mean, axis=1, keepdims=True)).max())
    described = {
        **(parameters or {}),
        "peak": {"value": peak, "unit": "deg/h"},
        "size_white": {"value": mean_size(scenario, mean, white=True), "unit": "1"},
    }
    if regressor is not None:
        values = {
            axis: _fit_driver(scenario, mean[i], regressor[1], axis=i)[0]
            for i, axis in enumerate(AXES)
            if shares[i]
        }
        described[regressor[0]] = {"values": values, "unit": regressor[2]} | (
            {"unless": list(unless)} if form_differs and unless else {}
        )
    return HiddenEffect(
        axes=axes_with_share(shares),
        form_differs=form_differs,
        size=strength,
        nats=NATS * strength**2,
        tau=tau or (max(1.0, 2 / scenario.rate), scenario.seconds / 3),
        mean=mean,
        parameters=described,
        **description,
    )


def make_variance_effect(
    scenario: Scenario,
    ratio: Callable[[float], Floats],
    *,
    strength: float,
    first: float,
    tau: tuple[float, float] | None = None,
    **description: Any,
) -> tuple[HiddenEffect, float]:
    """Make an effect on the noise density, and return it with its amplitude.

    `ratio` computes the density ratio of `variance_size` from an amplitude, and 1 from amplitude 0;
    the search for the amplitude of `strength` starts at the small one `first`. All else are fields
    of `HiddenEffect`.
    """
    amplitude = amplitude_for(lambda a: variance_size(scenario, ratio(a)), strength, first=first)
    final = ratio(amplitude)
    effect = HiddenEffect(
        size=variance_size(scenario, final),
        nats=variance_nats(scenario, final, quiescent=description.get("active") is not None),
        tau=tau or (1 / scenario.rate, 30.0),
        variance=final if final.ndim == 2 and final.shape[1] > 1 else None,
        parameters={"ratio": {"value": float(np.abs(final - 1).max()), "unit": "1"}},
        **description,
    )
    return effect, amplitude
