"""Time stamps as integers, nanoseconds since 1970-01-01T00:00:00 UTC, and as text."""

from __future__ import annotations

import os
import re
from datetime import UTC, date, datetime
from typing import Any

import numpy as np
import pandas as pd

from gyrostab.arrays import Ints
from gyrostab.errors import OptionError, TimeError

NANOSECONDS = 10**9
_CLOCK = r"(\d{1,2})(?::(\d{1,2})(?::(\d{1,2})(?:[.,](\d+))?)?)?"
_ZONE = r"\s*(Z|UTC|GMT|[+-]\d{1,2}(?::?\d{2})?)?"
_INSTANT = re.compile(
    rf"(\d{{4}}|1(?=-0?1-))-(\d{{1,2}})-(\d{{1,2}})(?:[T ]\s*{_CLOCK}{_ZONE})?", re.IGNORECASE
)
_COMPACT_INSTANT = re.compile(
    rf"(\d{{4}})(\d\d)(\d\d)(?:[T ](\d\d)(\d\d)(\d\d)(?:[.,](\d+))?{_ZONE})?", re.IGNORECASE
)


def to_nanoseconds(stamps: Any, *, far_as_nat: bool = False) -> Ints:
    """Convert datetime64 of any unit to integers; ``NaT`` becomes the lowest one.

    Dates before 1678 or after 2262 exceed 64 bits; numpy would wrap them around without an error.

    Parameters
    ----------
    far_as_nat : bool
        Treat such dates as ``NaT``.

    Raises
    ------
    TimeError
        When there are such dates.

    Examples
    --------
    >>> to_nanoseconds(np.array(["1970-01-01T00:00:02"], dtype="datetime64[s]"))
    array([2000000000])
    """
    dates = np.asarray(stamps)
    dates = dates.astype(dates.dtype.newbyteorder("="), copy=False)
    if dates.dtype.kind == "M" and dates.dtype != np.dtype("datetime64[ns]"):
        low, high = (
            np.datetime64(day, "D").astype(dates.dtype) for day in ("1677-09-22", "2262-04-11")
        )
        is_far = (dates <= low) | (dates > high)
        if is_far.any() and not far_as_nat:
            raise TimeError(
                f"the time {dates[is_far].flat[0]} is outside the years 1678 to 2262, which 64-bit "
                "nanoseconds hold; correct it"
            )
        dates = np.where(is_far, np.datetime64("NaT"), dates) if is_far.any() else dates
    return dates.astype("datetime64[ns]", copy=False).view(np.int64)


def format_stamp(stamp: int) -> str:
    """Format a stamp as ISO 8601, to the millisecond.

    Examples
    --------
    >>> format_stamp(2_000_000_000), format_stamp(np.iinfo(np.int64).min)
    ('1970-01-01T00:00:02.000', 'no stamp')
    """
    date = np.datetime64(int(stamp), "ns").astype("datetime64[ms]")
    return "no stamp" if np.isnat(date) else str(date)


def label_stamp(time: Any) -> str:
    """Format a datetime64 as a label, with milliseconds if it is between two seconds.

    Examples
    --------
    >>> label_stamp(np.datetime64("2026-11-20T14:00:00.250")), label_stamp(np.datetime64("2026-11"))
    ('2026-11-20 14:00:00.250', '2026-11-01 00:00:00')
    """
    return format_stamp(int(to_nanoseconds(time))).replace("T", " ").removesuffix(".000")


def split_instant(text: str) -> tuple[int, int, int, int] | None:
    """Split a date and time into year, month, day and nanoseconds after its midnight UTC.

    Only texts that can be read in one way are split: the year has four digits and comes first (ISO
    8601, or the form ``2026-1-2 3:4:5 UTC`` that UDUNITS reads). The fields are not checked against
    a calendar.

    Parameters
    ----------
    text : str
        The date and time; UTC unless it names an offset.

    Returns
    -------
    tuple of int or None
        None when the text has another form.

    Examples
    --------
    >>> split_instant("2026-1-2 3:00 +01:00")
    (2026, 1, 2, 7200000000000)
    >>> split_instant("01-02-2026") is None
    True
    """
    match = _INSTANT.fullmatch(text.strip()) or _COMPACT_INSTANT.fullmatch(text.strip())
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(group or 0) for group in match.groups()[:6])
    fraction, zone = match.groups()[6:]
    seconds = 3600 * hour + 60 * minute + second
    if seconds > 86400 or minute > 59 or second > 60:
        return None
    if zone and zone[0] in "+-":
        digits = zone[1:].replace(":", "")
        hours, minutes = (digits, "0") if len(digits) <= 2 else (digits[:-2], digits[-2:])
        if int(hours) > 23 or int(minutes) > 59:
            return None
        seconds -= int(f"{zone[0]}1") * (3600 * int(hours) + 60 * int(minutes))
    if second == 60 and seconds % 86400:  # a leap second is the last one of a day
        return None
    return year, month, day, seconds * NANOSECONDS + int((fraction or "0")[:9].ljust(9, "0"))


def stamp_ns(start: Any, name: str = "start") -> int:
    """Convert an instant to nanoseconds since 1970.

    Parameters
    ----------
    start : str or datetime
        The instant; text is ISO 8601, UTC unless it says otherwise. A bare number is refused: it
        could be seconds or nanoseconds.

    Raises
    ------
    OptionError
        When it is not a date and time, or outside the years 1678 to 2262.

    Examples
    --------
    >>> stamp_ns("1970-01-01T02:00:01+02:00")
    1000000000
    """
    try:
        if isinstance(start, str):
            fields = split_instant(start)
            if fields is None:
                raise ValueError("the year does not come first, with four digits")
            days = (date(*fields[:3]) - date(1970, 1, 1)).days
            stamp = days * 86400 * NANOSECONDS + fields[3]
        else:
            time = pd.Timestamp(start)
            if pd.isna(time) or isinstance(start, int | float | np.number):
                raise ValueError("no time")
            stamp = int((time.tz_convert(None) if time.tzinfo else time).as_unit("ns").value)
    except pd.errors.OutOfBoundsDatetime:
        stamp = 2**63
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        example = "2026-11-20T14:00:00 (UTC)"
        raise OptionError(
            f"{name} {start!r} is not a date and time; write for instance {example}"
        ) from error
    if abs(stamp) >= 2**63:
        raise OptionError(
            f"{name} {start!r} is outside the years 1678 to 2262, which 64-bit nanoseconds hold; "
            "give another date"
        )
    return stamp


def time_of_day() -> str:
    """Return the current time, UTC, as ISO 8601.

    The environment variable ``SOURCE_DATE_EPOCH`` [s since 1970] replaces the clock if it is set.

    With that variable, the same inputs, options and versions make the same file, byte for byte.

    Raises
    ------
    OptionError
        When the variable is not an integer number of seconds.

    References
    ----------
    https://reproducible-builds.org/specs/source-date-epoch/

    Examples
    --------
    >>> len(time_of_day())
    20
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        now = datetime.now(UTC) if not epoch else datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise OptionError(
            f"SOURCE_DATE_EPOCH={epoch!r} in the environment is not a whole number of seconds "
            "since 1970; unset it"
        ) from error
    return f"{now:%Y-%m-%dT%H:%M:%SZ}"


def extend_history(log: Any, done: str) -> str:
    """Return the history of a log with one more line: the current time, and what was done."""
    earlier = str(log.attrs.get("history") or "")
    return "\n".join(filter(None, [earlier, f"{time_of_day()} {done}"]))
