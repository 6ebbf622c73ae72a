"""Figures with 95 % intervals and targets: met, missed, or not shown where cases are too few."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Line = dict[str, Any]
Row = Mapping[str, Any]
#: Key of a value of a row, or function that computes it.
Read = str | Callable[[Row], Any]

_RESAMPLINGS = 1000
_SEED = 0  # of the resamplings
_LEAST_RECORDS = 6  # for an interval from resampled records


@dataclass(frozen=True)
class Target:
    """Range in which a figure should lie; the target is met if its whole interval lies there.

    `surely`, if given, replaces `most` for the upper end of the interval; `text` states the target.
    """

    text: str
    least: float = -math.inf
    most: float = math.inf
    surely: float | None = None

    def state(self, value: float, low: float, high: float) -> str:
        """Decide between met, missed and not shown.

        Examples
        --------
        >>> Target(">= 95 %", least=0.95).state(0.97, 0.92, 0.99)
        'not shown'
        """
        if not self.text:
            return ""
        if not math.isfinite(value):
            return "not shown"
        if not self.least <= value <= self.most:
            return "missed"
        return (
            "met"
            if low >= self.least and high <= (self.most if self.surely is None else self.surely)
            else "not shown"
        )


NO_TARGET = Target("")


def at_least(least: float) -> Target:
    """Make the target of a share that should be so large."""
    return Target(f">= {100 * least:.0f} %", least=least)


def at_most(most: float) -> Target:
    """Make the target of a share that should be so small."""
    return Target(f"<= {100 * most:.0f} %", most=most)


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Compute Wilson's 95 % interval of a share.

    Examples
    --------
    >>> [round(limit, 4) for limit in wilson(0, 300)]
    [0.0, 0.0126]
    """
    if total == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest

    interval = binomtest(hits, total).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def _number_records(rows: Sequence[Row]) -> NDArray[np.intp]:
    """Number the records of rows; rows of one ``index`` are of one record."""
    numbers: dict[Any, int] = {}
    keys = [
        ("no index", place) if row.get("index") is None else row["index"]
        for place, row in enumerate(rows)
    ]
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.intp)


def resample(
    rows: Sequence[Row], statistic: Callable[[NDArray[np.intp]], float]
) -> tuple[float, float]:
    """Compute the 95 % interval of a statistic of rows, from resampled records.

    Rows of one record are not independent, and are resampled together.

    Parameters
    ----------
    rows : sequence of dict
    statistic : callable
        Computes a number from the positions of resampled rows.
    """
    record = _number_records(rows)
    count = np.bincount(record)
    if count.size < _LEAST_RECORDS:
        return -math.inf, math.inf
    order, first = np.argsort(record, kind="stable"), np.cumsum(count) - count
    values = []
    for chosen in np.random.default_rng(_SEED).integers(
        count.size, size=(_RESAMPLINGS, count.size)
    ):
        size = count[chosen]
        within = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        values.append(statistic(order[np.repeat(first[chosen], size) + within]))
    low, high = np.nanquantile(values, (0.025, 0.975))
    return float(low), float(high)


def share_interval(rows: Sequence[Row], flags: Sequence[bool]) -> tuple[float, float]:
    """Compute the 95 % interval of a share of rows: Wilson's, if each is of another record.

    Where no row, or every row, is flagged, resampling shows no scatter, and the interval is
    Wilson's of as many records.
    """
    hits, total = sum(flags), len(flags)
    records = len(set(_number_records(rows).tolist()))
    if records == total or hits in (0, total):
        return wilson(records * hits // max(total, 1), records)
    outcomes = np.array(flags)
    low, high = resample(rows, lambda chosen: float(outcomes[chosen].mean()))
    return max(0.0, low), min(1.0, high)


def share_columns(key: str, rows: Sequence[Row], flag: Read) -> dict[str, float]:
    """Make the columns of a share of rows and of the ends of its interval."""
    flags = [bool(value) for value in _read_values(rows, flag)]
    low, high = share_interval(rows, flags)
    return {key: sum(flags) / len(flags), f"{key}_low": low, f"{key}_high": high}


def _read_values(rows: Sequence[Row], read: Read) -> list[Any]:
    return [row[read] if isinstance(read, str) else read(row) for row in rows]


def make_line(
    name: str, value: float, low: float, high: float, number: int, target: Target
) -> Line:
    """Make a line of the table."""
    state = target.state(value, low, high)
    return {
        "quantity": name,
        "value": float(value),
        "low": float(low),
        "high": float(high),
        "n": number,
        "target": target.text,
        "state": state,
    }


def share(name: str, rows: Sequence[Row], flag: Read, target: Target = NO_TARGET) -> Line:
    """Make the line of the share of rows in which a value is true, or not zero or empty."""
    if not rows:
        return make_line(name, math.nan, math.nan, math.nan, 0, target)
    value, low, high = share_columns("share", rows, flag).values()
    return make_line(name, value, low, high, len(rows), target)


def median(name: str, rows: Sequence[Row], read: Read, target: Target = NO_TARGET) -> Line:
    """Make the line of a median of the finite values of rows."""
    return _quantile_line(name, rows, read, 0.5, target)


def spread(name: str, rows: Sequence[Row], read: Read, target: Target = NO_TARGET) -> Line:
    """Make the line of the 68 % quantile of normalised errors, 1 where these are right."""
    return _quantile_line(name, rows, read, 0.6827, target, size_of=abs)


def _quantile_line(
    name: str,
    rows: Sequence[Row],
    read: Read,
    level: float,
    target: Target,
    *,
    size_of: Callable[[float], float] = float,
) -> Line:
    pairs = [
        (row, size_of(value))
        for row, value in zip(rows, _read_values(rows, read), strict=True)
        if value is not None and math.isfinite(value)
    ]
    if not pairs:
        return make_line(name, math.nan, math.nan, math.nan, 0, target)
    used, sizes = [row for row, _ in pairs], np.array([value for _, value in pairs])
    low, high = resample(used, lambda chosen: float(np.quantile(sizes[chosen], level)))
    return make_line(name, float(np.quantile(sizes, level)), low, high, sizes.size, target)
