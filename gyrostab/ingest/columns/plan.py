"""Determine roles, units and factors of columns from their headers, for every format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gyrostab.errors import GyrostabError, OptionError
from gyrostab.ingest.columns.headers import AXIS_PATTERN, FileColumn, split_header
from gyrostab.ingest.columns.plan_draft import (
    MAX_HEADERS,
    Column,
    PlanDraft,
    name_columns,
    resolve_duplicates,
)
from gyrostab.ingest.columns.plan_roles import plan_channels, plan_gyro
from gyrostab.ingest.columns.plan_time import find_time
from gyrostab.ingest.columns.preset import PresetMatch, find_preset
from gyrostab.ingest.limits import check_columns
from gyrostab.ingest.options import ColumnSummary, ReadOptions
from gyrostab.wording import list_some


@dataclass(frozen=True)
class Plan:
    """Roles and units of the columns of one file, with notes and problems."""

    path: Path
    columns: tuple[Column, ...]
    summaries: tuple[ColumnSummary, ...]
    signal: str | None  # "rate", "angle" or None
    kind: str | None  # "rate", "angle" or "increment"
    notes: tuple[str, ...]
    problems: tuple[GyrostabError, ...]
    unmatched: tuple[str, ...]
    options: ReadOptions  # with the sampling rate that the lines above the header name

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


def plan_columns(
    path: Path,
    columns: Sequence[FileColumn],
    options: ReadOptions,
    *,
    rising: Callable[[int], bool] | None = None,
    above: Sequence[str] = (),
    is_filled: Callable[[int], bool] | None = None,
    word_in: Callable[[int], str] | None = None,
) -> Plan:
    """Determine the role and unit of each column.

    `rising` returns whether the first values of a column rise, which decides between candidates for
    the time column; `above` are the lines above the header, which may identify the program that
    wrote the file; `is_filled` returns whether any of the first cells of a column is filled, and
    `word_in` the first of them that holds no number, or nothing.
    """
    check_columns(path, len(columns), options.limits)
    headers = [column.header for column in columns]
    split = [(header, split_header(header)[0]) for header in headers]
    preset = PresetMatch("")
    if not any(AXIS_PATTERN.match(name.lower()) for _, name in split):  # named gyro_x ... already
        preset = find_preset(path, split, above=above, is_filled=is_filled)
    draft = PlanDraft(path, options, rising, word_in)
    named = resolve_duplicates(draft, name_columns(draft, columns, preset.columns))
    time = find_time(draft, named)
    data_columns = [column for column in named if column is not time]
    gyro = [column for column in data_columns if AXIS_PATTERN.match(column.low)]
    signal, kind = plan_gyro(draft, gyro, columns)
    plan_channels(draft, [column for column in data_columns if not AXIS_PATTERN.match(column.low)])
    rate = preset.rate if time is None and options.rate is None else None
    if preset.name:
        source_note = f", and {rate:g} Hz by the lines above the header" if rate else ""
        draft.notes.insert(
            0, f"read as a file of {preset.name}{source_note}; --map, --unit and --rate overrule it"
        )
    elif preset_axes := [
        f"{c.header} is {c.name}" for c in named if c.preset and AXIS_PATTERN.match(c.low)
    ]:
        draft.notes.append(
            f"taken for axes: {list_some(preset_axes, MAX_HEADERS)}; --map overrules it"
        )
    if time is None and options.rate is None and rate is None and not draft.problems:
        draft.refuse(
            OptionError,
            "there is no time column; give the sampling rate with --rate HZ (and --start), or "
            f"name the column: --map NAME=time. Columns: {list_some(headers, MAX_HEADERS)}",
        )
    draft.add_notes(columns)
    unused = [f"--unit {key}" for key in options.unit if key not in draft.used_units]
    unmatched = [f"--map {key}" for key in options.map if key not in draft.used_map] + unused
    order = {"time": 0, "gyro": 1, "channel": 2}
    planned = sorted(
        draft.columns,
        key=lambda column: (order[column.role], column.name if column.role == "gyro" else ""),
    )
    return Plan(
        path,
        tuple(planned),
        tuple(draft.summaries),
        signal,
        kind,
        tuple(draft.notes),
        tuple(draft.problems),
        tuple(unmatched),
        options if rate is None else replace(options, rate=rate),
    )
