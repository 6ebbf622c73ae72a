"""Effects of temperature, light power and vibration on the level of the noise.

Each adds to the squared coefficients in proportion to those of the model, independent of the other
effects; their order does not matter.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError, SchemaError
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Chunk, Effect, Likeness, Prediction, Setup, Windows, parameter
from gyrostab.units import HOUR, INNER
from gyrostab.wording import join_words

#: Least N^2 of a polynomial law, as a share of its value at the reference (a tenth of N). Outside
#: of the range where it was measured, the polynomial could be negative.
LEAST_SHARE = 0.01
#: Share of a record that is left out at an end of the range of a channel, where a few values may be
#: wrong. Design choice.
_END_SHARE = 0.05
#: Resonances of a mount that are tried, as shares of the sampling rate, and their qualities. The
#: bands of a spectrum, each 1.5 times as wide as the one below, do not resolve more.
_RESONANCE_SHARES = (0.045, 0.08, 0.14, 0.25, 0.45)
_RESONANCE_QUALITIES = (1.0, 4.0)
#: Multiple of a resonance above which less than 1e-4 of the density of a rigid mount is left.
_MOUNT_BAND = 10.0


def _raise_noise(effect: Effect, chunk: Chunk, share: Floats) -> dict[str, Floats]:
    """Raise squared N by a share of the model's value, at least to `LEAST_SHARE` of it."""
    if share.size and float(share.min()) < LEAST_SHARE - 1.0:
        driver = effect.channel_names()[next(iter(chunk.drivers))]
        warnings.warn(
            f"effect {effect.name!r}: its law gives less than {100 * LEAST_SHARE:.0f} % of N^2 at "
            f"some values of {driver}, and negative values beyond; "
            f"{100 * LEAST_SHARE:.0f} % is taken there. Give smaller "
            "coefficients or another reference for another law",
            stacklevel=2,
        )
        share = np.maximum(share, LEAST_SHARE - 1.0)
    return {"N": chunk.level["N"] + chunk.setup.noise["N"][:, None] ** 2 * share}


@dataclass(frozen=True, kw_only=True)
class TemperatureNoise(Effect):
    """Angle random walk that follows the temperature.

    ``N^2(T) = N0^2 (1 + c1 (T - T0) + c2 (T - T0)^2)``, N0 of the model; no less than 1 % of N0^2

    References
    ----------
    Li et al. 2013, Chin. J. Lasers 40, 0908004 (dynamic Allan variance of three gyros from -40 to
    60 degC). The size is an estimate: a few per cent of N per 30 degC.

    Examples
    --------
    >>> print(TemperatureNoise(linear=0.002, axes=["x"]).say())
    The angle random walk follows the temperature on axis x: relative to its value at 25 degC, N^2
    changes by 0.002 1/degC.
    """

    name = "temperature_noise"
    short = "N follows T"
    plain = "white noise that varies with temperature"
    next_measurement = (
        "return to the first temperature: noise that follows temperature returns too, noise that "
        "follows age does not"
    )
    stage = "noise"
    terms = "N"
    channels: ClassVar[Mapping[str, str]] = {"temperature": INNER["temperature"]}
    size_parameters = ("linear", "quadratic")

    linear: float = parameter(
        "1/degC", "growth of N^2 per degree, as a share of it", typical=2e-3, limit=1e3
    )
    quadratic: float = parameter(
        "1/degC^2", "the same per degree squared", default=0.0, typical=1e-5, limit=1e3
    )
    reference: float = parameter(
        "degC", "temperature of the model's N", default=25.0, low=-273.15, high=500.0
    )

    def refer_noise_to(self, drivers: Mapping[str, float]) -> TemperatureNoise:
        """Take the polynomial about another temperature, without its value there.

        Examples
        --------
        >>> cold = TemperatureNoise(linear=0.01, quadratic=0.001)
        >>> warm = cold.refer_noise_to({"temperature": 35.0})
        >>> warm.reference, warm.linear, warm.quadratic
        (35.0, 0.03, 0.001)
        """
        at = drivers["temperature"]
        return replace(
            self, reference=at, linear=self.linear + 2.0 * self.quadratic * (at - self.reference)
        )

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """Take a low temperature of the record as reference: outside of it N is an extrapolation.

        About the mean, the square of the temperature would have the form of any slow event.
        """
        low = np.quantile(windows.drivers["temperature"], _END_SHARE)
        return {"reference": np.array([np.round(low)])}

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Floats], Any]:
        above = chunk.drivers["temperature"] - self.reference
        return _raise_noise(self, chunk, above * (self.linear + above * self.quadratic)), state

    def explain(self, windows: Windows) -> Prediction:
        """Predict the growth of N^2 in every window."""
        above = windows.drivers["temperature"] - self.reference
        return Prediction(level={("N", "linear"): above, ("N", "quadratic"): above**2})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = [self.quantity(name, errors) for name in self.list_sizes() or ("linear",)]
        start = f"relative to its value at {self.quantity('reference')}, N^2 changes by"
        follows = f"The angle random walk follows the temperature {self.on_axes()}"
        return f"{follows}: {start} {', '.join(terms)}."


