"""Dates as text: ISO 8601, and what spreadsheets and loggers write in its place.

The order of day and month follows from the form where it can: the year comes first, a month has a
name, or points separate the numbers (DIN 5008, day first). ``05/01/2026`` can be read in two ways;
its order follows from a day above 12, or from the user.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

#: Orders of the parts of a date.
YEAR_FIRST, DAY_FIRST, MONTH_FIRST = "YYYY/MM/DD", "DD/MM/YYYY", "MM/DD/YYYY"
#: In place of an order: unknown, taken for that with the day first where the file is inspected.
EITHER_FIRST = f"{DAY_FIRST} or {MONTH_FIRST}"
#: In place of an order: times of day without a date.
NO_DATE = "hh:mm:ss"
#: In place of an order: dates that end with the name of a time zone.
NAMED_ZONE = "date and time with the name of a zone"

_CLOCK = r"(?P<hour>\d\d?):(?P<minute>\d\d)(?::(?P<second>\d\d)(?:[.,](?P<part>\d+))?)?"
_ISO = re.compile(
    r"^\s*\d{4}-?\d\d-?\d\d([T ]\d\d(:?\d\d){0,2}([.,]\d+)?\s*(Z|[+-]\d\d(:?\d\d)?)?)?\s*$"
)
_DATE = re.compile(
    r"^\s*(?:(?P<year>\d{4})(?P<mark>[-/.])(?P<month>\d\d?)(?P=mark)(?P<day>\d\d?)"
    r"|(?P<first>\d\d?)(?P<between>[-/. ])(?:(?P<second_part>\d\d?)(?P=between)(?P<last>\d{4})"
    r"|(?P<name>[A-Za-z]{3,9})(?P=between)(?P<short>\d{4}|\d\d)))"
    rf"(?:[T,\s]\s*{_CLOCK}\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>Z|[+-]\d\d(?::?\d\d)?)?)?\s*$"
)
_TIME_OF_DAY = re.compile(rf"^\s*{_CLOCK}\s*(?:[AaPp][Mm])?\s*$")
_ZONE_NAME = re.compile(r"^(.*:\d\d(?:[.,]\d+)?(?:\s*[AaPp][Mm])?)\s*[A-Za-z][A-Za-z/_]+\s*$")
_OFFSET = re.compile(r":\d\d(?:[.,]\d+)?\s*(?:Z|[+-]\d\d(?::?\d\d)?)\s*$")
#: Offset from UTC in a header, ``UTC+02:00``, and the name of a time zone at its end.
_HEADER_OFFSET = re.compile(
    r"(?<![A-Za-z/])(?:UTC|GMT)(?:\s?(?P<sign>[+-])(?P<hours>\d\d?)(?::?(?P<minutes>\d\d))?)?(?!\w)"
)
_HEADER_ZONE = re.compile(
    r"[\[(,_ ]((?:[A-Z]{1,2}[SD]|[CEW]E|[CEMP])T|MSK"
    r"|(?:Africa|America|Asia|Atlantic|Australia|Europe|Indian|Pacific|US)/\w+)[\])]?\s*$"
)
#: Names of columns that give the zone of each row, and a cell that gives UTC.
_ZONE_COLUMN = re.compile(
    r"(?:tz|time[ _-]?zone)(?:[ _-]?(?:name|offset))?|(?:utc|gmt)[ _-]?offset", re.IGNORECASE
)
_UTC = re.compile(r"(?:(?:Etc/)?(?:UTC|GMT)|Z)?[+-]?[0:.]*", re.IGNORECASE)
#: Years of two digits from this one on are of the 20th century, as in POSIX and `datetime`.
_FIRST_SHORT_YEAR = 69
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")


def is_iso(text: str) -> bool:
    """Return whether a cell is an ISO 8601 date or time (a bare number of 8 digits is not)."""
    return bool(_ISO.match(text)) and not text.strip().isdigit()


def holds_date(text: str) -> bool:
    """Return whether a cell is a date, with or without the time, in any form that is known.

    Examples
    --------
    >>> [holds_date(text) for text in ("2026-05-01", "1.5.2026 08:00:00,5", "1.5", "08:00:00")]
    [True, True, False, False]
    """
    return is_iso(text) or bool(_DATE.match(text))


def has_offset(text: str) -> bool:
    """Return whether a date and time ends with its offset from UTC.

    Examples
    --------
    >>> has_offset("2026-05-01T08:00:00.5+02:00"), has_offset("2026-05-01T08:00:00")
    (True, False)
    """
    return bool(_OFFSET.search(text))


def is_time_of_day(text: str) -> bool:
    """Return whether a cell is a time without a date, such as ``08:00:00.25``."""
    return bool(_TIME_OF_DAY.match(text))


def names_zone(text: str) -> bool:
    """Return whether a cell is a date and time that ends with the name of a time zone.

    Examples
    --------
    >>> [names_zone(f"5/1/2026 8:00:00 {end}") for end in ("PM CDT", "PM", "Europe/Berlin", "Z")]
    [True, False, True, False]
    """
    match = None if holds_date(text) else _ZONE_NAME.match(text)
    return match is not None and holds_date(match[1])


def find_offset(header: str) -> int | None:
    """Return the offset from UTC that a header names [ns]; None without one.

    Examples
    --------
    >>> [find_offset(text) for text in ("Date Time, GMT-05:30", "time [UTC+2]", "time_UTC", "Time")]
    [-19800000000000, 7200000000000, 0, None]
    """
    match = _HEADER_OFFSET.search(header.replace("_", " "))
    if match is None:
        return None
    minutes = 60 * int(match["hours"] or 0) + int(match["minutes"] or 0)
    return minutes * 60 * 10**9 * (-1 if match["sign"] == "-" else 1)


def find_zone_name(header: str) -> str | None:
    """Return the name of a time zone at the end of a header, other than that of UTC.

    Examples
    --------
    >>> [find_zone_name(text) for text in ("Timestamp (CEST)", "time Europe/Oslo", "Date/Time")]
    ['CEST', 'Europe/Oslo', None]
    """
    match = _HEADER_ZONE.search(header)
    return match[1] if match else None


def states_zone(name: str, cell: str) -> bool:
    """Return whether a cell of a column with this name gives another time zone than UTC.

    A column ``zone`` may hold other things, such as formations.

    Examples
    --------
    >>> [states_zone("tz", cell) for cell in ("+02:00", "CEST", "7200", "UTC", "+00:00")]
    [True, True, True, False, False]
    >>> [states_zone("zone", cell) for cell in ("UTC-06:00", "Europe/Oslo", "3", "B")]
    [True, True, False, False]
    """
    if name.lower() == "zone":
        return bool(find_offset(cell) or find_offset(f"UTC{cell}") or find_zone_name(f" {cell}"))
    return bool(_ZONE_COLUMN.fullmatch(name)) and not _UTC.fullmatch(cell)


def find_order(cells: Iterable[str]) -> str | None:
    """Return the order of the parts of dates; None if they can be read in two ways.

    It is `NO_DATE` if all cells are times of day, and `NAMED_ZONE` if one names a time zone.

    Examples
    --------
    >>> find_order(["2026-05-01"]), find_order(["01.05.2026"]), find_order(["05/01/2026"])
    ('YYYY/MM/DD', 'DD/MM/YYYY', None)
    >>> find_order(["05/12/2026 23:59:59", "05/13/2026 00:00:00"])
    'MM/DD/YYYY'
    """
    cells, pairs = list(cells), []
    if all(map(is_time_of_day, cells)):
        return NO_DATE
    if any(map(names_zone, cells)):
        return NAMED_ZONE
    for cell in cells:
        match = None if is_iso(cell) else _DATE.match(cell)
        if match and match["first"]:
            if match["between"] == "." or match["name"]:
                return DAY_FIRST
            pairs.append((int(match["first"]), int(match["second_part"])))
    if not pairs:
        return YEAR_FIRST
    is_day_first = any(first > 12 for first, _ in pairs)
    is_month_first = any(second > 12 for _, second in pairs)
    if is_day_first == is_month_first:
        return None
    return DAY_FIRST if is_day_first else MONTH_FIRST


def parse_order(text: str) -> str | None:
    """Return the order that a text such as ``DD.MM.YYYY hh:mm:ss`` states; None for other texts.

    Examples
    --------
    >>> parse_order("DD.MM.YYYY hh:mm:ss"), parse_order("m/d/yyyy"), parse_order("s")
    ('DD/MM/YYYY', 'MM/DD/YYYY', None)
    """
    match = re.match(r"^\s*([dmy]+)[-/. ]([dmy]+)[-/. ]([dmy]+)\b", text, re.IGNORECASE)
    letters = "".join(part[0].lower() for part in match.groups()) if match else ""
    return {"ymd": YEAR_FIRST, "dmy": DAY_FIRST, "mdy": MONTH_FIRST}.get(letters)


def as_iso(text: str, order: str) -> str | None:
    """Return a date as ISO 8601; None if it is not a date of this order.

    Examples
    --------
    >>> as_iso("5/1/2026 1:30:00.25 PM", "MM/DD/YYYY"), as_iso("01-May-26 08:00", "DD/MM/YYYY")
    ('2026-05-01T13:30:00.25', '2026-05-01T08:00:00')
    >>> as_iso("2026-05-01 08:00:00,25", "YYYY/MM/DD")
    '2026-05-01 08:00:00.25'
    """
    text = text.strip()
    if is_iso(text):
        return text.replace(",", ".")
    match = _DATE.match(text)
    if match is None:
        return None
    year, month, day = match["year"], match["month"], match["day"]
    if year is None:
        year, day, month = match["last"], match["first"], match["second_part"]
        if match["name"]:
            short = match["name"][:3].lower()
            month = str(_MONTHS.index(short) + 1) if short in _MONTHS else "0"
            year = match["short"]
            if len(year) == 2:
                year = f"{'19' if int(year) >= _FIRST_SHORT_YEAR else '20'}{year}"
        elif order == MONTH_FIRST:
            day, month = month, day
        elif order == YEAR_FIRST:
            return None
    date = f"{year}-{int(month):02d}-{int(day):02d}"
    if match["hour"] is None:
        return date
    hour = int(match["hour"])
    if match["half"]:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (match["half"].lower() == "pm")
    part = f".{match['part']}" if match["part"] else ""
    return (
        f"{date}T{hour:02d}:{match['minute']}:{match['second'] or '00'}{part}{match['zone'] or ''}"
    )
