"""Time stamps as integers: nanoseconds since 1970-01-01T00:00:00 UTC, without a float on the way where the text is exact."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyrostab.errors import UnitError
from gyrostab.timegrid import stamp_ns

__all__ = ["NAT", "TimeUnit", "cells_to_ns", "floats_to_ns", "integers_to_ns", "looks_iso", "parse_time_unit", "texts_to_ns"]

#: The integer of ``NaT``.
NAT = np.iinfo(np.int64).min
_LIMIT = 2**63 - 1

_UNITS = {
    1: ("ns", "nsec", "nanosecond", "nanoseconds"),
    10**3: ("us", "µs", "μs", "usec", "microsecond", "microseconds"),
    10**6: ("ms", "msec", "millis", "millisecond", "milliseconds"),
    10**9: ("s", "sec", "secs", "second", "seconds"),
    60 * 10**9: ("min", "minute", "minutes"),
    3600 * 10**9: ("h", "hr", "hour", "hours"),
    86400 * 10**9: ("d", "day", "days"),
}
_NANOSECONDS = {spelling: ns for ns, spellings in _UNITS.items() for spelling in spellings}
_ISO = re.compile(r"^\s*\d{4}-?\d\d-?\d\d([T ]\d\d(:?\d\d){0,2}([.,]\d+)?\s*(Z|[+-]\d\d(:?\d\d)?)?)?\s*$")
_NUMBER = re.compile(r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?$")


@dataclass(frozen=True)
class TimeUnit:
    """Unit of a numeric time column: nanoseconds per unit, and the epoch [ns since 1970] where the unit names one."""

    text: str
    ns: Fraction
    epoch: int | None = None

    @property
    def digits(self) -> int | None:
        """Decimals that make one nanosecond (9 for seconds), or None when the unit is no power of ten of it."""
        return next((n for n in range(13) if self.ns == 10**n), None)


def parse_time_unit(text: str) -> TimeUnit:
    """Read a time unit, with a factor in front or a CF epoch behind if there is one.

    Raises
    ------
    UnitError
        When the text is no time unit.

    Examples
    --------
    >>> parse_time_unit("us").ns
    Fraction(1000, 1)
    >>> parse_time_unit("seconds since 1970-01-02 00:00:00").epoch
    86400000000000
    """
    name, _, since = (part.strip() for part in text.strip().partition(" since "))
    epoch = stamp_ns(since, f"time unit {text!r}") if since else None
    factor, _, bare = name.rpartition(" ")
    ns = _NANOSECONDS.get(bare.lower() if bare.lower() in _NANOSECONDS else bare)
    if ns is None or (factor and not _NUMBER.match(factor.strip())):
        raise UnitError(f"time unit {text!r} is not known; known are s, ms, us, ns, min, h, d, with a factor in front if needed")
    return TimeUnit(text, ns * Fraction(factor.strip() or "1"), epoch)


def looks_iso(text: str) -> bool:
    """Whether a cell is written as an ISO 8601 date or time (a bare number of 8 digits is not)."""
    return bool(_ISO.match(text)) and not text.strip().isdigit()


def texts_to_ns(texts: Sequence[Any] | NDArray[Any]) -> NDArray[np.int64]:
    """Stamps of ISO 8601 texts (UTC unless they say otherwise); unreadable ones are `NAT`."""
    stamps = pd.to_datetime(pd.Series(list(texts), dtype=object), format="ISO8601", utc=True, errors="coerce")
    return np.asarray(stamps.dt.tz_convert(None).to_numpy(dtype="datetime64[ns]")).view(np.int64)


def integers_to_ns(values: NDArray[np.int64], unit: TimeUnit, epoch: int) -> NDArray[np.int64]:
    """Stamps of whole numbers of `unit` since `epoch`; a stamp outside the years 1678 to 2262 is `NAT`."""
    zero = epoch if unit.epoch is None else unit.epoch
    up, down = unit.ns.numerator, unit.ns.denominator
    limit = (_LIMIT - abs(zero) * down - down) // up
    inside = (values <= limit) & (values >= -limit)
    counts = np.where(inside, values, 0)
    scaled = counts * up if down == 1 else (counts * up + down // 2) // down
    return np.where(inside, scaled + zero, NAT)


def floats_to_ns(values: NDArray[np.floating[Any]], unit: TimeUnit, epoch: int) -> NDArray[np.int64]:
    """Stamps of binary floating point numbers: whole units as integers, only the fraction as a float."""
    wide = np.asarray(values, dtype=np.float64)
    usable = np.isfinite(wide) & (np.abs(wide) < 2.0**62)
    whole = np.floor(np.where(usable, wide, 0.0))
    stamps = integers_to_ns(whole.astype(np.int64), unit, epoch)
    part = np.rint((np.where(usable, wide, 0.0) - whole) * float(unit.ns)).astype(np.int64)
    return np.where(usable & (stamps != NAT), stamps + part, NAT)


def cells_to_ns(cells: Sequence[str], unit: TimeUnit | None, epoch: int) -> NDArray[np.int64]:
    """Stamps of text cells, exact to the last decimal (the slow way): numbers of `unit`, or ISO 8601 where `unit` is None."""
    if unit is None:
        return texts_to_ns([cell.strip() if looks_iso(cell) else None for cell in cells])
    zero = epoch if unit.epoch is None else unit.epoch
    stamps = np.full(len(cells), NAT, dtype=np.int64)
    for index, cell in enumerate(cells):
        text = cell.strip()
        if _NUMBER.match(text):
            value = Fraction(text) * unit.ns
            nanoseconds = round(value) + zero
            if abs(nanoseconds) <= _LIMIT:
                stamps[index] = nanoseconds
    return stamps
