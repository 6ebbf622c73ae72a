"""Clock of the logger."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrostab.errors import OptionError
from gyrostab.physics.base import (
    Array,
    Chunk,
    Effect,
    Prediction,
    Setup,
    Windows,
    parameter,
)
from gyrostab.units import HOUR

_PPM = 1e-6
_MAX_KEPT_SAMPLES = 2**20


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
    'The clock of the samples is fast by 50 ppm on all axes.'
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

    def slip(self, seconds: Array, duration: float) -> Array:
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

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
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
        return f"The clock of the samples is {fast} by {number}{more} {self.on_axes()}."


def _means_between(history: Array, start: int, read: Array) -> Array:
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
