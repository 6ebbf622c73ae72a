"""Bias that changes in steps: jumps, telegraph and fringe hops."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gyrostab.arrays import Floats
from gyrostab.physics.base import Chunk, Effect, Likeness, Prediction, Setup, Windows, parameter
from gyrostab.physics.phase import lorentz_density
from gyrostab.units import HOUR

_LIGHT_M_PER_S = 299_792_458.0  # m/s
_RADIAN_PER_S = math.degrees(1.0) * HOUR  # deg/h


def step_means(positions: Sequence[float], levels: Sequence[Any], first: int, size: int) -> Floats:
    """Average a piecewise constant function over each sample.

    Parameters
    ----------
    positions : sequence of float
        Increasing positions of the steps [samples since the start of the log].
    levels : sequence
        Values before the first step, after it, and so on: one more than steps. A value may be an
        array of rows.
    first, size : int
        First sample and number of samples.

    Returns
    -------
    ndarray, shape (size,) or (rows, size)

    Examples
    --------
    >>> step_means([1.0, 2.75], [0.0, 4.0, -4.0], 0, 4)
    array([ 0.,  4.,  2., -4.])
    """
    where, values = np.asarray(positions, np.float64), np.asarray(levels, np.float64)
    steps = np.diff(values, axis=0)
    means = values[np.searchsorted(where, first + np.arange(size), side="right")]
    index = np.clip(np.floor(where) - first, -1, size).astype(np.int64)
    inside = (index >= 0) & (index < size) & (where > np.floor(where))
    share = (index + first + 1 - where)[inside]
    np.add.at(means, index[inside], steps[inside] * share.reshape(-1, *(1,) * (values.ndim - 1)))
    return np.ascontiguousarray(means.T)


@dataclass
class _Stepping:
    """State of a random step process: its level, and the position of its next step [samples]."""

    rng: np.random.Generator
    level: Any
    next: float


def _average_process(process: _Stepping, chunk: Chunk, step: Callable[[_Stepping], None]) -> Floats:
    """Average a process over each sample; `step` changes its level and sets its next step."""
    positions: list[float] = []
    levels = [process.level]
    while process.next < chunk.first + chunk.size:
        positions.append(process.next)
        step(process)
        levels.append(process.level)
    return step_means(positions, levels, chunk.first, chunk.size)


def _draw_wait(rng: np.random.Generator, mean: float) -> float:
    """Draw an exponential waiting time; infinite if its mean is."""
    drawn = float(rng.standard_exponential())
    return math.inf if math.isinf(mean) else drawn * mean


def _share_after(windows: Windows, instant: float) -> Floats:
    """Compute the share of every window that lies after an instant [s]."""
    return np.clip((windows.end - instant) / (windows.end - windows.begin), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class BiasJump(Effect):
    """Bias that jumps permanently at restarts, at shocks, or at a given time.

    ``b = J_1 + J_2 + ...``, with normal J of the rms `restart` at every return of power, and of the
    rms `shock` at random times; and the step `step` at the time `at`. A shock acts on all axes with
    independent sizes.

    References
    ----------
    Wang et al. 2016, Sensors (loss of power and vibration in one record). Sizes are estimates: 0.01
    to 0.1 deg/h for a good gyro, 0.1 to 3 deg/h for a simple one.

    Examples
    --------
    >>> BiasJump(step=0.1, at=330, axes=["x"]).say()
    'The bias jumps on axis x: by 0.1 deg/h at 330 s.'
    """

    name = "bias_jump"
    short = "bias changes at restarts, shocks"
    plain = "a bias jump"
    next_measurement = (
        "switch the power off and on several times, with nothing else changed, and compare the "
        "bias before and after"
    )
    size_parameters = ("restart", "shock", "step")

    restart: float = parameter(
        "deg/h", "rms of the jump at every restart", default=0.0, typical=0.05, low=0.0, high=1e6
    )
    shock: float = parameter(
        "deg/h", "rms of the jump at every shock", default=0.0, typical=0.02, low=0.0, high=1e6
    )
    shocks_per_hour: float = parameter(
        "1/h", "shocks at random times", default=0.0, typical=2.0, low=0.0, high=1e6
    )
    step: tuple[float, ...] = parameter(
        "deg/h", "jump at the time `at`", default=(), typical=(0.1,), limit=1e9, many=True
    )
    at: float = parameter(
        "s", "time of that jump since the start of the log", default=0.0, typical=100.0, low=0.0
    )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Compute the jumps at restarts and at `at`, and draw the first shock."""
        restarts, shocks = rng.spawn(2)
        count = len(setup.axes)
        normal = restarts.standard_normal((len(setup.restarts), count))
        places = np.append(setup.restarts[:, 1].astype(np.float64), self.at * setup.rate)
        jumps = np.concatenate(
            [self.restart * normal, self.expand_to_axes("step", setup.axes)[None]]
        )
        order = np.argsort(places, kind="stable")
        levels = np.cumsum(np.concatenate([np.zeros((1, count)), jumps[order]]), axis=0)
        mean = HOUR * setup.rate / self.shocks_per_hour if self.shocks_per_hour else math.inf
        return (
            places[order],
            levels,
            _Stepping(shocks, np.zeros(count), _draw_wait(shocks, mean)),
            mean,
        )

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        places, levels, process, mean = state

        def jump(process: _Stepping) -> None:
            process.level = process.level + self.shock * process.rng.standard_normal(
                len(chunk.setup.axes)
            )
            process.next += _draw_wait(process.rng, mean)

        listed_jumps = step_means(places, levels, chunk.first, chunk.size)
        return listed_jumps + _average_process(process, chunk, jump), state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List times of the jump: returns of power, and edges and centres of the windows."""
        restart_times = windows.restarts[:, 1] if windows.restarts.size else np.empty(0)
        return {
            "at": np.unique(
                np.concatenate(
                    [restart_times, windows.begin[1:], (windows.begin + windows.end) / 2.0]
                )
            )
        }

    def explain(self, windows: Windows) -> Prediction:
        """Predict the share of every window after the jump; random jumps are fitted as `step`."""
        return Prediction(mean={"step": _share_after(windows, self.at)})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        parts = (
            [f"by {self.quantity('step', errors)} at {self.quantity('at', errors)}"]
            if any(self.step)
            else []
        )
        parts += [f"by {self.quantity('restart', errors)} rms at restarts"] if self.restart else []
        if self.shock:
            size = self.quantity("shock", errors)
            parts.append(f"by {size} rms at shocks, {self.shocks_per_hour:.3g} per hour")
        return f"The bias jumps {self.on_axes()}: {'; '.join(parts) or 'by nothing'}."


@dataclass(frozen=True, kw_only=True)
class Telegraph(Effect):
    """Bias that switches between two levels at random times.

    ``b = 0`` or ``D``; the dwell times are exponential, with the means `low` (at 0) and `high` (at
    D).

    References
    ----------
    Machlup 1954, J. Appl. Phys. 25, 341 (spectrum). Sizes are estimates: 0.01 to 0.3 deg/h, 10 to
    1000 s.

    Examples
    --------
    >>> Telegraph(step=0.1, low=100, high=50, axes=["x"]).say()
    'The bias switches by 0.1 deg/h on axis x, for 50 s up and 100 s down on average.'
    """

    name = "telegraph"
    short = "bias switches between levels"
    plain = "a bias that switches between two levels"
    next_measurement = (
        "record until the bias has switched ten times: the histogram of the means then shows two "
        "levels"
    )
    size_parameters = ("step",)
    likeness: ClassVar[Mapping[str, Likeness]] = {"bias_jump": "single event"}
    is_steady = True
    shapes_spectrum = True

    step: tuple[float, ...] = parameter(
        "deg/h", "upper level above the lower", typical=(0.1,), limit=1e9, many=True
    )
    low: float = parameter(
        "s", "mean time at the lower level, where the bias is 0", default=100.0, low=1e-3, high=1e9
    )
    high: float = parameter("s", "mean time at the upper level", default=100.0, low=1e-3, high=1e9)

    @property
    def correlation_time(self) -> float:
        """Correlation time T_c [s]."""
        return self.low * self.high / (self.low + self.high)

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Draw the level of every axis from the stationary state."""
        rows = []
        for child in rng.spawn(len(setup.axes)):
            up = float(child.random() < self.high / (self.low + self.high))
            rows.append(
                _Stepping(
                    child, up, _draw_wait(child, (self.high if up else self.low) * setup.rate)
                )
            )
        return rows

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        def switch(process: _Stepping) -> None:
            process.level = 1.0 - process.level
            process.next += _draw_wait(
                process.rng, (self.high if process.level else self.low) * chunk.rate
            )

        unit = np.stack([_average_process(row, chunk, switch) for row in state])
        return self.expand_to_axes("step", chunk.setup.axes)[:, None] * unit, state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List mean times at both levels, from ten samples to a quarter of the record."""
        times = np.geomspace(
            10.0 / windows.rate, max(windows.end[-1] / 4.0, 20.0 / windows.rate), 6
        )
        return {"low": times, "high": times}

    def explain(self, windows: Windows) -> Prediction:
        share = self.high / (self.low + self.high)
        density = (
            share
            * (1.0 - share)
            * lorentz_density(windows.frequency, self.correlation_time, windows.rate)
        )
        return Prediction(
            spectrum={"step": np.broadcast_to(density, (windows.begin.size, density.size))},
            wander={
                "step": (self.correlation_time, np.full(windows.begin.size, share * (1.0 - share)))
            },
            levels="step",
        )

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        high, low = self.quantity("high", errors), self.quantity("low", errors)
        size = self.quantity("step", errors)
        times = f"for {high} up and {low} down on average"
        return f"The bias switches by {size} {self.on_axes()}, {times}."


@dataclass(frozen=True, kw_only=True)
class FringeHop(Effect):
    """Locking of the loop on another fringe: the rate steps by a whole number of fringes.

    ``w_out = w + k lambda c / (L D)``, L the length and D the diameter of the coil, independent of
    the refractive index. A fringe hop by k = ``order`` occurs at the time `at`, or else at random
    times by plus or minus k, lasts for a time of mean `hold`, and ends at a restart.

    References
    ----------
    Lefevre 2014, The Fiber-Optic Gyroscope, 2nd ed. (unambiguous range): 500 m on 4 cm at 1550 nm
    give 1331 deg/s. The frequency of fringe hops is an estimate.

    Examples
    --------
    >>> effect = FringeHop(order=1, length=500, diameter=0.04, at=60, axes=["z"])
    >>> round(effect.fringe / 3600)
    1331
    >>> effect.say()
    'The rate steps by 1 fringe of 4.792e+06 deg/h on axis z, at 60 s.'
    """

    name = "fringe_hop"
    short = "steps of one fringe"
    plain = "steps of one fringe"
    next_measurement = "compare the size of the steps with the rate of one fringe of this coil"
    stage = "electronics"
    size_parameters = ("order",)
    likeness: ClassVar[Mapping[str, Likeness]] = {"bias_jump": "size"}

    order: float = parameter(
        "1", "signed number of fringes", default=1.0, limit=1000.0, whole="whole number of fringes"
    )
    length: float = parameter(
        "m", "length of the coil's fiber", default=500.0, low=1.0, high=1e5, source="Lefevre 2014"
    )
    diameter: float = parameter(
        "m", "diameter of the coil", default=0.04, low=1e-3, high=10.0, source="Lefevre 2014"
    )
    wavelength: float = parameter(
        "nm", "wavelength of the light", default=1550.0, low=100.0, high=1e4, source="Lefevre 2014"
    )
    at: float = parameter("s", "time of the step; inf for random ones", default=math.inf, low=0.0)
    per_hour: float = parameter(
        "1/h",
        "random steps, while on the right fringe",
        default=0.0,
        typical=60.0,
        low=0.0,
        high=1e6,
    )
    hold: float = parameter(
        "s", "mean time until return; inf for never", default=math.inf, typical=20.0, low=1e-6
    )

    @property
    def fringe(self) -> float:
        """Rate of one fringe [degree hour-1]."""
        return (
            self.wavelength * 1e-9 * _LIGHT_M_PER_S / (self.length * self.diameter) * _RADIAN_PER_S
        )

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Start on the right fringe, and draw the first step."""
        mean = HOUR * setup.rate / self.per_hour if self.per_hour else math.inf
        children = rng.spawn(len(setup.axes))
        if math.isfinite(self.at):
            return [_Stepping(child, 0.0, self.at * setup.rate) for child in children]
        return [_Stepping(child, 0.0, _draw_wait(child, mean)) for child in children]

    def generate(self, chunk: Chunk, state: Any) -> tuple[Floats, Any]:
        mean = (
            HOUR * chunk.rate / self.per_hour if self.per_hour and math.isinf(self.at) else math.inf
        )
        returns = chunk.setup.restarts[:, 1].astype(np.float64)

        def switch(process: _Stepping) -> None:
            if process.level:
                process.level = 0.0
                process.next += _draw_wait(process.rng, mean)
                return
            sign = 1.0 if math.isfinite(self.at) or process.rng.random() < 0.5 else -1.0
            process.level = sign
            later = returns[returns > process.next]
            process.next = min(
                process.next + _draw_wait(process.rng, self.hold * chunk.rate),
                float(later[0]) if later.size else math.inf,
            )

        fringes = np.stack([_average_process(row, chunk, switch) for row in state])
        return chunk.signal + self.order * self.fringe * fringes, state

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """List times of the step: the edges of the windows."""
        return {"at": windows.begin[1:]}

    def explain(self, windows: Windows) -> Prediction:
        """Predict window means of one fringe from the step until its mean return."""
        if math.isinf(self.at):
            return Prediction(mean={"order": np.zeros(windows.begin.size)})
        share = _share_after(windows, self.at) - _share_after(windows, self.at + self.hold)
        return Prediction(mean={"order": self.fringe * share})

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        count = self.quantity("order", errors)
        when = (
            f"at {self.at:.6g} s"
            if math.isfinite(self.at)
            else f"{self.per_hour:.3g} times per hour"
        )
        size = f"{count} fringe{'' if self.order == 1 else 's'} of {self.fringe:.4g} deg/h"
        return f"The rate steps by {size} {self.on_axes()}, {when}."
