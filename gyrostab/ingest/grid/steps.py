"""Steps between stamps: stretches of them, their common period, and patterns that recur."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["cut_stretches", "finer_period", "refine_period"]

_PATTERN, _ROWS = (
    8,
    17,
)  # rows after which a pattern of steps recurs at most, and those that it must hold for beside
_WHOLE = 0.15  # samples that a step of a pattern may be off
_LONGEST = 5.0  # samples that it may take


def cut_stretches(parts: list[NDArray[np.int64]], length: int) -> NDArray[np.float64]:
    """Stretches of `length` stamps, each from its first on [ns]."""
    stride = length if sum(map(len, parts)) > 200 * length else 1  # of a short log, every stretch
    several = [
        np.lib.stride_tricks.sliding_window_view(part, length)[::stride]
        for part in parts
        if len(part) >= length
    ]
    table = np.concatenate([*several, np.empty((0, length), dtype=np.int64)])
    return np.asarray(table - table[:, :1], dtype=np.float64)


def refine_period(steps: NDArray[np.float64], period: float) -> float:
    """Period [ns] near a first guess of which the steps are whole numbers; the guess itself where there is none."""
    start = period
    for _ in range(30):
        near = np.abs(steps) < 5.5 * period
        count = np.rint(steps[near] / period).sum()
        if count <= 0 or not 0.3 < period / start < 2.0:  # there is no lattice
            return start
        new = float(steps[near].sum() / count)
        if abs(new - period) < 1e-12 * period:
            break
        period = new
    return period


def finer_period(parts: list[NDArray[np.int64]], period: float) -> float | None:
    """Period [ns] of which the steps are 1, 1, 3 and again 1, 1, 3, as if of every five rows the same two were missing.

    Stamps alone do not tell such a log from one whose rows are read in groups. The rounding of even
    stamps makes patterns, too, but of steps that differ by one tick; steps by jitter do not recur;
    and pauses between bursts are longer.
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
