"""Convert time stamps to integers, nanoseconds since 1970-01-01T00:00:00 UTC, exactly.

References
----------
CF conventions 1.11, section 4.4 (time coordinate, calendars).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.errors import UnitError
from gyrostab.ingest.columns.dates import YEAR_FIRST, as_iso
from gyrostab.store.lazy import read_slice
from gyrostab.time.stamps import split_instant, to_nanoseconds
from gyrostab.units import DAY

#: Periods after which clocks begin again [ns], and their names: of the time of day, of the GPS
#: week, and 32-bit counters of microseconds, of 0.1 ms and of milliseconds.
CLOCK_PERIODS = {
    int(DAY) * 10**9: "a day",
    7 * int(DAY) * 10**9: "a week",
    **{
        2**32 * tick: f"{2**32 * tick / 1e9:.10g} s, when its 32-bit counter is full,"
        for tick in (10**3, 10**5, 10**6)
    },
}
#: Beginning of GPS time, 1980-01-06, and length of its weeks [ns].
GPS_EPOCH, GPS_WEEK = 315_964_800 * 10**9, 7 * int(DAY) * 10**9
#: Weeks below the first one may be counted modulo 1024, or come from a receiver without a fix.
MIN_GPS_WEEK, MAX_GPS_WEEK = 1024, 9999
GPS_NOTE = "the stamps are GPS time, which has no leap seconds (18 s ahead of UTC in 2026)"
#: Steps from which the typical one follows.
_TYPICAL_STEPS = 4096
#: The integer of ``NaT``.
NAT = np.iinfo(np.int64).min
_MAX_INT64 = 2**63 - 1
#: Julian day number of 1970-01-01.
_ORDINAL_1970 = 2440588

_UNITS = {
    1: ("ns", "nsec", "nsecs", "nanosecond", "nanoseconds"),
    10**3: ("us", "µs", "μs", "usec", "usecs", "microsecond", "microseconds"),
    10**6: ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"),
    10**9: ("s", "sec", "secs", "second", "seconds"),
    60 * 10**9: ("min", "mins", "minute", "minutes"),
    3600 * 10**9: ("h", "hr", "hrs", "hour", "hours"),
    86400 * 10**9: ("d", "day", "days"),
    7 * 86400 * 10**9: ("week", "weeks"),
}
#: Unit of the serial dates of MATLAB, days, and the one of 1970-01-01.
DATENUM, _DATENUM_1970 = "datenum", 719_529
_NANOSECONDS = {spelling: ns for ns, spellings in _UNITS.items() for spelling in spellings}
_SINCE = re.compile(r"\bsince\b", re.IGNORECASE)
#: Calendars in which a date is an instant; the others are calendars of climate models.
_CALENDARS = ("standard", "gregorian", "proleptic_gregorian", "julian")
#: Longest cell that can be a stamp [characters]: a double written in full has at most 325 digits
#: before and 1074 after the point.
_MAX_DIGITS = 1400
_NUMBER = re.compile(r"^[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d{1,4})?$")


@dataclass(frozen=True)
class TimeUnit:
    """Unit of a numeric time column: nanoseconds per unit, and epoch [ns since 1970]."""

    text: str
    ns: Fraction
    epoch: int | None = None

    @property
    def digits(self) -> int | None:
        """Decimals down to one nanosecond (9 for seconds); None if not a power of ten.

        Also None when the epoch is outside the years 1678 to 2262, where sums with it exceed 64
        bits.
        """
        if self.epoch is not None and abs(self.epoch) > _MAX_INT64:
            return None
        return next((n for n in range(13) if self.ns == 10**n), None)


#: Unit of stamps.
NANOSECOND = TimeUnit("ns", Fraction(1))


def names_epoch(text: str) -> bool:
    """Return whether a unit counts from an epoch, such as ``seconds since 1970-01-01``."""
    return bool(_SINCE.search(text))


def parse_time_unit(text: str, calendar: str | None = None) -> TimeUnit:
    """Parse a time unit, with an optional leading factor and an optional CF epoch.

    It is not case-sensitive, as in UDUNITS. `calendar` is the CF calendar of the epoch. ``datenum``
    is the unit of the serial dates of MATLAB. `UnitError` when the text is not a time unit, when
    its epoch is ambiguous or depends on the clock, or when the calendar is not one of real dates.

    Examples
    --------
    >>> parse_time_unit("us").ns
    Fraction(1000, 1)
    >>> parse_time_unit("Seconds Since 1970-01-02 00:00:00").epoch
    86400000000000
    """
    if text.strip().lower() == DATENUM:
        return TimeUnit(text, Fraction(int(DAY) * 10**9), -_DATENUM_1970 * int(DAY) * 10**9)
    name, *since = (part.strip() for part in _SINCE.split(text, maxsplit=1))
    epoch = _epoch_ns(text, since[0], calendar) if since else None
    factor, _, bare = name.rpartition(" ")
    # Ms is ambiguous: megasecond, or milliseconds mistyped
    ns = None if bare == "Ms" else _NANOSECONDS.get(bare.lower(), _NANOSECONDS.get(bare))
    if ns is None or (
        factor and not (len(factor) <= _MAX_DIGITS and _NUMBER.match(factor.strip()))
    ):
        units = (
            "s, ms, us, ns, min, h, d, week, with a factor in front if needed, and datenum (MATLAB)"
        )
        raise UnitError(
            f"time unit {text!r} is not known; known are {units}; months and years have no fixed "
            "length"
        )
    scale = Fraction(factor.strip() or "1")
    if not 0 < ns * scale < 2**63 or (ns * scale).denominator >= 2**63:
        raise UnitError(
            f"time unit {text!r}: the factor {factor} is not usable; give a number above 0, of "
            "less than 292 years"
        )
    return TimeUnit(text, ns * scale, epoch)


def _epoch_ns(text: str, since: str, calendar: str | None) -> int:
    """Return the epoch of a unit [ns since 1970], which may exceed 64 bits."""
    import cftime

    calendar_name = (calendar or "standard").strip().lower()
    if calendar_name not in _CALENDARS:
        raise UnitError(
            f"time unit {text!r}: dates of the calendar {calendar!r} are not instants of a "
            "recording; "
            "write the times in the standard calendar"
        )
    fields = split_instant(since)
    try:
        if fields is None:
            raise ValueError
        year, month, day, nanoseconds = fields
        days = cftime.datetime(year, month, day, calendar=calendar_name).toordinal() - _ORDINAL_1970
    except ValueError:
        raise UnitError(
            f"time unit {text!r}: {since!r} is not a date that can be read in one way only; "
            "write the year first, as in 'seconds since 2026-01-02T00:00:00'"
        ) from None
    return int(days) * 86400 * 10**9 + nanoseconds


def read_stamps(raw: xr.Dataset, begin: int, end: int) -> Ints:
    """Read the stamps of rows of a raw log [ns since 1970], `NAT` where unreadable."""
    stamps = read_slice(raw["time"].data, max(begin, 0), min(end, raw.sizes["row"]))
    return to_nanoseconds(stamps)


def texts_to_ns(texts: Sequence[Any] | Array) -> Ints:
    """Convert ISO 8601 texts (UTC by default) to stamps; unreadable ones become `NAT`."""
    stamps = pd.to_datetime(
        pd.Series(list(texts), dtype=object), format="ISO8601", utc=True, errors="coerce"
    )
    return to_nanoseconds(stamps.dt.tz_convert(None).to_numpy(), far_as_nat=True)


def integers_to_ns(values: Ints, unit: TimeUnit, epoch: int) -> Ints:
    """Convert counts of `unit` since `epoch` to stamps; `NAT` outside 1678 to 2262."""
    zero = epoch if unit.epoch is None else unit.epoch
    up, down = unit.ns.numerator, unit.ns.denominator
    if (up, down, zero) == (1, 1, 0):
        return values
    inside: Any = True
    if down > 1:
        limit = (_MAX_INT64 - down) // up
        inside = (values >= -limit) & (values <= limit)
        values, up = (np.where(inside, values, 0) * up + down // 2) // down, 1
    low, high = max(-((_MAX_INT64 + zero) // up), -_MAX_INT64), (_MAX_INT64 - zero) // up
    # Products and sums may exceed 64 bits on the way; those that fit in the end are exact.
    stamps = values * up + np.int64((zero + 2**63) % 2**64 - 2**63)
    if down == 1 and np.size(values) and low <= values.min() and values.max() <= high:
        return stamps
    return np.where(inside & (values >= low) & (values <= high), stamps, NAT)


def floats_to_ns(values: NDArray[np.floating[Any]], unit: TimeUnit, epoch: int) -> Ints:
    """Convert floats to stamps: whole units as integers, only the fraction in floating point."""
    wide = np.asarray(values, dtype=np.float64)
    usable = np.isfinite(wide) & (np.abs(wide) < 2.0**62)
    whole_units = np.floor(np.where(usable, wide, 0.0))
    stamps = integers_to_ns(whole_units.astype(np.int64), unit, epoch)
    part = np.rint((np.where(usable, wide, 0.0) - whole_units) * float(unit.ns)).astype(np.int64)
    return np.where(usable & (stamps != NAT), stamps + part, NAT)


def numbers_to_ns(values: Array, unit: TimeUnit, epoch: int) -> Ints:
    """Convert counts of `unit` since `epoch`, whole or not, to stamps."""
    if values.dtype.kind == "f":
        return floats_to_ns(values, unit, epoch)
    if values.dtype.kind == "u":
        values = np.minimum(values, np.uint64(_MAX_INT64))
    return integers_to_ns(values.astype(np.int64), unit, epoch)


def add_weeks(stamps: Ints, weeks: Floats) -> Ints:
    """Add GPS weeks to the beginning of GPS time plus times of week; `NAT` for other numbers.

    Examples
    --------
    >>> add_weeks(np.array([GPS_EPOCH] * 2), np.array([2000.0, 0.0])).astype("datetime64[ns]")
    array(['2018-05-06T00:00:00.000000000',                           'NaT'],
          dtype='datetime64[ns]')
    """
    is_week = (weeks >= MIN_GPS_WEEK) & (weeks <= MAX_GPS_WEEK) & (weeks == np.rint(weeks))
    added = np.where(is_week, weeks, 0).astype(np.int64) * GPS_WEEK
    return np.where(is_week & (stamps != NAT), stamps + added, NAT)


def is_number(text: str, *, comma: bool = False) -> bool:
    """Return whether a cell holds a plain decimal number (no words, no ``nan``)."""
    text = plain_number(text.replace(",", ".") if comma else text).strip()
    return len(text) <= _MAX_DIGITS and bool(_NUMBER.match(text))


def plain_number(text: str) -> str:
    """Write the exponent of a number with E, where Fortran writes D, and minus as a hyphen.

    Examples
    --------
    >>> [plain_number(text) for text in ("1.5d+02", "\N{MINUS SIGN}1.5", "(1.5)")]
    ['1.5E+02', '-1.5', '-1.5']
    """
    text = text.upper().replace("D", "E").replace("\N{MINUS SIGN}", "-")
    in_brackets = text.startswith("(") and text.endswith(")")  # of spreadsheets
    return f"-{text[1:-1]}" if in_brackets else text


def cells_to_ns(
    cells: Sequence[str], unit: TimeUnit | None, epoch: int, order: str = YEAR_FIRST
) -> Ints:
    """Convert text cells to stamps, exact to the last decimal: numbers of `unit`, or dates.

    `order` is that of day, month and year in dates that are not ISO 8601, and `epoch` the beginning
    of 1970 in the zone of dates [ns since 1970].
    """
    if unit is None:
        return integers_to_ns(
            texts_to_ns([as_iso(cell, order) for cell in cells]), NANOSECOND, epoch
        )
    zero = epoch if unit.epoch is None else unit.epoch
    stamps = np.full(len(cells), NAT, dtype=np.int64)
    for index, cell in enumerate(cells):
        if is_number(cell):
            value = Fraction(plain_number(cell.strip())) * unit.ns
            nanoseconds = round(value) + zero
            if abs(nanoseconds) <= _MAX_INT64:
                stamps[index] = nanoseconds
    return stamps


class TurningClock:
    """Continue the stamps of successive blocks, and count the periods that are added to them."""

    def __init__(self) -> None:
        self.last: int | None = None
        self.turns: list[int] = []

    def continue_stamps(self, stamps: Ints) -> Ints:
        """Return the stamps of the next block, continued where the clock begins again."""
        places = np.flatnonzero(stamps != NAT)
        if not places.size:
            return stamps
        good = stamps[places] + sum(self.turns)
        steps = np.diff(good)
        typical = typical_step(good)
        backward = np.flatnonzero(steps < -min(CLOCK_PERIODS) // 2) + 1
        turns = [] if self.last is None else [(0, find_turns(int(good[0]) - self.last, typical)[0])]
        for row in backward.tolist():
            turn, _ = find_turns(int(steps[row - 1]), typical)
            if not (row < steps.size and steps[row] > turn // 2):  # one wrong stamp
                turns.append((row, turn))
        for row, turn in turns:
            if turn:
                good[row:] += turn
                self.turns.append(turn)
        self.last = int(good[-1])
        if not self.turns:
            return stamps
        continued = stamps.copy()
        continued[places] = good
        return continued

    def describe(self) -> list[str]:
        """Return a note if a period was added."""
        if not self.turns:
            return []
        period = CLOCK_PERIODS[max(self.turns)]
        times = f"{len(self.turns)} time{'s' * (len(self.turns) > 1)}"
        return [
            f"the clock begins again after {period} ({times}) "
            "without a pause; the stamps are continued"
        ]


def typical_step(stamps: Ints) -> float:
    """Return a typical step [ns] of the first stamps of a block; 0 if all of them are equal."""
    steps = np.diff(stamps[stamps != NAT][: _TYPICAL_STEPS + 1])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def find_turns(step: int, typical: float, *, first: int | None = None) -> tuple[int, int]:
    """Return the period of a clock that begins again at a step, and how often, or 0.

    No row is lost there; `typical` is a typical step of the stamps [ns]. Within a file a clock
    begins again once. Between files it may have several times, with `first` as its first stamp from
    its zero [ns].

    Examples
    --------
    >>> find_turns(-86_399_950_000_000, 5e7), find_turns(-86_000_000_000_000, 5e7)
    ((86400000000000, 1), (0, 0))
    """
    for period in CLOCK_PERIODS:
        turns, rest = -(step // period), step % period
        is_possible = turns == 1 if first is None else -period / 2 <= first < period
        if is_possible and 0 < rest <= 2 * typical < period / 2:
            return period, turns
    return 0, 0
