"""Determine roles, units and factors of columns from their headers, for every format."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gyrostab.errors import GyrostabError, OptionError
from gyrostab.ingest.columns.headers import AXIS_PATTERN, split_header
from gyrostab.ingest.columns.plan_draft import (
    MAX_HEADERS,
    Column,
    PlanDraft,
    name_columns,
    resolve_duplicates,
)
from gyrostab.ingest.columns.plan_roles import find_time, plan_channels, plan_gyro
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
    rate: float | None = (
        None  # [Hz], from the lines above the header of a file without a time column
    )

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
    headers: Sequence[str],
    options: ReadOptions,
    *,
    units: Mapping[int, str] | None = None,
    calendars: Mapping[int, str] | None = None,
    stamped: Collection[int] = (),
    orders: Mapping[int, str | None] | None = None,
    rising: Callable[[int], bool] | None = None,
    above: Sequence[str] = (),
    is_filled: Callable[[int], bool] | None = None,
    word_in: Callable[[int], str] | None = None,
    coded: Mapping[int, str] | None = None,
) -> Plan:
    """Determine the role and unit of each column.

    Parameters
    ----------
    headers : sequence of str
        Header cells as written, or ``"0"``, ``"1"``, ... for a file without a header.
    units : mapping of int to str, optional
        Units that the format stores outside the header (NetCDF attributes).
    calendars : mapping of int to str, optional
        CF calendars of those units that name an epoch.
    stamped : collection of int
        Columns whose values are dates (text, datetime types).
    orders : mapping of int to str or None, optional
        Order of day, month and year in columns of text: one of `gyrostab.ingest.columns.dates`, or
        None if they can be read in two ways; the year comes first in others.
    rising : callable, optional
        Returns whether the first values of a column rise; decides between several candidates for
        the time column.
    above : sequence of str
        Lines above the header, which may identify the program that wrote the file.
    is_filled : callable, optional
        Returns whether any of the first cells of a column is filled.
    word_in : callable, optional
        Returns the first of the cells of a column that holds no number, or nothing.
    coded : mapping of int to str, optional
        Roles of columns by a code of the format, in the form of ``--map``, which overrules them.

    Returns
    -------
    Plan
        ``Plan.check()`` raises the first problem.
    """
    check_columns(path, len(headers), options.limits)
    split = [(header, split_header(header)[0]) for header in headers]
    preset = PresetMatch("")
    if not any(AXIS_PATTERN.match(name.lower()) for _, name in split):  # named gyro_x ... already
        preset = find_preset(path, split, above=above, is_filled=is_filled)
    draft = PlanDraft(path, options, rising, word_in)
    named = name_columns(
        draft,
        headers,
        units or {},
        calendars or {},
        frozenset(stamped),
        orders or {},
        {**(coded or {}), **preset.columns},
    )
    named = resolve_duplicates(draft, named)
    time = find_time(draft, named)
    data_columns = [column for column in named if column is not time]
    gyro = [column for column in data_columns if AXIS_PATTERN.match(column.low)]
    signal, kind = plan_gyro(draft, gyro, headers)
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
    draft.add_notes(headers)
    unused = [f"--unit {key}" for key in options.unit if key not in draft.used_units]
    unmatched = [f"--map {key}" for key in options.map if key not in draft.used_map] + unused
    order = {"time": 0, "gyro": 1, "channel": 2}
    columns = sorted(
        draft.columns,
        key=lambda column: (order[column.role], column.name if column.role == "gyro" else ""),
    )
    return Plan(
        path,
        tuple(columns),
        tuple(draft.summaries),
        signal,
        kind,
        tuple(draft.notes),
        tuple(draft.problems),
        tuple(unmatched),
        rate,
    )
