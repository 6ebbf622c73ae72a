"""Effects of the electronics: supply, correlated bias and clipping."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.physics.base import Chunk, Effect, Likeness, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import lorentz_density, sine_means, steady_line
from gyrostab.units import INNER

_LAGS_S = np.array([0.0, 8.0, 25.0, 80.0, 250.0])


@dataclass(frozen=True, kw_only=True)
class SupplyBias(Effect):
    """Bias that follows the supply voltage or the light power, and ripple of the supply.

    ``b = k_V (V - V0) + k_P (P - P0) + A sin(2 pi f t)``, averaged over every sample, so ripple
    above half of the sampling rate is aliased.

    With a `lag`, V and P are first-order responses to the channels, ``lag dV/dt = V_channel - V``,
    in equilibrium at the start: a regulator settles, and parts heated by load or light follow their
    power with a delay.

    References
    ----------
    IEEE Std 952-1997 (sensitivity to the supply). Sizes are estimates.

    Examples
    --------
    >>> SupplyBias(voltage=0.01, axes=["x"]).say()
    'The bias follows the supply on axis x, by 0.01 deg/h/V of voltage.'
    """

    name = "supply_bias"
    short = "bias follows supply voltage or light power"
    plain = "a bias that follows supply voltage or light power"
    next_measurement = "change the supply voltage in steps at a steady temperature"
    channels: ClassVar[Mapping[str, str]] = {
        "supply_voltage": INNER["voltage"],
        "light_power": INNER["power"],
    }
    size_parameters = ("voltage", "power", "ripple")

    voltage: float = parameter("deg/h/V", "bias per volt", default=0.0, typical=0.01, limit=1e4)
    power: float = parameter(
        "deg/h/uW", "bias per microwatt of light", default=0.0, typical=1e-3, limit=1e4
    )
    reference_voltage: float = parameter("V", "voltage without bias", default=24.0, limit=1e4)
    reference_power: float = parameter("uW", "power without bias", default=100.0, low=0.0, high=1e6)
    ripple: float = parameter(
        "deg/h", "amplitude of the ripple", default=0.0, typical=0.05, limit=1e6
    )
    frequency: float = parameter(
        "Hz", "frequency of the ripple", default=100.0, typical=3.3, low=1e-6, high=1e6
    )
    lag: float = parameter(
        "s",
        "time constant with which the bias follows the channels; 0 for none",
        default=0.0,
        low=0.0,
        high=1e5,
    )

    def needs(self) -> tuple[str, ...]:
        return ("supply_voltage",) * bool(self.voltage) + ("light_power",) * bool(self.power)

    def courses(self) -> tuple[str, ...]:
        """List the channels that the effect follows with a lag."""
        return self.needs() if self.lag else ()

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        return {}

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        bias = np.zeros(chunk.size)
        if not chunk.size:
            return bias, state
        lagged = {name: chunk.drivers[name] for name in self.needs()}
        if self.lag:
            from gyrostab.kernels.thermal import lag_values

            for name, values in lagged.items():
                lagged[name], state[name] = lag_values(
                    values, chunk.rate, self.lag, state.get(name)
                )
        if self.voltage:
            bias += self.voltage * (lagged["supply_voltage"] - self.reference_voltage)
        if self.power:
            bias += self.power * (lagged["light_power"] * 1e6 - self.reference_power)
        if self.ripple:
            bias += self.ripple * sine_means(chunk, self.frequency)
        return bias, state

    def points(self, windows: Windows) -> list[Mapping[str, float | str]]:
        """List lags without ripple, and ripple frequencies without lag."""
        lags: list[Mapping[str, float | str]] = [
            {"frequency": self.frequency, "lag": float(lag)} for lag in _LAGS_S
        ]
        return lags + [
            {"frequency": float(frequency), "lag": 0.0} for frequency in windows.frequency
        ]

    def explain(self, windows: Windows) -> Prediction:
        """Predict the window means from the present channels, and the line of the ripple."""
        mean = {}
        if "supply_voltage" in windows.drivers:
            mean["voltage"] = (
                self._average_channel(windows, "supply_voltage") - self.reference_voltage
            )
        if "light_power" in windows.drivers:
            mean["power"] = (
                self._average_channel(windows, "light_power") * 1e6 - self.reference_power
            )
        place, spectrum = steady_line(windows, self.frequency)
        return Prediction(mean=mean, spectrum={"ripple": spectrum}, coherent=True, line=place)

    def _average_channel(self, windows: Windows, name: str) -> Floats:
        from gyrostab.kernels.thermal import mean_followed

        if not self.lag:
            return windows.drivers[name]
        at, values = windows.course(name)
        return mean_followed(at, values, windows.begin, windows.end, self.lag)

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        parts = [f"by {self.quantity('voltage', errors)} of voltage"] if self.voltage else []
        parts += [f"by {self.quantity('power', errors)} of light power"] if self.power else []
        parts += [f"with a lag of {self.quantity('lag', errors)}"] if self.lag and parts else []
        if self.ripple:
            size, frequency = self.quantity("ripple", errors), self.quantity("frequency", errors)
            parts.append(f"with a ripple of {size} at {frequency}")
        return f"The bias follows the supply {self.on_axes()}, {', '.join(parts) or 'by nothing'}."


@dataclass(frozen=True, kw_only=True)
class GaussMarkov(Effect):
    """Bias with an exponential correlation (Gauss-Markov process).

    ``b' = -b / T_c + q w``, w white, with the rms ``q sqrt(T_c / 2)``. Every sample is the exact
    mean over its interval.

    References
    ----------
    IEEE Std 952-1997, annex C (exponentially correlated noise). Sizes are estimates.

    Examples
    --------
    >>> GaussMarkov(rms=0.05, correlation_time=300, axes=["x"]).say()
    'The bias wanders by 0.05 deg/h rms on axis x, with a correlation time of 300 s.'
    """

    name = "gauss_markov"
    short = "exponentially correlated bias"
    plain = "a slowly wandering bias (Gauss-Markov process)"
    next_measurement = "record at rest for at least ten times the correlation time of the bias"
    size_parameters = ("rms",)
    likeness: ClassVar[Mapping[str, Likeness]] = {"telegraph": "always"}
    is_steady = True
    shapes_spectrum = True

    rms: tuple[float, ...] = parameter(
        "deg/h", "rms of the bias", typical=(0.05,), low=0.0, high=1e9, many=True
    )
    correlation_time: float = parameter(
        "s", "correlation time T_c", default=100.0, low=1e-6, high=1e9
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Make the random generator and the initial value of every axis."""
        return [(child, float(child.standard_normal())) for child in rng.spawn(len(setup.axes))]

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        from gyrostab.kernels.random.stochastic import ornstein_uhlenbeck_means

        unit, new_state = np.empty(chunk.shape), []
        for row, (child, position) in enumerate(state):
            normal = child.standard_normal((chunk.size, 2))
            unit[row], position = ornstein_uhlenbeck_means(
                normal, self.correlation_time * chunk.rate, position
            )
            new_state.append((child, position))
        return self.expand_to_axes("rms", chunk.setup.axes)[:, None] * unit, new_state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List correlation times from ten samples to a quarter of the record."""
        return {
            "correlation_time": np.geomspace(
                10.0 / windows.rate, max(windows.end[-1] / 4.0, 20.0 / windows.rate), 8
            )
        }

    def explain(self, windows: Windows) -> Prediction:
        """Predict the spectrum of the samples."""
        density = lorentz_density(windows.frequency, self.correlation_time, windows.rate)
        return Prediction(
            spectrum={"rms": np.broadcast_to(density, (windows.begin.size, density.size))},
            wander={"rms": (self.correlation_time, np.ones(windows.begin.size))},
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        size, time = self.quantity("rms", errors), self.quantity("correlation_time", errors)
        return (
            f"The bias wanders by {size} rms {self.on_axes()}, with a correlation time of {time}."
        )


@dataclass(frozen=True, kw_only=True)
class Clipping(Effect):
    """Clipping of the rate at the limits of the electronics.

    ``out = min(max(w, c - l), c + l)``, before the logger averages; 0 means no limit.

    References
    ----------
    Lefevre 2014, The Fiber-Optic Gyroscope, 2nd ed. (dynamic range). The data sheet gives the
    limit; the typical one here clips noise and is for tests.

    Examples
    --------
    >>> Clipping(limit=3.6e6, axes=["z"]).say()
    'The rate is clipped on axis z, beyond 3.6e+06 deg/h from 0 deg/h.'
    """

    name = "clipping"
    short = "samples limited to a range"
    plain = "clipped extremes"
    next_measurement = "widen the output range"
    stage = "electronics"
    size_parameters = ("limit",)

    limit: float = parameter(
        "deg/h", "largest distance from the centre; 0 for no limit", typical=5.0, low=0.0, high=1e12
    )
    centre: float = parameter("deg/h", "middle of the range", default=0.0, limit=1e12)

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        return self.transfer(chunk.signal), state

    def transfer(self, rate: Floats) -> Floats:
        """Return the clipped rates."""
        if self.limit == 0.0:
            return rate
        return np.clip(rate, self.centre - self.limit, self.centre + self.limit)

    def explain(self, windows: Windows) -> Prediction:
        """Predict anomalous samples; means and spectra are not linear in the limit."""
        return Prediction(marks=("extremes",))

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        limit, centre = self.quantity("limit", errors), self.quantity("centre", errors)
        return f"The rate is clipped {self.on_axes()}, beyond {limit} from {centre}."
