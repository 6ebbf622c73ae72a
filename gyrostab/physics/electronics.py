"""Effects of the electronics: supply, bias that wanders with a memory, the end of the range, the clock."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.errors import OptionError
from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Setup, Stage, Windows, parameter
from gyrostab.physics.lorentz import lorentz_density
from gyrostab.physics.phase import fold, line_density, turn_means
from gyrostab.units import HOUR, INNER

__all__ = ["Clipping", "ClockError", "GaussMarkov", "SupplyBias"]

_PPM = 1e-6
_LONGEST = 2**20
_LAGS = np.array([0.0, 8.0, 25.0, 80.0, 250.0])


@dataclass(frozen=True, kw_only=True)
class SupplyBias(Effect):
    """Bias that follows the supply voltage or the power of the light, and ripple of the supply.

    ``b = k_V (V - V0) + k_P (P - P0) + A sin(2 pi f t)``, averaged over every sample, so ripple
    above half of the sampling rate folds.

    With a `lag` V and P are what follows the channels with that time constant, ``lag dV/dt =
    V_channel - V``, in balance at the start: a regulator settles, and parts that the load or the
    light heats come after their power.

    *DAVAR*: a battery that runs down is a slow trend (R), a load that is switched a step (apparent
    K), ripple a bump at 0.371 / f or at its fold. *Window mean*: follows the channel at once, or
    after the lag. *Spectrum*: the line of the ripple. *Axes*: all follow the same channel with
    factors of their own.

    Confused with temperature_bias (temperature moves the voltage, or loads heat), ageing_bias (a
    battery over days) and spectral_line: regress on voltage and temperature at once; loads that are
    switched separate them. With a lag, the exponential after a switched load is what tells it from
    a random walk.

    References
    ----------
    IEEE Std 952-1997 (sensitivity to the supply). Sizes are estimates.

    Examples
    --------
    >>> SupplyBias(voltage=0.01, axes=["x"]).say()
    'The bias follows the supply on axis x, by 0.01 deg/h/V of the voltage.'
    """

    name: ClassVar[str] = "supply_bias"
    short: ClassVar[str] = "bias follows supply voltage or light power"
    stage: ClassVar[Stage] = "rate"
    channels: ClassVar[Mapping[str, str]] = {
        "supply_voltage": INNER["voltage"],
        "light_power": INNER["power"],
    }
    size_parameters: ClassVar[tuple[str, ...]] = ("voltage", "power", "ripple")
    references: ClassVar[tuple[str, ...]] = ("IEEE Std 952-1997",)

    voltage: float = parameter(
        "deg/h/V", "bias per volt", default=0.0, typical=0.01, low=-1e4, high=1e4
    )
    power: float = parameter(
        "deg/h/uW", "bias per microwatt of light", default=0.0, typical=1e-3, low=-1e4, high=1e4
    )
    reference_voltage: float = parameter(
        "V", "voltage without bias", default=24.0, low=-1e4, high=1e4
    )
    reference_power: float = parameter("uW", "power without bias", default=100.0, low=0.0, high=1e6)
    ripple: float = parameter(
        "deg/h", "amplitude of the ripple", default=0.0, typical=0.05, low=-1e6, high=1e6
    )
    frequency: float = parameter(
        "Hz", "frequency of the ripple", default=100.0, typical=3.3, low=1e-6, high=1e6
    )
    lag: float = parameter(
        "s",
        "time constant with which the bias follows the channels; 0 for at once",
        default=0.0,
        low=0.0,
        high=1e5,
    )

    def needs(self) -> tuple[str, ...]:
        """Only what it is sensitive to."""
        return ("supply_voltage",) * bool(self.voltage) + ("light_power",) * bool(self.power)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """No channel has been seen."""
        return {}

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """Rate contribution [degree hour-1] on every sample."""
        bias = np.zeros(chunk.size)
        if not chunk.size:
            return bias, state
        seen = {name: self._follow(chunk, name, state) for name in self.needs()}
        if self.voltage:
            bias += self.voltage * (seen["supply_voltage"] - self.reference_voltage)
        if self.power:
            bias += self.power * (seen["light_power"] * 1e6 - self.reference_power)
        if self.ripple:
            cycles = self.frequency / chunk.rate
            middle = (
                np.arange(chunk.first, chunk.first + chunk.size, dtype=np.float64) + 0.5
            ) * cycles
            bias += self.ripple * turn_means(middle, np.full(1, cycles), -math.pi / 2.0)
        return bias, state

    def _follow(self, chunk: Chunk, name: str, state: dict[str, Any]) -> Array:
        """A channel, straight between its samples, as the bias follows it; where it stands goes into the state."""
        from gyrostab.kernels.thermal import relax

        values = chunk.drivers[name]
        if not self.lag:
            return values
        before = state.get(name, (float(values[0]), np.zeros(1)))
        speed, state[name] = relax(
            values, chunk.rate, np.array([self.lag]), np.ones((1, 1)), before
        )
        return np.asarray(values - self.lag * speed[0])

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """The frequency of the ripple, band by band; lags from at once to minutes."""
        return {"frequency": windows.frequency, "lag": _LAGS}

    def points(self, windows: Windows) -> list[Mapping[str, float | str]]:
        """Lags of what follows channels, frequencies of what does not."""
        lags: list[Mapping[str, float | str]] = [
            {"frequency": self.frequency, "lag": float(lag)} for lag in _LAGS
        ]
        return lags + [
            {"frequency": float(frequency), "lag": 0.0} for frequency in windows.frequency
        ]

    def explain(self, windows: Windows) -> Prediction:
        """Window means: the channels that there are; the line of the ripple."""
        mean = {}
        if "supply_voltage" in windows.drivers:
            mean["voltage"] = self._followed(windows, "supply_voltage") - self.reference_voltage
        if "light_power" in windows.drivers:
            mean["power"] = self._followed(windows, "light_power") * 1e6 - self.reference_power
        place = np.full(windows.begin.size, float(fold(self.frequency, windows.rate)))
        power = 0.5 * np.sinc(self.frequency / windows.rate) ** 2
        return Prediction(
            mean=mean,
            spectrum={"ripple": line_density(windows, place, power)},
            coherent=True,
            line=place,
        )

    def _followed(self, windows: Windows, name: str) -> Array:
        """Window means of a channel as the bias follows it."""
        from gyrostab.kernels.thermal import mean_followed

        if not self.lag:
            return windows.drivers[name]
        at, values = windows.course(name)
        return mean_followed(at, values, windows.begin, windows.end, self.lag)

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        parts = [f"by {self.quantity('voltage', errors)} of the voltage"] if self.voltage else []
        parts += [f"by {self.quantity('power', errors)} of light"] if self.power else []
        parts += [f"with a lag of {self.quantity('lag', errors)}"] if self.lag and parts else []
        parts += (
            [
                f"with a ripple of {self.quantity('ripple', errors)} at {self.quantity('frequency', errors)}"
            ]
            if self.ripple
            else []
        )
        return f"The bias follows the supply {self.on_axes()}, {', '.join(parts) or 'by nothing'}."


@dataclass(frozen=True, kw_only=True)
class GaussMarkov(Effect):
    """Bias that wanders with an exponential memory.

    ``b' = -b / T_c + q w``, w white; of the rms ``q sqrt(T_c / 2)``. Every sample is the exact mean
    over its interval.

    *DAVAR*: ``(q T_c)^2 / tau [1 - T_c / (2 tau) (3 - 4 exp(-tau / T_c) + exp(-2 tau / T_c))]``:
    slope +1/2 of sigma, a bump of 0.617 times the rms at 1.89 T_c, slope -1/2. *Window mean*:
    wanders, and comes back to zero. *Spectrum*: Lorentzian, flat below 1 / (2 pi T_c). *Axes*:
    independent.

    Confused with B and K together (no bump), and with telegraph, which has the same second order:
    the distribution of short means is normal here, and has two peaks there.

    References
    ----------
    IEEE Std 952-1997, annex C (exponentially correlated noise). Sizes are estimates.

    Examples
    --------
    >>> GaussMarkov(rms=0.05, correlation_time=300, axes=["x"]).say()
    'The bias wanders by 0.05 deg/h rms on axis x, with a memory of 300 s.'
    """

    name: ClassVar[str] = "gauss_markov"
    short: ClassVar[str] = "exponentially correlated bias"
    stage: ClassVar[Stage] = "rate"
    size_parameters: ClassVar[tuple[str, ...]] = ("rms",)
    references: ClassVar[tuple[str, ...]] = ("IEEE Std 952-1997, annex C",)

    rms: tuple[float, ...] = parameter(
        "deg/h", "rms of the bias", typical=(0.05,), low=0.0, high=1e9, many=True
    )
    correlation_time: float = parameter(
        "s", "time constant T_c of its memory", default=100.0, low=1e-6, high=1e9
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Random numbers of every axis, and where it stands."""
        return [(child, float(child.standard_normal())) for child in rng.spawn(len(setup.axes))]

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """Rate contribution [degree hour-1] on every sample."""
        from gyrostab.kernels.random.stochastic import ornstein_uhlenbeck_means

        unit, after = np.empty(chunk.shape), []
        for row, (child, position) in enumerate(state):
            normal = child.standard_normal((chunk.size, 2))
            unit[row], position = ornstein_uhlenbeck_means(
                normal, self.correlation_time * chunk.rate, position
            )
            after.append((child, position))
        return self.each("rms", chunk.setup.axes)[:, None] * unit, after

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
        """Correlation times from ten samples to a quarter of the record."""
        return {
            "correlation_time": np.geomspace(
                10.0 / windows.rate, max(windows.end[-1] / 4.0, 20.0 / windows.rate), 8
            )
        }

    def explain(self, windows: Windows) -> Prediction:
        """The spectrum of the samples."""
        density = lorentz_density(windows.frequency, self.correlation_time, windows.rate)
        return Prediction(
            spectrum={"rms": np.broadcast_to(density, (windows.begin.size, density.size))},
            wander={"rms": (self.correlation_time, np.ones(windows.begin.size))},
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        memory = self.quantity("correlation_time", errors)
        return f"The bias wanders by {self.quantity('rms', errors)} rms {self.on_axes()}, with a memory of {memory}."


@dataclass(frozen=True, kw_only=True)
class Clipping(Effect):
    """The electronics end at a limit: what is beyond is cut.

    ``out = min(max(w, c - l), c + l)``, before the logger averages; a limit of 0 is none.

    *DAVAR*: nothing where the rate is inside; less at short times where noise reaches the limit,
    and a lie about motion beyond. *Window mean*: stops at the limit, and is pulled to the centre
    before it. *Spectrum*: odd harmonics of what is cut. *Axes*: each by itself.

    Confused with small noise and dead_zone (at the centre, not at the ends): the histogram ends in
    a wall, with many samples of one value, unless the logger averages after the limit.

    References
    ----------
    Lefevre 2014, The Fiber-Optic Gyroscope, 2nd ed. (dynamic range). The limit is that of the data
    sheet; the typical one here cuts noise and is for trials.

    Examples
    --------
    >>> Clipping(limit=3.6e6, axes=["z"]).say()
    'The rate is cut on axis z, beyond 3.6e+06 deg/h from 0 deg/h.'
    """

    name: ClassVar[str] = "clipping"
    short: ClassVar[str] = "missing tails"
    stage: ClassVar[Stage] = "electronics"
    size_parameters: ClassVar[tuple[str, ...]] = ("limit",)
    references: ClassVar[tuple[str, ...]] = ("Lefevre 2014, The Fiber-Optic Gyroscope",)

    limit: float = parameter(
        "deg/h", "largest distance from the centre; 0 for no limit", typical=5.0, low=0.0, high=1e12
    )
    centre: float = parameter("deg/h", "middle of the range", default=0.0, low=-1e12, high=1e12)

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """The signal within the limits [degree hour-1]."""
        if self.limit == 0.0:
            return chunk.signal, state
        return np.clip(chunk.signal, self.centre - self.limit, self.centre + self.limit), state

    def explain(self, windows: Windows) -> Prediction:
        """Nothing in means and spectra that is linear in the limit: it shows in the distribution."""
        return Prediction(marks=("extremes",))

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        return f"The rate is cut {self.on_axes()}, beyond {self.quantity('limit', errors)} from {self.quantity('centre', errors)}."


@dataclass(frozen=True, kw_only=True)
class ClockError(Effect):
    """The clock that takes the samples runs wrong, and its stamps are believed.

    When the clock has counted t, the time is ``theta(t) = t - s(t)`` with ``s' = e + d t``: e the
    `error` of a clock that is too fast, d its `drift`. The log holds what was there at theta. Where
    the gyro gives increments of angle (``output = "angle"``), they are divided by an interval that
    they do not have, and ``w`` becomes ``w theta'``.

    With ``reading = "latest"`` the logger takes the latest sample of the instrument: now and then
    it skips one, or has one twice, every 1 / e samples. With ``"average"`` it takes the mean over
    its own interval of an instrument that holds every sample until the next; white noise then keeps
    its N at long times, and loses up to half of its variance in samples that fall between two, so
    give the model an `oversampling`. Stamps of a fast clock are right at the start of the log,
    those of a slow one at its end (and the first sample is held until its time), so that nothing
    has to be known before it happens.

    *DAVAR*: noise as it was; everything with a frequency is moved by e. *Window mean*: ``-e w``, in
    proportion to the rate. *Spectrum*: lines moved by e. *Axes*: all alike. *Channels* with a clock
    of their own: the lag grows with time.

    Confused with scale_factor, which is the same in one axis with rotation, but differs from axis
    to axis and leaves lines and lags where they are.

    References
    ----------
    Allan 1987, IEEE Trans. UFFC 34, 647 (models of clocks). Sizes: 20 to 100 ppm for plain quartz,
    are estimates.

    Examples
    --------
    >>> ClockError(error=50).say()
    'The clock of the samples is fast by 50 ppm on all axes.'
    """

    name: ClassVar[str] = "clock_error"
    short: ClassVar[str] = "wrong or drifting rate of time"
    stage: ClassVar[Stage] = "sampling"
    size_parameters: ClassVar[tuple[str, ...]] = ("error", "drift")
    references: ClassVar[tuple[str, ...]] = ("Allan 1987, IEEE Trans. UFFC",)

    error: float = parameter(
        "ppm",
        "the clock is too fast by this at the start; negative for slow",
        default=0.0,
        typical=50.0,
        low=-1e5,
        high=1e5,
    )
    drift: float = parameter(
        "ppm/h", "growth of the error", default=0.0, typical=1.0, low=-1e4, high=1e4
    )
    output: str = parameter(
        "text",
        "increments of angle by the counted interval, or rates",
        default="angle",
        choices=("angle", "rate"),
    )
    reading: str = parameter(
        "text", "how a sample is taken", default="latest", choices=("latest", "average")
    )

    def slip(self, seconds: Array, duration: float) -> Array:
        """How far stamps are ahead of time [s], when the clock has counted `seconds` of the log's `duration` [s]."""
        error, drift = self.error * _PPM, self.drift * _PPM / HOUR

        def ahead(t: Any) -> Any:
            return error * t + drift * t * t / 2.0

        lowest = min(ahead(t) for t in self._extremes(duration))
        return np.asarray(ahead(seconds) - lowest)

    def _extremes(self, duration: float) -> tuple[float, float, float]:
        """Where the slip may be smallest or largest [s]: start, end, and where the error goes through zero."""
        turning = -self.error / self.drift * HOUR if self.drift else 0.0
        return 0.0, duration, min(max(turning, 0.0), duration)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """No samples yet; and how many have to be kept."""
        duration = setup.size / setup.rate
        times = np.array(self._extremes(duration))
        growth = (self.error + self.drift * times / HOUR) * _PPM
        if np.abs(growth).max() > 0.3:
            raise OptionError(
                f"effect {self.name!r}: the clock gets wrong by {np.abs(growth).max():.0%}; make error and drift smaller"
            )
        keep = math.ceil(float(self.slip(times, duration).max()) * setup.rate) + 3
        if keep > _LONGEST:
            raise OptionError(
                f"effect {self.name!r}: the clock gets wrong by {keep} samples; make the log shorter, or error and drift smaller"
            )
        return keep, None

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        """The signal at the times of the clock [degree hour-1]."""
        keep, memory = state
        if not (self.error or self.drift):
            return chunk.signal, state
        if memory is None:
            memory = np.repeat(chunk.signal[:, :1], keep, axis=1)
        known = np.concatenate([memory, chunk.signal], axis=1)
        start = chunk.first - keep  # sample of the instrument that known begins with
        edges = np.arange(chunk.first, chunk.first + chunk.size + 1, dtype=np.float64)
        read = edges - self.slip(edges / chunk.rate, chunk.setup.size / chunk.rate) * chunk.rate
        latest = self.reading == "latest"
        values = (
            known[:, np.floor(read[:-1]).astype(np.int64) - start]
            if latest
            else _means_between(known, start, read)
        )
        if self.output == "angle":
            middle = (edges[:-1] + 0.5) / chunk.rate
            values = values * (1.0 - (self.error + self.drift * middle / HOUR) * _PPM)
        return values, (keep, known[:, known.shape[1] - keep :])

    def explain(self, windows: Windows) -> Prediction:
        """Window means in proportion to the rate, if the gyro gives increments of angle."""
        own = np.stack([windows.own[axis] for axis in windows.axes]) * (self.output == "angle")
        return Prediction(mean={"error": -_PPM * own, "drift": -_PPM * own * windows.centre / HOUR})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Say it in one sentence."""
        fast, size = ("slow", -self.error) if self.error < 0 else ("fast", self.error)
        number = self.quantity("error", errors).replace(f"{self.error:.4g}", f"{size:.4g}", 1)
        more = f", more by {self.quantity('drift', errors)}" if self.drift else ""
        return f"The clock of the samples is {fast} by {number}{more} {self.on_axes()}."


def _means_between(known: Array, start: int, read: Array) -> Array:
    """Means of samples that hold, from one place to the next [samples], less than two apart; `known` begins with the sample `start`."""
    begin, end = read[:-1], read[1:]
    whole = np.floor(begin)
    column = whole.astype(np.int64) - start
    total = np.zeros((known.shape[0], begin.size))
    for step in range(3):
        share = np.clip(
            np.minimum(end, whole + step + 1) - np.maximum(begin, whole + step), 0.0, 1.0
        )
        total += share * known[:, np.minimum(column + step, known.shape[1] - 1)]
    return total / (end - begin)
