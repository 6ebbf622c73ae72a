"""Effects of time alone: a bias that drifts, and noise that grows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Windows, parameter
from gyrostab.units import DAY, HOUR


@dataclass(frozen=True, kw_only=True)
class AgeingBias(Effect):
    """Bias that trends with time.

    ``b = s t + c log(1 + t / t_a)``, t since the start of the log

    References
    ----------
    No published sizes; estimates: below 0.01 deg/h in a day, logarithmic over the first days.

    Examples
    --------
    >>> AgeingBias(slope=0.005, axes=["x"]).say()
    'The bias ages on axis x, by 0.005 deg/h/day.'
    """

    name = "ageing_bias"
    short = "bias trends with time"
    plain = "a bias trend in time"
    next_measurement = (
        "reverse the temperature once: a trend in time continues, a bias that follows temperature "
        "returns"
    )
    size_parameters = ("slope", "logarithmic")

    slope: float = parameter(
        "deg/h/day", "growth of the bias in a day", default=0.0, typical=0.005, limit=1e4
    )
    logarithmic: float = parameter(
        "deg/h", "growth per factor e of t + time", default=0.0, typical=0.01, limit=1e3
    )
    time: float = parameter(
        "h", "time after which the logarithm bends", default=24.0, low=1e-3, high=1e6
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        middle = chunk.seconds + 0.5 / chunk.rate
        return self.slope * (middle / DAY) + self.logarithmic * np.log1p(
            middle / (self.time * HOUR)
        ), state

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """List times at which the logarithm bends, 0.03 to 3 times the length of the record."""
        length = (windows.end[-1] - windows.begin[0]) / HOUR
        return {"time": np.maximum(length * np.array([0.03, 0.1, 0.3, 1.0, 3.0]), 1e-3)}

    def explain(self, windows: Windows) -> Prediction:
        """Predict the window means of both parts."""
        scale = self.time * HOUR

        def integral(t: Array) -> Array:
            return np.asarray((scale + t) * np.log1p(t / scale) - t)

        bend = (integral(windows.end) - integral(windows.begin)) / (windows.end - windows.begin)
        return Prediction(mean={"slope": windows.centre / DAY, "logarithmic": bend})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = [self.quantity("slope", errors)] if self.slope or not self.logarithmic else []
        if self.logarithmic:
            size, time = self.quantity("logarithmic", errors), self.quantity("time", errors)
            terms.append(f"{size} times the logarithm of time over {time}")
        return f"The bias ages {self.on_axes()}, by {' and '.join(terms)}."


@dataclass(frozen=True, kw_only=True)
class AgeingNoise(Effect):
    """Angle random walk that grows with time.

    ``N^2(t) = N0^2 (1 + g (t / 1 h)^p)``, t since the start of the log, N0 of the model

    References
    ----------
    Jin et al. 2010, Sci. China Tech. Sci. 53, 3056 (noise of an irradiated gyro grows with the loss
    of its coil, a power law of the dose). The size is an estimate: a light path that loses 1 dB in
    1000 h raises N^2 by 6e-4 in an hour where the noise of the detector dominates.

    Examples
    --------
    >>> print(AgeingNoise(growth=0.02).say())
    The angle random walk ages on all axes: N^2 grows by 0.02 of its initial value in the first
    hour, as time to the power 1.
    """

    name = "ageing_noise"
    short = "N trends with time"
    plain = "white noise with a trend in time"
    next_measurement = "repeat the record at the same temperature some days later"
    stage = "noise"
    terms = "N"
    size_parameters = ("growth",)

    growth: float = parameter(
        "1", "growth of N^2 in the first hour, as a share of it", typical=6e-4, low=0.0, high=1e3
    )
    exponent: float = parameter("1", "power of time", default=1.0, low=0.1, high=5.0)

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Array], Any]:
        hours = (chunk.seconds + 0.5 / chunk.rate) / HOUR
        base = chunk.setup.noise["N"][:, None] ** 2
        return {"N": chunk.level["N"] + base * (self.growth * hours**self.exponent)}, state

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        return {"exponent": np.array([0.5, 1.0, 2.0])}

    def explain(self, windows: Windows) -> Prediction:
        """Predict the growth of N^2 in every window."""
        power = self.exponent + 1.0
        begin, end = windows.begin / HOUR, windows.end / HOUR
        return Prediction(
            level={("N", "growth"): (end**power - begin**power) / (power * (end - begin))}
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        growth, power = self.quantity("growth", errors), self.quantity("exponent", errors)
        grows = f"grows by {growth} of its initial value in the first hour"
        law = f"as time to the power {power}"
        return f"The angle random walk ages {self.on_axes()}: N^2 {grows}, {law}."
