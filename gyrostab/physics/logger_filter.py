"""Filter and decimation of the logger."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrostab.errors import OptionError
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Setup, Windows, parameter

#: Samples of a fast instrument (`instrument = 0`) per sample of the log: they resolve its low-pass.
FAST_INSTRUMENT_SAMPLES = 16


@dataclass(frozen=True, kw_only=True)
class LoggerFilter(Effect):
    """Filter and decimation of the logger, at the rate of the instrument.

    A Butterworth low-pass of `order` poles with half power at `cutoff` (bilinear transform) is
    followed by a moving average over `length`. A sample of the log is the mean of n samples of the
    instrument (integrate and dump), or with ``pick = 1`` every n-th of them, where n is the
    `oversampling` of the model; what passes the filter above half of the log's rate is then
    aliased. All filters are causal and keep their state between chunks. To explain a recording,
    `instrument` takes the place of n: 1 for a filter at the rate of the log, 0 for a fast
    instrument (n = 16).

    References
    ----------
    Oppenheim and Schafer 2010, Discrete-Time Signal Processing, 3rd ed. (bilinear transform,
    decimation). Sizes are estimates: 0.2 to 0.4 times the log's rate.

    Examples
    --------
    >>> LoggerFilter(cutoff=80, order=4).say()
    'The logger filters on all axes: low-pass of order 4 at 80 Hz; its samples are means.'
    """

    name = "logger_filter"
    short = "low-pass, integrate-and-dump, decimation"
    plain = "a filter in the logger"
    next_measurement = (
        "read the logger settings, or log at a higher rate: a filter leaves the long averaging "
        "times unchanged"
    )
    stage = "sampling"
    size_parameters = ("cutoff", "length", "pick")
    is_steady = True
    shapes_spectrum = True

    cutoff: float = parameter(
        "Hz", "half power of the low-pass; 0 for none", default=0.0, typical=2.0, low=0.0, high=1e6
    )
    order: float = parameter(
        "1", "poles of the low-pass", default=2.0, low=1.0, high=12.0, whole="whole number"
    )
    length: float = parameter(
        "s", "length of the moving average; 0 for none", default=0.0, low=0.0, high=1e4
    )
    pick: float = parameter(
        "1",
        "1: every n-th sample of the instrument; 0: means of n",
        default=0.0,
        low=0.0,
        high=1.0,
        whole="whole number",
    )
    instrument: float = parameter(
        "1",
        "n, to explain a recording; 0: 16, a fast instrument",
        default=0.0,
        low=0.0,
        high=1000.0,
        whole="whole number",
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Design the sections of the low-pass and the length of the average."""
        sections = None
        if self.cutoff:
            from scipy.signal import butter

            if self.cutoff >= setup.rate / 2.0:
                raise OptionError(
                    f"effect {self.name!r}: a cutoff of {self.cutoff:g} Hz is not below half of "
                    f"the instrument's {setup.rate:g} Hz; "
                    "raise oversampling in the model's [log], or lower the cutoff"
                )
            sections = butter(int(self.order), self.cutoff, fs=setup.rate, output="sos")
        taps = max(1, round(self.length * setup.rate))
        if taps > 10_000:
            raise OptionError(
                f"effect {self.name!r}: a length of {self.length:g} s is {taps} samples "
                "of the instrument; give at most 10000"
            )
        return sections, None, taps, None

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
        sections, inner, taps, memory = state
        signal = chunk.signal
        if sections is not None:
            from scipy.signal import sosfilt, sosfilt_zi

            if inner is None:
                inner = sosfilt_zi(sections)[:, None, :] * signal[None, :, :1]
            signal, inner = sosfilt(sections, signal, zi=inner)
        if taps > 1:
            memory = np.repeat(signal[:, :1], taps - 1, axis=1) if memory is None else memory
            history = np.concatenate([memory, signal], axis=1)
            memory = history[:, 1 - taps :].copy()
            total = np.zeros_like(signal)
            for lag in range(taps):
                total += history[:, lag : lag + chunk.size]
            signal = total / taps
        if self.pick:
            signal = signal[:, :: chunk.setup.oversampling]
        return signal, (sections, inner, taps, memory)

    def points(self, windows: Windows) -> list[Mapping[str, float | str]]:
        """List low-passes and averages, for slow and fast instruments; one filter at a time."""
        cutoff = windows.rate * np.geomspace(0.02, 1.5, 27)
        points: list[dict[str, float]] = []
        for order in (1.0, 2.0, 4.0):
            points += [
                {"cutoff": f, "order": order, "instrument": 1.0}
                for f in cutoff[cutoff < 0.49 * windows.rate].tolist()
            ]
            points += [{"cutoff": f, "order": order, "instrument": 0.0} for f in cutoff.tolist()]
        points += [
            {"cutoff": f, "order": 1.0, "instrument": 0.0, "pick": 1.0} for f in cutoff.tolist()
        ]
        points += [
            {"length": taps / windows.rate, "instrument": 1.0}
            for taps in (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
        ]
        points += [
            {"length": taps / windows.rate, "instrument": 0.0}
            for taps in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
        ]
        nothing = {"cutoff": 0.0, "order": 2.0, "length": 0.0, "pick": 0.0, "instrument": 0.0}
        return [nothing | point for point in points]

    def explain(self, windows: Windows) -> Prediction:
        """Predict the factors on the spectra of the noise terms.

        They are those in samples of the instrument. Aliases of white noise raise the whole
        spectrum, those of quantization noise its upper part, and those of slow noise nothing.
        """
        if not (self.cutoff or self.length):
            return Prediction()
        n = int(self.instrument) or FAST_INSTRUMENT_SAMPLES
        frequency, rate = np.asarray(windows.frequency, np.float64), windows.rate
        alias = frequency[..., None] + rate * np.arange(n)
        passed = self._digital_response(alias, rate, n)
        folded = np.minimum(alias, n * rate - alias)
        return Prediction(
            response={
                symbol: np.asarray(
                    (passed * sampled_psd(symbol, folded, n * rate)).sum(axis=-1)
                    / sampled_psd(symbol, frequency, rate)
                )
                for symbol in "QNBK"
            }
        )

    def _digital_response(self, f: Array, rate: float, n: int) -> Array:
        """Return the power response at frequencies of an instrument with `n` samples per sample."""
        fast = n * rate
        if self.cutoff >= fast / 2.0:
            raise OptionError(
                f"effect {self.name!r}: a cutoff of {self.cutoff:g} Hz is not below half of "
                f"the instrument's {fast:g} Hz"
            )
        response = np.ones_like(f)
        if self.cutoff:
            ratio = np.tan(np.pi * f / fast) / math.tan(math.pi * self.cutoff / fast)
            response = 1.0 / (1.0 + ratio ** (2 * int(self.order)))
        for taps in (max(1, round(self.length * fast)), 1 if self.pick else n):
            if taps > 1:  # mean of `taps` samples
                response = (
                    response
                    * (np.sin(np.pi * taps * f / fast) / (taps * np.sin(np.pi * f / fast))) ** 2
                )
        return np.asarray(response)

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        parts = []
        if self.cutoff:
            parts = [f"low-pass of order {int(self.order)} at {self.quantity('cutoff', errors)}"]
        parts += [f"average over {self.quantity('length', errors)}"] if self.length else []
        sampling = (
            "filtered at the rate of the log"
            if self.instrument == 1.0
            else "picked"
            if self.pick
            else "means"
        )
        filters = ", ".join(parts) or "nothing"
        return f"The logger filters {self.on_axes()}: {filters}; its samples are {sampling}."
