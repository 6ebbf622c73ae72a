"""Effects of the sampling: filter and decimation of the logger, and its clock."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.noise import sampled_psd
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.units import HOUR

#: Samples of a fast instrument (`instrument = 0`) per sample of the log: they resolve its low-pass.
FAST_INSTRUMENT_SAMPLES = 16
_PPM = 1e-6
_MAX_KEPT_SAMPLES = 2**20
_MIN_PART = 1e-6  # of a sample; smaller ones are rounding


@dataclass(frozen=True, kw_only=True)
class LoggerFilter(Effect):
    """Filter and decimation of the logger, at the rate of the instrument.

    A Butterworth low-pass of `order` poles with half power at `cutoff` (bilinear transform) is
    followed by a moving average over `length`, in which the oldest sample counts for the part that
    it fills. A sample of the log is the mean of n samples of the
    instrument (integrate and dump), or with ``pick = 1`` every n-th of them, where n is the
    `oversampling` of the model; what passes the filter above half of the log's rate is then
    aliased. All filters are causal and keep their state between chunks. With ``instrument = 1`` the
    filter acts on the samples of the log instead. With 0, n is the oversampling of a model, and 16
    to explain a recording, for instance of a fast instrument.

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
        "n: 1 for a filter at the rate of the log; 0: the oversampling, 16 for a recording",
        default=0.0,
        low=0.0,
        high=1000.0,
        whole="whole number",
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Design the sections of the low-pass, and check the average."""
        if self.instrument > 1.0 and self.instrument != setup.oversampling:
            raise OptionError(
                f"effect {self.name!r}: instrument = {self.instrument:g} is not the oversampling "
                f"of the model, which is {setup.oversampling}; give oversampling = "
                f"{self.instrument:g} in [log], or leave instrument out"
            )
        rate = setup.rate * self._samples_at(setup.oversampling) / setup.oversampling
        sections = None
        if self.cutoff:
            from scipy.signal import butter

            if self.cutoff >= rate / 2.0:
                raise OptionError(
                    f"effect {self.name!r}: a cutoff of {self.cutoff:g} Hz is not below half of "
                    f"the instrument's {rate:g} Hz; "
                    "raise oversampling in the model's [log], or lower the cutoff"
                )
            sections = butter(int(self.order), self.cutoff, fs=rate, output="sos")
        whole, part = self._split_length(rate)
        if whole > 10_000:
            raise OptionError(
                f"effect {self.name!r}: a length of {self.length:g} s is {whole} samples "
                "of the instrument; give at most 10000"
            )
        if whole == 0 and part:
            raise OptionError(
                f"effect {self.name!r}: a length of {self.length:g} s is shorter than a sample of "
                f"the instrument's {rate:g} Hz, so that the average changes nothing; "
                "raise oversampling in the model's [log], or leave length out"
            )
        return sections, None, None

    def at_oversampling(self, oversampling: int) -> Self:
        """Return the same filter of a model with this oversampling, with n as its `instrument`."""
        return replace(self, instrument=float(self._samples_at(oversampling)))

    def _samples_at(self, oversampling: int) -> int:
        """Return n, the samples that the filter takes in one of the log."""
        return 1 if self.instrument == 1.0 else oversampling

    def _split_length(self, rate: float) -> tuple[int, float]:
        """Return the whole samples in the moving average, and the part of the one before them."""
        samples = self.length * rate
        whole = math.floor(samples + _MIN_PART)
        return whole, samples - whole if samples - whole > _MIN_PART else 0.0

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        sections, inner, memory = state
        oversampling = chunk.setup.oversampling
        samples = self._samples_at(oversampling)
        count = oversampling // samples
        signal = _average_samples(chunk.signal, count)
        # before the log, the filter has followed the rate: the first sample without its noise
        start = _average_samples(chunk.signal[:, :count] - chunk.white[:, :count], count)
        if sections is not None:
            from scipy.signal import sosfilt, sosfilt_zi

            if inner is None:
                inner = sosfilt_zi(sections)[:, None, :] * start[None]
            signal, inner = sosfilt(sections, signal, zi=inner)
        whole, part = self._split_length(chunk.rate * samples / oversampling)
        weights = [part] * (part > 0.0) + [1.0] * whole  # the oldest sample first
        if len(weights) > 1:
            older = len(weights) - 1
            memory = np.repeat(start, older, axis=1) if memory is None else memory
            history = np.concatenate([memory, signal], axis=1)
            memory = history[:, -older:].copy()
            total = np.zeros_like(signal)
            for lag, weight in enumerate(weights):
                past = history[:, lag : lag + signal.shape[1]]
                total += past if weight == 1.0 else weight * past
            signal = total / (whole + part)
        if self.pick:
            signal = signal[:, ::samples]
        return signal, (sections, inner, memory)

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

    def _digital_response(self, f: Floats, rate: float, n: int) -> Floats:
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
        for whole, part in (self._split_length(fast), (1 if self.pick else n, 0.0)):
            total = whole + part
            if total > 1.0:  # mean of whole samples and a part of the one before
                mean = np.sin(np.pi * whole * f / fast) / (total * np.sin(np.pi * f / fast))
                rest = part / total
                turn = np.cos(np.pi * (whole + 1) * f / fast)
                response = response * (mean**2 + rest**2 + 2.0 * rest * mean * turn)
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


def _average_samples(signal: Floats, count: int) -> Floats:
    """Average each `count` samples."""
    if count == 1:
        return signal
    return np.asarray(signal.reshape(signal.shape[0], -1, count).mean(axis=2))


@dataclass(frozen=True, kw_only=True)
class ClockError(Effect):
    """Wrong rate of the sampling clock, whose time stamps are taken as correct.

    When the clock has counted t, the true time is ``theta(t) = t - s(t)`` with ``s' = e + d t``: e
    is the `error` of a fast clock, d its `drift`. The log holds the signal at theta. Where the gyro
    gives angle increments (``output = "angle"``), they are divided by the wrong interval, and ``w``
    becomes ``w theta'``.

    With ``reading = "latest"`` the logger takes the latest sample of the instrument, and skips or
    repeats one every 1 / e samples. With ``"average"`` it averages, over its interval, an
    instrument that holds every sample until the next. White noise then keeps its N at long times,
    but loses up to half of its variance in samples between two others, so give the model an
    `oversampling`. Stamps of a fast clock are right at the start of the log, those of a slow one at
    its end (the first sample is held until its time), which keeps the effect causal.

    References
    ----------
    Allan 1987, IEEE Trans. UFFC 34, 647 (clock models). Sizes are estimates: 20 to 100 ppm for
    plain quartz.

    Examples
    --------
    >>> ClockError(error=50).say()
    'The sampling clock is fast by 50 ppm on all axes.'
    """

    name = "clock_error"
    short = "wrong or drifting rate of time"
    plain = "an error of the clock"
    next_measurement = "log a second clock, or a known frequency such as the mains"
    stage = "sampling"
    size_parameters = ("error", "drift")

    error: float = parameter(
        "ppm",
        "relative error of a fast clock at the start; negative for slow",
        default=0.0,
        typical=50.0,
        limit=1e5,
    )
    drift: float = parameter("ppm/h", "growth of the error", default=0.0, typical=1.0, limit=1e4)
    output: str = parameter(
        "text",
        "angle increments over the counted interval, or rates",
        default="angle",
        choices=("angle", "rate"),
    )
    reading: str = parameter(
        "text", "how a sample is taken", default="latest", choices=("latest", "average")
    )

    def slip(self, seconds: Floats, duration: float) -> Floats:
        """Compute the lead of the stamps over true time [s] at counted `seconds` of `duration`."""
        error, drift = self.error * _PPM, self.drift * _PPM / HOUR

        def ahead(t: Any) -> Any:
            return error * t + drift * t * t / 2.0

        lowest = min(ahead(t) for t in self._list_extremes(duration))
        return np.asarray(ahead(seconds) - lowest)

    def _list_extremes(self, duration: float) -> tuple[float, float, float]:
        """List the times of extreme slip [s]: start, end, and zero crossing of the error."""
        turning = -self.error / self.drift * HOUR if self.drift else 0.0
        return 0.0, duration, min(max(turning, 0.0), duration)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Compute the number of samples to keep; the memory starts empty."""
        duration = setup.size / setup.rate
        times = np.array(self._list_extremes(duration))
        growth = (self.error + self.drift * times / HOUR) * _PPM
        if np.abs(growth).max() > 0.3:
            raise OptionError(
                f"effect {self.name!r}: the clock error reaches "
                f"{100 * np.abs(growth).max():.0f} %; make error and drift smaller"
            )
        keep = math.ceil(float(self.slip(times, duration).max()) * setup.rate) + 3
        if keep > _MAX_KEPT_SAMPLES:
            raise OptionError(
                f"effect {self.name!r}: the clock slip reaches {keep} samples; "
                "make the log shorter, or error and drift smaller"
            )
        return keep, None

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        keep, memory = state
        if not (self.error or self.drift):
            return chunk.signal, state
        if memory is None:
            memory = np.repeat(chunk.signal[:, :1], keep, axis=1)
        history = np.concatenate([memory, chunk.signal], axis=1)
        start = chunk.first - keep  # first sample of the instrument in `history`
        edges = np.arange(chunk.first, chunk.first + chunk.size + 1, dtype=np.float64)
        read = edges - self.slip(edges / chunk.rate, chunk.setup.size / chunk.rate) * chunk.rate
        latest = self.reading == "latest"
        values = (
            history[:, np.floor(read[:-1]).astype(np.int64) - start]
            if latest
            else _means_between(history, start, read)
        )
        if self.output == "angle":
            middle = (edges[:-1] + 0.5) / chunk.rate
            values = values * (1.0 - (self.error + self.drift * middle / HOUR) * _PPM)
        return values, (keep, history[:, -keep:].copy())

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means proportional to the rate, if the gyro gives angle increments."""
        rates = np.stack([windows.own[axis] for axis in windows.axes]) * (self.output == "angle")
        return Prediction(
            mean={"error": -_PPM * rates, "drift": -_PPM * rates * windows.centre / HOUR}
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        fast, size = ("slow", -self.error) if self.error < 0 else ("fast", self.error)
        number = self.quantity("error", errors).replace(f"{self.error:.4g}", f"{size:.4g}", 1)
        more = f", growing by {self.quantity('drift', errors)}," if self.drift else ""
        return f"The sampling clock is {fast} by {number}{more} {self.on_axes()}."


def _means_between(history: Floats, start: int, read: Floats) -> Floats:
    """Average held samples between successive positions less than two samples apart.

    `history` begins with sample `start`.
    """
    begin, end = read[:-1], read[1:]
    sample = np.floor(begin)
    column = sample.astype(np.int64) - start
    total = np.zeros((history.shape[0], begin.size))
    for step in range(3):
        share = np.clip(
            np.minimum(end, sample + step + 1) - np.maximum(begin, sample + step), 0.0, 1.0
        )
        total += share * history[:, np.minimum(column + step, history.shape[1] - 1)]
    return total / (end - begin)
