"""Header names to roles, units and factors: the same for every format."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gyrostab.errors import FormatError, GyrostabError, MissingUnitError, OptionError, UnitError
from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    GYRO_PATTERNS,
    KNOWN_CHANNEL_PATTERN,
    TIME_PATTERN,
    Header,
    distinct_columns,
    example_unit,
    free_name,
    is_contract_name,
    is_time_unit,
    is_unit,
    is_unit_of,
    quantity_of,
    split_header,
    unit_quantity,
)
from gyrostab.ingest.columns.preset import PresetMatch, find_preset
from gyrostab.ingest.columns.stamps import TimeUnit, names_epoch, parse_time_unit
from gyrostab.ingest.limits import check_columns, describe_limit, limit_value
from gyrostab.ingest.options import ColumnSummary, ReadOptions
from gyrostab.units import HOUR, INNER, known_units, parse_unit

__all__ = ["Column", "Plan", "plan_columns", "split_header"]


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
    rate: float | None = (
        None  # [Hz], where the lines above the header tell it and there is no time column
    )

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


def plan_columns(
    path: Path,
    headers: Sequence[str],
    options: ReadOptions,
    *,
    units: Mapping[int, str] | None = None,
    calendars: Mapping[int, str] | None = None,
    stamped: Collection[int] = (),
    rising: Callable[[int], bool] | None = None,
    above: Sequence[str] = (),
    is_filled: Callable[[int], bool] | None = None,
    coded: Mapping[int, str] | None = None,
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
    calendars : mapping of int to str, optional
        CF calendars of those units that name an epoch.
    stamped : collection of int
        Columns whose values are dates already (ISO 8601 text, datetime types).
    rising : callable, optional
        Says of a column whether its first values rise; it decides between several columns that look
        like the time.
    above : sequence of str
        Lines above the header, which may tell the program that wrote the file.
    is_filled : callable, optional
        Says of a column whether its first cells hold anything.
    coded : mapping of int to str, optional
        What columns are by a code of the format, in the form of ``--map``, which is stronger.

    Returns
    -------
    Plan
        ``Plan.check()`` raises what is wrong.

    Raises
    ------
    FormatError
        When there are more columns than the limit allows.
    """
    check_columns(path, len(headers), options.limits)
    preset = _known_program(path, headers, above, is_filled)
    work = PlanDraft(path, options, rising or (lambda source: True))
    named = work.name(
        headers,
        units or {},
        calendars or {},
        frozenset(stamped),
        {**(coded or {}), **preset.columns},
    )
    named = work.separate(named)
    time = work.find_time(named)
    rest = [column for column in named if column is not time]
    gyro = [column for column in rest if AXIS_PATTERN.match(column.low)]
    signal, kind = work.plan_gyro(gyro, headers)
    work.plan_channels([column for column in rest if not AXIS_PATTERN.match(column.low)])
    rate = preset.rate if time is None and options.rate is None else None
    if preset.name:
        told = f", and {rate:g} Hz by the lines above the header" if rate else ""
        work.notes.insert(
            0, f"read as a file of {preset.name}{told}; --map, --unit and --rate overrule it"
        )
    elif found := [
        f"{c.header} is {c.name}" for c in named if c.preset and AXIS_PATTERN.match(c.low)
    ]:
        work.notes.append(f"taken for axes: {list_names(found)}; --map overrules it")
    if time is None and options.rate is None and rate is None and not work.problems:
        message = f"{path.name}: there is no time column; give the sampling rate with --rate HZ (and --start)"
        work.problems.append(
            OptionError(
                f"{message}, or name the column: --map NAME=time. Columns: {list_names(headers)}"
            )
        )
    work.finish(headers)
    unused = [f"--unit {key}" for key in options.unit if key not in work.used_units]
    unmatched = [f"--map {key}" for key in options.map if key not in work.used_map] + unused
    order = {"time": 0, "gyro": 1, "channel": 2}
    columns = sorted(
        work.columns,
        key=lambda column: (order[column.role], column.name if column.role == "gyro" else ""),
    )
    return Plan(
        path,
        tuple(columns),
        tuple(work.summaries),
        signal,
        kind,
        tuple(work.notes),
        tuple(work.problems),
        tuple(unmatched),
        rate,
    )


def _known_program(
    path: Path,
    headers: Sequence[str],
    above: Sequence[str],
    is_filled: Callable[[int], bool] | None,
) -> PresetMatch:
    """The preset of a file, unless the file names its axes in our way."""
    split = [(header, split_header(header)[0]) for header in headers]
    if any(AXIS_PATTERN.match(name.lower()) for _, name in split):
        return PresetMatch("")
    return find_preset(path, split, above=above, is_filled=is_filled) or PresetMatch("")


