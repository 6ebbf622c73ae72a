"""Effects of temperature on the bias: its value, its change, its differences and its history."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.noise import NORMAL_95
from gyrostab.physics.base import Chunk, Effect, Likeness, Prediction, Windows, parameter
from gyrostab.units import HOUR, INNER

_MINUTE = 60.0
_NO_LAG_S = 1e-3
#: Lags of a temperature sensor that a diagnosis tries [s]: none, and that of a sensor next to the
#: gyro (estimate). With one of 60 s as well, the time of a smooth course would be left open: in one
#: of 14 simulated records, the time-shift test failed an effect of five detection limits.
_SENSOR_LAGS_S = np.array([0.0, 20.0])


def _true_temperature(sensor_lag: float, chunk: Chunk, last: float | None) -> tuple[Floats, Any]:
    """Return the temperature ahead of a lagging sensor, and the last reading of the chunk."""
    reading = np.ascontiguousarray(chunk.drivers["temperature"])
    if not (sensor_lag and chunk.size):
        return reading, last
    change = np.diff(reading, prepend=reading[0] if last is None else last) * chunk.rate
    return reading + sensor_lag * change, float(reading[-1])


@dataclass(frozen=True, kw_only=True)
class TemperatureBias(Effect):
    """Bias that follows the temperature without delay.

    ``b = a1 (T - T0) + a2 (T - T0)^2 + a3 (T - T0)^3``

    With a sensor that lags the gyro by ``sensor_lag``, T is the channel plus ``sensor_lag`` times
    its rate of change.

    References
    ----------
    IEEE Std 952-1997 (temperature sensitivity of the bias). Sizes are estimates of what is left
    after compensation: 1e-4 to 3e-3 deg/h/degC for a gyro of 0.03 deg/h, 0.01 to 0.06 for one of 1
    to 10 deg/h.

    Examples
    --------
    >>> TemperatureBias(sensitivity=0.002, axes=["x"]).say()
    'The bias follows the temperature on axis x, by 0.002 deg/h/degC.'
    """

    name = "temperature_bias"
    short = "bias follows T"
    plain = "a bias that follows temperature"
    next_measurement = (
        "heat and cool once with a hold at each end: a bias that follows temperature stays during "
        "the hold and returns later"
    )
    channels: ClassVar[Mapping[str, str]] = {"temperature": INNER["temperature"]}
    size_parameters = ("sensitivity", "quadratic", "cubic")

    sensitivity: float = parameter("deg/h/degC", "bias per degree", typical=1e-3, limit=1e4)
    quadratic: float = parameter(
        "deg/h/degC^2", "bias per degree squared", default=0.0, typical=1e-5, limit=1e3
    )
    cubic: float = parameter(
        "deg/h/degC^3", "bias per degree cubed", default=0.0, typical=1e-7, limit=1e2
    )
    reference: float = parameter(
        "degC", "temperature at which the bias is zero", default=25.0, low=-273.15, high=500.0
    )
    sensor_lag: float = parameter(
        "s", "lag of the temperature sensor behind the gyro", default=0.0, low=0.0, high=HOUR
    )

    def courses(self) -> tuple[str, ...]:
        """List the temperature if its sensor lags: its change would be that of the noise."""
        return self.needs() if self.sensor_lag else ()

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        temperature, state = _true_temperature(self.sensor_lag, chunk, state)
        above = temperature - self.reference
        return above * (self.sensitivity + above * (self.quadratic + above * self.cubic)), state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List the lags; the reference is the mean temperature, at which the terms differ most."""
        mean = round(float(np.mean(windows.drivers["temperature"])), 1)
        return {"reference": np.array([mean]), "sensor_lag": _SENSOR_LAGS_S}

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means proportional to powers of the temperature."""
        above = windows.drivers["temperature"] - self.reference
        if self.sensor_lag:
            at, temperature = windows.course("temperature")
            change = _average_changes(windows, at, temperature, _NO_LAG_S)
            above = above + self.sensor_lag / _MINUTE * change
        return Prediction(mean={"sensitivity": above, "quadratic": above**2, "cubic": above**3})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = [self.quantity(name, errors) for name in self.list_sizes() or ("sensitivity",)]
        size = ", ".join(terms)
        if self.quadratic or self.cubic:  # sensitivity alone is the same at every temperature
            size += f" around {self.quantity('reference')}"
        if self.sensor_lag:
            size += f", measured by a sensor that lags by {self.quantity('sensor_lag', errors)}"
        return f"The bias follows the temperature {self.on_axes()}, by {size}."


@dataclass(frozen=True, kw_only=True)
class Shupe(Effect):
    """Bias that follows the change of the coil temperature (Shupe effect).

    ``b = s h * dT/dt + r d/dt (T_outer - T_inner)``

    The coil is a winding that is heated from outside (T) and insulated inside. h is the response of
    the winding's mean to its surface: a sum of diffusion modes of the times ``lag / (2 n - 1)^2``,
    the slowest ``lag = 4 d^2 / (pi^2 kappa)`` for the thickness d. s is the residual asymmetry of
    the winding, pure and elasto-optic together; r is the effect of the outer half of the layers
    against the inner one, during the heat flow. With a sensor that lags the surface by
    ``sensor_lag``, the surface temperature is ``T + sensor_lag dT/dt``; nearly cancelling layers
    have the same effect because they follow the second derivative.

    References
    ----------
    Shupe 1980, Appl. Opt. 19, 654; Mohr and Schadt 2004, Proc. SPIE 5502, 410 (elasto-optic part);
    Zhuo and Du, Shupe effect of fiber sensing coils in multidimensional thermal field (the second
    part); Senol et al. 2024, Sci. Rep. (0.05 deg/h left at any ramp after trimming); Carslaw and
    Jaeger 1959 (the modes). A winding of 12 mm with kappa = 2.2e-7 m^2/s has a lag of 265 s
    (estimate); a coil of 500 m and 4 cm whose halves differ by 0.1 % of a ramp of 1 degC/min reads
    about 0.3 deg/h.

    Examples
    --------
    >>> print(Shupe(sensitivity=0.05, axes=["x"]).say())
    The bias follows the rate of change of the temperature on axis x, by 0.05 deg/h/(degC/min) with
    a lag of 265 s.
    """

    name = "shupe"
    short = "bias follows (lagged) dT/dt"
    plain = "a bias that follows the rate of change of temperature (Shupe effect)"
    next_measurement = (
        "hold the temperature after a ramp: a Shupe bias decays, and changes sign when the ramp "
        "is reversed"
    )
    channels: ClassVar[Mapping[str, str]] = {"temperature": INNER["temperature"]}
    size_parameters = ("sensitivity", "transient")

    sensitivity: float = parameter(
        "deg/h/(degC/min)",
        "bias at a steady ramp",
        typical=0.05,
        limit=1e3,
        source="Senol et al. 2024",
    )
    transient: float = parameter(
        "deg/h/(degC/min)",
        "bias per difference of ramps, outer minus inner half",
        default=0.0,
        typical=0.3,
        limit=1e3,
    )
    lag: float = parameter(
        "s", "relaxation time of the slowest mode", default=265.0, low=1e-3, high=1e6
    )
    modes: float = parameter(
        "1",
        "number of modes; 1 for a simple lag",
        default=5.0,
        low=1.0,
        high=50.0,
        whole="whole number of modes",
    )
    sensor_lag: float = parameter(
        "s",
        "lag of the temperature sensor behind the surface of the winding",
        default=0.0,
        low=0.0,
        high=HOUR,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transient and self.modes < 2:
            raise OptionError(
                f"effect {self.name!r}: transient needs at least 2 modes, "
                "because one mode has no outer and inner half"
            )

    def courses(self) -> tuple[str, ...]:
        """List the temperature, because its rate of change would be that of the noise."""
        return self.needs()

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        from gyrostab.kernels.thermal import relax, slab

        temperature = chunk.drivers["temperature"]
        if not chunk.size:
            return np.zeros(0), state
        times, whole, halves = slab(self.lag, int(self.modes))
        carry = (float(temperature[0]), np.zeros(times.size)) if state is None else state
        change = np.diff(temperature, prepend=carry[0]) * chunk.rate
        ahead = self.sensor_lag / times  # (T' - v) / t is the lagged second derivative
        felt, state = relax(
            temperature, chunk.rate, times, np.stack([whole, halves]) * (1.0 - ahead), carry
        )
        felt = felt + np.stack([whole @ ahead * change, halves @ ahead * change])
        return _MINUTE * (self.sensitivity * felt[0] + self.transient * felt[1]), state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List lags from none to thick windings, with sensors on the winding and off it."""
        return {
            "lag": np.append(_NO_LAG_S, np.geomspace(30.0, 3000.0, 6)),
            "sensor_lag": np.array([0.0, 20.0, 60.0]),
        }

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means from the temperature at its finest resolution, linearly joined."""
        from gyrostab.kernels.thermal import mean_changes, slab

        times, whole, halves = slab(self.lag, int(self.modes))
        at, temperature = windows.course("temperature")
        modes = np.stack(
            [_average_changes(windows, at, temperature, float(time)) for time in times]
        )
        if self.sensor_lag:
            ahead = (self.sensor_lag / times)[:, None]
            modes = (1.0 - ahead) * modes + ahead * _MINUTE * mean_changes(
                at, temperature, windows.begin, windows.end, 0.0
            )
        return Prediction(mean={"sensitivity": whole @ modes, "transient": halves @ modes})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = (
            [self.quantity("sensitivity", errors)] if self.sensitivity or not self.transient else []
        )
        if self.transient:
            terms += [f"{self.quantity('transient', errors)} while heat passes through the winding"]
        size = f"{' and '.join(terms)} {_with_lag(self, errors)}"
        if self.sensor_lag:
            size += f", measured by a sensor that lags by {self.quantity('sensor_lag', errors)}"
        return (
            f"The bias follows the rate of change of the temperature {self.on_axes()}, by {size}."
        )


def _with_lag(effect: Shupe | ThermalGradient, errors: Mapping[str, float] | None) -> str:
    """Describe the lag, or its upper limit."""
    if effect.lag > _NO_LAG_S:
        return f"with a lag of {effect.quantity('lag', errors)}"
    if errors and "lag" in errors:
        return f"with a lag of {NORMAL_95 * errors['lag']:.2g} s at most"
    return "without a lag"


def _average_changes(windows: Windows, at: Floats, values: Floats, lag: float) -> Floats:
    """Average a lagged rate of change over the windows [unit of the values min-1]."""
    from gyrostab.kernels.thermal import mean_changes

    return _MINUTE * mean_changes(at, values, windows.begin, windows.end, lag)


@dataclass(frozen=True, kw_only=True)
class ThermalGradient(Effect):
    """Bias that follows the difference of two temperatures, or its change.

    ``b = s (T1 - T2) + r h * d(T1 - T2)/dt``, h a lag

    References
    ----------
    Zhuo and Du, Shupe effect of fiber sensing coils in multidimensional thermal field (bias by the
    difference of dT/dt between the sides of a coil); Jo et al., J. Korea Inst. Mil. Sci. Technol.
    (by temperature and its gradient; three times smaller after compensation). Sizes are estimates:
    0.01 to 1 deg/h/degC.

    Examples
    --------
    >>> print(ThermalGradient(sensitivity=0.05, axes=["x"]).say())
    The bias follows the difference of temperature and temperature_2 on axis x, by 0.05 deg/h/degC.
    """

    name = "thermal_gradient"
    short = "bias follows a difference of two temperatures"
    plain = "a bias that follows a temperature difference"
    next_measurement = "log a second temperature at the other end of the coil"
    channels: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("temperature", "temperature_2"), INNER["temperature"]
    )
    size_parameters = ("sensitivity", "change")

    sensitivity: float = parameter(
        "deg/h/degC", "bias per difference", default=0.0, typical=0.05, limit=1e3
    )
    change: float = parameter(
        "deg/h/(degC/min)", "bias per change of the difference", default=0.0, typical=0.1, limit=1e3
    )
    lag: float = parameter("s", "lag of that change", default=60.0, low=1e-3, high=1e6)

    def courses(self) -> tuple[str, ...]:
        """List both temperatures if the effect follows the change of their difference."""
        return self.needs() if self.change else ()

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        from gyrostab.kernels.thermal import relax

        difference = chunk.drivers["temperature"] - chunk.drivers["temperature_2"]
        if not (self.change and chunk.size):
            return self.sensitivity * difference, state
        carry = (float(difference[0]), np.zeros(1)) if state is None else state
        felt, state = relax(difference, chunk.rate, np.array([self.lag]), np.ones((1, 1)), carry)
        return self.sensitivity * difference + _MINUTE * self.change * felt[0], state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        return {"lag": np.append(_NO_LAG_S, np.geomspace(10.0, 1000.0, 5))}

    def explain(self, windows: Windows) -> Prediction:
        difference = windows.drivers["temperature"] - windows.drivers["temperature_2"]
        at, first, second = windows.course("temperature", "temperature_2")
        return Prediction(
            mean={
                "sensitivity": difference,
                "change": _average_changes(windows, at, first - second, self.lag),
            }
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = (
            [self.quantity("sensitivity", errors)] if self.sensitivity or not self.change else []
        )
        if self.change:
            terms.append(
                f"{self.quantity('change', errors)} of its change, {_with_lag(self, errors)}"
            )
        names = " and ".join(self.channel_names().values())
        size = ", ".join(terms)
        return f"The bias follows the difference of {names} {self.on_axes()}, by {size}."


@dataclass(frozen=True, kw_only=True)
class ThermalHysteresis(Effect):
    """Temperature hysteresis of the bias.

    ``b = a (T - H)``, where H follows T with a dead band of half-width w: it is constant while T
    moves inside of the dead band, and is dragged along by T otherwise.

    After a reversal, b changes from -a w (falling T) to a w (rising T) over the first 2 w, whatever
    the speed; at the start it is zero. With a sensor that lags the gyro by ``sensor_lag``, T is the
    channel plus ``sensor_lag`` times its rate of change.

    References
    ----------
    Zhou et al. 2025, Micromachines 16, 357 (hysteresis of resonator gyros over temperature). Sizes
    are estimates: a dead band of 1 to 10 degC, 10 to 50 % of the temperature bias.

    Examples
    --------
    >>> print(ThermalHysteresis(sensitivity=3e-4, width=4, axes=["x"]).say())
    The bias has a temperature hysteresis on axis x, of 0.0003 deg/h/degC within a dead band of 4
    degC to each side.
    """

    name = "thermal_hysteresis"
    short = "bias depends on the history of T"
    plain = "a bias with temperature hysteresis"
    next_measurement = (
        "run a closed temperature cycle twice: with hysteresis heating and cooling differ, and "
        "the loop repeats"
    )
    channels: ClassVar[Mapping[str, str]] = {"temperature": INNER["temperature"]}
    size_parameters = ("sensitivity",)
    likeness: ClassVar[Mapping[str, Likeness]] = {"temperature_bias": "limit"}

    sensitivity: float = parameter(
        "deg/h/degC", "bias per degree in the dead band", typical=3e-4, limit=1e4
    )
    width: float = parameter(
        "degC", "half of the dead band", default=3.0, low=0.0, high=500.0, difference=True
    )
    sensor_lag: float = parameter(
        "s", "lag of the temperature sensor behind the gyro", default=0.0, low=0.0, high=HOUR
    )

    def courses(self) -> tuple[str, ...]:
        """List the temperature, because its extremes would be those of the noise."""
        return self.needs()

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        from gyrostab.kernels.thermal import apply_dead_band

        # behind a lagging sensor, the temperature is known from the second reading on
        begin = 1 if state is None and self.sensor_lag else 0
        lagged, follower = (None, None) if state is None else state
        temperature, lagged = _true_temperature(self.sensor_lag, chunk, lagged)
        bias, known = np.zeros(chunk.size), temperature[begin:]
        if known.size:
            first = float(known[0]) if follower is None else follower
            follower_course, follower = apply_dead_band(known, self.width, first)
            bias[begin:] = self.sensitivity * (known - follower_course)
        return bias, (lagged, follower) if chunk.size else state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List dead bands up to a third of the range of the temperature."""
        return {
            "width": np.ptp(windows.drivers["temperature"])
            * np.array([0.01, 0.03, 0.1, 0.2, 0.33]),
            "sensor_lag": _SENSOR_LAGS_S,
        }

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means from the temperature at its finest resolution, linearly joined."""
        from gyrostab.kernels.thermal import mean_dead_band_distance

        at, temperature = windows.course("temperature")
        if self.sensor_lag:
            temperature = temperature + self.sensor_lag * np.gradient(temperature, at)
        apart = mean_dead_band_distance(at, temperature, windows.begin, windows.end, self.width)
        return Prediction(mean={"sensitivity": apart})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        size, width = self.quantity("sensitivity", errors), self.quantity("width", errors)
        band = f"within a dead band of {width} to each side"
        if self.sensor_lag:
            band += f", measured by a sensor that lags by {self.quantity('sensor_lag', errors)}"
        return f"The bias has a temperature hysteresis {self.on_axes()}, of {size} {band}."
