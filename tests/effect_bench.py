"""Run an effect by itself on plain arrays, cut into chunks at will: for the tests of the effects."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.physics.base import Chunk, Effect, Setup


def run(
    effect: Effect,
    *,
    size: int,
    rate: float = 10.0,
    axes: Sequence[str] = ("x", "y", "z"),
    drivers: Mapping[str, Any] | None = None,
    true: Mapping[str, Any] | None = None,
    signal: Any = None,
    noise: Mapping[str, Any] | None = None,
    cuts: Sequence[int] = (),
    seed: int = 1,
    **setup: Any,
) -> Any:
    """What `effect` does to `size` samples, cut before the samples `cuts`.

    Returns
    -------
    ndarray, shape (axes, size)
        Contribution or signal; for the stage "noise" a dict of squared coefficients by symbol.
    """
    names = tuple(axis for axis in axes if not effect.axes or axis in effect.axes)
    coefficients = {symbol: np.broadcast_to(value, len(names)).astype(float) for symbol, value in (noise or {}).items()}
    frame = Setup(rate=rate, size=size, start=0, axes=names, noise=coefficients, **setup)
    state = effect.begin(frame, np.random.default_rng(seed))
    given = {name: np.broadcast_to(np.asarray(values, float), size) for name, values in (drivers or {}).items()}
    motion = {axis: np.broadcast_to(np.asarray((true or {}).get(axis, 0.0), float), size) for axis in axes}
    before = np.zeros((len(names), size)) if signal is None else np.broadcast_to(np.asarray(signal, float), (len(names), size))
    parts = []
    edges = [0, *cuts, size]
    for first, end in itertools.pairwise(edges):
        here = slice(first, end)
        chunk = Chunk(
            setup=frame,
            first=first,
            size=end - first,
            drivers={name: values[here] for name, values in given.items()},
            true={axis: values[here] for axis, values in motion.items()},
            signal=before[:, here].copy(),
            level={symbol: np.repeat(value[:, None] ** 2, end - first, axis=1) for symbol, value in coefficients.items()},
        )
        values, state = effect.generate(chunk, copy.deepcopy(state))
        parts.append(values if effect.stage == "noise" else np.broadcast_to(values, (len(names), np.shape(values)[-1])))
    if effect.stage == "noise":
        return {
            symbol: np.concatenate([np.broadcast_to(part[symbol], (len(names), np.shape(part[symbol])[-1])) for part in parts], axis=1)
            for symbol in parts[0]
        }
    return np.concatenate(parts, axis=1)


def same_whatever_the_cuts(effect: Effect, cuts: Sequence[int], **options: Any) -> None:
    """Assert that cutting the time into chunks changes nothing, not even the last bit."""
    whole, cut = run(effect, **options), run(effect, cuts=sorted(cuts), **options)
    if isinstance(whole, dict):
        assert whole.keys() == cut.keys()
        for symbol in whole:
            np.testing.assert_array_equal(cut[symbol], whole[symbol])
    else:
        np.testing.assert_array_equal(cut, whole)


def random_cuts(seed: int, size: int, pieces: int = 5) -> list[int]:
    """Some places to cut, also single samples apart."""
    rng = np.random.default_rng(seed)
    places: NDArray[np.int64] = np.unique(np.concatenate([rng.integers(1, size, pieces), [1, size // 2, size // 2 + 1]]))
    return [int(place) for place in places if 0 < place < size]
