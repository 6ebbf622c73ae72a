"""Figures with 95 % intervals and targets: met, missed, or not shown where cases are too few."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Line = dict[str, Any]
Row = Mapping[str, Any]

_RESAMPLINGS = 1000
_SEED = 0  # of the resamplings
_LEAST_RECORDS = 6  # for an interval from resampled records


def judge(target: str, value: float, low: float, high: float) -> str:
    """Decide whether a figure and its interval meet a target: met, missed, or not shown.

    A target such as ">= 95 %", "92-98 %" or "<= 1 %, upper bound <= 2 %" is met if the whole
    interval lies in it; the upper bound, if given, is that of the interval.

    Examples
    --------
    >>> judge(">= 95 %", 0.97, 0.92, 0.99)
    'not shown'
    """
    if not target:
        return ""
    unit = 100.0 if "%" in target else 1.0
    first, *more = (float(number) / unit for number in re.findall(r"[\d.]+", target))
    least, most = (-math.inf, first) if target.startswith("<=") else (first, math.inf)
    highest = more[0] if more else most
    most = highest if "-" in target else most
    if math.isfinite(value) and not least <= value <= most:
        return "missed"
    return "met" if math.isfinite(value) and low >= least and high <= highest else "not shown"


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Compute Wilson's 95 % interval of a share.

    Examples
    --------
    >>> [round(limit, 4) for limit in wilson(0, 300)]
    [0.0, 0.0126]
    """
    from scipy.stats import binomtest

    interval = binomtest(hits, total).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def _number_records(rows: Sequence[Row]) -> NDArray[np.intp]:
    """Number the records of rows; rows of one ``index`` are of one record."""
    return np.asarray(pd.factorize(np.array([row["index"] for row in rows]))[0], dtype=np.intp)


def resample(
    rows: Sequence[Row], statistic: Callable[[NDArray[np.intp]], float]
) -> tuple[float, float]:
    """Compute the 95 % interval of a statistic of rows, from resampled records.

    Rows of one record are not independent, and are resampled together. The statistic computes a
    number from the positions of resampled rows.
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
    Wilson's of as many records. Near both ends it shows too little, and no interval is narrower
    than Wilson's of as many independent rows.
    """
    hits, total = sum(flags), len(flags)
    records = len(set(_number_records(rows).tolist()))
    if records == total or hits in (0, total):
        return wilson(records * hits // total, records)
    outcomes = np.array(flags)
    resampled = resample(rows, lambda chosen: float(outcomes[chosen].mean()))
    low, high = zip(resampled, wilson(hits, total), strict=True)
    return min(low), max(high)


def share_columns(rows: Sequence[Row], flag: str) -> dict[str, float]:
    """Make the columns of a share of rows and of the ends of its interval."""
    flags = [bool(row[flag]) for row in rows]
    low, high = share_interval(rows, flags)
    return {flag: sum(flags) / len(flags), f"{flag}_low": low, f"{flag}_high": high}


def make_line(name: str, value: float, low: float, high: float, number: int, target: str) -> Line:
    """Make a line of the table."""
    return {
        "quantity": name,
        "value": float(value),
        "low": float(low),
        "high": float(high),
        "n": number,
        "target": target,
        "state": judge(target, value, low, high),
    }


def share(name: str, rows: Sequence[Row], flag: str, target: str = "") -> Line:
    """Make the line of the share of rows in which a value is true, or not zero or empty.

    Rows without a value, None, do not count.
    """
    rows = [row for row in rows if row[flag] is not None]
    if not rows:
        return make_line(name, math.nan, math.nan, math.nan, 0, target)
    value, low, high = share_columns(rows, flag).values()
    return make_line(name, value, low, high, len(rows), target)


def median(name: str, rows: Sequence[Row], column: str, target: str = "") -> Line:
    """Make the line of a median of the finite values of rows."""
    return _quantile_line(name, rows, column, 0.5, target)


def spread(name: str, rows: Sequence[Row], column: str, target: str = "") -> Line:
    """Make the line of the 68 % quantile of normalised errors, 1 where these are right."""
    return _quantile_line(name, rows, column, 0.6827, target, size_of=abs)


def _quantile_line(
    name: str,
    rows: Sequence[Row],
    column: str,
    level: float,
    target: str,
    *,
    size_of: Callable[[float], float] = float,
) -> Line:
    used = [row for row in rows if row[column] is not None and math.isfinite(row[column])]
    if not used:
        return make_line(name, math.nan, math.nan, math.nan, 0, target)
    sizes = np.array([size_of(row[column]) for row in used])
    low, high = resample(used, lambda chosen: float(np.quantile(sizes[chosen], level)))
    return make_line(name, float(np.quantile(sizes, level)), low, high, sizes.size, target)


_STATISTICS = {"share": share, "median": median, "spread": spread}


def make_lines(table: str, groups: Mapping[str, Sequence[Row]]) -> list[Line]:
    """Make the lines of a table that ``figures.csv`` lists, from groups of rows by name."""
    text = resources.files(__package__).joinpath("figures.csv").read_text(encoding="utf-8")
    figures = csv.DictReader(
        (line for line in text.splitlines() if not line.startswith("#")), delimiter=";"
    )
    lines = []
    for figure in (figure for figure in figures if figure["table"] == table):
        where = figure["where"].split()
        rows = [row for row in groups[figure["rows"]] if all(row[flag] for flag in where)]
        make = _STATISTICS[figure["statistic"]]
        lines.append(make(figure["quantity"], rows, figure["column"], figure["target"]))
    return lines
