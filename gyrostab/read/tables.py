"""Files that hold several tables, each with stamps of its own: the table with the gyro axes becomes the log, the others channels of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.errors import FormatError
from gyrostab.read.arrays import read_columns, summarise
from gyrostab.read.buffers import SPILL_BYTES
from gyrostab.read.columns import Plan, plan_columns
from gyrostab.read.combine import with_channels
from gyrostab.read.options import FileSummary, ReadOptions

__all__ = ["Table", "plain_names", "read_tables", "scan_tables"]

#: First row, row after the last one -> values.
Part = Callable[[int, int], Any]


@dataclass(frozen=True)
class Table:
    """Columns of one length.

    `names` and `units` are those of the columns; `stamps` are in the unit `time_unit`, or dates where that is None; without stamps
    a column of the table may hold the time. `coded` is what a column is by a code of the format, in the form of ``--map``.
    """

    rows: int
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    columns: tuple[Part, ...]
    stamps: Part | None = None
    time_unit: str | None = None
    coded: tuple[str | None, ...] = ()


def plain_names(names: Sequence[tuple[str, ...]]) -> list[str]:
    """The last part of each name where that is unique, otherwise all of it, joined by dots.

    Examples
    --------
    >>> plain_names([("imu", "wx"), ("imu", "temp"), ("probe", "temp")])
    ['wx', 'imu.temp', 'probe.temp']
    """
    seen = Counter(name[-1] for name in names)
    return [name[-1] if seen[name[-1]] == 1 else ".".join(part for part in name if part) for name in names]


@dataclass(frozen=True)
class _Planned:
    """The tables with the plan of all their columns; source numbers run through the tables, stamps first."""

    tables: list[Table]
    first: list[int]
    plan: Plan
    main: int

    def part(self, place: int) -> tuple[Plan, Any]:
        """The plan of one table's columns, and how to fetch them."""
        table, begin = self.tables[place], self.first[place]
        clocks = [replace(column, source=begin) for column in self.plan.of("time") if table.stamps is not None]
        own = [column for column in self.plan.columns if begin <= column.source < begin + 1 + len(table.names)]
        columns = clocks + [column for column in own if not (clocks and column.role == "time")]

        def fetch(source: int, start: int, stop: int) -> Any:
            part = table.stamps if source == begin else table.columns[source - begin - 1]
            assert part is not None
            return part(start, stop)

        return replace(self.plan, columns=tuple(columns)), fetch


def _plan(path: Path, tables: Sequence[Table], options: ReadOptions) -> _Planned:
    kept = [table for table in tables if table.rows and table.names]
    if not kept:
        raise FormatError(f"{path.name}: it holds no values; copy it again, or look at what the logger wrote")
    headers: list[str] = []
    units: dict[int, str] = {}
    coded: dict[int, str] = {}
    first = []
    for table in kept:
        first.append(len(headers))
        named = table.stamps is not None and not any(one.stamps is not None for one in kept[: len(first) - 1])
        if named and table.time_unit:
            units[len(headers)] = table.time_unit
        for offset, unit in enumerate(table.units, 1):
            if unit:
                units[len(headers) + offset] = unit
        coded.update({len(headers) + offset: meaning for offset, meaning in enumerate(table.coded, 1) if meaning})
        headers += ["time" if named else "", *table.names]
    stamped = [begin for begin, table in zip(first, kept, strict=True) if table.stamps is not None and table.time_unit is None]
    plan = plan_columns(path, headers, options, units=units, stamped=stamped, coded=coded)
    wanted = plan.of("gyro") or plan.of("channel")
    holders = {max(place for place, begin in enumerate(first) if begin <= column.source): column.header for column in wanted}
    if plan.of("gyro") and len(holders) > 1:
        names = " and ".join(repr(name) for name in list(holders.values())[:2])
        raise FormatError(
            f"{path.name}: the gyro axes {names} have different stamps; read them one by one, dropping the others (--map NAME=-)"
        )
    return _Planned(kept, first, plan, min(holders, default=0))


def scan_tables(path: Path, form: str, tables: Sequence[Table], options: ReadOptions, notes: Sequence[str] = ()) -> FileSummary:
    """A summary, with the first and last stamps of the table of the gyro axes."""
    planned = _plan(path, tables, options)
    plan, fetch = planned.part(planned.main)
    summary = summarise(form, plan, options, planned.tables[planned.main].rows, fetch, notes)
    return replace(summary, channels=tuple(column.name for column in planned.plan.of("channel")))


def read_tables(
    path: Path, tables: Sequence[Table], options: ReadOptions, *, notes: Sequence[str] = (), limit: int = SPILL_BYTES
) -> xr.Dataset:
    """The raw log of the table with the gyro axes; channels of the other tables are on stamps of their own.

    Raises
    ------
    FormatError
        When there is nothing in the tables, or the gyro axes have different stamps.
    """
    planned = _plan(path, tables, options)
    planned.plan.check()
    plan, fetch = planned.part(planned.main)
    log = read_columns(plan, options, planned.tables[planned.main].rows, fetch, notes=notes, limit=limit)
    others = []
    for place, table in enumerate(planned.tables):
        plan, fetch = planned.part(place)
        if place != planned.main and plan.of("channel"):
            plan = replace(plan, signal=None, kind=None, notes=())
            others.append(read_columns(plan, options, table.rows, fetch, limit=limit))
    return with_channels(log, others)
