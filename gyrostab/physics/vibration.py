"""Effects of acceleration, vibration and the magnetic field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.physics.base import Chunk, Effect, Likeness, Prediction, Setup, Windows, parameter
from gyrostab.units import INNER

_MIN_EDGE_HZ = 0.01
_FOLDED_POINTS = 1001  # of the spectrum of the samples, from which a sentence takes the band


def _declare_sensitivity(unit: str, meaning: str) -> Any:
    return parameter(unit, meaning, default=0.0, typical=1e-3, limit=1e4)


@dataclass(frozen=True, kw_only=True)
class _Vector(Effect):
    """Bias that is the scalar product of a vector channel with the parameters x, y, z."""

    def needs(self) -> tuple[str, ...]:
        return tuple(channel for channel in self.channels if getattr(self, channel[-1]))

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        bias = np.zeros(chunk.size)
        for channel in self.needs():
            bias += getattr(self, channel[-1]) * chunk.drivers[channel]
        return bias, state

    def explain(self, windows: Windows) -> Prediction:
        return Prediction(
            mean={
                name[-1]: windows.drivers[name] for name in self.channels if name in windows.drivers
            }
        )

    def parts(self, errors: Mapping[str, float] | None) -> str:
        """Format the components: ``"0.01 deg/h/g along x"``."""
        parts = [f"{self.quantity(name, errors)} along {name}" for name in self.list_sizes()]
        return ", ".join(parts) or "nothing"


@dataclass(frozen=True, kw_only=True)
class GSensitivity(_Vector):
    """Bias that follows the acceleration.

    ``b = G_x a_x + G_y a_y + G_z a_z`` for each axis that it acts on.

    References
    ----------
    IEEE Std 952-1997 (acceleration-sensitive drift); Cordova 1998, US patent 5847829 (sensitivity
    by geometry of the coil). Sizes are estimates: 1e-4 to 1e-2 deg/h/g for a good coil, below 0.1
    for a simple one.

    Examples
    --------
    >>> GSensitivity(x=0.01, axes=["z"]).say()
    'The bias follows the acceleration on axis z, by 0.01 deg/h/g along x.'
    """

    name = "g_sensitivity"
    short = "bias follows acceleration"
    plain = "a bias that follows acceleration"
    next_measurement = (
        "turn the tool over at rest: g-sensitivity changes sign with gravity, rectification does "
        "not"
    )
    channels: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("accel_x", "accel_y", "accel_z"), INNER["acceleration"]
    )
    size_parameters = ("x", "y", "z")

    x: float = _declare_sensitivity("deg/h/g", "bias per g along x")
    y: float = _declare_sensitivity("deg/h/g", "bias per g along y")
    z: float = _declare_sensitivity("deg/h/g", "bias per g along z")

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means from the present components, and a flat transfer function."""
        flat = np.ones(windows.frequency.size, np.complex128)
        return replace(
            super().explain(windows), transfer={(name[-1], name): flat for name in self.channels}
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        return f"The bias follows the acceleration {self.on_axes()}, by {self.parts(errors)}."


@dataclass(frozen=True, kw_only=True)
class VibrationRectification(Effect):
    """Bias that follows the square of the vibration.

    ``b = k2 g^2 + k4 g^4``, g the rms acceleration

    References
    ----------
    Qin et al. 2026 (0.0118 to 0.0445 deg/h under a sine of 6 g at 30 Hz, which is 0.7e-3 to 2.5e-3
    deg/h/g^2); Cordova 1998, US patent 5847829 (windings that reduce it). Scaled to the 13.39 g
    of Wang et al. 2016: 0.1 to 0.4 deg/h.

    Examples
    --------
    >>> print(VibrationRectification(sensitivity=1.5e-3, axes=["x"]).say())
    Vibration is rectified to a bias on axis x, of 0.0015 deg/h/g^2 times the square of the rms
    vibration.
    """

    name = "vibration_rectification"
    short = "bias follows g_rms squared"
    plain = "a bias caused by vibration (vibration rectification)"
    next_measurement = (
        "repeat at twice the vibration: rectification grows fourfold, g-sensitivity twofold; then "
        "turn the tool over: g-sensitivity changes sign"
    )
    channels: ClassVar[Mapping[str, str]] = {"vibration": INNER["acceleration"]}
    size_parameters = ("sensitivity", "quartic")

    sensitivity: float = parameter(
        "deg/h/g^2", "bias per mean square", typical=1.5e-3, limit=10.0, source="Qin et al. 2026"
    )
    quartic: float = parameter(
        "deg/h/g^4", "bias per mean square squared", default=0.0, typical=1e-7, limit=1.0
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        square = chunk.drivers["vibration"] ** 2
        return square * (self.sensitivity + square * self.quartic), state

    def explain(self, windows: Windows) -> Prediction:
        square = windows.drivers["vibration"] ** 2
        return Prediction(mean={"sensitivity": square, "quartic": square**2})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = []
        if self.sensitivity or not self.quartic:
            terms.append(
                f"{self.quantity('sensitivity', errors)} times the square of the rms vibration"
            )
        if self.quartic:
            power = "its fourth power" if terms else "the fourth power of the rms vibration"
            terms.append(f"{self.quantity('quartic', errors)} times {power}")
        return f"Vibration is rectified to a bias {self.on_axes()}, of {', and of '.join(terms)}."


@dataclass(frozen=True, kw_only=True)
class AliasedVibration(Effect):
    """Angular vibration in a band above half of the sampling rate, which is aliased.

    ``rate(t) = s g(t) v(t)``: v is noise of unit power between `low` and `high` (Butterworth, half
    power at both), after a mount with a resonance, if given; g is the rms of the vibration. A
    sample is v at its beginning (``"point"``) or the mean of v over its interval (``"average"``,
    integrate and dump). The samples are drawn from the process in continuous time, and therefore
    have the density ``sum_k S(f + k fs) |H(f + k fs)|^2`` with H = 1 or sinc(f / fs). Where the
    instrument of the model samples faster than the log, fs is the rate of the instrument, and the
    filter of the logger follows.

    References
    ----------
    Wang et al. 2016, Sensors (13.39 g, 1 g^2/Hz at 700 to 800 Hz, logged at 400 Hz); Optik, linear
    vibration and three-axis FOGs in MWD (angular vibration by the mounting, under-sampled). The
    angular rate per g is an estimate.

    Examples
    --------
    >>> print(AliasedVibration(sensitivity=4.0, low=700, high=800).say())
    Vibration at 700 to 800 Hz folds into the samples on all axes, with a sensitivity of 4 deg/h/g;
    each sample is a point of it.
    """

    name = "aliased_vibration"
    short = "vibration above half of the sampling rate, aliased"
    plain = "vibration aliased by the sampling"
    next_measurement = (
        "log at a higher rate, or with an analogue filter: an aliased band moves or disappears"
    )
    channels: ClassVar[Mapping[str, str]] = {"vibration": INNER["acceleration"]}
    size_parameters = ("sensitivity",)
    likeness: ClassVar[Mapping[str, Likeness]] = {"vibration_noise": "any spectrum"}

    sensitivity: tuple[float, ...] = parameter(
        "deg/h/g", "rms rate in the band per rms g", typical=3.7, limit=1e6, many=True
    )
    low: float = parameter(
        "Hz",
        "lower edge of the band",
        default=700.0,
        low=_MIN_EDGE_HZ,
        high=1e5,
        source="Wang et al. 2016",
    )
    high: float = parameter(
        "Hz",
        "upper edge of the band",
        default=800.0,
        low=_MIN_EDGE_HZ,
        high=1e5,
        source="Wang et al. 2016",
    )
    resonance: float = parameter(
        "Hz", "resonance of the mount; 0 for a rigid one", default=0.0, low=0.0, high=1e5
    )
    quality: float = parameter("1", "quality of that resonance", default=10.0, low=0.5, high=1000.0)
    sampling: str = parameter(
        "text", "how a sample is taken", default="point", choices=("point", "average")
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.low < self.high:
            raise OptionError(
                f"effect {self.name!r}: the band from low = {self.low:g} "
                f"to high = {self.high:g} Hz is empty; low must be below high"
            )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        from gyrostab.kernels.random.coloured import band, begin_process

        average, mount = self.sampling == "average", (self.resonance, self.quality)
        return begin_process(band(self.low, self.high, setup.rate, *mount, average=average), rng)

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        from gyrostab.kernels.random.coloured import read_process

        values, state = read_process(state, chunk.size)
        sensitivity = self.expand_to_axes("sensitivity", chunk.setup.axes)
        return sensitivity[:, None] * (chunk.drivers["vibration"] * values), state

    def points(self, windows: Windows) -> list[Mapping[str, float | str]]:
        """List point samples and averages of the band of the vibration channel, if known."""
        low, high = windows.bands.get("vibration", (self.low, self.high))
        edges = {"low": max(low, _MIN_EDGE_HZ), "high": max(high, 2.0 * _MIN_EDGE_HZ)}
        return [edges | {"sampling": sampling} for sampling in ("point", "average")]

    def explain(self, windows: Windows) -> Prediction:
        """Predict the aliased spectrum of one process on all axes."""
        folded = self._fold_density(windows.frequency, windows.rate)
        power = windows.drivers["vibration"] ** 2
        return Prediction(spectrum={"sensitivity": power[:, None] * folded}, coherent=True)

    def _fold_density(self, frequency: Floats, rate: float) -> Floats:
        """Return the two-sided density of the samples [Hz-1] for unit sensitivity and vibration."""
        from gyrostab.kernels.random.coloured import band_psd, folded_psd

        def density(f: Floats) -> Floats:
            return band_psd(f, self.low, self.high, self.resonance, self.quality)

        average = self.sampling == "average"
        return folded_psd(density, frequency, rate, 3.0 * self.high, average=average)

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        mount = ""
        if self.resonance:
            mount = f", behind a mount with a resonance at {self.quantity('resonance', errors)}"
        sampling = "a point of it" if self.sampling == "point" else "its mean over the interval"
        size = self.quantity("sensitivity", errors)
        band = f"{self.low:.4g} to {self.high:.4g} Hz"
        folds = f"Vibration at {band} folds into the samples {self.on_axes()}"
        return f"{folds}, with a sensitivity of {size}{mount}; each sample is {sampling}."

    def say_in_record(self, windows: Windows, errors: Mapping[str, float] | None = None) -> str:
        """Describe the folded band in the record, unless the log states the band of the vibration.

        Bands that fold onto the same frequencies give the same samples.
        """
        if "vibration" in windows.bands:
            return self.say(errors)
        frequency = np.linspace(0.0, windows.rate / 2.0, _FOLDED_POINTS)
        density = self._fold_density(frequency, windows.rate)
        rms = float(np.sqrt(density.mean() * windows.rate))
        in_record = replace(self, sensitivity=tuple(size * rms for size in self.sensitivity))
        band = frequency[density >= density.max() / 2.0]
        size = in_record.quantity("sensitivity")
        return (
            f"Vibration above half of the sampling rate folds into the samples {self.on_axes()}, "
            f"as noise at {band[0]:.3g} to {band[-1]:.3g} Hz of {size} (rms) in the record, which "
            "does not determine its original frequencies."
        )


@dataclass(frozen=True, kw_only=True)
class Magnetic(_Vector):
    """Bias that follows the magnetic field in the tool (Faraday effect in the coil).

    ``b = m_x B_x + m_y B_y + m_z B_z`` for each axis that it acts on, B in the frame of the tool.

    References
    ----------
    Fizoptika, glossary of fiber-optic gyros (magnetic sensitivity). Sizes are estimates: 0.1 to 10
    deg/h/G without a shield, which is 1e-3 to 0.1 deg/h/uT, and a hundredth of it with one; the
    earth's field is 25 to 65 uT.

    Examples
    --------
    >>> Magnetic(x=0.002, axes=["z"]).say()
    'The bias follows the magnetic field on axis z, by 0.002 deg/h/uT along x.'
    """

    name = "magnetic"
    short = "bias follows the magnetic field"
    plain = "a bias that follows the magnetic field"
    next_measurement = (
        "turn a magnet, or turn the tool in the earth's field, and log a magnetometer"
    )
    channels: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("mag_x", "mag_y", "mag_z"), INNER["magnetic"]
    )
    size_parameters = ("x", "y", "z")

    x: float = _declare_sensitivity("deg/h/uT", "bias per microtesla along x")
    y: float = _declare_sensitivity("deg/h/uT", "bias per microtesla along y")
    z: float = _declare_sensitivity("deg/h/uT", "bias per microtesla along z")

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        return f"The bias follows the magnetic field {self.on_axes()}, by {self.parts(errors)}."
