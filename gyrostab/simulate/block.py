"""One block of a simulated log: drivers, noise, effects and logger, up to the rates."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OptionError
from gyrostab.physics.base import STAGES, Chunk, Effect, Setup
from gyrostab.simulate.drivers import Source
from gyrostab.simulate.noise import Units, shape
from gyrostab.time.grid import grid_times
from gyrostab.units import HOUR

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Step:
    """One effect with the rows of its axes, and the sources and unit conversion of its channels."""

    effect: Effect
    setup: Setup
    rows: tuple[int, ...]
    factors: Mapping[str, float]
    sources: Mapping[str, str]  # source of each channel it needs


@dataclass(frozen=True)
class Plan:
    """Constant properties of a simulation."""

    rate: float  # sampling rate of the log [Hz]
    oversampling: int  # samples of the instrument in one of the log
    start: int  # first stamp [ns since 1970]
    axes: tuple[str, ...]
    coefficients: tuple[Mapping[str, float], ...]  # noise coefficients of each axis
    steps: tuple[Step, ...]  # the effects, in the order in which they act
    sources: Mapping[str, Source]  # channels that are needed, by their names in the log
    turning: str  # axis that feels the channel ``rotation_rate``; empty when none does
    #: (n, 2): samples that are missing on all axes, [first, one past last], rising; not those of
    #: the recording that the log is simulated like.
    gaps: NDArray[np.int64]
    recorded: Mapping[str, str]  # axis -> source of its recorded rate
    bias: tuple[float, ...]  # constant rate of each axis [degree hour-1]


@dataclass
class BlockState:
    """What one stretch hands to the next."""

    effects: list[Any]
    drivers: dict[str, float | None] = field(default_factory=dict)
    noise: dict[str, Mapping[str, float]] = field(default_factory=dict)


def next_block(
    plan: Plan,
    state: BlockState,
    first: int,
    count: int,
    units: Sequence[Units],
) -> tuple[Array, BlockState]:
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
    instants = grid_times(plan.start, plan.rate * factor, index)
    before = int(grid_times(plan.start, plan.rate * factor, max(first * factor - 1, 0)))
    channels = {}
    for name, source in plan.sources.items():
        channels[name], state.drivers[name] = source.at(
            instants, state.drivers.get(name), before=before
        )
    true = {axis: np.zeros(index.size) for axis in plan.axes}
    if plan.turning:
        true[plan.turning] += channels["rotation_rate"] * HOUR
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

    def change(stage: str, signal: Array, **options: Any) -> None:
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
    signal = _add_noise(plan, state, by_stage["noise"], act, units, true)
    for stage in ("rate", "sensor", "electronics"):
        change(stage, signal, true=true)
    slow = _sample_log(plan, by_stage["sampling"], act, signal, true, count)
    true = (
        {axis: values.reshape(count, factor).mean(axis=1) for axis, values in true.items()}
        if factor > 1
        else true
    )
    change("logger", slow, true=true, fast=False)
    _drop_gaps(plan, slow, first)
    return slow, state


def _add_noise(
    plan: Plan,
    state: BlockState,
    numbers: list[int],
    act: Any,
    units: Sequence[Units],
    true: Mapping[str, Array],
) -> Array:
    """True rate and noise, with the noise at the level that the effects give it."""
    size = units[0].size
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
                levels[row][term] = row_values
    signal = np.empty((len(plan.axes), size))
    for row, axis in enumerate(plan.axes):
        noise, state.noise[axis] = shape(
            units[row],
            {term: np.maximum(values, 0.0) for term, values in levels[row].items()},
            plan.rate * plan.oversampling,
            state.noise.get(axis, {}),
            ramp=plan.coefficients[row]["R"],
        )
        signal[row] = noise + (true[axis] + plan.bias[row])
    return signal


def _sample_log(
    plan: Plan, numbers: list[int], act: Any, signal: Array, true: Mapping[str, Array], count: int
) -> Array:
    """The samples of the log: those that an effect picked, or means over the sampling interval."""
    rows: list[Array] = list(signal)
    for number in numbers:
        inputs = [rows[row] for row in plan.steps[number].rows]
        if any(row.size != count * plan.oversampling for row in inputs):
            name = plan.steps[number].effect.name
            raise OptionError(
                f"effect {name!r} follows another effect that has decimated the log already; "
                "leave one of them out"
            )
        step, values = act(number, true=true, signal=np.stack(inputs))
        for row, row_values in zip(step.rows, values, strict=True):
            rows[row] = row_values
    return np.stack(
        [
            row if row.size == count else row.reshape(count, plan.oversampling).mean(axis=1)
            for row in rows
        ]
    )


def _drop_gaps(plan: Plan, rate: Array, first: int) -> None:
    """Put NaN into the gaps."""
    count = rate.shape[1]
    for begin, end in plan.gaps[
        np.searchsorted(plan.gaps[:, 1], first, side="right") : np.searchsorted(
            plan.gaps[:, 0], first + count
        )
    ]:
        rate[:, max(begin - first, 0) : end - first] = np.nan
