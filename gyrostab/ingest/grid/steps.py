"""Steps between stamps: their common period, and recurring patterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["cut_stretches", "finer_period", "refine_period"]

_PATTERN, _ROWS = (
    8,
    17,
)  # longest pattern of steps, and further rows in which it must recur
_WHOLE = 0.15  # largest distance of a step of a pattern from whole samples [samples]
_LONGEST = 5.0  # longest step of a pattern [samples]


def cut_stretches(parts: list[NDArray[np.int64]], length: int) -> NDArray[np.float64]:
    """Return stretches of `length` stamps, relative to the first stamp of each [ns]."""
    stride = length if sum(map(len, parts)) > 200 * length else 1  # overlap in a short log
    several = [
        np.lib.stride_tricks.sliding_window_view(part, length)[::stride]
        for part in parts
        if len(part) >= length
    ]
    table = np.concatenate([*several, np.empty((0, length), dtype=np.int64)])
    return np.asarray(table - table[:, :1], dtype=np.float64)


def refine_period(steps: NDArray[np.float64], period: float) -> float:
    """Refine a first guess of the period [ns] of which the steps are multiples, if there is one."""
    start = period
    for _ in range(30):
        near = np.abs(steps) < 5.5 * period
        count = np.rint(steps[near] / period).sum()
        if count <= 0 or not 0.3 < period / start < 2.0:  # no common period
            return start
        new = float(steps[near].sum() / count)
        if abs(new - period) < 1e-12 * period:
            break
        period = new
    return period


def finer_period(parts: list[NDArray[np.int64]], period: float) -> float | None:
    """Find the period [ns] of recurring steps such as 1, 1, 3, 1, 1, 3; None if there is none.

    In such a log the same two of every five rows are missing, or rows are read in groups; stamps
    alone cannot distinguish these. The rounding of even stamps also makes patterns, but of steps
    that differ by one tick; steps by jitter do not recur; pauses between bursts are longer.
    """
    table = np.diff(cut_stretches(parts, _PATTERN + _ROWS))
    rising = table[table > 0]
    if rising.size == 0:
        return None
    single = refine_period(table.ravel(), float(np.quantile(rising, 0.1)))
    if single > 0.9 * period:
        return None
    counts = np.rint(table / single)
    whole = (np.abs(table / single - counts) < _WHOLE).all(axis=1)
    again = [(counts[:, rows:] == counts[:, :-rows]).all(axis=1) for rows in range(2, _PATTERN + 1)]
    uneven = (counts.min(axis=1) == 1) & (counts.max(axis=1) > 2) & (counts.max(axis=1) <= _LONGEST)
    return single if (whole & np.any(again, axis=0) & uneven).mean() > 0.5 else None
