"""The plan of a file: columns to read, notes, problems, and the options that were used.

Presets name the columns in the files of known programs: TOML files, recognised by headers and lines
above them. A preset has a `name`, `times` (candidates for the time column; the first that is filled
is used) and `columns`: target in the form of ``--map`` -> headers that the program writes. `above`
and `file` are patterns for a line above the header and for the file name, `needs` lists further
headers that must be present, `drops` lists columns that are not kept, and `rate` is a pattern that
finds the sampling rate [Hz] above the header.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from gyrostab.errors import FormatError, GyrostabError
from gyrostab.ingest.columns.dates import YEAR_FIRST
from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    FileColumn,
    channel_name,
    distinct_columns,
    free_name,
    split_header,
    stored_name,
)
from gyrostab.ingest.columns.stamps import TimeUnit
from gyrostab.ingest.options import ColumnSummary, ReadOptions
from gyrostab.store.toml import load_toml_folder
from gyrostab.wording import list_some

#: Columns that a message lists by name.
MAX_HEADERS = 30
_load_folder = cache(load_toml_folder)


@dataclass(frozen=True)
class Column:
    """A column to read, as ``value * factor + offset`` in `units`.

    Stamps are numbers of `time_unit`, or dates if it is None.
    """

    source: int
    header: str
    role: str  # "time", "week" (GPS weeks, which are added to the time), "gyro" or "channel"
    name: str  # "time", the axis, or the channel
    units: str
    factor: float = 1.0
    offset: float = 0.0
    time_unit: TimeUnit | None = None
    date_order: str = YEAR_FIRST  # of stamps that are text
    #: Zero of numbers whose unit names none, and the beginning of 1970 in the zone of dates [ns
    #: since 1970].
    epoch: int = 0


@dataclass
class Plan:
    """Roles and units of the columns of one file, with notes and problems."""

    path: Path
    options: ReadOptions  # with the sampling rate that the lines above the header name
    columns: list[Column] = field(default_factory=list)
    summaries: list[ColumnSummary] = field(default_factory=list)
    signal: str | None = None  # "rate", "angle" or None
    kind: str | None = None  # "rate", "angle" or "increment"
    notes: list[str] = field(default_factory=list)
    problems: list[GyrostabError] = field(default_factory=list)
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

    def unit_key(self, names: Sequence[str]) -> str | None:
        """Return the key of ``--unit`` that is the first of some names, in any case of letters."""
        keys_by_name = {key.lower(): key for key in self.options.unit}
        return next(filter(None, (keys_by_name.get(name.lower()) for name in names)), None)

    def find_unit(
        self,
        column: FileColumn,
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

    def leave_out(self, column: FileColumn) -> None:
        """Add the summary of a column that is left out."""
        self.add_summary(column, column.name, "left out", column.written)

    def add_column(self, column: FileColumn, text: str | None, planned: Column) -> None:
        """Add a column to read, with the unit that the file or the user gives it."""
        self.columns.append(planned)
        name = column.low if planned.role == "gyro" else planned.name
        self.add_summary(column, name, planned.role, text)

    def add_summary(self, column: FileColumn, name: str, role: str, unit: str | None) -> None:
        """Add the summary of a column."""
        self.summaries.append(ColumnSummary(column.header, name, role, unit, column.key))


def describe_left_out(reason: str, names: Sequence[str], advice: str = "") -> list[str]:
    """Return a note on columns that are left out, if there are any.

    Examples
    --------
    >>> describe_left_out("they carry no unit", ["a", "b"], "give one"), describe_left_out("", [])
    (['left out, as they carry no unit: a, b (give one)'], [])
    """
    listed = list_some(names, MAX_HEADERS)
    return [f"left out, as {reason}: {listed}{f' ({advice})' if advice else ''}"] * bool(names)


def name_columns(
    plan: Plan, columns: Sequence[FileColumn], presets: Mapping[int, str]
) -> list[FileColumn]:
    """Name the columns by ``--map``, then by the preset, and drop those that either drops."""
    headers = list(distinct_columns(columns))
    exact_keys = {key.strip(): key for key in plan.options.map}
    names = {text for column in headers for text in (column.key, column.header, column.name)}
    keys_by_name = {key.lower(): exact_keys[key] for key in exact_keys if key not in names}
    targets = {split_header(target)[0].lower() for target in plan.options.map.values()}
    are_axes_given = any(map(AXIS_PATTERN.match, targets))  # then the preset names none
    named: list[FileColumn] = []
    for column in headers:
        texts = (column.key, column.header, column.name)
        keys = (exact_keys.get(text, keys_by_name.get(text.lower())) for text in texts)
        key = next(filter(None, keys), None)
        if key is not None:
            plan.used_map.add(key)
            target, target_unit = split_header(plan.options.map[key])
            if target in ("", "-"):
                continue
            column.name, column.unit, column.mapped = target, target_unit or column.unit, True
        elif preset := presets.get(column.source, column.target):
            target, target_unit = split_header(preset)
            is_axis = bool(AXIS_PATTERN.match(target.lower()))
            if target == "-" or target.lower() in targets or (is_axis and are_axes_given):
                plan.leave_out(column)
                continue
            column.name, column.preset = target, True
            if target_unit is not None:  # overruled by --unit, overrules a header without a unit
                column.unit, column.stored = None, target_unit
        if column.name:
            named.append(column)
    return named


def resolve_duplicates(plan: Plan, named: list[FileColumn]) -> list[FileColumn]:
    """Give columns of one name different names; an axis must be one column."""
    groups: dict[str, list[FileColumn]] = {}
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


class PresetMatch(NamedTuple):
    """A preset that fits a file: column number -> target of ``--map``; rate [Hz] if known."""

    name: str = ""
    columns: Mapping[int, str] = MappingProxyType({})
    rate: float | None = None


def find_preset(path: Path, columns: Sequence[FileColumn], above: Sequence[str]) -> PresetMatch:
    """Find the preset that fits a file, with an empty name for the files of other programs.

    `above` are the lines above the header.
    """
    places: dict[str, int] = {}
    for place, column in reversed(list(enumerate(columns))):
        for name in (split_header(column.header)[0], column.header):
            places[name.strip().lower()] = place

    def held(names: Sequence[str]) -> list[int]:
        return [places[name.lower()] for name in names if name.lower() in places]

    for key, preset in _load_folder("gyrostab.ingest.columns", "presets").items():
        gyro = [names for target, names in preset["columns"].items() if target.startswith("gyro_")]
        if (
            not all(map(held, [*gyro, *([name] for name in preset.get("needs", ()))]))
            or ("file" in preset and not re.search(preset["file"], path.name, re.IGNORECASE))
            or ("above" in preset and not any(re.search(preset["above"], line) for line in above))
        ):
            continue
        targets = dict.fromkeys(held(preset.get("drops", ())), "-")
        times = {at: time["unit"] for time in preset["times"] for at in held([time["column"]])}
        targets |= dict.fromkeys(times, "-")
        filled_times = [at for at in times if columns[at].is_filled]
        targets |= {at: f"time [{times[at]}]" for at in filled_times[:1]}
        for target, names in preset["columns"].items():
            targets |= dict.fromkeys(held(names)[:1], target)
        matches = (re.search(preset["rate"], line) for line in above if "rate" in preset)
        rates = [float(match[1]) for match in matches if match]
        return PresetMatch(f"{preset['name']} (preset {key})", targets, next(iter(rates), None))
    return PresetMatch()
