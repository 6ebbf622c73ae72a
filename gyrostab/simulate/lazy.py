"""Rates of a simulated log as a dask array of chained blocks, computable in any order."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.simulate.block import BlockState, Plan, next_block
from gyrostab.simulate.noise import NoiseState, draw

#: Results that a chain keeps, for the threads that ask for them a little later.
RECENT = 3
#: States that a chain keeps over its whole length, to begin again from.
STATES = 512


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
        self, plan: Plan, state: BlockState, starts: Sequence[NoiseState], counts: Sequence[int]
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


def _make_rates(log: _Log, number: int, made: Any) -> NDArray[np.float64]:
    return np.asarray(log.blocks(number) if made is None else made)


def lazy_rates(
    plan: Plan, state: BlockState, starts: Sequence[NoiseState], size: int, *, chunk: int
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
