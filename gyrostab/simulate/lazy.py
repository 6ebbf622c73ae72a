"""The rates of a simulated log as a dask array: chains of blocks, each of which hands its state to the next."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gyrostab.simulate.block import BlockState, Plan, next_block
from gyrostab.simulate.drivers import SHORT, Source, Stretch
from gyrostab.simulate.noise import NoiseState, Units, draw
from gyrostab.timegrid import grid_times

__all__ = ["lazy_rates"]

#: Blocks of random numbers that may be waiting for the block in which they are used.
AHEAD = 2


def _initial(state: Any) -> tuple[None, Any]:
    """What there was before the first block."""
    return None, state


def _draw(previous: tuple[Any, NoiseState], first: int, size: int, gate: Any) -> tuple[Units, NoiseState]:
    """The random numbers of the next block of an axis; `gate` only holds them back, so that they do not run far ahead."""
    return draw(previous[1], first, size)


def _step(plan: Plan, previous: tuple[Any, BlockState], first: int, count: int, draws: Any, parts: Any, missing: Any) -> Any:
    """The next block of the log."""
    stretches = {}
    for name, low, high, offset, pieces in parts:
        values = np.concatenate([np.asarray(piece, dtype=np.float64) for piece in pieces])
        stretches[name] = (Stretch(low, high), values[low - offset : high - offset])
    return next_block(plan, previous[1], first, count, [one[0] for one in draws], stretches, missing)


def _needed(source: Source, edges: Any, stretch: Stretch) -> list[Any]:
    """Stretch of a long channel, and the chunks that hold it."""
    first, last = np.searchsorted(edges, [stretch.low, stretch.high - 1], side="right") - 1
    keys = [(source.values.name, int(number)) for number in range(first, last + 1)]
    return [source.name, stretch.low, stretch.high, int(edges[first]), keys]


def _arrays(sources: Mapping[str, Source]) -> dict[str, Source]:
    """The long channels, as dask arrays."""
    import dask.array as da

    long = {name: source for name, source in sources.items() if source.stamps is None}
    return {name: replace(source, values=da.asarray(source.values, chunks=SHORT)) for name, source in long.items()}


def lazy_rates(plan: Plan, state: BlockState, starts: Sequence[NoiseState], size: int, *, missing_in: Any = None, chunk: int) -> Any:
    """Rates of a whole log, block by block.

    Parameters
    ----------
    plan : Plan
    state : BlockState
        Before the first sample.
    starts : sequence of NoiseState
        Noise of each axis before the first sample.
    size : int
        Samples of the log.
    missing_in : ndarray or dask array, shape (axes, size), optional
        Signal whose NaN the log shall have too.
    chunk : int
        Samples of a block.

    Returns
    -------
    dask array, shape (axes, size)
        Rate [degree hour-1].
    """
    import dask.array as da
    from dask.base import tokenize
    from dask.highlevelgraph import HighLevelGraph

    factor = plan.oversampling
    counts = [min(chunk, size - first) for first in range(0, size, chunk)]
    long = _arrays(plan.sources)
    edges = {name: np.concatenate([[0], np.cumsum(source.values.chunks[0])]) for name, source in long.items()}
    mask = None if missing_in is None else da.isnan(da.asarray(missing_in)).rechunk({0: -1, 1: tuple(counts)})
    token = tokenize(plan.start, plan.rate, size, chunk, np.random.default_rng().integers(2**62))
    rate, step, noise, fixed = (f"{word}-{token}" for word in ("simulated-rate", "simulate-block", "draw-noise", "simulation-plan"))
    tasks: dict[Any, Any] = {
        fixed: replace(plan, sources={**plan.sources, **{name: replace(one, values=None) for name, one in long.items()}})
    }
    tasks[(step, -1)] = (_initial, state)
    for row, start in enumerate(starts):
        tasks[(noise, row, -1)] = (_initial, start)
    for k, count in enumerate(counts):
        first = k * chunk
        instants = np.array([max(first * factor - 1, 0), (first + count) * factor - 1])
        before, end = grid_times(plan.start, plan.rate * factor, instants).tolist()
        draws = [(noise, row, k) for row in range(len(starts))]
        for row, key in enumerate(draws):
            tasks[key] = (_draw, (noise, row, k - 1), first * factor, count * factor, (step, max(-1, k - 1 - AHEAD)))
        parts = []
        for name, source in long.items():
            stretch = source.stretch(before, end)
            assert stretch is not None
            parts.append(_needed(source, edges[name], stretch))
        tasks[(step, k)] = (_step, fixed, (step, k - 1), first, count, draws, parts, None if mask is None else (mask.name, 0, k))
        tasks[(rate, 0, k)] = (operator.itemgetter(0), (step, k))
    arrays = [*(source.values for source in long.values()), *([] if mask is None else [mask])]
    graph = HighLevelGraph.from_collections(rate, tasks, dependencies=arrays)
    return da.Array(graph, rate, chunks=((len(plan.axes),), tuple(counts)), dtype=np.float64)
