"""Earth rate, by the attitude of the tool."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import TURN, fold, turn_means, turn_means_of_windows, turns_of_samples
from gyrostab.units import INNER


@dataclass(frozen=True, kw_only=True)
class EarthRate(Effect):
    """The rotation of the earth, seen by a tool that rotates about its own axis.

    With inclination I from straight down, azimuth A and latitude L, the tool sees ``W_d = W (cos L
    sin I cos A - sin L cos I)`` along its axis, ``W_h = W (cos L cos I cos A + sin L sin I)``
    towards the high side and ``W_r = -W cos L sin A`` to the right of it. An axis at `off` degrees
    from the tool's axis, and at the angle a (`around`) from x towards y, sees ``cos(off) W_d +
    sin(off) (W_h cos(F + a) + W_r sin(F + a))``, with the toolface F = F0 + integral of the
    rotation rate, clockwise looking down the hole. Axes with names that end in x, y, z have 90, 90,
    0 degrees off and 0, 90, 0 around. Each sample is the mean over its interval.

    References
    ----------
    IEEE Std 952-1997, annex C (Allan variance of a sinusoid); 15.041067 deg/h is the earth's
    rotation against the stars.

    Examples
    --------
    >>> print(EarthRate(latitude=60).say())
    The tool sees 7.521 deg/h of the earth's 15.04 deg/h across its axis and -13.03 deg/h along it,
    on all axes, as it does at latitude 60 deg if it is vertical.
    """

    name = "earth_rate"
    short = "earth rate modulated by tool rotation"
    plain = "earth rate, which varies with the toolface"
    next_measurement = (
        "stop the rotation at four toolfaces 90 degrees apart: earth rate follows the toolface"
    )
    stage = "motion"
    channels: ClassVar[Mapping[str, str]] = {"rotation_rate": INNER["rotation_rate"]}
    size_parameters = ("rate",)

    latitude: float = parameter("deg", "latitude, north positive", typical=45.0, limit=90.0)
    inclination: float = parameter(
        "deg",
        "angle of the tool from straight down",
        default=0.0,
        typical=30.0,
        low=0.0,
        high=180.0,
    )
    azimuth: float = parameter(
        "deg", "direction of the tool, clockwise from north", default=0.0, typical=60.0, limit=360.0
    )
    toolface: float = parameter(
        "deg", "angle of x from the high side at the start", default=0.0, limit=360.0
    )
    off: tuple[float, ...] = parameter(
        "deg", "angle of each axis from the tool's", default=(), low=0.0, high=180.0, many=True
    )
    around: tuple[float, ...] = parameter(
        "deg", "angle of each axis around the tool", default=(), limit=360.0, many=True
    )
    rate: float = parameter(
        "deg/h",
        "rotation of the earth",
        default=15.041067,
        low=0.0,
        high=20.0,
        source="sidereal day of 86164.1 s",
    )

    def components(self) -> tuple[float, float, float]:
        """Compute the rate along the tool, to its high side and to the right [degree hour-1]."""
        lat, inc, azi = (
            math.radians(angle) for angle in (self.latitude, self.inclination, self.azimuth)
        )
        north, down = self.rate * math.cos(lat), -self.rate * math.sin(lat)
        along = north * math.sin(inc) * math.cos(azi) + down * math.cos(inc)
        high = north * math.cos(inc) * math.cos(azi) - down * math.sin(inc)
        return along, high, -north * math.sin(azi)

    def directions(self, axes: tuple[str, ...]) -> tuple[Floats, Floats]:
        """Compute the angles of the axes from the tool's axis and around it [radian]."""
        if self.off or self.around:  # across the tool by default
            off = self.expand_to_axes("off", axes) if self.off else np.full(len(axes), 90.0)
            return np.radians(off), np.radians(self.expand_to_axes("around", axes))
        angles = {"x": (90.0, 0.0), "y": (90.0, 90.0), "z": (0.0, 0.0)}
        for axis in axes:
            if axis[-1:].lower() not in angles:
                raise OptionError(
                    f"effect {self.name!r}: axis {axis!r} is not x, y or z; "
                    "give its direction with off and around [deg]"
                )
        off, around = np.radians(np.array([angles[axis[-1].lower()] for axis in axes])).T
        return off, around

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Check the directions, and start with zero turns of the tool."""
        self.directions(setup.axes)
        return 0.0

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        middle, inside, state = turns_of_samples(chunk.drivers["rotation_rate"], chunk.rate, state)
        along, across, phase = self._rates_on(chunk.setup.axes)
        means = turn_means(middle, inside, phase[:, None])
        return np.asarray(along[:, None] + across[:, None] * means), state

    def _rates_on(self, axes: tuple[str, ...]) -> tuple[Floats, Floats, Floats]:
        """Return the constant rate of each axis, and amplitude and phase of the one that turns."""
        along, high, right = self.components()
        off, around = self.directions(axes)
        phase = math.radians(self.toolface) + around - math.atan2(right, high)
        return along * np.cos(off), math.hypot(high, right) * np.sin(off), phase

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List initial toolfaces; a survey knows the other parameters."""
        return {"toolface": np.arange(0.0, 360.0, 30.0)}

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means, and the frequency of the line."""
        rotation = windows.drivers["rotation_rate"]
        constant, turning, phase = self._rates_on(windows.axes)
        means = turn_means_of_windows(windows, rotation, phase)
        rates = constant[:, None] + turning[:, None] * means
        off, around = self.directions(windows.axes)
        across = math.hypot(*self.components()[1:]) / self.rate if self.rate else 0.0
        pattern = np.zeros((len(windows.axes), 3), np.complex128)
        pattern[:, 0] = across * np.sin(off) * np.exp(1j * around)
        return Prediction(
            mean={"rate": rates / self.rate if self.rate else 0.0 * rates},
            line=fold(np.abs(rotation) / TURN, windows.rate),
            order={"rate": pattern},
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        along, _, _ = self.components()
        attitude = (
            f"at an inclination of {self.quantity('inclination')} and an azimuth of "
            f"{self.quantity('azimuth')}"
            if self.inclination
            else "if it is vertical"
        )
        return (
            f"{self._say_across(errors)} and {along:.4g} deg/h along it, {self.on_axes()}, as it "
            f"does at latitude {self.quantity('latitude', errors)} {attitude}."
        )

    def say_in_record(self, windows: Windows, errors: Mapping[str, float] | None = None) -> str:
        """Describe the rate that turns; the constant one along the tool is part of the bias."""
        return (
            f"{self._say_across(errors)}, {self.on_axes()}, as a vertical tool does at latitude "
            f"{self.quantity('latitude', errors)}."
        )

    def _say_across(self, errors: Mapping[str, float] | None) -> str:
        across = math.hypot(*self.components()[1:])
        return (
            f"The tool sees {across:.4g} deg/h of the earth's {self.quantity('rate', errors)} "
            "across its axis"
        )
