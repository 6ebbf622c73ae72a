"""Instants at which a step of the mean is tried."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.physics.prediction import Windows

__all__ = ["known_instants", "tried_instants"]

Array = NDArray[np.float64]
_MOST, _PEAKS = (
    240,
    20,
)  # instants that are tried, and steps of the means among them: a step that is a block off does not fit
_LENGTHS = (2, 8, 32)  # blocks on either side that tell a step


def known_instants(windows: Windows) -> Array:
    """Instants at which power came back [s]."""
    return np.asarray(windows.restarts[:, 1] if windows.restarts.size else np.empty(0))


def tried_instants(values: Array, windows: Windows) -> list[float]:
    """Instants that are tried, of those that are possible.

    All where they are few. Else some, evenly, those at which power came back, and those at which
    the means of an axis step most; where each has the chance of the time that it stands for,
    looking at the means first gives no advantage.

    Parameters
    ----------
    values : ndarray
        Instants that are possible, rising [s].
    windows : Windows

    Examples
    --------
    >>> begin = 20.0 * np.arange(1000)
    >>> walk = np.random.default_rng(1).standard_normal(1000)
    >>> walk[617:] += 5.0
    >>> windows = Windows(begin, begin + 20.0, np.ones(1), 10.0, ("x",), own={"x": walk})
    >>> tried = tried_instants(begin[1:], windows)
    >>> len(tried) < 300, 617 * 20.0 in tried
    (True, True)
    """
    if len(values) <= _MOST:
        return [float(one) for one in values]
    every = -(-len(values) // (_MOST - 3 * _PEAKS))
    steps = _steps(windows)
    near = values[
        np.abs(values[:, None] - steps).min(axis=1, initial=np.inf)
        <= 0.5 * (windows.end[0] - windows.begin[0])
    ]
    return [
        float(one)
        for one in np.unique(
            np.concatenate([values[every // 2 :: every], known_instants(windows), near])
        )
    ]


def _steps(windows: Windows) -> Array:
    """Beginnings of the blocks at which the means of an axis step most [s]."""
    found: list[tuple[float, float]] = []
    for values in windows.own.values():
        if not np.isfinite(values).all():
            continue
        total = np.concatenate([[0.0], np.cumsum(values)])
        for length in _LENGTHS:
            inner = np.arange(length, values.size - length + 1)
            if inner.size < 2 * length:
                continue
            size = np.abs(total[inner + length] - 2.0 * total[inner] + total[inner - length])
            wide = np.lib.stride_tricks.sliding_window_view(
                np.pad(size, length), 2 * length + 1
            ).max(axis=1)
            usual = max(float(np.median(size)), 1e-300)
            found += [
                (float(size[k] / usual), float(windows.begin[inner[k]]))
                for k in np.flatnonzero(size == wide)
            ]
    largest = dict.fromkeys(at for _, at in sorted(found, reverse=True))
    return np.array(list(largest)[:_PEAKS])