@dataclass(frozen=True, kw_only=True)
class LightPowerNoise(Effect):
    """Angle random walk that follows the light power at the detector.

    ``N^2(P) = a_th / P^2 + a_sh / P + a_x``: noise of the detector, shot noise, and excess noise of
    the source. The model's N applies at the nominal power P0, where the parameters are the shares
    of the first two terms; the rest is excess noise: ``N^2(P) = N0^2 (s_th (P0 / P)^2 + s_sh P0 / P
    + 1 - s_th - s_sh)``.

    References
    ----------
    Blin et al. 2007, IEEE Photonics Technol. Lett. 19, 1520 (detector noise below 5 uW, above it
    excess noise that does not depend on the power); Jin et al. 2010, Sci. China Tech. Sci. 53, 3056
    (loss of an irradiated coil). With 5 uW as the point where both are the same and P0 = 10 uW,
    detector noise has 0.2 of N^2; that and 0.1 of shot noise are the typical sizes.

    Examples
    --------
    >>> print(LightPowerNoise(thermal=0.2, shot=0.1).say())
    The angle random walk follows the light power on all axes: at 0.0001 W, 0.2 of N^2 is detector
    noise and 0.1 of N^2 is shot noise.
    """

    name = "light_power_noise"
    short = "N follows light power"
    plain = "white noise that varies with light power"
    next_measurement = "change the light power in steps at a steady temperature, and log it"
    stage = "noise"
    terms = "N"
    channels: ClassVar[Mapping[str, str]] = {"light_power": INNER["power"]}
    size_parameters = ("thermal", "shot")

    thermal: float = parameter(
        "1",
        "share of the detector's noise in N^2 at the nominal power",
        typical=0.2,
        low=0.0,
        high=1.0,
    )
    shot: float = parameter(
        "1", "share of shot noise there", default=0.0, typical=0.1, low=0.0, high=1.0
    )
    nominal: float = parameter(
        "W", "light power of the model's N", default=1e-4, low=1e-12, high=10.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thermal + self.shot > 1.0 + 1e-12:
            total = self.thermal + self.shot
            raise OptionError(
                f"effect {self.name!r}: thermal + shot are {total:g} of N^2; "
                "give shares with a sum of 1 or less"
            )

    def refer_noise_to(self, drivers: Mapping[str, float]) -> LightPowerNoise:
        """Take another light power as nominal; there all of N^2 is that of detector and shots.

        Examples
        --------
        >>> full = LightPowerNoise(thermal=0.1, shot=0.2)
        >>> full.refer_noise_to({"light_power": 5e-5})
        LightPowerNoise(axes=(), driver=(), thermal=0.4, shot=0.4, nominal=5e-05)
        """
        loss = self.nominal / drivers["light_power"]
        thermal, shot = self.thermal * loss**2, self.shot * loss
        scale = max(thermal + shot, 1.0)
        return replace(
            self, thermal=thermal / scale, shot=shot / scale, nominal=drivers["light_power"]
        )

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """Take a high power of the record as nominal: outside of it N is an extrapolation."""
        high = np.quantile(windows.drivers["light_power"], 1.0 - _END_SHARE)
        return {"nominal": np.array([float(f"{high:.3g}")])}

    def courses(self) -> tuple[str, ...]:
        """List the light power, because the effect divides by it."""
        return self.needs()

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Floats], Any]:
        power = chunk.drivers["light_power"]
        if power.size and not float(power.min()) > 0.0:
            place = int(power.argmin())
            name, when = self.channel_names()["light_power"], chunk.seconds[place]
            raise SchemaError(
                f"effect {self.name!r}: the channel {name!r} is {power[place]:g} W {when:.6g} s "
                "after the start; it must be above 0: correct the channel, or leave its bad "
                "values out"
            )
        loss = self.nominal / power
        share = self.thermal * (loss**2 - 1.0) + self.shot * (loss - 1.0)
        return {"N": chunk.level["N"] + chunk.setup.noise["N"][:, None] ** 2 * share}, state

    def explain(self, windows: Windows) -> Prediction:
        """Predict the growth of N^2 in every window."""
        loss = self.nominal / windows.drivers["light_power"]
        return Prediction(level={("N", "thermal"): loss**2 - 1.0, ("N", "shot"): loss - 1.0})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        kinds = {"thermal": "detector", "shot": "shot"}
        shares = join_words(
            [
                f"{self.quantity(name, errors)} of N^2 is {kinds[name]} noise"
                for name in self.list_sizes() or tuple(kinds)
            ]
        )
        follows = f"The angle random walk follows the light power {self.on_axes()}"
        return f"{follows}: at {self.quantity('nominal')}, {shares}."