class PlanDraft:
    """The lists that grow while a file's header is being understood."""

    def __init__(self, path: Path, options: ReadOptions, rising: Callable[[int], bool]):
        self.path, self.options, self.rising = path, options, rising
        self.columns: list[Column] = []
        self.summaries: list[ColumnSummary] = []
        self.notes: list[str] = []
        self.problems: list[GyrostabError] = []
        self.left_out: list[str] = []
        self.surplus: list[str] = []
        self.kept_channels = 0
        self.unitless: list[tuple[str, str | None, str]] = []  # name, quantity, header
        self.used_map: set[str] = set()
        self.used_units: set[str] = set()

    def name(
        self,
        headers: Sequence[str],
        units: Mapping[int, str],
        calendars: Mapping[int, str],
        stamped: frozenset[int],
        presets: Mapping[int, str],
    ) -> list[Header]:
        """Apply the map, then the preset, and drop what they drop."""
        wanted = {key.strip().lower(): key for key in self.options.map}
        targets = {split_header(target)[0].lower() for target in self.options.map.values()}
        named: list[Header] = []
        for column in distinct_columns(headers):
            source = column.source
            column.stored, column.calendar = units.get(source), calendars.get(source)
            column.stamped = source in stamped
            texts = (column.key.lower(), column.header.lower(), column.low)
            key = next((wanted[text] for text in texts if text in wanted), None)
            if key is not None:
                self.used_map.add(key)
                target, target_unit = split_header(self.options.map[key])
                if target in ("", "-"):
                    continue
                column.name, column.unit, column.mapped = target, target_unit or column.unit, True
            elif source in presets:
                target, target_unit = split_header(presets[source])
                if target == "-" or _is_taken(target.lower(), targets):
                    self._leave_out(column)
                    continue
                column.name, column.preset = target, True
                if (
                    target_unit is not None
                ):  # weaker than --unit, stronger than a header that holds no unit
                    column.unit, column.stored = None, target_unit
            if column.name:
                named.append(column)
        return named

    def separate(self, named: list[Header]) -> list[Header]:
        """Give columns of one name names of their own; an axis must be one column."""
        groups: dict[str, list[Header]] = {}
        for column in named:
            groups.setdefault(
                column.low if is_contract_name(column.low) else column.name, []
            ).append(column)
        taken, dropped = set(groups), set[int]()
        renamed: list[str] = []
        for name, same in groups.items():
            asked = [column for column in same if column.mapped]
            if len(same) == 1 or (name == "time" and len(asked) < 2):
                continue
            if len(asked) > 1 or (AXIS_PATTERN.match(name) and not asked):
                headers = ", ".join(repr(column.header) for column in same[:5])
                fix = f'drop the others, for instance --map "{(asked or same)[1].key}=-"'
                self.problems.append(
                    FormatError(
                        f"{self.path.name}: {len(same)} columns are called {name!r} ({headers}); {fix}"
                    )
                )
            elif AXIS_PATTERN.match(name):
                others = [column for column in same if not column.mapped]
                dropped.update(column.source for column in others)
                self.notes.append(
                    f"left out, as --map names another column {name}: {list_names([column.header for column in others])}"
                )
            else:
                for number, column in enumerate(
                    sorted(same, key=lambda column: not column.mapped)[1:], 2
                ):
                    column.name = free_name(f"{column.name}_", taken, number)
                    taken.add(column.name)
                    renamed.append(f"{column.header!r} is {column.name!r}")
        if renamed:
            more = f" and {len(renamed) - 5} more" if len(renamed) > 5 else ""
            self.notes.append(f"columns of one name are kept apart: {', '.join(renamed[:5])}{more}")
        return [column for column in named if column.source not in dropped]

    def find_time(self, named: list[Header]) -> Header | None:
        """The one time column, with its unit; others that look like it are left out with a note."""
        found = [c for c in named if c.low == "time" and c.mapped] or [
            c for c in named if c.low == "time" and c.preset
        ]
        if not found:
            found = [
                c
                for c in named
                if not (c.mapped or c.preset) and TIME_PATTERN.match(c.low) and self._may_be_time(c)
            ]
            sure = [c for c in found if c.low != "t" or c.unit or c.stored or c.stamped]
            found = sure or found
        if not found:
            found = [
                c
                for c in named
                if c.stamped and self.rising(c.source) and not (c.mapped or c.preset)
            ]
            if found:
                self.notes.append(
                    f"{found[0].header!r} is taken for the time column, as it holds dates"
                )
        if not found:
            return None
        found.sort(key=lambda c: not self.rising(c.source))
        column = found[0]
        candidates = {id(c) for c in found}
        others = found[1:] + [c for c in named if id(c) not in candidates and c.low == "time"]
        if others:
            names = " and ".join(repr(c.header) for c in [column, *others][:3])
            self.notes.append(
                f'{names} look like the time; {column.header!r} is used (for another: --map "{others[0].key}=time")'
            )
            for other in others:
                self._leave_out(other)
            dropped = {id(other) for other in others}
            named[:] = [c for c in named if id(c) not in dropped]
        unit = None if column.stamped else self._time_unit(column)
        self.columns.append(
            Column(column.source, column.header, "time", "time", "time", "ns", time_unit=unit)
        )
        self._add_summary(
            column,
            "time",
            "time",
            "time",
            unit.text if unit else "ISO 8601" if column.stamped else None,
        )
        if (
            unit is not None
            and unit.epoch is None
            and self.options.epoch is None
            and not self.options.channels_only
        ):
            self.notes.append(
                "numeric time is counted from 1970-01-01T00:00:00 UTC; give --epoch for another zero"
            )
        if unit is not None and unit.epoch is not None and self.options.epoch is not None:
            self.notes.append(
                f"--epoch is not used: the time column {column.header!r} is in {unit.text!r}"
            )
        return column

    @staticmethod
    def _may_be_time(column: Header) -> bool:
        written = column.unit or column.stored
        # An epoch that cannot be read is reported, not passed over.
        return written is None or names_epoch(written) or is_time_unit(written)

    def _time_unit(self, column: Header) -> TimeUnit | None:
        suffix = TIME_PATTERN.match(split_header(column.header)[0].lower())
        named = next((text for text in suffix.groups() if text), None) if suffix else None
        written = column.unit or (
            named if named not in ("utc", "iso") and column.stored is None else None
        )
        keys = [column.name, column.key, column.header, "time"]
        text = self._unit_text(
            column, keys, written, is_time_unit, prefer_given=column.unit is None
        )
        if text is None:
            message = f"{self.path.name}: the time column {column.header!r} holds numbers and carries no unit"
            self.problems.append(
                MissingUnitError(f"{message}; give it with --unit time=s (or ms, us, ns)")
            )
            return None
        try:
            return parse_time_unit(text, column.calendar if text == column.stored else None)
        except GyrostabError as error:
            how = '"time=seconds since 2026-01-02T00:00:00"' if names_epoch(text) else "time=s"
            self.problems.append(
                UnitError(
                    f"{self.path.name}: column {column.header!r}: {error}; or give it with --unit {how}"
                )
            )
            return None

    def plan_gyro(
        self, gyro: list[Header], headers: Sequence[str]
    ) -> tuple[str | None, str | None]:
        """Units of the gyro axes, and whether they are rates, increments or cumulative angles."""
        if self.options.channels_only:
            for column in gyro:
                self._leave_out(column)
            self.left_out.extend(c.header for c in gyro)
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
            listed = ", ".join(
                f"{header!r} ({quantity})" for header, quantity in quantities.items()
            )
            message = f"{self.path.name}: the gyro axes are partly rates, partly angles: {listed}"
            self.problems.append(
                UnitError(f"{message}; keep one kind and drop the others with --map NAME=-")
            )
        if not quantities:
            return None, None
        signal = next(iter(quantities.values()))
        first = next(column for column in gyro if column.header in quantities)
        return signal, self._find_kind(signal, first.header, first.key, first.low)

    def _plan_axis(self, column: Header) -> str | None:
        match = AXIS_PATTERN.match(column.low)
        assert match is not None
        stem, axis = match.groups()
        example = "deg/s" if stem == "gyro" else "deg"
        allowed = ("rate", "angle") if stem == "gyro" else ("angle",)
        keys = [column.low, column.key, column.header, stem]
        text = self._unit_text(
            column, keys, column.unit, lambda written: is_unit_of(written, allowed)
        )
        if text is None:
            message = f"{self.path.name}: the gyro column {column.header!r} carries no unit"
            how = (
                f"give it with --unit {stem}={example} (all axes) or --unit {column.low}={example}"
            )
            self.problems.append(
                MissingUnitError(
                    f"{message}; {how}, or write it in the header: {column.low} [{example}]"
                )
            )
            self._add_summary(column, column.low, "gyro", None, None)
            return None
        try:
            unit = parse_unit(
                text,
                next((quantity for quantity in allowed if is_unit_of(text, (quantity,))), None),
            )
        except UnitError as error:
            if "factor" in str(error):
                self.problems.append(
                    UnitError(f"{self.path.name}: column {column.header!r}: {error}")
                )
                return None
            hint = f'known are {known_units("rate")}; give it with --unit {stem}={example}, or with a factor --unit "{stem}=0.1 arcsec/s"'
            self.problems.append(
                UnitError(
                    f"{self.path.name}: column {column.header!r}: unit {text!r} is not known; {hint}"
                )
            )
            self._add_summary(column, column.low, "gyro", None, text)
            return None
        if unit.quantity not in allowed:
            message = f"{self.path.name}: column {column.header!r} has the unit {text!r}, which is a unit of {unit.quantity}, not of {allowed[0]}"
            how = f"{allowed[0]} units are {known_units(allowed[0])}; give the right one with --unit {stem}={example}"
            self.problems.append(
                UnitError(
                    f'{message}; {how}, or with a factor for counts: --unit "{stem}=0.1 {_arcsec_unit(stem)}"'
                )
            )
            self._add_summary(column, column.low, "gyro", unit.quantity, text)
            return None
        inner = INNER[unit.quantity]
        self.columns.append(
            Column(
                column.source,
                column.header,
                "gyro",
                axis,
                unit.quantity,
                inner,
                unit.factor,
                unit.offset,
            )
        )
        self._add_summary(column, column.low, "gyro", unit.quantity, text)
        return unit.quantity

    def _find_kind(self, signal: str, header: str, key: str, name: str) -> str | None:
        if signal == "rate":
            if self.options.kind == "angle":
                message = f"{self.path.name}: --kind angle, but column {header!r} is a rate"
                fix = f'leave --kind out, or correct the unit with --map "{key}={name} [deg]"'
                self.problems.append(OptionError(f"{message}; {fix}"))
            return "rate"
        if self.options.kind is None:
            message = (
                f"{self.path.name}: column {header!r} is an angle, and nothing says of which kind"
            )
            how = "--kind angle if it is the cumulative angle, --kind rate if each row is the increment since the row before"
            self.problems.append(OptionError(f"{message}; give {how}"))
        return "angle" if self.options.kind == "angle" else "increment"

    def plan_channels(self, rest: list[Header]) -> None:
        """Channels: what carries a unit is kept, the rest is left out with a note, or refused if it was asked for."""
        for column in rest:
            quantity = quantity_of(column.low)
            known = bool(KNOWN_CHANNEL_PATTERN.match(column.low))
            name = column.low if known or quantity else re.sub(r"[/\s]+", "_", column.name)
            keys = [
                name,
                column.name,
                column.key,
                column.header,
                *([column.low.split("_")[0]] if quantity else []),
            ]
            usable = (
                partial(is_unit_of, quantities=(unit_quantity(quantity),)) if quantity else is_unit
            )
            text = self._unit_text(column, keys, column.unit, usable)
            if column.low == "ramp" and text is None:
                text = "1"  # any scale will do
            asked = (
                column.mapped
                or any(key.lower() in _by_lower_name(self.options.unit) for key in keys)
                or (known and self.options.channels_only)
            )
            if text is None and asked:
                message = f"{self.path.name}: column {column.header!r} carries no unit; give it with --unit {name}={example_unit(quantity)}"
                self.problems.append(
                    MissingUnitError(f'{message}, or drop the column with --map "{column.key}=-"')
                )
            if (
                text is not None
                and not (known or asked)
                and self.kept_channels >= limit_value("channels", self.options.limits)
            ):
                self.surplus.append(column.header)
                self._leave_out(column)
                continue
            if text is None:
                self.unitless.append((name, quantity, column.header))
                self._leave_out(column)
                continue
            self._plan_channel(column, name, quantity, text, known=known, asked=asked)

    def _plan_channel(
        self,
        column: Header,
        name: str,
        quantity: str | None,
        text: str,
        *,
        known: bool,
        asked: bool,
    ) -> None:
        factor, offset, units = 1.0, 0.0, text
        if quantity is not None:
            expected = unit_quantity(quantity)
            if is_unit_of(text, (expected,)):
                unit = parse_unit(text, expected)
                scale = 1.0 / HOUR if quantity == "rotation_rate" else 1.0
                factor, offset, units = unit.factor * scale, unit.offset, INNER[quantity]
            elif quantity == "number":
                units = INNER["number"]
            elif known:
                message = f"column {column.header!r}: {text!r} is no known unit of {expected}"
                how = f"known are {known_units(expected)}; give it with --unit {name}={example_unit(quantity)}"
                if not asked:
                    self.notes.append(f"{message}, so it is left out; {how}")
                    self._leave_out(column)
                    return
                fix = f'{how}, or drop the column with --map "{column.key}=-"'
                self.problems.append(UnitError(f"{self.path.name}: {message}; {fix}"))
            else:
                quantity = None
        self.kept_channels += 1
        self.columns.append(
            Column(
                column.source,
                column.header,
                "channel",
                name,
                quantity or "other",
                units,
                factor,
                offset,
            )
        )
        self._add_summary(column, name, "channel", quantity or "other", text)

    def _unit_text(
        self,
        column: Header,
        keys: list[str],
        written: str | None,
        usable: Callable[[str], bool],
        *,
        prefer_given: bool = False,
    ) -> str | None:
        """The unit of a column: that of the header, unless it is none and the user gave one."""
        given = _by_lower_name(self.options.unit)
        key = next((given[low] for low in map(str.lower, keys) if low in given), None)
        if key is None:
            return written or column.stored
        self.used_units.add(key)
        text = self.options.unit[key]
        if written is None or prefer_given or written == text:
            return text
        if not usable(written):
            self.notes.append(
                f"column {column.header!r} says [{written}], which is no usable unit; it is read by --unit {key}={text}"
            )
            return text
        note = f"column {column.header!r} says [{written}], so --unit {key}={text} is not applied to it"
        self.notes.append(
            f'{note}; to overrule the header give --map "{column.key}={column.low} [{text}]"'
        )
        return written

    def _leave_out(self, column: Header) -> None:
        self._add_summary(column, column.name, "left out", None, column.unit or column.stored)

    def _add_summary(
        self, column: Header, name: str, role: str, quantity: str | None, unit: str | None
    ) -> None:
        self.summaries.append(ColumnSummary(column.header, name, role, quantity, unit, column.key))

    def finish(self, headers: Sequence[str]) -> None:
        """Notes on what was left out, summaries in the order of the file."""
        if self.unitless:
            name, quantity, _ = min(
                self.unitless, key=lambda entry: entry[1] is None
            )  # one of a known quantity first
            how = f"keep one with a unit: --unit {shlex.quote(f'{name}={example_unit(quantity)}')}"
            self.notes.append(
                f"left out, as they carry no unit: {list_names([header for _, _, header in self.unitless])} ({how})"
            )
        if self.surplus:
            needed = self.kept_channels + len(self.surplus)
            how = f"map those that are needed (--map NAME=NAME); {describe_limit('channels', needed, self.options.limits)}"
            self.notes.append(
                f"left out, as there are more channels than a log keeps: {list_names(self.surplus, 5)} ({how})"
            )
        if self.left_out:
            self.notes.append(
                f"left out, as the file is read for its channels: {list_names(self.left_out)}"
            )
        place = {header.strip(): index for index, header in enumerate(headers)}
        self.summaries.sort(key=lambda summary: place.get(summary.header, -1))


