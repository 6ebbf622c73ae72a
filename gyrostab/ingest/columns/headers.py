"""Parse header cells: name and unit of a column, and the names that gyrostab knows."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from gyrostab.errors import GyrostabError
from gyrostab.ingest.columns.dates import (
    DAY_FIRST,
    NAMED_ZONE,
    NO_DATE,
    YEAR_FIRST,
    find_order,
    holds_date,
    is_time_of_day,
    names_zone,
)
from gyrostab.ingest.columns.stamps import (
    NAT,
    cells_to_ns,
    is_number,
    parse_time_unit,
    plain_number,
)
from gyrostab.schema import RESERVED_NAMES
from gyrostab.units import known_units, parse_unit

_T = TypeVar("_T")

AXIS_PATTERN = re.compile(r"^(gyro|angle)_([a-z]\d*|\d+)$")
_TIME_SUFFIX = r"s|sec|seconds?|ms|milliseconds?|us|microseconds?|ns|nanoseconds?|utc|iso"
TIME_PATTERN = re.compile(
    rf"^(?:(?:time|timestamp|t)(?:[_ ]({_TIME_SUFFIX}))?|(?:time|timestamp)(sec|ms|us|ns|utc))$"
)
#: Names of angle increments.
INCREMENT_PATTERN = re.compile(r"(^|[^a-z])d_?(theta|ang|phi)|delta|incr", re.IGNORECASE)
GYRO_PATTERNS = [
    *(
        re.compile(pattern, re.IGNORECASE)
        for pattern in (r"gyr|angular_?(rate|vel)|omega", r"^[gw]_?[xyz](_|$)|^w_rs", r"rate|rot")
    ),
    INCREMENT_PATTERN,
]

#: Channel name, or the stem before an underscore -> quantity.
QUANTITIES = {
    "temperature": "temperature",
    "vibration": "acceleration",
    "accel": "acceleration",
    "rotation_rate": "rotation_rate",
    "supply_voltage": "voltage",
    "light_power": "power",
    "pressure": "pressure",
    "mag": "magnetic",
    "ramp": "number",
}
KNOWN_CHANNEL_PATTERN = re.compile(
    r"^(temperature|vibration|rotation_rate|supply_voltage|light_power|pressure|ramp|accel_[xyz]|mag_[xyz])$"
)
#: Cells without a value, in lower case; other text is unreadable. The kernel knows them too.
VOID_CELLS = frozenset(("", "nan", "-nan", "null", "na", "n/a", "none"))
#: Rises for each fall above which a column holds stamps: a clock may step back, and noise rises as
#: often as it falls.
RISES_OF_STAMPS = 9
#: Other names of a temperature, in lower case.
TEMPERATURE_PATTERN = re.compile(r"temp|(^|[^a-z])tmp")


@dataclass
class FileColumn:
    """A column as its format describes it, and the name that it gets."""

    header: str  # as written, or "0", "1", ... in a file without a header
    stored: str | None = None  # unit that the format stores outside the header
    calendar: str | None = None  # the CF calendar of that unit
    stamped: bool = False  # holds dates (text, datetime types)
    date_order: str | None = YEAR_FIRST  # of these dates; None if they can be read in two ways
    target: str | None = None  # by a code of the format, in the form of --map, which overrules it
    cells: Sequence[str] = ()  # the first ones, with decimal points; empty if they are not known
    # from here on by `distinct_columns` and `name_columns`
    source: int = 0  # number of the column in the file
    name: str = ""
    unit: str | None = None  # in the header, or of --map
    key: str = ""  # unique name for --map
    mapped: bool = False  # named by --map
    preset: bool = False  # named by the preset of the program that wrote the file

    @property
    def low(self) -> str:
        """Name in lower case."""
        return self.name.lower()

    @property
    def written(self) -> str | None:
        """Unit in the header, or stored outside it."""
        return self.unit or self.stored

    @property
    def is_named(self) -> bool:
        """Whether ``--map`` or the preset names the column."""
        return self.mapped or self.preset

    @property
    def is_filled(self) -> bool:
        """Whether any of the first cells is filled, as far as they are known."""
        return not self.cells or any(cell.strip().lower() not in VOID_CELLS for cell in self.cells)

    @property
    def first_word(self) -> str:
        """The first cell that holds no number, cut to 60 characters; empty without one."""
        cells = (cell.strip()[:60] for cell in self.cells)
        return next((c for c in cells if c.lower() not in VOID_CELLS and not is_number(c)), "")

    @property
    def may_rise(self) -> bool:
        """Whether the first filled cells, if they are known, rise from row to row as stamps do."""
        if not self.cells:
            return True
        cells = [cell for cell in self.cells if cell.strip()]
        if all(map(is_number, cells)):
            steps = np.diff([float(plain_number(cell)) for cell in cells])
        else:
            order = find_order(cells) or DAY_FIRST
            if order == NAMED_ZONE:
                return True
            if order == NO_DATE:
                cells = [f"1970-01-01 {cell}" for cell in cells]
            stamps = cells_to_ns(cells, None, 0, order)
            steps = np.diff(stamps[stamps != NAT])
        return int((steps > 0).sum()) > RISES_OF_STAMPS * int((steps < 0).sum())


def describe_cells(header: str, unit: str | None, cells: Sequence[str]) -> FileColumn:
    """Describe a column by its first cells, which show whether it holds dates, and their order.

    Examples
    --------
    >>> column = describe_cells("start", None, ["", "01.05.2026 08:00:00"])
    >>> column.stamped, column.date_order
    (True, 'DD/MM/YYYY')
    """
    filled = [cell for cell in cells if cell.strip()]
    is_dated = any(holds_date(c) or is_time_of_day(c) or names_zone(c) for c in filled)
    order = find_order(filled) if is_dated else YEAR_FIRST
    return FileColumn(header, unit, stamped=is_dated, date_order=order, cells=cells)


def split_header(text: str) -> tuple[str, str | None]:
    """Split a header cell into name and unit.

    A unit is in square brackets, or in parentheses if the unit is known. A whole number in brackets
    is an index and stays in the name.

    Examples
    --------
    >>> split_header("gyro_x [deg/h]")
    ('gyro_x', 'deg/h')
    >>> split_header("gyro_rad[0]")
    ('gyro_rad[0]', None)
    >>> split_header("Gyroscope x (rad/s)"), split_header("Supply (raw)")
    (('Gyroscope x', 'rad/s'), ('Supply (raw)', None))
    """
    text = text.strip()
    name, unit = _split_last(text, "(", ")")
    if name and unit is not None and not unit.isdigit() and is_unit(unit):
        return name, unit
    name, unit = _split_last(text, "[", "]")
    # "gyro_rad[1]" is an index, "ramp [1]" a unit
    if unit is None or (unit.isdigit() and (unit != "1" or not re.search(r"\s\[", text))):
        return text, None
    return name, unit


def _split_last(text: str, opening: str, closing: str) -> tuple[str, str | None]:
    """Split off the brackets at the end of a text; their content is None if there are none."""
    begin = text.rfind(opening)
    if begin < 0 or text.find(closing, begin) != len(text) - 1:
        return text, None
    return text[:begin].strip(), text[begin + 1 : -1].strip()


def is_unit(text: str) -> bool:
    """Return whether a text is a known unit, of time or of any other quantity."""
    is_known = _parse_or_none(parse_unit, text) is not None or is_time_unit(text)
    return is_known and bool(text.strip(" -"))


def is_unit_of(text: str | None, quantities: Collection[str]) -> bool:
    """Return whether a text is a unit of one of these quantities."""
    if text is None:
        return False
    units = ((_parse_or_none(parse_unit, text, quantity), quantity) for quantity in quantities)
    return any(unit is not None and unit.quantity == quantity for unit, quantity in units)


def is_time_unit(text: str) -> bool:
    """Return whether a text is a unit of time."""
    return _parse_or_none(parse_time_unit, text) is not None


def _parse_or_none(parse: Callable[..., _T], *arguments: str) -> _T | None:
    try:
        return parse(*arguments)
    except GyrostabError:
        return None


def time_suffix(name: str) -> str | None:
    """Return the unit or form in the name of a time column, such as ``ms`` or ``utc``, or None."""
    match = TIME_PATTERN.match(name.lower())
    return next((text for text in match.groups() if text), None) if match else None


def distinct_columns(columns: Sequence[FileColumn]) -> Iterator[FileColumn]:
    """Yield the columns, each with a unique key: name, header or numbered name."""
    split = [(column.header.strip(), *split_header(column.header)) for column in columns]
    names = Counter(name.lower() for _, name, _ in split)
    header_counts = Counter(header.lower() for header, _, _ in split)
    used_names = header_counts.keys() | names.keys()
    counts: Counter[str] = Counter()
    for source, (header, name, unit) in enumerate(split):
        key = name if names[name.lower()] == 1 else header
        if header_counts[key.lower()] > 1:
            counts[key.lower()] += 1
            number = counts[key.lower()]
            key = key if number == 1 else free_name(f"{name}_", used_names, number)
            used_names.add(key.lower())
        yield replace(columns[source], header=header, source=source, name=name, unit=unit, key=key)


def free_name(stem: str, used_names: Collection[str], number: int = 2) -> str:
    """Return the first free name of the form stem plus number."""
    while f"{stem}{number}" in used_names or f"{stem}{number}".lower() in used_names:
        number += 1
    return f"{stem}{number}"


def quantity_of(low: str) -> str | None:
    """Return the quantity that a channel of this name measures, None if unknown."""
    return next((QUANTITIES[stem] for stem in QUANTITIES if is_named_after(low, stem)), None)


def is_named_after(low: str, stem: str) -> bool:
    """Return whether a name in lower case is a stem, or a stem before an underscore."""
    return f"{low}_".startswith(f"{stem}_")


def example_unit(quantity: str | None) -> str:
    """Return a unit to suggest in a message."""
    return "1" if quantity is None else known_units(quantity).split(",")[0]


def channel_name(column: FileColumn) -> str:
    """Return the name of a column as a channel, without blanks and slashes."""
    return re.sub(r"[/\s]+", "_", column.low if quantity_of(column.low) else column.name)


def stored_name(name: str) -> str:
    """Return the name that a channel has in the log, where that of a variable is taken.

    ``time_temperature`` holds the stamps of ``temperature``.
    """
    is_taken = name in RESERVED_NAMES or name.startswith("time_")
    return f"{name}_channel" if is_taken else name