@dataclass(frozen=True, kw_only=True)
class _FollowsVibration(Effect):
    """Noise whose added variance grows with a power of the rms acceleration."""

    stage = "noise"
    channels: ClassVar[Mapping[str, str]] = {"vibration": INNER["acceleration"]}
    laws: ClassVar[Mapping[str, str]] = {}  # size -> symbol of the noise term that it raises

    exponent: float = parameter(
        "1", "power of the vibration with which the noise grows", default=1.0, low=0.1, high=4.0
    )

    def _raise_to_power(self, drivers: Mapping[str, Floats]) -> Floats:
        """Compute the vibration [g] to the power of the added variance."""
        return np.asarray(np.abs(drivers["vibration"]) ** (2.0 * self.exponent))

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Floats], Any]:
        excited = self._raise_to_power(chunk.drivers)
        return {
            symbol: chunk.level[symbol] + getattr(self, name) ** 2 * excited
            for name, symbol in self.laws.items()
        }, state

    def explain(self, windows: Windows) -> Prediction:
        """Predict the added spectra of independent noise on each axis."""
        excited = self._raise_to_power(windows.drivers)[:, None]
        return Prediction(
            spectrum={
                name: excited * sampled_psd(symbol, windows.frequency, windows.rate)
                for name, symbol in self.laws.items()
            }
        )

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        return {"exponent": np.array([0.5, 1.0, 2.0])}

    def _describe_law(self, errors: Mapping[str, float] | None) -> str:
        if self.exponent == 1.0:
            return "added in squares"
        return f"added in squares, as vibration to the power {self.quantity('exponent', errors)}"


