"""Header names to roles, units and factors: the same for every format."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gyrostab.errors import FormatError, GyrostabError, MissingUnitError, OptionError, UnitError
from gyrostab.read.options import ColumnSummary, ReadOptions
from gyrostab.read.stamps import TimeUnit, parse_time_unit
from gyrostab.units import INNER, known_units, parse_unit

__all__ = ["Column", "Plan", "plan_columns", "split_header"]

_BRACKET = re.compile(r"^(.*?)\s*\[([^\[\]]*)\]\s*$")
_AXIS = re.compile(r"^(gyro|angle)_([a-z]\d*|\d+)$")
_TIME_SUFFIX = r"s|sec|seconds?|ms|milliseconds?|us|microseconds?|ns|nanoseconds?|utc|iso"
_TIME = re.compile(rf"^(?:time|timestamp|t)(?:_({_TIME_SUFFIX}))?$")
_LOOKS_GYRO = [
    re.compile(pattern, re.IGNORECASE) for pattern in (r"gyr|angular_?(rate|vel)|omega", r"^[gw]_?[xyz](_|$)|^w_rs", r"rate|rot")
]

#: Channel name, or the stem before an underscore -> quantity.
_QUANTITIES = {
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
_KNOWN = re.compile(r"^(temperature|vibration|rotation_rate|supply_voltage|light_power|pressure|ramp|accel_[xyz]|mag_[xyz])$")


@dataclass(frozen=True)
class Column:
    """A column that is read: ``inner = value * factor + offset`` in `units`; stamps convert by `time_unit` (None: ISO 8601)."""

    source: int
    header: str
    role: str  # "time", "gyro" or "channel"
    name: str  # "time", the axis, or the channel
    quantity: str
    units: str
    factor: float = 1.0
    offset: float = 0.0
    time_unit: TimeUnit | None = None


@dataclass(frozen=True)
class Plan:
    """How the columns of one file are understood."""

    path: Path
    columns: tuple[Column, ...]
    summaries: tuple[ColumnSummary, ...]
    signal: str | None  # "rate", "angle" or None
    kind: str | None  # "rate", "angle" or "increment"
    notes: tuple[str, ...]
    problems: tuple[GyrostabError, ...]
    unmatched: tuple[str, ...]

    def check(self) -> Plan:
        """Raise the first problem, if there is one."""
        if self.problems:
            raise self.problems[0]
        return self

    def of(self, role: str) -> list[Column]:
        """The columns of a role."""
        return [column for column in self.columns if column.role == role]

    @property
    def time(self) -> Column | None:
        """The column of stamps."""
        return next(iter(self.of("time")), None)


@dataclass
class _Header:
    """A column while it is being understood."""

    source: int
    header: str
    name: str
    unit: str | None
    stored: str | None = None  # the unit that the format keeps beside the header, weaker than --unit
    mapped: bool = False
    stamped: bool = False

    @property
    def low(self) -> str:
        return self.name.lower()


def split_header(text: str) -> tuple[str, str | None]:
    """Name and unit of a header cell; a whole number in brackets is an index and stays in the name.

    Examples
    --------
    >>> split_header("gyro_x [deg/h]")
    ('gyro_x', 'deg/h')
    >>> split_header("gyro_rad[0]")
    ('gyro_rad[0]', None)
    """
    match = _BRACKET.match(text.strip())
    if not match or (match.group(2).strip().isdigit() and match.group(2).strip() != "1"):
        return text.strip(), None
    if match.group(2).strip() == "1" and not re.search(r"\s\[", text):
        return text.strip(), None  # "gyro_rad[1]" is an index, "ramp [1]" a unit
    return match.group(1).strip(), match.group(2).strip()


def plan_columns(
    path: Path,
    headers: Sequence[str],
    options: ReadOptions,
    *,
    units: Mapping[int, str] | None = None,
    stamped: Collection[int] = (),
) -> Plan:
    """Decide what each column is.

    Parameters
    ----------
    path : Path
        The file, for messages.
    headers : sequence of str
        Header cells as they are written, or ``"0"``, ``"1"``, ... where there are none.
    options : ReadOptions
        What the user said.
    units : mapping of int to str, optional
        Units that the format stores beside the header (NetCDF attributes).
    stamped : collection of int
        Columns whose values are dates already (ISO 8601 text, datetime types).

    Returns
    -------
    Plan
        Nothing is raised here; ``Plan.check()`` raises what is wrong.
    """
    work = _Work(path, options)
    named = work.name(headers, units or {}, frozenset(stamped))
    time = work.find_time(named)
    rest = [column for column in named if column is not time]
    gyro = [column for column in rest if _AXIS.match(column.low)]
    signal, kind = work.plan_gyro(gyro, headers)
    work.plan_channels([column for column in rest if column not in gyro])
    if time is None and options.rate is None and not work.problems:
        message = f"{path.name}: there is no time column; give the sampling rate with --rate HZ (and --start)"
        work.problems.append(OptionError(f"{message}, or name the column: --map NAME=time. Columns: {_listing(headers)}"))
    work.finish(headers)
    unused = [f"--unit {key}" for key in options.unit if key not in work.used_units]
    unmatched = [f"--map {key}" for key in options.map if key not in work.used_map] + unused
    order = {"time": 0, "gyro": 1, "channel": 2}
    columns = sorted(work.columns, key=lambda column: (order[column.role], column.name if column.role == "gyro" else ""))
    return Plan(path, tuple(columns), tuple(work.summaries), signal, kind, tuple(work.notes), tuple(work.problems), tuple(unmatched))


class _Work:
    """The lists that grow while a file's header is being understood."""

    def __init__(self, path: Path, options: ReadOptions):
        self.path, self.options = path, options
        self.columns: list[Column] = []
        self.summaries: list[ColumnSummary] = []
        self.notes: list[str] = []
        self.problems: list[GyrostabError] = []
        self.left_out: list[str] = []
        self.used_map: set[str] = set()
        self.used_units: set[str] = set()

    def name(self, headers: Sequence[str], units: Mapping[int, str], stamped: frozenset[int]) -> list[_Header]:
        """Apply the map, drop what it drops, and refuse duplicates."""
        wanted = {key.strip().lower(): key for key in self.options.map}
        named: list[_Header] = []
        for source, header in enumerate(headers):
            name, unit = split_header(header)
            key = next((wanted[text] for text in (header.strip().lower(), name.lower()) if text in wanted), None)
            column = _Header(source, header.strip(), name, unit, units.get(source), stamped=source in stamped)
            if key is not None:
                self.used_map.add(key)
                target, target_unit = split_header(self.options.map[key])
                if target in ("", "-"):
                    continue
                column.name, column.unit, column.mapped = target, target_unit or column.unit, True
            if column.name:
                named.append(column)
        for low, count in Counter(c.low if _contract_name(c.low) else c.name for c in named).items():
            if count > 1:
                same = [f"{c.header!r}" for c in named if low in (c.low, c.name)]
                text = f"{self.path.name}: {count} columns are called {low!r} ({', '.join(same)})"
                self.problems.append(FormatError(f"{text}; rename them in the file or drop one with --map NAME=-"))
        return named

    def find_time(self, named: list[_Header]) -> _Header | None:
        """The one time column, with its unit."""
        found = [c for c in named if c.low == "time" and c.mapped]
        if not found:
            found = [c for c in named if not c.mapped and _TIME.match(c.low) and self._may_be_time(c)]
            sure = [c for c in found if c.low != "t" or c.unit or c.stored or c.stamped]
            found = sure or found
        if len(found) > 1:
            names = " and ".join(repr(c.header) for c in found)
            fix = f'keep one and drop the other, for instance --map "{found[1].name}=-"'
            self.problems.append(FormatError(f"{self.path.name}: {names} both look like the time column; {fix}"))
        if not found:
            return None
        column = found[0]
        unit = None if column.stamped else self._time_unit(column)
        self.columns.append(Column(column.source, column.header, "time", "time", "time", "ns", time_unit=unit))
        self._summarise(column, "time", "time", "time", unit.text if unit else "ISO 8601" if column.stamped else None)
        if unit is not None and unit.epoch is None and self.options.epoch is None and not self.options.channels_only:
            self.notes.append("numeric time is counted from 1970-01-01T00:00:00 UTC; give --epoch for another zero")
        return column

    @staticmethod
    def _may_be_time(column: _Header) -> bool:
        written = column.unit or column.stored
        if written is None:
            return True
        try:
            parse_time_unit(written)
        except GyrostabError:
            return False
        return True

    def _time_unit(self, column: _Header) -> TimeUnit | None:
        suffix = _TIME.match(split_header(column.header)[0].lower())
        written = column.unit or (suffix.group(1) if suffix and suffix.group(1) not in ("utc", "iso") else None)
        text = self._unit_text(column, [column.name, column.header, "time"], written, prefer_given=column.unit is None)
        if text is None:
            message = f"{self.path.name}: the time column {column.header!r} holds numbers and carries no unit"
            self.problems.append(MissingUnitError(f"{message}; give it with --unit time=s (or ms, us, ns)"))
            return None
        try:
            return parse_time_unit(text)
        except GyrostabError as error:
            self.problems.append(UnitError(f"{self.path.name}: column {column.header!r}: {error}; give it with --unit time=s"))
            return None

    def plan_gyro(self, gyro: list[_Header], headers: Sequence[str]) -> tuple[str | None, str | None]:
        """Units of the gyro axes, and whether they are rates, increments or cumulative angles."""
        if self.options.channels_only:
            self.left_out.extend(c.header for c in gyro)
            for column in gyro:
                self._summarise(column, column.name, "left out", None, column.unit)
            return None, None
        if not gyro:
            if not self.problems:
                self.problems.append(_no_gyro(self.path, headers))
            return None, None
        quantities: dict[str, str] = {}
        for column in gyro:
            quantity = self._plan_axis(column)
            if quantity is not None:
                quantities[column.header] = quantity
        if len(set(quantities.values())) > 1:
            listed = ", ".join(f"{header!r} ({quantity})" for header, quantity in quantities.items())
            message = f"{self.path.name}: the gyro axes are partly rates, partly angles: {listed}"
            self.problems.append(UnitError(f"{message}; keep one kind and drop the others with --map NAME=-"))
        if not quantities:
            return None, None
        signal = next(iter(quantities.values()))
        return signal, self._kind(signal, next(iter(quantities)))

    def _plan_axis(self, column: _Header) -> str | None:
        match = _AXIS.match(column.low)
        assert match is not None
        stem, axis = match.groups()
        example = "deg/s" if stem == "gyro" else "deg"
        text = self._unit_text(column, [column.low, column.header, stem], column.unit)
        if text is None:
            message = f"{self.path.name}: the gyro column {column.header!r} carries no unit"
            how = f"give it with --unit {stem}={example} (all axes) or --unit {column.low}={example}"
            self.problems.append(MissingUnitError(f"{message}; {how}, or write it in the header: {column.low} [{example}]"))
            self._summarise(column, column.low, "gyro", None, None)
            return None
        try:
            unit = parse_unit(text)
        except UnitError as error:
            if "factor" in str(error):
                self.problems.append(UnitError(f"{self.path.name}: column {column.header!r}: {error}"))
                return None
            hint = f'known are {known_units("rate")}; give it with --unit {stem}={example}, or with a factor --unit "{stem}=0.1 arcsec/s"'
            self.problems.append(UnitError(f"{self.path.name}: column {column.header!r}: unit {text!r} is not known; {hint}"))
            self._summarise(column, column.low, "gyro", None, text)
            return None
        allowed = ("rate", "angle") if stem == "gyro" else ("angle",)
        if unit.quantity not in allowed:
            message = (
                f"{self.path.name}: column {column.header!r} has the unit {text!r}, which is a unit of {unit.quantity}, not of {allowed[0]}"
            )
            how = f"{allowed[0]} units are {known_units(allowed[0])}; give the right one with --unit {stem}={example}"
            self.problems.append(UnitError(f'{message}; {how}, or with a factor for counts: --unit "{stem}=0.1 {_arcsec(stem)}"'))
            self._summarise(column, column.low, "gyro", unit.quantity, text)
            return None
        inner = INNER[unit.quantity]
        self.columns.append(Column(column.source, column.header, "gyro", axis, unit.quantity, inner, unit.factor, unit.offset))
        self._summarise(column, column.low, "gyro", unit.quantity, text)
        return unit.quantity

    def _kind(self, signal: str, header: str) -> str | None:
        if signal == "rate":
            if self.options.kind == "angle":
                message = f"{self.path.name}: --kind angle, but column {header!r} is a rate"
                self.problems.append(OptionError(f"{message}; leave --kind out, or correct the unit with --unit gyro=deg"))
            return "rate"
        if self.options.kind is None:
            message = f"{self.path.name}: column {header!r} is an angle, and nothing says of which kind"
            how = "--kind angle if it is the cumulative angle, --kind rate if each row is the increment since the row before"
            self.problems.append(OptionError(f"{message}; give {how}"))
        return "angle" if self.options.kind == "angle" else "increment"

    def plan_channels(self, rest: list[_Header]) -> None:
        """Channels: known names need a unit, others are kept when they carry one."""
        for column in rest:
            known = bool(_KNOWN.match(column.low))
            stem = column.low.split("_")[0]
            quantity = _QUANTITIES.get(column.low) or _QUANTITIES.get(stem)
            if quantity is None:
                quantity = next((q for name, q in _QUANTITIES.items() if column.low.startswith(name + "_")), None)
            name = column.low if known or quantity else re.sub(r"[/\s]+", "_", column.name)
            keys = [name, column.name, column.header] + ([stem] if quantity else [])
            text = self._unit_text(column, keys, column.unit)
            if column.low == "ramp" and text is None:
                text = "1"  # any scale will do
            if text is None and (known or column.mapped):
                example = (
                    known_units(quantity).split(",")[0] if quantity and quantity != "rotation_rate" else "deg/s" if quantity else "UNIT"
                )
                message = f"{self.path.name}: column {column.header!r} carries no unit; give it with --unit {name}={example}"
                self.problems.append(MissingUnitError(f'{message}, or drop the column with --map "{column.header}=-"'))
            if text is None:
                self.left_out.append(column.header)
                self._summarise(column, name, "left out", None, None)
                continue
            self._plan_channel(column, name, quantity, text, strict=known)

    def _plan_channel(self, column: _Header, name: str, quantity: str | None, text: str, *, strict: bool) -> None:
        factor, offset, units = 1.0, 0.0, text
        if quantity is not None:
            expected = "rate" if quantity == "rotation_rate" else quantity
            try:
                unit = parse_unit(text)
                fits = unit.quantity == expected
            except UnitError:
                fits = False
            if fits:
                scale = 1.0 / 3600.0 if quantity == "rotation_rate" else 1.0
                factor, offset, units = unit.factor * scale, unit.offset, INNER[quantity]
            elif quantity == "number":
                units = INNER["number"]
            elif strict:
                message = f"{self.path.name}: column {column.header!r}: {text!r} is no known unit of {expected}"
                how = f"known are {known_units(expected)}; give it with --unit {name}=UNIT"
                self.problems.append(UnitError(f'{message}; {how}, or drop the column with --map "{column.header}=-"'))
            else:
                quantity = None
        self.columns.append(Column(column.source, column.header, "channel", name, quantity or "other", units, factor, offset))
        self._summarise(column, name, "channel", quantity or "other", text)

    def _unit_text(self, column: _Header, keys: list[str], written: str | None, *, prefer_given: bool = False) -> str | None:
        lows = [key.lower() for key in keys]
        given = {key.lower(): key for key in self.options.unit}
        key = next((given[low] for low in lows if low in given), None)
        if key is None:
            return written or column.stored
        self.used_units.add(key)
        text = self.options.unit[key]
        if written is None or prefer_given or written == text:
            return text
        note = f"column {column.header!r} says [{written}], so --unit {key}={text} is not applied to it"
        self.notes.append(f'{note}; to overrule the header give --map "{column.header}={column.low} [{text}]"')
        return written

    def _summarise(self, column: _Header, name: str, role: str, quantity: str | None, unit: str | None) -> None:
        self.summaries.append(ColumnSummary(column.header, name, role, quantity, unit))

    def finish(self, headers: Sequence[str]) -> None:
        """Notes on what was left out, summaries in the order of the file."""
        if self.left_out:
            self.notes.append(f"left out, as they carry no unit and no known name: {_listing(self.left_out)}")
        place = {header.strip(): index for index, header in enumerate(headers)}
        self.summaries.sort(key=lambda summary: place.get(summary.header, -1))


