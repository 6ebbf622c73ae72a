"""Effects of time alone: a bias that drifts, noise that grows, and warm-up after power-on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.physics.base import Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.units import DAY, HOUR


@dataclass(frozen=True, kw_only=True)
class AgeingBias(Effect):
    """Bias that trends with time.

    ``b = s t + c log(1 + t / t_a)``, t since the start of the log

    References
    ----------
    No published sizes; estimates: below 0.01 deg/h in a day, logarithmic over the first days.

    Examples
    --------
    >>> AgeingBias(slope=0.005, axes=["x"]).say()
    'The bias ages on axis x, by 0.005 deg/h/day.'
    """

    name = "ageing_bias"
    short = "bias trends with time"
    plain = "a bias trend in time"
    next_measurement = (
        "reverse the temperature once: a trend in time continues, a bias that follows temperature "
        "returns"
    )
    size_parameters = ("slope", "logarithmic")

    slope: float = parameter(
        "deg/h/day", "growth of the bias in a day", default=0.0, typical=0.005, limit=1e4
    )
    logarithmic: float = parameter(
        "deg/h", "growth per factor e of t + time", default=0.0, typical=0.01, limit=1e3
    )
    time: float = parameter(
        "h", "time after which the logarithm bends", default=24.0, low=1e-3, high=1e6
    )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        middle = chunk.seconds + 0.5 / chunk.rate
        return self.slope * (middle / DAY) + self.logarithmic * np.log1p(
            middle / (self.time * HOUR)
        ), state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List times at which the logarithm bends, 0.03 to 3 times the length of the record."""
        length = (windows.end[-1] - windows.begin[0]) / HOUR
        return {"time": np.maximum(length * np.array([0.03, 0.1, 0.3, 1.0, 3.0]), 1e-3)}

    def explain(self, windows: Windows) -> Prediction:
        """Predict the window means of both parts."""
        scale = self.time * HOUR

        def integral(t: Floats) -> Floats:
            return np.asarray((scale + t) * np.log1p(t / scale) - t)

        bend = (integral(windows.end) - integral(windows.begin)) / (windows.end - windows.begin)
        return Prediction(mean={"slope": windows.centre / DAY, "logarithmic": bend})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        terms = [self.quantity("slope", errors)] if self.slope or not self.logarithmic else []
        if self.logarithmic:
            size, time = self.quantity("logarithmic", errors), self.quantity("time", errors)
            terms.append(f"{size} times the logarithm of time over {time}")
        return f"The bias ages {self.on_axes()}, by {' and '.join(terms)}."