@dataclass(frozen=True, kw_only=True)
class VibrationNoise(_FollowsVibration):
    """Noise level that follows the vibration: angle random walk, and noise of the angle.

    ``N^2(t) = N0^2 + s_N^2 g^2p``, ``Q^2(t) = Q0^2 + s_Q^2 g^2p``, g the rms acceleration in units
    of 1 g, p the exponent. With `resonance`, the added white noise passes a mount, a mass on a
    spring: its density at the frequency f is ``s_N^2 g^2p f0^4 / ((f^2 - f0^2)^2 + (f f0 / q)^2)``,
    f0 the resonance and q its quality. A sample is the mean over its interval.

    For noise above half of the sampling rate, see aliased_vibration.

    References
    ----------
    Li et al. 2013, Chin. J. Lasers 40, 0908004 (vibration made N four times as large over the
    record, ten times in a window, and Q five times); Zhang et al. 2017, Sensors 17, 2367 (vibration
    noise from the dynamic Allan variance). The sizes per g are estimates: the levels of vibration
    are not printed.

    Examples
    --------
    >>> VibrationNoise(white=0.02, axes=["x"]).say()
    'Vibration raises the noise on axis x: 0.02 deg/sqrt(h)/g of N, added in squares.'
    """

    name = "vibration_noise"
    short = "noise level follows vibration"
    plain = "noise that rises with vibration"
    next_measurement = (
        "log an accelerometer at the full rate: its spectrum and its coherence with the gyro "
        "separate noise from motion"
    )
    terms = "QN"
    laws: ClassVar[Mapping[str, str]] = {"white": "N", "quantization": "Q"}
    size_parameters = ("white", "quantization")
    likeness: ClassVar[Mapping[str, Likeness]] = {"aliased_vibration": "any spectrum"}

    white: float = parameter(
        "deg/sqrt(h)/g",
        "added N, in squares, per rms g",
        default=0.0,
        typical=0.02,
        low=0.0,
        high=1e3,
    )
    quantization: float = parameter(
        "urad/g", "added Q, in squares, per rms g", default=0.0, typical=5.0, low=0.0, high=1e6
    )
    resonance: float = parameter(
        "Hz", "resonance of the mount; 0 for a rigid one", default=0.0, low=0.0, high=1e5
    )
    quality: float = parameter("1", "quality of that resonance", default=1.0, low=0.5, high=1000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.resonance and self.quantization:
            raise OptionError(
                f"effect {self.name!r}: a mount (resonance = {self.resonance:g} Hz) filters white "
                "noise only; give the quantization in another effect of this name"
            )

    @classmethod
    def example(cls, **values: Any) -> Self:
        """Make the effect with its typical sizes; of white noise only with a resonance."""
        return super().example(**{"quantization": 0.0} if values.get("resonance") else {}, **values)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Begin independent noise behind the mount on each axis."""
        if not self.resonance:
            return None
        from gyrostab.kernels.random.coloured import begin_process, mount

        transition = mount(self.resonance, self.quality, setup.rate)
        return [begin_process(transition, own) for own in rng.spawn(len(setup.axes))]

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Floats], Any]:
        if not self.resonance:
            return super().generate(chunk, state)
        from gyrostab.kernels.random.coloured import read_process

        noise, state = zip(*(read_process(process, chunk.size) for process in state), strict=True)
        size = self.white * math.sqrt(HOUR) * np.sqrt(self._raise_to_power(chunk.drivers))
        return {"rate": size * np.stack(noise)}, state

    def points(self, windows: Windows) -> list[Mapping[str, float | str]]:
        """List exponents with a rigid mount, and with resonances in the band of the log."""
        mounts = [(0.0, 1.0)] + [
            (share * windows.rate, quality)
            for share in _RESONANCE_SHARES
            for quality in _RESONANCE_QUALITIES
        ]
        return [
            {"exponent": float(exponent), "resonance": resonance, "quality": quality}
            for exponent in self.nuisance(windows)["exponent"]
            for resonance, quality in mounts
        ]

    def explain(self, windows: Windows) -> Prediction:
        """Predict the added spectra of independent noise on each axis."""
        if not self.resonance:
            return super().explain(windows)
        from gyrostab.kernels.random.coloured import folded_psd, mount_psd

        def density(f: Floats) -> Floats:
            return mount_psd(f, self.resonance, self.quality)

        highest = max(windows.rate, _MOUNT_BAND * self.resonance)
        folded = folded_psd(density, windows.frequency, windows.rate, highest, average=True)
        excited = self._raise_to_power(windows.drivers)[:, None]
        return Prediction(spectrum={"white": excited * HOUR * folded})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        laws = self.laws
        terms = [f"{self.quantity(name, errors)} of {laws[name]}" for name in self.list_sizes()]
        size = " and ".join(terms) or "nothing"
        if self.resonance:
            at = self.quantity("resonance", errors)
            size += f" through a mount with a resonance at {at}"
        return f"Vibration raises the noise {self.on_axes()}: {size}, {self._describe_law(errors)}."


@dataclass(frozen=True, kw_only=True)
class VibrationRandomWalk(_FollowsVibration):
    """Rate random walk that grows under vibration.

    ``K^2(t) = K0^2 + s^2 g^2p``, g the rms acceleration in units of 1 g, p the exponent

    References
    ----------
    Li et al. 2013, Chin. J. Lasers 40, 0908004 (K of 0.32 at rest, up to 5.9 deg/h^1.5 in windows
    under vibration); Wang et al. 2016, Sensors (K grows under vibration). The size per g is an
    estimate, and both papers leave open whether it is a walk or a step.

    Examples
    --------
    >>> VibrationRandomWalk(sensitivity=0.5, axes=["x"]).say()
    'Vibration adds rate random walk on axis x: 0.5 deg/h^1.5/g of K, added in squares.'
    """

    name = "vibration_random_walk"
    short = "K follows vibration"
    plain = "a random walk that rises with vibration"
    next_measurement = (
        "vibrate evenly for at least half an hour: a random walk keeps growing between the edges, "
        "a step does not"
    )
    terms = "K"
    laws: ClassVar[Mapping[str, str]] = {"sensitivity": "K"}
    size_parameters = ("sensitivity",)

    sensitivity: float = parameter(
        "deg/h^1.5/g", "added K, in squares, per rms g", typical=0.5, low=0.0, high=1e4
    )

    def explain(self, windows: Windows) -> Prediction:
        """Predict the added spectrum of a random walk averaged over each sample, and the walk."""
        growth = self._raise_to_power(windows.drivers) / HOUR
        return replace(super().explain(windows), wander={"sensitivity": (math.inf, growth)})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        size = f"{self.quantity('sensitivity', errors)} of K, {self._describe_law(errors)}"
        return f"Vibration adds rate random walk {self.on_axes()}: {size}."
