"""Choose the time column of a file, its unit, and the order of day and month in its dates."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from gyrostab.errors import GyrostabError, MissingUnitError, UnitError
from gyrostab.ingest.columns.dates import (
    DAY_FIRST,
    EITHER_FIRST,
    MONTH_FIRST,
    NAMED_ZONE,
    NO_DATE,
    YEAR_FIRST,
    find_offset,
    find_zone_name,
    has_offset,
    parse_order,
    states_zone,
)
from gyrostab.ingest.columns.headers import (
    KNOWN_CHANNEL_PATTERN,
    TIME_PATTERN,
    VOID_CELLS,
    FileColumn,
    is_time_unit,
    split_header,
    time_suffix,
)
from gyrostab.ingest.columns.plan import Column, Plan
from gyrostab.ingest.columns.stamps import (
    GPS_EPOCH,
    GPS_NOTE,
    GPS_WEEK,
    MIN_GPS_WEEK,
    TimeUnit,
    cells_to_ns,
    is_number,
    names_epoch,
    parse_time_unit,
    plain_number,
)

#: Orders of stamps that cannot be read.
UNREADABLE = (NO_DATE, NAMED_ZONE)
#: Names of columns of GPS weeks and of times of week, of their letters alone.
_WEEK_NAME = re.compile(r"(?:gps)?week(?:no|num|number)?|gpswn")
_TIME_OF_WEEK_NAME = re.compile(
    r"(?:gps)?(?:i?tow|sow|(?:time|sec(?:ond)?s?)(?:of|in)week)(?:s|sec|ms|us|ns)?"
    r"|gps(?:time|sec(?:ond)?s?)"
)


def find_time(plan: Plan, named: list[FileColumn]) -> FileColumn | None:
    """Choose the time column and its unit; other candidates are left out with a note."""
    time_columns = _find_by_name(named) or _find_by_content(plan, named)
    if not time_columns:
        return None
    column, *rivals = sorted(time_columns, key=lambda c: not c.may_rise)
    rivals += [c for c in named if c.low == "time" and c not in time_columns]
    if rivals:
        names = " and ".join(repr(c.header) for c in [column, *rivals][:3])
        plan.notes.append(
            f"{names} look like the time; {column.header!r} is used (for another: --map "
            f'"{rivals[0].key}=time")'
        )
        for rival in rivals:
            plan.leave_out(rival)
        named[:] = [c for c in named if c not in rivals]
    if column.stamped:
        unit, order = None, _date_order(plan, column)
        epoch = -_find_offset(plan, column, named)
        written: str | None = "ISO 8601" if order == YEAR_FIRST else order
    else:
        unit, order, epoch = _time_unit(plan, column), YEAR_FIRST, plan.options.epoch_ns
        written = unit.text if unit else None
        unit = _add_weeks(plan, column, unit, named)
    planned = Column(
        column.source, column.header, "time", "time", "ns", 1.0, 0.0, unit, order, epoch
    )
    plan.add_column(column, written, planned)
    if (
        unit is not None
        and unit.epoch is None
        and plan.options.epoch is None
        and not plan.options.channels_only
    ):
        plan.notes.append(
            "numeric time is counted from 1970-01-01T00:00:00 UTC; give --epoch for another zero"
        )
    if unit is not None and unit.epoch is not None and plan.options.epoch is not None:
        plan.notes.append(
            f"--epoch is not used: the time column {column.header!r} is in {unit.text!r}"
        )
    return column


def _add_weeks(
    plan: Plan, column: FileColumn, unit: TimeUnit | None, named: list[FileColumn]
) -> TimeUnit | None:
    """Plan the GPS weeks of times of week, and return their unit with the beginning of GPS time."""
    is_dated = plan.options.epoch is not None or unit is None or unit.epoch is not None
    if is_dated or not _TIME_OF_WEEK_NAME.fullmatch(_letters_of(column)):
        return unit
    stamps = cells_to_ns([cell for cell in column.cells if is_number(cell)], unit, 0)
    candidates = [c for c in named if not c.mapped and _WEEK_NAME.fullmatch(_letters_of(c))]
    filled = [c for c in candidates if any(map(is_number, c.cells))]
    if not filled or stamps.min(initial=0) < 0 or stamps.max(initial=0) > GPS_WEEK:
        return unit
    weeks = filled[0]
    numbers = (float(plain_number(cell)) for cell in weeks.cells if is_number(cell))
    if len(filled) > 1 or max(numbers) < MIN_GPS_WEEK:
        reason = (
            f"there are several columns of them, {filled[1].header!r} too"
            if len(filled) > 1
            else f"they are below {MIN_GPS_WEEK}, as without a fix or of a counter of 10 bits"
        )
        plan.refuse(
            UnitError,
            f"{weeks.header!r} may hold the GPS weeks of {column.header!r}, but {reason}; give "
            "the beginning of the week, for instance --epoch 2026-03-08",
        )
        return unit
    plan.notes.append(f"{weeks.header!r} holds the GPS weeks of {column.header!r}; {GPS_NOTE}")
    plan.columns.append(Column(weeks.source, weeks.header, "week", "week", "week"))
    plan.add_summary(weeks, "time", "time", None)
    named.remove(weeks)
    return replace(unit, epoch=GPS_EPOCH) if unit else None


def _letters_of(column: FileColumn) -> str:
    return re.sub(r"[^a-z]", "", split_header(column.header)[0].lower())


def _find_by_name(named: Sequence[FileColumn]) -> list[FileColumn]:
    """Find the columns that are called time: by ``--map``, else by the preset, else in the file."""
    called = [c for c in named if c.low == "time" and c.is_named]
    if called:
        return [c for c in called if c.mapped] or called
    likely = [c for c in named if not c.is_named and TIME_PATTERN.match(c.low) and _may_be_time(c)]
    return [c for c in likely if c.low != "t" or c.written or c.stamped] or likely


def _find_by_content(plan: Plan, named: Sequence[FileColumn]) -> list[FileColumn]:
    """Find the columns of dates, else the only column that rises in a unit of time, with a note."""
    can_leave_out = plan.options.rate is not None
    candidates = [
        c
        for c in named
        if c.stamped
        and c.may_rise
        and not c.is_named
        and not (can_leave_out and c.date_order in UNREADABLE)
    ]
    reason = "it holds dates"
    if not candidates:
        clocks = [c for c in named if _is_clock(c)]
        candidates = clocks if len(clocks) == 1 else []
        reason = "it is the only column that rises in a unit of time"
    if candidates:
        plan.notes.append(f"{candidates[0].header!r} is read as the time column, because {reason}")
    return candidates


def _may_be_time(column: FileColumn) -> bool:
    # An epoch that cannot be read is reported, not ignored.
    return column.written is None or column.stamped or _counts_time(column.written)


def _counts_time(unit: str) -> bool:
    return is_time_unit(unit) or names_epoch(unit)


def _is_clock(column: FileColumn) -> bool:
    """Return whether a column of another name has a unit of time, and values known to rise."""
    return (
        column.written is not None
        and _counts_time(column.written)
        and not column.is_named
        and not KNOWN_CHANNEL_PATTERN.match(column.low)
        and bool(column.cells)
        and column.may_rise
    )


def _date_order(plan: Plan, column: FileColumn) -> str:
    """Return the order of day, month and year: from the user, the header, or the dates."""
    if column.date_order == NAMED_ZONE:
        plan.refuse(
            UnitError,
            f"the time column {column.header!r} holds {column.first_word!r}, with the "
            "name of a time zone; write the offset from UTC in its place, for instance "
            "2026-05-01T08:00:00-06:00 or 05/20/2026 8:00:00 AM -06:00",
        )
        return NAMED_ZONE
    names = [column.name, column.key, column.header, "time"]
    for key in filter(None, (plan.unit_key([name]) for name in names)):
        if order := parse_order(plan.options.unit[key]):
            plan.used_units.add(key)
            return order
    order = parse_order(column.written or "") or column.date_order
    if order == NO_DATE:
        plan.refuse(
            UnitError,
            f"the time column {column.header!r} holds times of day without a date; write the date "
            "before the time, in this column or in one to its left, or give rate and start: --map "
            f'"{column.key}=-" --rate HZ --start 2026-05-01T08:00:00',
        )
    if order is None:
        plan.refuse(
            UnitError,
            f"the dates in the time column {column.header!r} can be read in two ways; say which "
            f"number is the day: --unit time={DAY_FIRST} or --unit time={MONTH_FIRST}",
        )
    return order or EITHER_FIRST


def _find_offset(plan: Plan, column: FileColumn, named: Sequence[FileColumn]) -> int:
    """Return the offset from UTC of dates without one [ns]: from the user or the header.

    A column that gives the zone of each row may change later in the file, and times may be in UTC
    in spite of it: the user has to say what they are.
    """
    cells = column.cells
    if not cells or any(map(has_offset, cells)):
        return 0
    key = plan.unit_key([column.name, column.key, column.header, "time"])
    given = None if key is None else find_offset(plan.options.unit[key])
    if key is not None and given is not None:
        plan.used_units.add(key)
        return given
    offset, zone = find_offset(column.header), find_zone_name(column.header)
    if offset is None and "utc" in column.header.lower():  # time_utc
        offset = 0
    if offset:
        plan.notes.append(
            f"the times are read with the offset from UTC that the header {column.header!r} names; "
            "for UTC give --unit time=UTC"
        )
    elif offset is None and zone is not None:
        plan.refuse(
            UnitError,
            f"the header of the time column {column.header!r} names the time zone {zone}; give its "
            "offset from UTC, for instance --unit time=UTC-06:00",
        )
    elif offset is None and (zone_cell := _find_zone_cell(named)):
        plan.refuse(
            UnitError,
            f"the times have no offset from UTC, and column {zone_cell[0]!r} holds "
            f"{zone_cell[1]!r}; say what they are: --unit time=UTC, or with the offset of local "
            "times, for instance --unit time=UTC-06:00",
        )
    return offset or 0


def _find_zone_cell(named: Sequence[FileColumn]) -> tuple[str, str] | None:
    """Find the first cell that gives another time zone than UTC, with the header of its column."""
    cells = ((column, cell.strip()) for column in named for cell in column.cells)
    zones = (
        (column.header, cell)
        for column, cell in cells
        if cell.lower() not in VOID_CELLS and states_zone(column.name, cell)
    )
    return next(zones, None)


def _time_unit(plan: Plan, column: FileColumn) -> TimeUnit | None:
    named = time_suffix(split_header(column.header)[0])
    written = column.unit or (
        named if named not in ("utc", "iso") and column.stored is None else None
    )
    keys = [column.name, column.key, column.header, "time"]
    text = plan.find_unit(column, keys, written, is_time_unit, prefer_given=column.unit is None)
    if text is None:
        word = column.first_word
        plan.refuse(
            MissingUnitError,
            f"the time column {column.header!r} holds {word!r}, which is neither a number nor a "
            "date in a form that is read; write the year with four digits and a zone as an offset, "
            "for instance 2026-05-01T08:00:00-06:00, 01.05.2026 8:00:00, 01-May-2026 08:00:00 or "
            "05/20/2026 8:00:00 AM"
            if word
            else f"the time column {column.header!r} carries no unit, and holds no dates; give the "
            "unit of numbers with --unit time=s (or ms, us, ns)",
        )
        return None
    try:
        return parse_time_unit(text, column.calendar if text == column.stored else None)
    except GyrostabError as error:
        advice = '"time=seconds since 2026-01-02T00:00:00"' if names_epoch(text) else "time=s"
        plan.refuse(
            UnitError, f"column {column.header!r}: {error}; or give it with --unit {advice}"
        )
        return None