@dataclass(frozen=True, kw_only=True)
class AgeingNoise(Effect):
    """Angle random walk that grows with time.

    ``N^2(t) = N0^2 (1 + g (t / 1 h)^p)``, t since the start of the log, N0 of the model

    References
    ----------
    Jin et al. 2010, Sci. China Tech. Sci. 53, 3056 (noise of an irradiated gyro grows with the loss
    of its coil, a power law of the dose). The size is an estimate: a light path that loses 1 dB in
    1000 h raises N^2 by 6e-4 in an hour where the noise of the detector dominates.

    Examples
    --------
    >>> print(AgeingNoise(growth=0.02).say())
    The angle random walk ages on all axes: N^2 grows by 0.02 of its initial value in the first
    hour, as time to the power 1.
    """

    name = "ageing_noise"
    short = "N trends with time"
    plain = "white noise with a trend in time"
    next_measurement = "repeat the record at the same temperature some days later"
    stage = "noise"
    terms = "N"
    size_parameters = ("growth",)

    growth: float = parameter(
        "1", "growth of N^2 in the first hour, as a share of it", typical=6e-4, low=0.0, high=1e3
    )
    exponent: float = parameter("1", "power of time", default=1.0, low=0.1, high=5.0)

    def generate(self, chunk: Chunk, state: Any) -> tuple[dict[str, Floats], Any]:
        hours = (chunk.seconds + 0.5 / chunk.rate) / HOUR
        base = chunk.setup.noise["N"][:, None] ** 2
        return {"N": chunk.level["N"] + base * (self.growth * hours**self.exponent)}, state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        return {"exponent": np.array([0.5, 1.0, 2.0])}

    def explain(self, windows: Windows) -> Prediction:
        """Predict the growth of N^2 in every window."""
        power = self.exponent + 1.0
        begin, end = windows.begin / HOUR, windows.end / HOUR
        return Prediction(
            level={("N", "growth"): (end**power - begin**power) / (power * (end - begin))}
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        growth, power = self.quantity("growth", errors), self.quantity("exponent", errors)
        grows = f"grows by {growth} of its initial value in the first hour"
        law = f"as time to the power {power}"
        return f"The angle random walk ages {self.on_axes()}: N^2 {grows}, {law}."


@dataclass(frozen=True, kw_only=True)
class WarmUp(Effect):
    """Bias that decays after every power-on.

    ``b = A q exp(-(t - t_on) / t_w) + A2 q2 exp(-(t - t_on) / t_2)``

    t_on is the start of the log, the end of every restart, and of every gap of at least `gap`. q is
    one for a cold gyro; with a time constant of `cooling`, a short loss of power restores only a
    part: ``q = 1 - (1 - left) exp(-t_off / cooling)``.

    References
    ----------
    Lefevre 2014, The Fiber-Optic Gyroscope, 2nd ed. (thermal transients). Sizes are estimates: 0.01
    to 0.5 deg/h for a gyro of 0.03 deg/h, 0.3 to 5 for one of 1 to 10 deg/h; 1 to 30 min, often
    with two time constants.

    Examples
    --------
    >>> WarmUp(amplitude=0.1, axes=["x"]).say()
    'The bias starts 0.1 deg/h off on axis x after every power-on and settles with a time
     constant of 600 s.'
    """

    name = "warm_up"
    short = "exponential bias after every power-on"
    plain = "warm-up after power-on"
    next_measurement = (
        "switch off and on again at a steady outside temperature: warm-up repeats after every start"
    )
    size_parameters = ("amplitude", "slow_amplitude")

    amplitude: float = parameter("deg/h", "bias of a cold gyro at power-on", typical=0.1, limit=1e4)
    time: float = parameter("s", "time constant", default=600.0, low=1e-3, high=1e6)
    slow_amplitude: float = parameter(
        "deg/h", "amplitude of a second, slower part", default=0.0, typical=0.05, limit=1e4
    )
    slow_time: float = parameter("s", "its time constant", default=HOUR, low=1e-3, high=1e7)
    cooling: float = parameter(
        "s", "time constant of cooling without power; 0 for none", default=0.0, low=0.0, high=1e6
    )
    gap: float = parameter(
        "s",
        "shortest gap that counts as a loss of power; inf for restarts only",
        default=math.inf,
        low=0.0,
    )
    cold: float = parameter(
        "1",
        "share of the amplitude at the start of the log: 1 for a cold gyro",
        default=1.0,
        low=0.0,
        high=1.0,
    )

    def _list_parts(self) -> tuple[tuple[str, float, float], ...]:
        return ("amplitude", self.amplitude, self.time), (
            "slow_amplitude",
            self.slow_amplitude,
            self.slow_time,
        )

    def _list_losses(self, gaps: Array, restarts: Array, per_second: float) -> Floats:
        """List losses of power [s] from gaps and restarts in units of 1 / `per_second` s."""
        long = (gaps[:, 1] - gaps[:, 0]) >= self.gap * per_second * (1.0 - 1e-9)
        return _merge_spans(np.concatenate([restarts, gaps[long]])) / per_second

    def _initial_shares(self, losses: Floats, time: float) -> Floats:
        """Compute the share of the amplitude at the start and after every loss of power."""
        on, share, shares = 0.0, self.cold, [self.cold]
        for gone, back in losses.tolist():
            remaining = share * math.exp(-(gone - on) / time)
            share = 1.0 - (1.0 - remaining) * (
                math.exp(-(back - gone) / self.cooling) if self.cooling else 0.0
            )
            on = back
            shares.append(share)
        return np.array(shares)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Compute the times of power-on, and the initial share of each part."""
        losses = self._list_losses(setup.gaps, setup.restarts, setup.rate)
        return np.concatenate([[0.0], losses[:, 1]]), [
            self._initial_shares(losses, time) for _, _, time in self._list_parts()
        ]

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        on, shares = state
        which = (
            np.searchsorted(
                np.rint(on * chunk.rate), chunk.first + np.arange(chunk.size), side="right"
            )
            - 1
        )
        since = chunk.seconds - on[which]
        bias = np.zeros(chunk.size)
        for (_, amplitude, time), share in zip(self._list_parts(), shares, strict=True):
            if not amplitude:
                continue
            inside = 1.0 / (chunk.rate * time)
            bias += (
                amplitude * (-math.expm1(-inside) / inside) * share[which] * np.exp(-since / time)
            )
        return bias, state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List time constants of the gyro and of its cooling."""
        slow = {"slow_time": np.geomspace(1800.0, 14400.0, 4)} if self.slow_amplitude else {}
        return {
            "time": np.geomspace(60.0, 1800.0, 6),
            "cooling": np.array([0.0, 300.0, 1800.0]),
        } | slow

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means over the time with data."""
        losses = self._list_losses(windows.gaps, windows.restarts, 1.0)
        holes = _merge_spans(np.concatenate([windows.gaps, windows.restarts]))
        begin, end = np.concatenate([[0.0], holes[:, 1]]), np.concatenate([holes[:, 0], [np.inf]])
        on = np.concatenate([[0.0], losses[:, 1]])
        which = np.searchsorted(on, begin, side="right") - 1
        present = _integrate_windows(windows, begin, end, lambda row, t: t - begin[row])
        mean = {}
        for name, _, time in self._list_parts():
            share = self._initial_shares(losses, time)[which]
            total = _integrate_windows(
                windows,
                begin,
                end,
                partial(
                    _integrate_decay, time=time, size=share, since=begin - on[which], begin=begin
                ),
            )
            mean[name] = np.divide(total, present, out=np.zeros_like(total), where=present > 0)
        return Prediction(mean=mean)

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        size, time = self.quantity("amplitude", errors), self.quantity("time", errors)
        settles = f"settles with a time constant of {time}"
        if self.slow_amplitude:
            slow, slow_time = (
                self.quantity(f"slow_{name}", errors) for name in ("amplitude", "time")
            )
            settles += f"; another {slow} settles with {slow_time}"
        return f"The bias starts {size} off {self.on_axes()} after every power-on and {settles}."


def _merge_spans(spans: Array) -> Floats:
    """Sort spans, and merge those that touch."""
    rows: list[list[float]] = []
    for begin, end in sorted(spans.tolist()):
        if rows and begin <= rows[-1][1]:
            rows[-1][1] = max(rows[-1][1], end)
        else:
            rows.append([begin, end])
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _integrate_decay(
    row: Ints, t: Floats, *, time: float, size: Floats, since: Floats, begin: Floats
) -> Floats:
    """Integrate an exponential from the begin of a span, `since` after its power-on, to t."""
    return np.asarray(
        time * size[row] * np.exp(-since[row] / time) * -np.expm1(-(t - begin[row]) / time)
    )


def _integrate_windows(
    windows: Windows, begin: Floats, end: Floats, part: Callable[[Ints, Floats], Floats]
) -> Floats:
    """Integrate over every window; ``part(row, t)`` is the integral from begin[row] to t."""
    until = np.maximum(np.minimum(end, windows.end.max()), begin)
    integral_before = np.concatenate([[0.0], np.cumsum(part(np.arange(begin.size), until))])

    def up_to(t: Floats) -> Floats:
        row = np.searchsorted(begin, t, side="right") - 1
        return np.asarray(integral_before[row] + part(row, np.minimum(t, end[row])))

    return up_to(windows.end) - up_to(windows.begin)
