"""Warm-up of a gyro after power-on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.physics.base import Array, Chunk, Effect, Prediction, Setup, Windows, parameter
from gyrostab.units import HOUR


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

    def _list_losses(self, gaps: NDArray[Any], restarts: NDArray[Any], per_second: float) -> Array:
        """List losses of power [s] from gaps and restarts in units of 1 / `per_second` s."""
        long = (gaps[:, 1] - gaps[:, 0]) >= self.gap * per_second * (1.0 - 1e-9)
        return _merge_spans(np.concatenate([restarts, gaps[long]])) / per_second

    def _initial_shares(self, losses: Array, time: float) -> Array:
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

    def generate(self, chunk: Chunk, state: Any) -> tuple[Array, Any]:
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

    def nuisance(self, windows: Windows) -> Mapping[str, Array]:
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


def _merge_spans(spans: NDArray[Any]) -> Array:
    """Sort spans, and merge those that touch."""
    rows: list[list[float]] = []
    for begin, end in sorted(spans.tolist()):
        if rows and begin <= rows[-1][1]:
            rows[-1][1] = max(rows[-1][1], end)
        else:
            rows.append([begin, end])
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _integrate_decay(
    row: NDArray[np.int64], t: Array, *, time: float, size: Array, since: Array, begin: Array
) -> Array:
    """Integrate an exponential from the begin of a span, `since` after its power-on, to t."""
    return np.asarray(
        time * size[row] * np.exp(-since[row] / time) * -np.expm1(-(t - begin[row]) / time)
    )


def _integrate_windows(
    windows: Windows, begin: Array, end: Array, part: Callable[[NDArray[np.int64], Array], Array]
) -> Array:
    """Integrate over every window; ``part(row, t)`` is the integral from begin[row] to t."""
    until = np.maximum(np.minimum(end, windows.end.max()), begin)
    integral_before = np.concatenate([[0.0], np.cumsum(part(np.arange(begin.size), until))])

    def up_to(t: Array) -> Array:
        row = np.searchsorted(begin, t, side="right") - 1
        return np.asarray(integral_before[row] + part(row, np.minimum(t, end[row])))

    return up_to(windows.end) - up_to(windows.begin)