def _is_taken(target: str, asked: set[str]) -> bool:
    """Whether the user has named a column for what a preset has another one for; axes are named all together."""
    return target in asked or (
        bool(AXIS_PATTERN.match(target)) and any(AXIS_PATTERN.match(name) for name in asked)
    )


def _by_lower_name(names: Mapping[str, str]) -> dict[str, str]:
    return {name.lower(): name for name in names}


def _arcsec_unit(stem: str) -> str:
    return "arcsec/s" if stem == "gyro" else "arcsec"


def list_names(names: Sequence[str], most: int = 30) -> str:
    shown = ", ".join(name for name in names[:most] if name)
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def _no_gyro(path: Path, headers: Sequence[str]) -> FormatError:
    columns = [column for column in distinct_columns(headers) if column.header]
    free = [c for c in columns if not TIME_PATTERN.match(c.low) and quantity_of(c.low) is None]
    looks = (c for pattern in GYRO_PATTERNS for c in free if pattern.search(c.name))
    likely = next(looks, free[0] if free else None)
    low = likely.header.lower() if likely else ""
    unit = (
        "deg/h" if re.search(r"deg_?(per_?|/)?h|dph", low) else "rad/s" if "rad" in low else "deg/s"
    )
    given = (
        ""
        if likely and likely.unit and is_unit_of(likely.unit, ("rate", "angle"))
        else f" --unit gyro={unit}"
    )
    message = f"{path.name}: no gyro column (gyro_x, gyro_y, gyro_z or angle_x ...). Columns: {list_names([c.name for c in columns], 100)}"
    how = f'Say which they are, for instance: --map "{likely.key if likely else "NAME"}=gyro_x"{given}'
    return FormatError(
        f"{message}. {how}; gyrostab scan {shlex.quote(path.name)} looks into each column"
    )
