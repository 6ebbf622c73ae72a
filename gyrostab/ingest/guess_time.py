"""Guess the time column of a file and its unit from names and numbers."""

from __future__ import annotations

import math
import re

from gyrostab.ingest.columns.headers import TIME_PATTERN, is_time_unit, is_unit_of
from gyrostab.ingest.columns.stamps import parse_time_unit
from gyrostab.ingest.inspect import ColumnInspection, FileInspection
from gyrostab.time.grid import MAX_RATE_HZ

#: Typical rate of gyro logs [Hz], and spread [decades].
TYPICAL_RATE_HZ, RATE_DECADES = 100.0, 1.0

_TIME_WORD = re.compile(r"time|stamp|tow|clock|epoch|elapsed|seconds|(^|[^a-z])t($|[^a-z])|sec$")

_COUNTER_WORD = re.compile(
    r"count|packet|seq|index|sample|(^|[^a-z])(n|no|nr|id|row|frame)($|[^a-z])"
)

_TIME_UNIT_PATTERNS = (
    (r"nanos|(^|[^a-z])ns$|_ns|nsec", "ns"),
    (r"micros|usec|timeus|(^|[^a-z])us$|_us", "us"),
    (r"millis|msec|(^|[^a-z])ms$|_ms", "ms"),
    (r"seconds|(^|[^a-z])s$|_sec$|_s$", "s"),
)
_UNITS = ("s", "ms", "us", "ns")
#: Unix time between 2001 and 2033 is 1 to 2 of these [s].
_EPOCH_S = 1e9
#: Unit of the dates of spreadsheets, and their values in the years 1968 to 2119.
_SERIAL_DAYS, _SERIAL_RANGE = "days since 1899-12-30", (25_000.0, 80_000.0)


def unit_seconds(unit: str | None) -> float:
    """Return the seconds of a unit of time, which is seconds if None.

    Examples
    --------
    >>> unit_seconds("min"), unit_seconds(None)
    (60.0, 1.0)
    """
    return float(parse_time_unit(unit or "s").ns) / 1e9


def rises_by_row(column: ColumnInspection, inspection: FileInspection) -> bool:
    """Return whether a column rises from row to row, as time does."""
    return (
        column.rows >= max(2, 0.5 * inspection.rows)
        and column.rising >= 0.5
        and column.rising + column.held >= 0.95
        and column.pace * MAX_RATE_HZ >= 1  # else too fast in any unit
    )


def guess_time(
    inspection: FileInspection, reasons: list[str], warnings: list[str]
) -> tuple[ColumnInspection | None, str | None]:
    """Guess the time column and its unit, and add the reasons and warnings; None without one."""
    best: tuple[float, ColumnInspection, str, str] | None = None
    for column in inspection.columns:
        if not rises_by_row(column, inspection):
            continue
        low = column.key.lower()
        named = bool(TIME_PATTERN.match(low) or _TIME_WORD.search(low))
        counter = (
            column.whole
            and abs(column.pace - 1.0) < 1e-6
            and abs(column.std - inspection.rows / math.sqrt(12)) < 0.1 * inspection.rows
        )
        written = column.unit or "1"
        has_other_unit = not (is_time_unit(written) or is_unit_of(written, ("number",)))
        if not named and (counter or has_other_unit or _COUNTER_WORD.search(low)):
            continue
        unit, reason = _time_unit(column)
        score = 2.0 * named + ("name" in reason) - 0.1 * _rate_distance(column, unit)
        if best is None or score > best[0]:
            best = score, column, unit, reason
    if best is None:
        return None, None
    _, column, unit, reason = best
    reasons.append(
        f"{column.key!r} is the time, as it rises from row to row; in {unit}, by {reason}"
    )
    if reason.startswith("the rate"):
        warnings.append(
            f'--unit "time={unit}" is an assumption, because of {reason}: if that is not the '
            "sampling rate, use the true unit instead"
        )
    return column, unit


def _time_unit(column: ColumnInspection) -> tuple[str, str]:
    """Guess the unit of a numeric time column; also return the evidence."""
    if column.unit and is_time_unit(column.unit):
        return column.unit, "its name"
    name = column.key.lower()
    for pattern, unit in _TIME_UNIT_PATTERNS:
        if re.search(pattern, name):
            return unit, "its name"
    for unit in _UNITS:
        if 1.0 <= column.first * unit_seconds(unit) / _EPOCH_S < 2.0:
            return unit, "its size, that of Unix time"
    low, high = _SERIAL_RANGE
    units = (*_UNITS, _SERIAL_DAYS) if low <= column.first < high else _UNITS
    unit = min(units, key=lambda unit: _rate_distance(column, unit))
    return unit, f"the rate of {1.0 / (column.pace * unit_seconds(unit)):.4g} Hz that it gives"


def _rate_distance(column: ColumnInspection, unit: str) -> float:
    return (
        abs(math.log10(1.0 / (column.pace * unit_seconds(unit)) / TYPICAL_RATE_HZ)) / RATE_DECADES
    )
