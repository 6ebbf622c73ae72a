"""Effects of acceleration and vibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Stage, Windows, parameter
from gyrostab.units import INNER

__all__ = ["GSensitivity"]


@dataclass(frozen=True, kw_only=True)
class GSensitivity(Effect):
    """Bias that follows the acceleration.

    ``b = G_x a_x + G_y a_y + G_z a_z`` for each axis that it acts on.

    *DAVAR*: the bump of a sinusoid at 0.371 / f while the tool rotates with f; steps at changes of the toolface (apparent K in the
    windows across them). *Window mean*: follows gravity in the tool. *Spectrum*: a line at the frequency of rotation.
    *Axes*: every axis follows the same accelerations with factors of its own.

    Confused with vibration_rectification (even in g, this one is odd: turn the tool over), earth_rate (known amplitude, no free
    factor) and magnetic (phase of the magnetic field, not of gravity).

    References
    ----------
    IEEE Std 952-1997 (acceleration-sensitive drift); Cordova 1998, US patent 5847829 (sensitivity by geometry of the coil).
    Sizes are estimates: 1e-4 to 1e-2 deg/h/g for a good coil, below 0.1 for a simple one.

    Examples
    --------
    >>> GSensitivity(x=0.01, axes=["z"]).say()
    'The bias follows the acceleration on axis z, by 0.01 deg/h/g along x.'
    """

    name: ClassVar[str] = "g_sensitivity"
    short: ClassVar[str] = "bias follows acceleration"
    stage: ClassVar[Stage] = "rate"
    channels: ClassVar[Mapping[str, str]] = dict.fromkeys(("accel_x", "accel_y", "accel_z"), INNER["acceleration"])
    size_parameters: ClassVar[tuple[str, ...]] = ("x", "y", "z")
    references: ClassVar[tuple[str, ...]] = ("IEEE Std 952-1997", "Cordova 1998, US patent 5847829")

    x: float = parameter("deg/h/g", "bias per g along x", default=0.0, typical=1e-3, low=-10.0, high=10.0)
    y: float = parameter("deg/h/g", "bias per g along y", default=0.0, typical=1e-3, low=-10.0, high=10.0)
    z: float = parameter("deg/h/g", "bias per g along z", default=0.0, typical=1e-3, low=-10.0, high=10.0)

    def needs(self) -> tuple[str, ...]:
        """Only the accelerations that it is sensitive to."""
        return tuple(f"accel_{name}" for name in self.size_parameters if getattr(self, name))

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """Rate contribution [degree hour-1] on every sample."""
        bias = np.zeros(chunk.size)
        for channel in self.needs():
            bias += getattr(self, channel[-1]) * chunk.drivers[channel]
        return bias, state

    def explain(self, windows: Windows) -> Prediction:
        """Window means: the accelerations that there are."""
        return Prediction(mean={name: windows.drivers[f"accel_{name}"] for name in "xyz" if f"accel_{name}" in windows.drivers})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        parts = [f"{self.quantity(name, errors)} along {name}" for name in self.size_parameters if getattr(self, name)]
        return f"The bias follows the acceleration {self.on_axes()}, by {', '.join(parts) or 'nothing'}."
