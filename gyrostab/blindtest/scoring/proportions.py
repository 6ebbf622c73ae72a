"""Figures with 95 % intervals and targets: met, missed, or not shown where cases are too few."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Line = dict[str, Any]


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


def share_columns(key: str, hits: int, total: int) -> dict[str, float]:
    """Make the columns of a share and of the ends of its Wilson's interval."""
    low, high = wilson(hits, total)
    return {key: hits / total, f"{key}_low": low, f"{key}_high": high}


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


def share(name: str, flags: Iterable[bool], target: Target = NO_TARGET) -> Line:
    """Make the line of a share of cases, with Wilson's interval."""
    outcomes = [bool(flag) for flag in flags]
    hits, total = sum(outcomes), len(outcomes)
    return make_line(
        name,
        hits / total if total else math.nan,
        *(wilson(hits, total) if total else (math.nan, math.nan)),
        total,
        target,
    )


def share_of(
    name: str, rows: Iterable[Mapping[str, Any]], key: str, target: Target = NO_TARGET
) -> Line:
    """Make the line of the share of rows in which a column is true, or not zero or empty."""
    return share(name, (row[key] for row in rows), target)


def median(name: str, values: Iterable[float | None], target: Target = NO_TARGET) -> Line:
    """Make the line of a median, with its order-statistic interval."""
    ordered = np.sort([value for value in values if value is not None and math.isfinite(value)])
    if ordered.size == 0:
        return make_line(name, math.nan, math.nan, math.nan, 0, target)
    reach = 0.98 * math.sqrt(ordered.size)
    low, high = (
        math.floor((ordered.size - 1) / 2 - reach),
        math.ceil((ordered.size - 1) / 2 + reach),
    )
    ends = (
        (-math.inf, math.inf)
        if ordered.size < 6
        else (ordered[max(0, low)], ordered[min(ordered.size - 1, high)])
    )
    return make_line(
        name, float(np.median(ordered)), float(ends[0]), float(ends[1]), ordered.size, target
    )


def spread(name: str, pulls: Iterable[float | None], target: Target = NO_TARGET) -> Line:
    """Make the line of the 68 % quantile of normalised errors, 1 where these are right."""
    sizes = np.abs([pull for pull in pulls if pull is not None and math.isfinite(pull)])
    if sizes.size == 0:
        return make_line(name, math.nan, math.nan, math.nan, 0, target)
    value = float(np.quantile(sizes, 0.6827))
    off = 0.96 / math.sqrt(sizes.size)  # 95 % interval of the share, by the binomial law
    low, high = (
        float(np.quantile(sizes, min(max(0.6827 + step, 0.0), 1.0))) for step in (-off, off)
    )
    return make_line(name, value, low, high, sizes.size, target)
