"""Effects of rotation: errors proportional to it, and real rotation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import SchemaError
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import fold, resonance_density
from gyrostab.units import HOUR, INNER

_PPM = 1e-6
_MRAD = 1e-3


@dataclass(frozen=True, kw_only=True)
class ScaleFactor(Effect):
    """Error that is a function of the rotation rate w about the axis.

    ``e = (S + S_T (T - T0)) w + A |w| + C w^3``

    References
    ----------
    IEEE Std 952-1997 (scale factor errors); He et al. 2015, OECC (the temperature of the scale
    factor leads the error of a gyro survey). Sizes are estimates: 10 to 100 ppm for a good gyro,
    100 to 1000 ppm for a simple one.

    Examples
    --------
    >>> ScaleFactor(linear=100, axes=["z"]).say()
    'The scale factor is wrong on axis z: linear 100 ppm.'
    """

    name = "scale_factor"
    short = "error proportional to (a function of) rotation rate"
    plain = "a scale-factor error"
    next_measurement = (
        "rotate at two known rates in both directions: a scale-factor error is proportional to "
        "the rate"
    )
    channels: ClassVar[Mapping[str, str]] = {
        "rotation_rate": INNER["rotation_rate"],
        "temperature": INNER["temperature"],
    }
    size_parameters = ("linear", "asymmetry", "cubic", "thermal")

    linear: float = parameter(
        "ppm", "error of the scale factor", default=0.0, typical=50.0, limit=1e6
    )
    asymmetry: float = parameter(
        "ppm", "the same sign for both directions", default=0.0, typical=10.0, limit=1e6
    )
    cubic: float = parameter(
        "ppm/(deg/s)^2", "growth with the square of the rate", default=0.0, typical=1e-5, limit=1.0
    )
    thermal: float = parameter(
        "ppm/degC", "growth with the temperature", default=0.0, typical=1.0, limit=1e4
    )
    reference: float = parameter(
        "degC", "temperature of the calibration", default=25.0, low=-273.15, high=500.0
    )
    rotation: str = parameter(
        "text",
        "rotation about the axis: the channel, or the true rate of the model",
        default="channel",
        choices=("channel", "true"),
    )

    def needs(self) -> tuple[str, ...]:
        """List the rotation rate unless the true rate is used, and the temperature if needed."""
        return ("rotation_rate",) * (self.rotation == "channel") + ("temperature",) * bool(
            self.thermal
        )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        if self.rotation == "channel":
            rate = chunk.drivers["rotation_rate"] * HOUR
        else:
            rate = np.stack([chunk.true[axis] for axis in chunk.setup.axes])
        error = (
            self.linear * rate
            + self.asymmetry * np.abs(rate)
            + self.cubic * rate * (rate / HOUR) ** 2
        )
        if self.thermal:
            error = error + self.thermal * (chunk.drivers["temperature"] - self.reference) * rate
        return error * _PPM, state

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means from the mean rotation rate.

        This is exact except for asymmetry and cubic while the rate varies within a window.
        """
        if self.rotation == "channel":
            rate = windows.drivers["rotation_rate"] * HOUR
        else:
            rate = np.stack([windows.own[axis] for axis in windows.axes])
        mean = {"linear": rate, "asymmetry": np.abs(rate), "cubic": rate * (rate / HOUR) ** 2}
        if "temperature" in windows.drivers:
            mean["thermal"] = rate * (windows.drivers["temperature"] - self.reference)
        return Prediction(mean={name: _PPM * design for name, design in mean.items()})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = [f"{name} {self.quantity(name, errors)}" for name in self.list_sizes()]
        return f"The scale factor is wrong {self.on_axes()}: {', '.join(terms) or 'by nothing'}."


def _declare_angle(axis: str) -> Any:
    meaning = f"misalignment angle towards axis {axis}"
    return parameter("mrad", meaning, default=0.0, typical=0.5, limit=1e3)


