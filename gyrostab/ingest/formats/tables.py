"""Files of several tables with separate stamps: gyro tables become the log, others its channels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError, OptionError
from gyrostab.ingest.columns.plan import Plan, plan_columns
from gyrostab.ingest.columns.typed import read_columns, summarise_columns
from gyrostab.ingest.combine import concatenate, with_channels
from gyrostab.ingest.options import FileSummary, ReadOptions

__all__ = ["Table", "library", "plain_names", "read_tables", "scan_tables", "sliced"]

#: First row, row after the last one -> values.
ReadSlice = Callable[[int, int], Any]


@dataclass(frozen=True)
class Table:
    """Columns of one length.

    `names` and `units` are those of the columns; `stamps` are in the unit `time_unit`, or dates if
    that is None; without stamps a column of the table may hold the time. `coded` holds targets of
    columns by a code of the format, in the form of ``--map``.
    """

    rows: int
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    columns: tuple[ReadSlice, ...]
    stamps: ReadSlice | None = None
    time_unit: str | None = None
    coded: tuple[str | None, ...] = ()


def sliced(values: Any) -> ReadSlice:
    """Return a function that slices an array, or what can be sliced like one."""
    return lambda start, stop: np.asarray(values[start:stop])


def plain_names(names: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the last part of each name if that is unique, otherwise all parts joined by dots.

    Examples
    --------
    >>> plain_names([("imu", "wx"), ("imu", "temp"), ("probe", "temp")])
    ['wx', 'imu.temp', 'probe.temp']
    """
    counts = Counter(name[-1] for name in names)
    return [
        name[-1] if counts[name[-1]] == 1 else ".".join(part for part in name if part)
        for name in names
    ]


@dataclass(frozen=True)
class _PlannedTables:
    """Tables with one plan; source numbers run through all tables, stamps first."""

    tables: list[Table]
    first: list[int]
    plan: Plan
    main: list[int]  # tables with gyro axes, each with separate stamps

    def part(self, place: int) -> tuple[Plan, Any]:
        """Return the plan of one table's columns, and the function that fetches them."""
        table, begin = self.tables[place], self.first[place]
        clocks = [
            replace(column, source=begin)
            for column in self.plan.of("time")
            if table.stamps is not None
        ]
        table_columns = [
            column
            for column in self.plan.columns
            if begin <= column.source < begin + 1 + len(table.names)
        ]
        columns = clocks + [
            column for column in table_columns if not (clocks and column.role == "time")
        ]

        def fetch(source: int, start: int, stop: int) -> Any:
            part = table.stamps if source == begin else table.columns[source - begin - 1]
            assert part is not None
            return part(start, stop)

        return replace(self.plan, columns=tuple(columns)), fetch


def _plan_tables(path: Path, tables: Sequence[Table], options: ReadOptions) -> _PlannedTables:
    filled = [table for table in tables if table.rows and table.names]
    if not filled:
        raise FormatError(
            f"{path.name}: it holds no values; copy it again, or check what the logger wrote"
        )
    headers: list[str] = []
    units: dict[int, str] = {}
    coded: dict[int, str] = {}
    first = []
    for table in filled:
        first.append(len(headers))
        named = table.stamps is not None and not any(
            earlier.stamps is not None for earlier in filled[: len(first) - 1]
        )
        if named and table.time_unit:
            units[len(headers)] = table.time_unit
        for offset, unit in enumerate(table.units, 1):
            if unit:
                units[len(headers) + offset] = unit
        coded.update(
            {
                len(headers) + offset: meaning
                for offset, meaning in enumerate(table.coded, 1)
                if meaning
            }
        )
        headers += ["time" if named else "", *table.names]
    stamped = [
        begin
        for begin, table in zip(first, filled, strict=True)
        if table.stamps is not None and table.time_unit is None
    ]
    plan = plan_columns(path, headers, options, units=units, stamped=stamped, coded=coded)
    main_columns = plan.of("gyro") or plan.of("channel")
    holders = {
        max(place for place, begin in enumerate(first) if begin <= column.source)
        for column in main_columns
    }
    return _PlannedTables(
        filled, first, plan, sorted(holders) if plan.of("gyro") else [min(holders, default=0)]
    )


def scan_tables(
    path: Path, form: str, tables: Sequence[Table], options: ReadOptions, notes: Sequence[str] = ()
) -> FileSummary:
    """Summarise tables, with the first and last stamps of the table with the gyro axes."""
    planned = _plan_tables(path, tables, options)
    main = planned.main[0]
    plan, fetch = planned.part(main)
    summary = summarise_columns(form, plan, options, planned.tables[main].rows, fetch, notes)
    axes, channels = (
        tuple(column.name for column in planned.plan.of(role)) for role in ("gyro", "channel")
    )
    return replace(summary, axes=axes, channels=channels)


def read_tables(
    path: Path,
    tables: Sequence[Table],
    options: ReadOptions,
    *,
    notes: Sequence[str] = (),
) -> xr.Dataset:
    """Return the raw log of the tables with gyro axes; other channels keep separate stamps.

    Raises
    ------
    FormatError
        When the tables are empty.
    """
    planned = _plan_tables(path, tables, options)
    planned.plan.check()
    main: list[xr.Dataset] = []
    channel_logs: list[xr.Dataset] = []
    for place, table in enumerate(planned.tables):
        plan, fetch = planned.part(place)
        if place in planned.main:
            table_notes = notes if not main else ()
            main.append(
                read_columns(
                    plan if not main else replace(plan, notes=()),
                    options,
                    table.rows,
                    fetch,
                    notes=table_notes,
                )
            )
        elif plan.of("channel"):
            plan = replace(plan, signal=None, kind=None, notes=())
            channel_logs.append(read_columns(plan, options, table.rows, fetch))
    log = with_channels(concatenate(main) if len(main) > 1 else main[0], channel_logs)
    return (
        log.assign_attrs(source_files=[path.name], row_start=[0])
        if "axis_rows" not in log.attrs
        else log
    )


def library(name: str, path: Path, *, extra: str) -> Any:
    """Import a format library."""
    try:
        return import_module(name)
    except ImportError as error:
        raise OptionError(
            f"{path.name}: reading it needs {name}; install it with pip install 'gyrostab[{extra}]'"
        ) from error
