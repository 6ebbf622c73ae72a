"""Effects of logger and telemetry on samples: quantization, bit errors and held samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.units import HOUR

#: Mean lengths of a frame sent twice, to which its geometric law is cut: longer ones have a
#: probability of 2e-9.
_FRAME_LENGTHS = 20.0


@dataclass(frozen=True, kw_only=True)
class RateQuantization(Effect):
    """Quantization of the rate in steps q.

    ``out = q round(w / q)``, or with ``mode = "floor"`` the value below, with ``"zero"`` the value
    towards zero.

    References
    ----------
    Widrow and Kollar 2008, Quantization Noise (q^2 / 12). Sizes: recordings of an ADIS16405 and a
    CH104 have steps of 180 and 36 deg/h; 0.1 arcsec in 10 ms, in a common file format, is 10 deg/h.

    Examples
    --------
    >>> RateQuantization(step=0.5).say()
    'The rate is quantized in steps of 0.5 deg/h on all axes.'
    """

    name = "rate_quantization"
    short = "quantization grid of the rate"
    plain = "quantization of the output"
    next_measurement = "log with one more bit, or in counts"
    stage = "logger"
    size_parameters = ("step",)

    step: float = parameter("deg/h", "distance between the values", typical=1.0, low=0.0, high=1e9)
    mode: str = parameter(
        "text",
        "to the nearest value, to the one below, or towards zero",
        default="round",
        choices=("round", "floor", "zero"),
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        if self.step == 0.0:
            return chunk.signal, state
        count = chunk.signal / self.step
        return self.step * {"round": np.rint, "floor": np.floor, "zero": np.trunc}[self.mode](
            count
        ), state

    def transfer(self, rate: Floats) -> Floats | None:
        """Return the truncated values of "zero"; rounding adds noise instead."""
        is_truncated = self.mode == "zero" and self.step > 0.0
        return self.step * np.trunc(rate / self.step) if is_truncated else None

    def explain(self, windows: Windows) -> Prediction:
        """Predict white noise of step^2 / 12 in every sample, and the offset of "floor".

        "zero" has an offset of half a step towards zero: a constant while the rate keeps its sign.
        """
        white = np.full((windows.begin.size, windows.frequency.size), 1.0 / (12.0 * windows.rate))
        mean = {"step": np.full(windows.begin.size, -0.5)} if self.mode == "floor" else {}
        return Prediction(mean=mean, spectrum={"step": white}, marks=("lattice",))

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        return (
            f"The rate is quantized in steps of {self.quantity('step', errors)} {self.on_axes()}."
        )


@dataclass(frozen=True, kw_only=True)
class Spikes(Effect):
    """Single wrong samples: bit errors or outliers.

    At random times, independently on each axis: ``kind = "bit"`` flips one bit, any of `bits` with
    equal probability, of the count of `lsb` (two's complement); ``"outlier"`` adds a normal number
    of the rms `size`.

    References
    ----------
    IEEE Std 952-1997 (test of the data for outliers). Rates are estimates.

    Examples
    --------
    >>> Spikes(per_hour=2, lsb=0.1, bits=16).say()
    'Single samples are wrong on all axes: one of 16 bits flips (lowest bit: 0.1 deg/h), 2
     times per hour.'
    """

    name = "spikes"
    short = "bit errors, outliers"
    plain = "bit errors or outliers"
    next_measurement = "log the raw data words: bit errors change them by powers of two counts"
    stage = "logger"
    size_parameters = ("per_hour",)

    per_hour: float = parameter(
        "1/h", "wrong samples of every axis", typical=60.0, low=0.0, high=1e8
    )
    kind: str = parameter("text", "what is wrong", default="bit", choices=("bit", "outlier"))
    lsb: float = parameter("deg/h", "what the lowest bit counts", default=0.1, low=1e-12, high=1e9)
    bits: float = parameter(
        "1", "bits of the number", default=16.0, low=2.0, high=48.0, whole="whole number"
    )
    size: float = parameter("deg/h", "rms of an outlier", default=100.0, low=0.0, high=1e12)

    def _sample_probability(self, rate: float) -> float:
        return min(1.0, self.per_hour / HOUR / rate)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Draw the first wrong sample of every axis."""
        chance = self._sample_probability(setup.rate)
        return [
            (child, int(child.geometric(chance)) - 1 if chance else None)
            for child in rng.spawn(len(setup.axes))
        ]

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        signal, chance, new_state = chunk.signal.copy(), self._sample_probability(chunk.rate), []
        for row, (child, following) in enumerate(state):
            while following is not None and following < chunk.first + chunk.size:
                place = following - chunk.first
                signal[row, place] = self._corrupt_value(float(signal[row, place]), child)
                following += int(child.geometric(chance))
            new_state.append((child, following))
        return signal, new_state

    def _corrupt_value(self, value: float, rng: np.random.Generator) -> float:
        if self.kind == "outlier":
            return value + self.size * float(rng.standard_normal())
        bits = int(self.bits)
        bit = int(rng.integers(bits))
        is_set = (round(value / self.lsb) >> bit) & 1
        weight = -(1 << bit) if bit == bits - 1 else 1 << bit
        return value + (-weight if is_set else weight) * self.lsb

    def explain(self, windows: Windows) -> Prediction:
        """Predict white noise with the mean square of the spikes, and outliers."""
        bits = int(self.bits)
        name, square = (
            ("size", 1.0) if self.kind == "outlier" else ("lsb", (4.0**bits - 1.0) / (3.0 * bits))
        )
        white = np.full(
            (windows.begin.size, windows.frequency.size),
            self._sample_probability(windows.rate) * square / windows.rate,
        )
        return Prediction(spectrum={name: white}, marks=("outliers",))

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        bit = f"one of {int(self.bits)} bits flips (lowest bit: {self.quantity('lsb', errors)})"
        deviation = bit if self.kind == "bit" else f"by {self.quantity('size', errors)} rms"
        often = self.quantity("per_hour", errors).removesuffix(" 1/h")
        return f"Single samples are wrong {self.on_axes()}: {deviation}, {often} times per hour."


@dataclass(frozen=True, kw_only=True)
class HeldSamples(Effect):
    """Lost samples that are silently replaced by earlier ones, or by zero.

    At random times, on all axes together, a geometric number of samples with the mean `length` (at
    least one) is replaced: by the last good one (``repeat``), by zero, or by as many samples just
    before (``frame``, a frame of telemetry that is sent twice).

    References
    ----------
    Wang et al. 2016, Sensors (data lost in telemetry, replaced by zeros). Rates are estimates.

    Examples
    --------
    >>> print(HeldSamples(per_hour=30, length=0.5).say())
    Samples are lost and filled with earlier ones on all axes, 30 times per hour for 0.5 s on
    average.
    """

    name = "held_samples"
    short = "repeated or zero-filled samples"
    plain = "repeated or zero-filled samples"
    next_measurement = "log a counter with each sample"
    stage = "logger"
    size_parameters = ("per_hour",)
    is_simultaneous = True
    shapes_spectrum = True

    per_hour: float = parameter(
        "1/h", "losses, outside of a loss", typical=360.0, low=0.0, high=1e8
    )
    length: float = parameter(
        "s", "mean length of a loss; at least a sample", default=0.5, low=0.0, high=1e6
    )
    fill: str = parameter(
        "text",
        "replacement: the last sample, zero, or the frame before",
        default="repeat",
        choices=("repeat", "zero", "frame"),
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Draw the first loss, [first sample, one past the last]; no good sample is known yet."""
        return rng, self._draw_loss(rng, 0, setup.rate), None

    def _draw_loss(
        self, rng: np.random.Generator, previous_end: int, rate: float
    ) -> tuple[int, int] | None:
        """Draw the next loss, with at least one good sample before it."""
        if self.per_hour == 0.0:
            return None
        first = previous_end + int(rng.geometric(min(1.0, self.per_hour / HOUR / rate)))
        count = int(rng.geometric(1.0 / max(1.0, self.length * rate)))
        if self.fill == "frame":
            count = min(count, first, self._samples_kept(rate))
        return first, first + count

    def _samples_kept(self, rate: float) -> int:
        """Return the samples that are kept to fill a loss: the last one, or the longest frame."""
        longest = math.ceil(_FRAME_LENGTHS * max(1.0, self.length * rate))
        return longest if self.fill == "frame" else 1

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        rng, loss, memory = state
        n_kept = self._samples_kept(chunk.rate)
        if memory is None:
            memory = np.repeat(chunk.signal[:, :1], n_kept, axis=1)
        history = np.concatenate([memory, chunk.signal], axis=1)
        end, offset = chunk.first + chunk.size, n_kept - chunk.first
        while loss is not None and loss[0] < end:
            low, high = max(loss[0], chunk.first) + offset, min(loss[1], end) + offset
            if self.fill == "frame":
                count = loss[1] - loss[0]
                history[:, low:high] = history[:, low - count : high - count]
            else:
                history[:, low:high] = 0.0 if self.fill == "zero" else history[:, low - 1 : low]
            if loss[1] > end:
                break
            loss = self._draw_loss(rng, loss[1], chunk.rate)
        return history[:, n_kept:], (rng, loss, history[:, -n_kept:].copy())

    def explain(self, windows: Windows) -> Prediction:
        """Predict a larger N, or window means biased towards zero."""
        count = max(1.0, self.length * windows.rate)
        if self.fill == "zero":
            share = count / windows.rate / HOUR
            rates = np.stack([windows.own[axis] for axis in windows.axes])
            return Prediction(mean={"per_hour": -share * rates}, marks=("filled",))
        growth = 2.0 * (count if self.fill == "frame" else count**2) / (HOUR * windows.rate)
        return Prediction(
            level={("N", "per_hour"): np.full(windows.begin.size, growth)}, marks=("repeats",)
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        filling = {"repeat": "earlier ones", "zero": "zero", "frame": "the frame before"}[self.fill]
        often = self.quantity("per_hour", errors).removesuffix(" 1/h")
        length = self.quantity("length", errors)
        times = f"{often} times per hour for {length} on average"
        return f"Samples are lost and filled with {filling} {self.on_axes()}, {times}."