def _arcsec(stem: str) -> str:
    return "arcsec/s" if stem == "gyro" else "arcsec"


def _contract_name(low: str) -> bool:
    return bool(_AXIS.match(low) or _KNOWN.match(low) or low == "time")


def _listing(names: Sequence[str], most: int = 30) -> str:
    shown = ", ".join(name for name in names[:most] if name)
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def _no_gyro(path: Path, headers: Sequence[str]) -> FormatError:
    names = [split_header(header)[0] for header in headers if header.strip()]
    free = [name for name in names if not _TIME.match(name.lower()) and name.lower().split("_")[0] not in _QUANTITIES]
    likely = next((name for pattern in _LOOKS_GYRO for name in free if pattern.search(name)), free[0] if free else "NAME")
    low = next((header for header in headers if likely in header), likely).lower()
    hour = re.search(r"deg_?(per_?|/)?h|dph", low)
    unit = "deg/h" if hour else "rad/s" if "rad" in low else "deg/s"
    given = "" if split_header(next((h for h in headers if likely in h), ""))[1] else f" --unit gyro={unit}"
    message = f"{path.name}: no gyro column (gyro_x, gyro_y, gyro_z or angle_x ...). Columns: {_listing(names, 100)}"
    return FormatError(f'{message}. Say which they are, for instance: --map "{likely}=gyro_x"{given}')
