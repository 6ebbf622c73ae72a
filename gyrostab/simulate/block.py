"""Blocks of a simulated log: drivers, noise, effects and logger, up to the rates.

The blocks are chained in a dask array, and computable in any order.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import OptionError
from gyrostab.physics.base import STAGES, Chunk, Effect, Setup
from gyrostab.simulate.drivers import DriverChannel
from gyrostab.simulate.noise import NoiseState, Units, draw, shape
from gyrostab.time.grid import grid_times
from gyrostab.units import HOUR

#: Results that a chain keeps, for the threads that ask for them a little later.
RECENT = 3
#: States that a chain keeps over its whole length, to begin again from.
STATES = 512


@dataclass(frozen=True)
class Step:
    """One effect with the rows of its axes, and the sources and unit conversion of its channels."""

    effect: Effect
    setup: Setup
    rows: tuple[int, ...]
    factors: Mapping[str, float]
    sources: Mapping[str, str]  # source of each channel it needs


@dataclass(frozen=True)
class SimulationPlan:
    """Constant properties of a simulation."""

    rate: float  # sampling rate of the log [Hz]
    oversampling: int  # samples of the instrument in one of the log
    start: int  # first stamp [ns since 1970]
    axes: tuple[str, ...]
    coefficients: tuple[Mapping[str, float], ...]  # noise coefficients of each axis
    steps: tuple[Step, ...]  # the effects, in the order in which they act
    sources: Mapping[str, DriverChannel]  # channels that are needed, by their names in the log
    #: Axis that feels the channel ``rotation_rate``, also one that is not simulated; empty when
    #: none does.
    turning: str
    #: (n, 2): samples that are missing on all axes, [first, one past last], rising; not those of
    #: the recording that the log is simulated like.
    gaps: Ints
    recorded: Mapping[str, str]  # axis -> source of its recorded rate
    bias: tuple[float, ...]  # constant rate of each axis [degree hour-1]


@dataclass
class BlockState:
    """What one stretch hands to the next."""

    effects: list[Any]
    drivers: dict[str, float | None] = field(default_factory=dict)
    noise: dict[str, Mapping[str, float]] = field(default_factory=dict)


def next_block(
    plan: SimulationPlan, state: BlockState, first: int, count: int, units: Sequence[Units]
) -> tuple[Floats, BlockState]:
    """Make the samples ``first`` to ``first + count`` of a log.

    Parameters
    ----------
    state : BlockState
        From the stretch before; it is left as it was.
    first, count : int
        Samples of the log.
    units : sequence of Units
        Random numbers of each axis.

    Returns
    -------
    rate : ndarray, shape (axes, count)
        Rate [degree hour-1], NaN where it is missing.
    state : BlockState
    """
    state = copy.deepcopy(state)
    factor = plan.oversampling
    index = first * factor + np.arange(count * factor)
    channels = _read_channels(plan, state, first * factor, index)
    true = {axis: np.zeros(index.size) for axis in plan.axes}
    if plan.turning:
        true[plan.turning] = channels["rotation_rate"] * HOUR
    by_stage: dict[str, list[int]] = {stage: [] for stage in STAGES}
    for number, step in enumerate(plan.steps):
        by_stage[step.effect.stage].append(number)

    def act(number: int, fast: bool = True, **fields: Any) -> tuple[Step, Any]:
        step = plan.steps[number]
        size, skip = (index.size, 1) if fast else (count, factor)
        drivers = {
            role: channels[name][::skip] * step.factors.get(role, 1.0)
            for role, name in step.sources.items()
        }
        chunk = Chunk(
            setup=step.setup,
            first=first * (factor // skip),
            size=size,
            drivers=drivers,
            recorded={axis: channels[name][::skip] for axis, name in plan.recorded.items()},
            **fields,
        )
        values, state.effects[number] = step.effect.generate(chunk, state.effects[number])
        return step, values

    def change(stage: str, signal: Floats, **options: Any) -> None:
        for number in by_stage[stage]:
            rows = list(plan.steps[number].rows)
            _, values = act(number, signal=signal[rows], **options)
            signal[rows] = signal[rows] + values if stage == "rate" else values

    for number in by_stage["motion"]:
        step, values = act(number, true=true)
        for row, part in zip(
            step.rows, np.broadcast_to(values, (len(step.rows), index.size)), strict=True
        ):
            true[plan.axes[row]] = true[plan.axes[row]] + part
    signal, white = _add_noise(plan, state, by_stage["noise"], act, units, true)
    for stage in ("rate", "sensor", "electronics"):
        change(stage, signal, true=true)
    slow = _sample_log(plan, by_stage["sampling"], act, signal, white, true, count)
    true = (
        {axis: values.reshape(count, factor).mean(axis=1) for axis, values in true.items()}
        if factor > 1
        else true
    )
    change("logger", slow, true=true, fast=False)
    _drop_gaps(plan, slow, first)
    return slow, state


def _read_channels(
    plan: SimulationPlan, state: BlockState, first: int, index: Ints
) -> dict[str, Any]:
    """Interpolate the channels at samples of the instrument, from `first` on; changes `state`."""
    rate = plan.rate * plan.oversampling
    instants = grid_times(plan.start, rate, index)
    before = int(grid_times(plan.start, rate, max(first - 1, 0)))
    channels = {}
    for name, source in plan.sources.items():
        channels[name], state.drivers[name] = source.at(
            instants, state.drivers.get(name), before=before
        )
    return channels


def _add_noise(
    plan: SimulationPlan,
    state: BlockState,
    numbers: list[int],
    act: Any,
    units: Sequence[Units],
    true: Mapping[str, Floats],
) -> tuple[Floats, Floats]:
    """True rate and noise, with the noise at the level that the effects give it; its Q and N."""
    size = units[0].size
    signal = np.stack([true[axis] + bias for axis, bias in zip(plan.axes, plan.bias, strict=True)])
    levels = [
        {
            term: np.full(size, value**2) if numbers else value**2
            for term, value in coefficients.items()
        }
        for coefficients in plan.coefficients
    ]
    for number in numbers:
        rows = plan.steps[number].rows
        level = {
            term: np.stack([levels[row][term] for row in rows])
            for term in plan.steps[number].effect.terms
        }
        step, changed = act(number, true=true, level=level)
        for term, values in changed.items():
            for row, row_values in zip(
                step.rows, np.broadcast_to(values, (len(rows), size)), strict=True
            ):
                if term == "rate":
                    signal[row] += row_values
                else:
                    levels[row][term] = row_values
    rate, white = plan.rate * plan.oversampling, np.zeros(signal.shape)
    has_sampling = any(step.effect.stage == "sampling" for step in plan.steps)
    for row, axis in enumerate(plan.axes):
        level = {term: np.maximum(values, 0.0) for term, values in levels[row].items()}
        before = state.noise.get(axis, {})
        ramp = plan.coefficients[row]["R"]
        noise, state.noise[axis] = shape(units[row], level, rate, before, ramp=ramp)
        signal[row] += noise
        if has_sampling:
            values = {term: units[row].values[term] for term in "QN" if term in units[row].values}
            white[row], _ = shape(replace(units[row], values=values), level, rate, before)
    return signal, white


def _sample_log(
    plan: SimulationPlan,
    numbers: list[int],
    act: Any,
    signal: Floats,
    white: Floats,
    true: Mapping[str, Floats],
    count: int,
) -> Floats:
    """The samples of the log: those that an effect picked, or means over the sampling interval."""
    rows: list[Floats] = list(signal)
    for number in numbers:
        chosen = list(plan.steps[number].rows)
        inputs = [rows[row] for row in chosen]
        if any(row.size != count * plan.oversampling for row in inputs):
            name = plan.steps[number].effect.name
            raise OptionError(
                f"effect {name!r} follows another effect that has decimated the log already; "
                "leave one of them out, or name it first in the model"
            )
        step, values = act(number, true=true, signal=np.stack(inputs), white=white[chosen])
        for row, row_values in zip(step.rows, values, strict=True):
            rows[row] = row_values
    return np.stack(
        [
            row if row.size == count else row.reshape(count, plan.oversampling).mean(axis=1)
            for row in rows
        ]
    )


def _drop_gaps(plan: SimulationPlan, rate: Floats, first: int) -> None:
    """Put NaN into the gaps."""
    count = rate.shape[1]
    for begin, end in plan.gaps[
        np.searchsorted(plan.gaps[:, 1], first, side="right") : np.searchsorted(
            plan.gaps[:, 0], first + count
        )
    ]:
        rate[:, max(begin - first, 0) : end - first] = np.nan


class Chain:
    """Steps that each need the state after the previous one.

    A chain remembers states on its way, so that going through it costs every step once, however it
    is cut into calls, and going back costs little. Threads may ask at the same time. A copy in
    another process starts anew; the results are the same.

    Parameters
    ----------
    step : callable
        (number of the step, state before it) -> (result, state after it); leaves the state given as
        it is.
    state : object
        State before step 0.
    length : int
        Number of steps.
    """

    def __init__(self, step: Callable[[int, Any], tuple[Any, Any]], state: Any, length: int):
        self._step, self._stride = step, -(-length // STATES)
        self._states, self._taken = {0: state}, 0
        self._recent: dict[int, Any] = {}
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {"_step": self._step, "_stride": self._stride, "_states": {0: self._states[0]}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _taken=0, _recent={}, _lock=threading.Lock())

    def __call__(self, number: int) -> Any:
        """Result of a step."""
        with self._lock:
            if number not in self._recent:
                latest = max(place for place in self._states if place <= number)
                for place in range(latest, number + 1):
                    self._recent[place], self._states[place + 1] = self._step(
                        place, self._states[place]
                    )
                    self._forget_state(place)
                self._taken = max(self._taken, number + 1)
            return self._recent[number]

    def go(self, number: int) -> Any:
        """Take a step and give its result, unless it was taken already; then give None."""
        return self(number) if number >= self._taken else None

    def _forget_state(self, place: int) -> None:
        while len(self._recent) > RECENT:
            del self._recent[next(iter(self._recent))]
        old = place - 2 * RECENT
        if old > 0 and old % self._stride:
            self._states.pop(old, None)


class _Log:
    """Blocks of a log: one chain of random numbers per axis, and the chain of the blocks."""

    def __init__(
        self,
        plan: SimulationPlan,
        state: BlockState,
        starts: Sequence[NoiseState],
        counts: Sequence[int],
    ):
        self.plan = plan
        self.firsts, self.counts = np.concatenate([[0], np.cumsum(counts)]).tolist(), list(counts)
        self.draws = [Chain(self._draw_numbers, start, len(counts)) for start in starts]
        self.blocks = Chain(self._compute_block, state, len(counts))

    def _draw_numbers(self, number: int, state: NoiseState) -> Any:
        factor = self.plan.oversampling
        return draw(state, self.firsts[number] * factor, self.counts[number] * factor)

    def _compute_block(self, number: int, state: BlockState) -> Any:
        units = [draw(number) for draw in self.draws]
        return next_block(self.plan, state, self.firsts[number], self.counts[number], units)


def _go_draw(log: _Log, row: int, number: int, *predecessors: Any) -> None:
    """Draw a block of an axis; its predecessor delays it, which keeps blocks in order."""
    log.draws[row].go(number)


def _go_block(log: _Log, number: int, *predecessors: Any) -> Any:
    """Rates of a block; None if it was made before."""
    return log.blocks.go(number)


def _make_rates(log: _Log, number: int, made: Any) -> Floats:
    return np.asarray(log.blocks(number) if made is None else made)


def lazy_rates(
    plan: SimulationPlan, state: BlockState, starts: Sequence[NoiseState], size: int, *, chunk: int
) -> Any:
    """Make the rates of a whole log, block by block.

    Parameters
    ----------
    state : BlockState
        Before the first sample.
    starts : sequence of NoiseState
        Noise of each axis before the first sample.
    size : int
        Samples of the log.
    chunk : int
        Samples of a block.

    Returns
    -------
    dask array, shape (axes, size)
        Rate [degree hour-1].
    """
    import dask.array as da
    from dask.highlevelgraph import HighLevelGraph

    counts = tuple(min(chunk, size - first) for first in range(0, size, chunk))
    token = f"{np.random.default_rng().integers(2**62):x}"
    name, log = f"simulated-rate-{token}", f"simulation-{token}"
    tasks: dict[Any, Any] = {log: _Log(plan, state, starts, counts)}
    rows = range(len(starts))
    for number in range(len(counts)):
        earlier = [(f"{log}-block", number - 1)] if number else []
        for row in rows:
            predecessors = [(f"{log}-draw", row, number - 1)] if number else []
            gate = [(f"{log}-block", number - RECENT)] if number >= RECENT else []
            tasks[(f"{log}-draw", row, number)] = (_go_draw, log, row, number, *predecessors, *gate)
        tasks[(f"{log}-block", number)] = (
            _go_block,
            log,
            number,
            *earlier,
            *((f"{log}-draw", row, number) for row in rows),
        )
        tasks[(name, 0, number)] = (_make_rates, log, number, (f"{log}-block", number))
    return da.Array(
        HighLevelGraph.from_collections(name, tasks),
        name,
        chunks=((len(plan.axes),), counts),
        dtype=np.float64,
    )
