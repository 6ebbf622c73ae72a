"""The plan of a file: columns to read, notes, problems, and the options that were used."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gyrostab.errors import FormatError, GyrostabError
from gyrostab.ingest.columns.dates import YEAR_FIRST
from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    FileColumn,
    Header,
    channel_name,
    distinct_columns,
    example_unit,
    free_name,
    is_unit_of,
    split_header,
    stored_name,
)
from gyrostab.ingest.columns.stamps import TimeUnit
from gyrostab.ingest.limits import describe_limit
from gyrostab.ingest.options import ColumnSummary, ReadOptions
from gyrostab.wording import list_some

#: Columns that a message lists by name.
MAX_HEADERS = 30


@dataclass(frozen=True)
class Column:
    """A column to read, as ``value * factor + offset`` in `units`.

    Stamps are numbers of `time_unit`, or dates if it is None.
    """

    source: int
    header: str
    role: str  # "time", "gyro" or "channel"
    name: str  # "time", the axis, or the channel
    quantity: str
    units: str
    factor: float = 1.0
    offset: float = 0.0
    time_unit: TimeUnit | None = None
    date_order: str = YEAR_FIRST  # of stamps that are text
    epoch: int = 0  # of numbers whose unit names none [ns since 1970]


@dataclass
class Plan:
    """Roles and units of the columns of one file, with notes and problems."""

    path: Path
    options: ReadOptions  # with the sampling rate that the lines above the header name
    #: Returns whether the first values of a column rise; None if the format does not look.
    rising: Callable[[int], bool] | None = None
    #: Returns the first value of a column that does not hold a number, or nothing.
    word_in: Callable[[int], str] = lambda source: ""
    columns: list[Column] = field(default_factory=list)
    summaries: list[ColumnSummary] = field(default_factory=list)
    signal: str | None = None  # "rate", "angle" or None
    kind: str | None = None  # "rate", "angle" or "increment"
    notes: list[str] = field(default_factory=list)
    problems: list[GyrostabError] = field(default_factory=list)
    #: Headers of gyro axes of a file of channels, and of channels beyond the limit.
    left_out: list[str] = field(default_factory=list)
    surplus: list[str] = field(default_factory=list)
    kept_channels: int = 0
    unitless: list[tuple[str, str | None, str]] = field(
        default_factory=list
    )  # name, quantity, header
    used_map: set[str] = field(default_factory=set)
    used_units: set[str] = field(default_factory=set)

    def check(self) -> Plan:
        """Raise the first problem, or return the plan."""
        if self.problems:
            raise self.problems[0]
        return self

    def of(self, role: str) -> list[Column]:
        """Return the columns of a role."""
        return [column for column in self.columns if column.role == role]

    @property
    def time(self) -> Column | None:
        """Column of stamps, None if there is none."""
        return next(iter(self.of("time")), None)

    @property
    def unmatched(self) -> list[str]:
        """Options that match no column."""
        unused = [f"--unit {key}" for key in self.options.unit if key not in self.used_units]
        return [f"--map {key}" for key in self.options.map if key not in self.used_map] + unused

    def rises(self, column: Header) -> bool:
        """Return whether the first values of a column may rise."""
        return self.rising is None or self.rising(column.source)

    def unit_key(self, names: Sequence[str]) -> str | None:
        """Return the key of ``--unit`` that is the first of some names, in any case of letters."""
        keys_by_name = {key.lower(): key for key in self.options.unit}
        return next(filter(None, (keys_by_name.get(name.lower()) for name in names)), None)

    def find_unit(
        self,
        column: Header,
        keys: list[str],
        written: str | None,
        usable: Callable[[str], bool],
        *,
        prefer_given: bool = False,
    ) -> str | None:
        """Return the unit of a column: from its header if usable, otherwise from the user."""
        key = self.unit_key(keys)
        if key is None:
            return written or column.stored
        self.used_units.add(key)
        text = self.options.unit[key]
        if written is None or prefer_given or written == text:
            return text
        if not usable(written):
            self.notes.append(
                f"column {column.header!r} says [{written}], which is not a usable unit; it is "
                f"read by --unit {key}={text}"
            )
            return text
        note = (
            f"column {column.header!r} says [{written}], so --unit {key}={text} is not "
            "applied to it"
        )
        self.notes.append(
            f'{note}; to overrule the header give --map "{column.key}={column.low} [{text}]"'
        )
        return written

    def refuse(self, error: type[GyrostabError], problem: str) -> None:
        """Add a problem, which prevents reading; the name of the file is put in front."""
        self.problems.append(error(f"{self.path.name}: {problem}"))

    def leave_out(self, column: Header) -> None:
        """Add the summary of a column that is left out."""
        self.add_summary(column, column.name, "left out", None, column.unit or column.stored)

    def add_column(self, column: Header, text: str | None, planned: Column) -> None:
        """Add a column to read, with the unit that the file or the user gives it."""
        self.columns.append(planned)
        name = column.low if planned.role == "gyro" else planned.name
        self.add_summary(column, name, planned.role, planned.quantity, text)

    def add_summary(
        self, column: Header, name: str, role: str, quantity: str | None, unit: str | None
    ) -> None:
        """Add the summary of a column."""
        self.summaries.append(ColumnSummary(column.header, name, role, quantity, unit, column.key))

    def add_notes(self, columns: Sequence[FileColumn]) -> None:
        """Add notes on columns that were left out, and sort the summaries as in the file."""
        if self.unitless:
            name, quantity, _ = min(
                self.unitless, key=lambda entry: entry[1] is None
            )  # a known quantity first
            option = f"--unit {shlex.quote(f'{name}={example_unit(quantity)}')}"
            if quantity is None and is_unit_of(name, ("rate",)):
                option = f'--map "{name}=rotation_rate [{name}]"'
            advice = f"keep one with a unit: {option}"
            self.notes.append(
                "left out, as they carry no unit: "
                f"{list_some([header for _, _, header in self.unitless], MAX_HEADERS)} ({advice})"
            )
        if self.surplus:
            needed = self.kept_channels + len(self.surplus)
            advice = (
                "map those that are needed (--map NAME=NAME); "
                f"{describe_limit('channels', needed, self.options.limits)}"
            )
            self.notes.append(
                "left out, as there are more channels than a log keeps: "
                f"{list_some(self.surplus, 5)} ({advice})"
            )
        if self.left_out:
            self.notes.append(
                "left out, as the file is read for its channels: "
                f"{list_some(self.left_out, MAX_HEADERS)}"
            )
        place = {column.header.strip(): index for index, column in enumerate(columns)}
        self.summaries.sort(key=lambda summary: place.get(summary.header, -1))


def name_columns(
    plan: Plan,
    columns: Sequence[FileColumn],
    presets: Mapping[int, str],
) -> list[Header]:
    """Name the columns by ``--map``, then by the preset, and drop those that either drops."""
    keys_by_name = {key.strip().lower(): key for key in plan.options.map}
    targets = {split_header(target)[0].lower() for target in plan.options.map.values()}
    named: list[Header] = []
    for column in distinct_columns(columns):
        texts = (column.key.lower(), column.header.lower(), column.low)
        key = next((keys_by_name[text] for text in texts if text in keys_by_name), None)
        if key is not None:
            plan.used_map.add(key)
            target, target_unit = split_header(plan.options.map[key])
            if target in ("", "-"):
                continue
            column.name, column.unit, column.mapped = target, target_unit or column.unit, True
        elif preset := presets.get(column.source, columns[column.source].target):
            target, target_unit = split_header(preset)
            if target == "-" or _is_taken(target.lower(), targets):
                plan.leave_out(column)
                continue
            column.name, column.preset = target, True
            if target_unit is not None:  # overruled by --unit, overrules a header without a unit
                column.unit, column.stored = None, target_unit
        if column.name:
            named.append(column)
    return named


def resolve_duplicates(plan: Plan, named: list[Header]) -> list[Header]:
    """Give columns of one name different names; an axis must be one column."""
    groups: dict[str, list[Header]] = {}
    for column in named:
        axis = AXIS_PATTERN.match(column.low)
        channel = "time" if column.low == "time" else stored_name(channel_name(column))
        groups.setdefault(f"gyro_{axis[2]}" if axis else channel, []).append(column)
    used_names, dropped = set(groups), set[int]()
    renamed: list[str] = []
    for name, same in groups.items():
        asked = [column for column in same if column.mapped]
        if len(same) == 1 or (name == "time" and len(asked) < 2):
            continue
        if len(asked) > 1 or (AXIS_PATTERN.match(name) and not asked):
            headers = ", ".join(repr(column.header) for column in same[:5])
            fix = f'drop the others, for instance --map "{(asked or same)[1].key}=-"'
            names = " or ".join(dict.fromkeys(repr(column.low) for column in same))
            plan.refuse(FormatError, f"{len(same)} columns are called {names} ({headers}); {fix}")
        elif AXIS_PATTERN.match(name):
            unmapped = [column for column in same if not column.mapped]
            dropped.update(column.source for column in unmapped)
            plan.notes.append(
                f"left out, as --map names another column {asked[0].low}: "
                f"{list_some([column.header for column in unmapped], MAX_HEADERS)}"
            )
        else:
            for number, column in enumerate(
                sorted(same, key=lambda column: not column.mapped)[1:], 2
            ):
                column.name = free_name(f"{name}_", used_names, number)
                used_names.add(column.name)
                renamed.append(f"{column.header!r} is {column.name!r}")
    if renamed:
        plan.notes.append(f"columns of one name are renamed: {list_some(renamed, 5)}")
    return [column for column in named if column.source not in dropped]


def _is_taken(target: str, asked: set[str]) -> bool:
    """Return whether --map names a column for this target, or for any axis if it is an axis."""
    return target in asked or (
        bool(AXIS_PATTERN.match(target)) and any(AXIS_PATTERN.match(name) for name in asked)
    )
