"""Times at which a step of the mean is tried."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrostab.physics.prediction import Windows

Array = NDArray[np.float64]
_MAX_TIMES = 240  # limits time
_MAX_STEPS = 20  # largest steps of the means among them: a step one block off does not fit
_SIDE_BLOCKS = (2, 8, 32)  # blocks on either side that define a step; design choice


def power_on_times(windows: Windows) -> Array:
    """Return the times at which power came back [s]."""
    return np.asarray(windows.restarts[:, 1] if windows.restarts.size else np.empty(0))


def select_step_times(values: Array, windows: Windows) -> list[float]:
    """Select the times to try among the possible ones.

    All if they are few. Otherwise some at equal intervals, those at which power came back, and
    those at which the means of an axis step most. Each has the prior probability of the time it
    represents, so that selecting by the means gives no advantage.

    Parameters
    ----------
    values : ndarray
        Possible times, rising [s].

    Examples
    --------
    >>> begin = 20.0 * np.arange(1000)
    >>> walk = np.random.default_rng(1).standard_normal(1000)
    >>> walk[617:] += 5.0
    >>> windows = Windows(begin, begin + 20.0, np.ones(1), 10.0, ("x",), own={"x": walk})
    >>> tried = select_step_times(begin[1:], windows)
    >>> len(tried) < 300, 617 * 20.0 in tried
    (True, True)
    """
    if len(values) <= _MAX_TIMES:
        return [float(instant) for instant in values]
    every = -(-len(values) // (_MAX_TIMES - 3 * _MAX_STEPS))
    steps = _largest_steps(windows)
    near_steps = values[
        np.abs(values[:, None] - steps).min(axis=1, initial=np.inf)
        <= 0.5 * (windows.end[0] - windows.begin[0])
    ]
    return [
        float(instant)
        for instant in np.unique(
            np.concatenate([values[every // 2 :: every], power_on_times(windows), near_steps])
        )
    ]


def _largest_steps(windows: Windows) -> Array:
    """Return the starts of the blocks at which the means of an axis step most [s]."""
    steps_found: list[tuple[float, float]] = []
    for values in windows.own.values():
        if not np.isfinite(values).all():
            continue
        total = np.concatenate([[0.0], np.cumsum(values)])
        for length in _SIDE_BLOCKS:
            inner = np.arange(length, values.size - length + 1)
            if inner.size < 2 * length:
                continue
            size = np.abs(total[inner + length] - 2.0 * total[inner] + total[inner - length])
            wide = np.lib.stride_tricks.sliding_window_view(
                np.pad(size, length), 2 * length + 1
            ).max(axis=1)
            usual = max(float(np.median(size)), 1e-300)
            steps_found += [
                (float(size[k] / usual), float(windows.begin[inner[k]]))
                for k in np.flatnonzero(size == wide)
            ]
    largest = dict.fromkeys(begin for _, begin in sorted(steps_found, reverse=True))
    return np.array(list(largest)[:_MAX_STEPS])