@dataclass(frozen=True, kw_only=True)
class Misalignment(Effect):
    """Leak of the true rate of other axes by misalignment angles.

    ``e = m_x w_x + m_y w_y + m_z w_z``, without the rate of the axis itself, where w are the true
    rates of the log's axes x, y and z. The same model must contain their motion (real_motion,
    earth_rate), or with ``motion = "recorded"`` they are the rates of the recording that the log is
    simulated like. A diagnosis writes the latter: it compares the axes of a recording.

    References
    ----------
    IEEE Std 952-1997 (input axis misalignment). Sizes are estimates: 0.1 to 1 mrad.

    Examples
    --------
    >>> Misalignment(z=0.5, axes=["x"]).say()
    'Rotation about other axes shows on axis x through misalignment, by 0.5 mrad of z.'
    """

    name = "misalignment"
    short = "another axis's rate leaks in"
    plain = "rotation about another axis, coupled in by misalignment"
    next_measurement = "rotate about one axis at a time and read the others"
    size_parameters = ("x", "y", "z")
    follows_axes = True

    x: float = _declare_angle("x")
    y: float = _declare_angle("y")
    z: float = _declare_angle("z")
    motion: str = parameter(
        "text",
        "rates of the other axes: the true ones of the model, or those of the recording",
        default="true",
        choices=("true", "recorded"),
    )

    def recorded_axes(self) -> tuple[str, ...]:
        """List the axes that leak in, if their recorded rates do."""
        return self.list_sizes() if self.motion == "recorded" else ()

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        error = np.zeros(chunk.shape)
        rates = chunk.recorded if self.motion == "recorded" else chunk.true
        for source in self.list_sizes():
            if source not in rates:
                raise SchemaError(
                    f"effect {self.name!r} needs the rate of axis {source!r}, which the log does "
                    f"not have; it has {', '.join(rates)}; "
                    f"set {source} = 0 or name the axes x, y, z"
                )
            for row, axis in enumerate(chunk.setup.axes):
                if axis != source:
                    error[row] += getattr(self, source) * _MRAD * rates[source]
        return error, state

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means proportional to the measured rates of the other axes."""
        mean = {}
        for source in self.size_parameters:
            if source in windows.own and any(axis != source for axis in windows.axes):
                mean[source] = np.stack(
                    [_MRAD * windows.own[source] * (axis != source) for axis in windows.axes]
                )
        flat = np.full(windows.frequency.size, _MRAD, np.complex128)
        return Prediction(mean=mean, transfer={(source, source): flat for source in mean})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = [f"{self.quantity(name, errors)} of {name}" for name in self.list_sizes()]
        size = ", ".join(terms) or "nothing"
        return f"Rotation about other axes shows {self.on_axes()} through misalignment, by {size}."


def _declare_tilt(axis: str) -> Any:
    meaning = f"tilt of the mounting per acceleration along {axis}"
    return parameter("mrad/g", meaning, default=0.0, typical=0.01, limit=100.0)


@dataclass(frozen=True, kw_only=True)
class RealMotion(Effect):
    """Real rotation: sway, rotation of the tool, and tilt of the mounting under acceleration.

    ``w_a = d_a (sway(t) + spin w(t) + d/dt (c_x a_x + c_y a_y + c_z a_z))``: d_a is the share of
    each axis (a direction); sway is the velocity of an oscillator of given frequency and quality
    driven by white noise; w the rotation rate; c the tilt per acceleration, whose change in a
    sample is the rotation in it. All of it is true rate, which misalignment, scale_factor and
    dead_zone act on. The rotation of the tool is in the log without this effect where the channel
    ``rotation_rate`` names the axis in its attribute ``rotation_axis``; `spin` is its projection on
    another direction.

    References
    ----------
    Optik, linear vibration and three-axis FOGs in MWD (angular vibration from linear vibration by
    the mounting). Sizes are estimates: 0.01 deg of sway at 0.5 Hz are 113 deg/h.

    Examples
    --------
    >>> RealMotion(sway=9, direction=[1.0, 0.5, 0.0], axes=["x", "y", "z"]).say()
    'The tool really rotates on axes x, y and z, with shares 1, 0.5 and 0: sway 9 deg/h at 0.3 Hz.'
    """

    name = "real_motion"
    short = "rotation that is not an error"
    plain = "real rotation of the tool, not a sensor error"
    next_measurement = (
        "log accelerometers and a second gyro on the same mount: real motion shows in all of "
        "them, a sensor error in one"
    )
    stage = "motion"
    channels: ClassVar[Mapping[str, str]] = {
        "rotation_rate": INNER["rotation_rate"]
    } | dict.fromkeys(("accel_x", "accel_y", "accel_z"), INNER["acceleration"])
    size_parameters = ("sway", "spin", "x", "y", "z")

    direction: tuple[float, ...] = parameter(
        "1", "share of each axis", default=(1.0,), limit=1.0, many=True
    )
    sway: float = parameter(
        "deg/h", "rms rate of the sway", default=0.0, typical=10.0, low=0.0, high=1e7
    )
    frequency: float = parameter("Hz", "frequency of the sway", default=0.3, low=1e-4, high=1e4)
    quality: float = parameter(
        "1", "frequency of the sway over its width", default=20.0, low=0.5, high=1e4
    )
    spin: float = parameter(
        "1",
        "share of the rotation rate, with scale-factor errors of gyro and channel",
        default=0.0,
        typical=1.0,
        limit=1.1,
    )
    x: float = _declare_tilt("x")
    y: float = _declare_tilt("y")
    z: float = _declare_tilt("z")

    def needs(self) -> tuple[str, ...]:
        """List the rotation rate if there is spin, and the accelerations that cause tilt."""
        return ("rotation_rate",) * bool(self.spin) + tuple(
            f"accel_{name}" for name in "xyz" if getattr(self, name)
        )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Draw the stationary state of the oscillator; the tilt starts at zero."""
        from gyrostab.kernels.random.coloured import begin_process, oscillator

        return begin_process(oscillator(self.frequency, self.quality, setup.rate), rng), None

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        from gyrostab.kernels.random.coloured import read_process

        process, tilt = state
        motion, process = read_process(process, chunk.size)
        motion = self.sway * motion
        if self.spin:
            motion += self.spin * HOUR * chunk.drivers["rotation_rate"]
        bent = [name for name in "xyz" if getattr(self, name)]
        if bent:
            angle = sum(
                (
                    math.degrees(getattr(self, name) * _MRAD) * chunk.drivers[f"accel_{name}"]
                    for name in bent
                ),
                np.zeros(chunk.size),
            )
            motion += np.diff(angle, prepend=angle[0] if tilt is None else tilt) * (
                chunk.rate * HOUR
            )
            tilt = float(angle[-1])
        direction = self.expand_to_axes("direction", chunk.setup.axes)[:, None]
        return direction * motion, (process, tilt)

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        return {"frequency": windows.frequency, "quality": np.array([5.0, 20.0, 80.0])}

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means of rotation and tilt, and the coherent spectrum of the sway."""
        direction = self.expand_to_axes("direction", windows.axes)[:, None]
        mean = {}
        if "rotation_rate" in windows.drivers:
            mean["spin"] = direction * HOUR * windows.drivers["rotation_rate"]
        for name in "xyz":
            if f"accel_{name}" in windows.drivers and windows.begin.size > 1:
                slope = np.gradient(windows.drivers[f"accel_{name}"], windows.centre)
                mean[name] = direction * (math.degrees(_MRAD) * HOUR * slope)

        sway = resonance_density(windows, self.frequency, self.quality)
        place = np.full(windows.begin.size, float(fold(self.frequency, windows.rate)))
        turning = np.asarray(2j * np.pi * windows.frequency * (math.degrees(_MRAD) * HOUR))
        transfer = {(name, f"accel_{name}"): turning for name in "xyz"}
        return Prediction(
            mean=mean, spectrum={"sway": sway}, coherent=True, line=place, transfer=transfer
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = []
        if self.sway:
            terms.append(
                f"sway {self.quantity('sway', errors)} at {self.quantity('frequency', errors)}"
            )
        if self.spin:
            terms.append(
                f"{self.quantity('spin', errors)} of {self.channel_names()['rotation_rate']}"
            )
        terms += [
            f"tilt {self.quantity(name, errors)} along {name}"
            for name in "xyz"
            if getattr(self, name)
        ]
        shares = f", with shares {self.quantity('direction')}" if len(self.direction) > 1 else ""
        return (
            f"The tool really rotates {self.on_axes()}{shares}: {', '.join(terms) or 'not at all'}."
        )
