"""Spectral lines of constant frequency, and lines phase-locked to the rotation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.physics.base import Chunk, Effect, Likeness, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import (
    TURN,
    fold,
    line_density,
    resonance_density,
    sine_means,
    steady_line,
    turn_means,
    turn_means_of_windows,
    turns_of_samples,
)
from gyrostab.units import INNER

#: Slower rotation is rest: a turn takes more than 100 s, and the channel may have noise. Design
#: choice, a tenth of the slowest stick-slip.
_LEAST_TURNING_DEG_S = 3.6


@dataclass(frozen=True, kw_only=True)
class SpectralLine(Effect):
    """A line of constant frequency: steady, or a resonance of given quality.

    ``rate(t) = A sin(2 pi f t + phi)``; or, with a quality Q, the velocity of an oscillator of that
    frequency driven by white noise, of the same mean square ``A^2 / 2``, with the density ``(A^2 /
    2) w f^2 / (pi ((f^2 - f0^2)^2 + w^2 f^2))`` and w = f0 / Q. Every sample is the mean over its
    interval, so a line above half of the sampling rate is aliased with the factor sinc(f / fs).

    References
    ----------
    IEEE Std 952-1997, annex C (Allan variance of a sinusoid). Sizes are estimates: structures
    resonate at 20 to 2000 Hz with a quality of 5 to 50.

    Examples
    --------
    >>> SpectralLine(amplitude=0.2, frequency=27.0, axes=["x"]).say()
    'There is a steady line of 0.2 deg/h at 27 Hz on axis x.'
    """

    name = "spectral_line"
    short = "steady line, resonance"
    plain = "a steady spectral line or resonance"
    next_measurement = (
        "change the sampling rate: an aliased line moves, a true one stays; change the rotation "
        "rate to see whether the line follows"
    )
    size_parameters = ("amplitude",)
    likeness: ClassVar[Mapping[str, Likeness]] = {"real_motion": "always", "supply_bias": "always"}

    amplitude: tuple[float, ...] = parameter(
        "deg/h", "amplitude, sqrt(2) times the rms", typical=0.2, limit=1e6, many=True
    )
    frequency: float = parameter("Hz", "frequency", typical=2.7, low=1e-6, high=1e5)
    quality: float = parameter(
        "1", "frequency over width; inf for a steady line", default=math.inf, low=0.5
    )
    phase: tuple[float, ...] = parameter(
        "deg",
        "phase of a steady line at the start of the log; drawn, for all axes alike, if not given",
        default=(),
        limit=1e6,
        many=True,
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Draw the stationary state of the oscillator, or the phases of a steady line [radian]."""
        if math.isinf(self.quality):
            if self.phase:
                return np.radians(self.expand_to_axes("phase", setup.axes))
            return np.full(len(setup.axes), rng.uniform(0.0, 2.0 * math.pi))
        from gyrostab.kernels.random.coloured import begin_process, oscillator

        return begin_process(oscillator(self.frequency, self.quality, setup.rate), rng)

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        amplitude = self.expand_to_axes("amplitude", chunk.setup.axes)[:, None]
        if isinstance(state, np.ndarray):
            return amplitude * sine_means(chunk, self.frequency, state[:, None]), state
        from gyrostab.kernels.random.coloured import read_process

        values, state = read_process(state, chunk.size)
        return amplitude / math.sqrt(2.0) * values, state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List one frequency per band, and qualities of a resonance."""
        grid = {"frequency": windows.frequency}
        return grid if math.isinf(self.quality) else grid | {"quality": np.array([5.0, 15.0, 50.0])}

    def explain(self, windows: Windows) -> Prediction:
        """Predict a spectrum of one process on all axes, and the frequency of the line."""
        place, spectrum = steady_line(windows, self.frequency)
        if not math.isinf(self.quality):
            spectrum = 0.5 * resonance_density(windows, self.frequency, self.quality)
        return Prediction(spectrum={"amplitude": spectrum}, coherent=True, line=place)

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        size, place = self.quantity("amplitude", errors), self.quantity("frequency", errors)
        if math.isinf(self.quality):
            return f"There is a steady line of {size} at {place} {self.on_axes()}."
        quality = self.quantity("quality", errors)
        peak = f"{size} at {place} with a quality of {quality}"
        return f"There is a resonance of {peak} {self.on_axes()}."


@dataclass(frozen=True, kw_only=True)
class RotationLine(Effect):
    """Lines phase-locked to the rotation of the tool, or of another driver such as a pump.

    ``rate(t) = sum_k A k^-p cos(k (m theta(t) + phi))`` over k = 1 to `harmonics`, theta the turns
    of the channel since the start of the log, m the `order` in lines per turn; zero at rest,
    because the motion causes the lines. The phase is the integral of the channel, continued from
    sample to sample, and each sample is the mean over its interval, so a line is aliased where its
    frequency exceeds half of the sampling rate.

    References
    ----------
    No published sizes; estimates: pumps 1 to 6 Hz, stick-slip 0.1 to 0.5 Hz with 0 to 2 times the
    mean rotation rate, whirl 5 to 20 Hz.

    Examples
    --------
    >>> print(RotationLine(amplitude=0.5, harmonics=3, axes=["x"]).say())
    There are 3 lines locked to rotation_rate on axis x, the first of 0.5 deg/h at order 1 (cycles
    per turn).
    """

    name = "rotation_line"
    short = "lines locked to tool rotation, pump or stick-slip"
    plain = "lines locked to the rotation of the tool"
    next_measurement = "repeat at another rotation rate: lines locked to the tool move with it"
    channels: ClassVar[Mapping[str, str]] = {"rotation_rate": INNER["rotation_rate"]}
    size_parameters = ("amplitude",)

    amplitude: tuple[float, ...] = parameter(
        "deg/h", "amplitude of the first line", typical=0.5, limit=1e6, many=True
    )
    order: float = parameter(
        "1", "frequency of the first line [per turn]", default=1.0, low=1e-3, high=1e3
    )
    harmonics: float = parameter(
        "1", "number of lines", default=1.0, low=1.0, high=100.0, whole="whole number of lines"
    )
    rolloff: float = parameter(
        "1", "the k-th line is k^-rolloff of the first", default=1.0, limit=5.0
    )
    phase: tuple[float, ...] = parameter(
        "deg", "phase of the first line at the start", default=(), limit=1e6, many=True
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Start with zero turns of the channel."""
        return 0.0

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        rotation = chunk.drivers["rotation_rate"]
        middle, inside, state = turns_of_samples(self.order * rotation, chunk.rate, state)
        amplitude = self.expand_to_axes("amplitude", chunk.setup.axes)
        phase = np.radians(self.expand_to_axes("phase", chunk.setup.axes))
        lines = amplitude[:, None] * sum(
            k**-self.rolloff * turn_means(k * middle, k * inside, k * phase[:, None])
            for k in range(1, int(self.harmonics) + 1)
        )
        return lines * (np.abs(rotation) >= _LEAST_TURNING_DEG_S), state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List phases over half a turn (the amplitude is signed), and lines per turn."""
        return {"phase": np.arange(0.0, 180.0, 30.0), "order": np.array([1.0, 2.0, 3.0, 4.0])}

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means at slow rotation, the comb, and the frequencies of the lines."""
        rotation = windows.drivers["rotation_rate"]
        phase = np.radians(self.expand_to_axes("phase", windows.axes))
        mean = sum(
            k**-self.rolloff
            * turn_means_of_windows(windows, rotation, k * phase, order=k * self.order)
            for k in range(1, int(self.harmonics) + 1)
        ) * (np.abs(rotation) >= _LEAST_TURNING_DEG_S)
        k = np.arange(1.0, int(self.harmonics) + 1)[:, None]
        cycles = k * self.order * np.abs(rotation) / TURN
        place = fold(cycles, windows.rate)
        power = 0.5 * (k**-self.rolloff * np.sinc(cycles / windows.rate)) ** 2
        comb = line_density(windows, place, power)
        order = {"amplitude": np.ones((len(windows.axes), 3), np.complex128)}
        return Prediction(
            mean={"amplitude": mean}, spectrum={"amplitude": comb}, line=place, order=order
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        count, channel = int(self.harmonics), self.channel_names()["rotation_rate"]
        many = "There is a line" if count == 1 else f"There are {count} lines"
        first = "of" if count == 1 else "the first of"
        size, order = self.quantity("amplitude", errors), self.quantity("order", errors)
        place = f"{size} at order {order} (cycles per turn)"
        return f"{many} locked to {channel} {self.on_axes()}, {first} {place}."
