"""Effects of temperature on the bias."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Stage, Windows, parameter
from gyrostab.units import INNER

__all__ = ["TemperatureBias"]


@dataclass(frozen=True, kw_only=True)
class TemperatureBias(Effect):
    """Bias that follows the temperature without delay.

    ``b = a1 (T - T0) + a2 (T - T0)^2 + a3 (T - T0)^3``

    *DAVAR*: nothing while the temperature stands, an apparent R of ``|a1 dT/dt|`` at the longest averaging times while it moves.
    *Window mean*: follows the temperature, the same on the way up and down. *Spectrum*: that of the temperature. *Axes*: each has
    its own coefficient, of either sign.

    Confused with shupe (follows dT/dt: changes sign with the direction of the ramp), with ageing_bias and random walk (do not turn
    back with the temperature) and with supply_bias (the supply follows the temperature: regress on both).

    References
    ----------
    IEEE Std 952-1997 (temperature sensitivity of the bias). Sizes are estimates of what is left after compensation:
    1e-4 to 3e-3 deg/h/degC for a gyro of 0.03 deg/h, 0.01 to 0.06 for one of 1 to 10 deg/h.

    Examples
    --------
    >>> TemperatureBias(sensitivity=0.002, axes=["x"]).say()
    'The bias follows the temperature on axis x, by 0.002 deg/h/degC around 25 degC.'
    """

    name: ClassVar[str] = "temperature_bias"
    short: ClassVar[str] = "bias follows T"
    stage: ClassVar[Stage] = "rate"
    channels: ClassVar[Mapping[str, str]] = {"temperature": INNER["temperature"]}
    size_parameters: ClassVar[tuple[str, ...]] = ("sensitivity", "quadratic", "cubic")
    references: ClassVar[tuple[str, ...]] = ("IEEE Std 952-1997",)

    sensitivity: float = parameter("deg/h/degC", "bias per degree", typical=1e-3, low=-10.0, high=10.0)
    quadratic: float = parameter("deg/h/degC^2", "bias per degree squared", default=0.0, typical=1e-5, low=-1.0, high=1.0)
    cubic: float = parameter("deg/h/degC^3", "bias per degree cubed", default=0.0, typical=1e-7, low=-0.1, high=0.1)
    reference: float = parameter("degC", "temperature at which the bias is zero", default=25.0, low=-273.15, high=500.0)

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """Rate contribution [degree hour-1] on every sample."""
        above = chunk.drivers["temperature"] - self.reference
        return above * (self.sensitivity + above * (self.quadratic + above * self.cubic)), state

    def explain(self, windows: Windows) -> Prediction:
        """Window means: the powers of the temperature."""
        above = windows.drivers["temperature"] - self.reference
        return Prediction(mean={"sensitivity": above, "quadratic": above**2, "cubic": above**3})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        terms = [self.quantity(name, errors) for name in self.size_parameters if name == "sensitivity" or getattr(self, name)]
        return f"The bias follows the temperature {self.on_axes()}, by {', '.join(terms)} around {self.quantity('reference')}."
