"""Effects of time by itself: a bias that trends, and noise that grows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Stage, Windows, parameter
from gyrostab.units import DAY, HOUR

__all__ = ["AgeingBias", "AgeingNoise"]


@dataclass(frozen=True, kw_only=True)
class AgeingBias(Effect):
    """Bias that trends with time.

    ``b = s t + c log(1 + t / t_a)``, t since the start of the log

    *DAVAR*: an apparent R of ``s + c / (t + t_a)``, the same at all times for the linear part,
    falling as 1 / t for the other. *Window mean*: a straight line, or one that flattens.
    *Spectrum*: nothing above the lowest band. *Axes*: each has its own sizes; no common sign.

    Confused with temperature_bias (a temperature that rises slowly trends as well: only where it
    turns back do they part), with a random walk (turns back by itself) and the slow part of warm_up
    (begins anew after each restart).

    References
    ----------
    No published sizes; estimates: below 0.01 deg/h in a day, logarithmic over the first days.

    Examples
    --------
    >>> AgeingBias(slope=0.005, axes=["x"]).say()
    'The bias ages on axis x, by 0.005 deg/h/day.'
    """

    name: ClassVar[str] = "ageing_bias"
    short: ClassVar[str] = "bias trends with time"
    stage: ClassVar[Stage] = "rate"
    size_parameters: ClassVar[tuple[str, ...]] = ("slope", "logarithmic")

    slope: float = parameter(
        "deg/h/day", "growth of the bias in a day", default=0.0, typical=0.005, low=-1e4, high=1e4
    )
    logarithmic: float = parameter(
        "deg/h",
        "growth whenever t + time is e times as much",
        default=0.0,
        typical=0.01,
        low=-1e3,
        high=1e3,
    )
    time: float = parameter(
        "h", "time after which the logarithm bends", default=24.0, low=1e-3, high=1e6
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """Rate contribution [degree hour-1] on every sample, at its middle."""
        middle = chunk.seconds + 0.5 / chunk.rate
        return self.slope * (middle / DAY) + self.logarithmic * np.log1p(
            middle / (self.time * HOUR)
        ), state

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """Where the logarithm bends: from a fraction of the record to many of it."""
        length = (windows.end[-1] - windows.begin[0]) / HOUR
        return {"time": np.maximum(length * np.array([0.03, 0.1, 0.3, 1.0, 3.0]), 1e-3)}

    def explain(self, windows: Windows) -> Prediction:
        """Window means of both parts."""
        scale = self.time * HOUR

        def integral(t: Array) -> Array:
            return np.asarray((scale + t) * np.log1p(t / scale) - t)

        bend = (integral(windows.end) - integral(windows.begin)) / (windows.end - windows.begin)
        return Prediction(mean={"slope": windows.centre / DAY, "logarithmic": bend})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        terms = [self.quantity("slope", errors)] if self.slope or not self.logarithmic else []
        if self.logarithmic:
            terms.append(
                f"{self.quantity('logarithmic', errors)} times the logarithm of time over {self.quantity('time', errors)}"
            )
        return f"The bias ages {self.on_axes()}, by {' and '.join(terms)}."


@dataclass(frozen=True, kw_only=True)
class AgeingNoise(Effect):
    """Angle random walk that grows with time.

    ``N^2(t) = N0^2 (1 + g (t / 1 h)^p)``, t since the start of the log, N0 of the model

    *DAVAR*: the whole slope -1/2 rises, slowly and without turning back; longer averaging times
    with it as long as N rules them. *Window mean*: nothing. *Spectrum*: white, with a level that
    grows. *Axes*: all alike when the source ages, one when its coil does.

    Confused with temperature_noise and light_power_noise where the temperature or the power trends
    with time: a temperature that turns back, or a record of the light power, separates them.

    References
    ----------
    Jin et al. 2010, Sci. China Tech. Sci. 53, 3056 (noise of an irradiated gyro grows with the loss
    of its coil, a power law of the dose). The size is an estimate: a light path that loses 1 dB in
    1000 h raises N^2 by 6e-4 in an hour where the detector's noise rules.

    Examples
    --------
    >>> AgeingNoise(growth=0.02).say()
    'The angle random walk ages on all axes: N^2 grows by 0.02 of itself in the first hour, with the power 1 of time.'
    """

    name: ClassVar[str] = "ageing_noise"
    short: ClassVar[str] = "N trends with time"
    stage: ClassVar[Stage] = "noise"
    terms: ClassVar[str] = "N"
    size_parameters: ClassVar[tuple[str, ...]] = ("growth",)
    references: ClassVar[tuple[str, ...]] = ("Jin et al. 2010, Sci. China Tech. Sci. 53, 3056",)

    growth: float = parameter(
        "1", "growth of N^2 in the first hour, as a share of it", typical=6e-4, low=0.0, high=1e3
    )
    exponent: float = parameter("1", "power of time", default=1.0, low=0.1, high=5.0)

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Array], Any]:
        """Squared N on every sample."""
        hours = (chunk.seconds + 0.5 / chunk.rate) / HOUR
        base = chunk.setup.noise["N"][:, None] ** 2
        return {"N": chunk.level["N"] + base * (self.growth * hours**self.exponent)}, state

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """The power of time."""
        return {"exponent": np.array([0.5, 1.0, 2.0])}

    def explain(self, windows: Windows) -> Prediction:
        """Growth of N^2 in every window."""
        power = self.exponent + 1.0
        begin, end = windows.begin / HOUR, windows.end / HOUR
        return Prediction(
            level={("N", "growth"): (end**power - begin**power) / (power * (end - begin))}
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        growth, power = self.quantity("growth", errors), self.quantity("exponent", errors)
        first = f"grows by {growth} of itself in the first hour, with the power {power} of time"
        return f"The angle random walk ages {self.on_axes()}: N^2 {first}."
