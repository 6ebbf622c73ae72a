"""Files of tables with separate stamps: gyro tables become the log, others its channels.

Numbers that NetCDF, Zarr and HDF5 (MATLAB 7.3) files store with CF attributes are decoded here.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.errors import FormatError, OptionError, UnitError
from gyrostab.ingest.columns.headers import FileColumn, describe_cells
from gyrostab.ingest.columns.plan import Column, Plan, describe_left_out
from gyrostab.ingest.columns.plan_roles import plan_columns
from gyrostab.ingest.columns.stamps import NAT, parse_time_unit
from gyrostab.ingest.columns.typed import float32_note, read_columns, summarise_columns
from gyrostab.ingest.combine import attach_channels, concatenate
from gyrostab.ingest.formats.packing import Decoder, attribute_text, fold_packing
from gyrostab.ingest.limits import check_stored
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.store.private import library_lock

#: Most columns of an array of two dimensions that is read as a table of sensors.
MAX_COLUMNS = 64
_HEAD_ROWS = 50  # whose texts show the time zone


@dataclass(frozen=True)
class TableColumn:
    """A column; its name is used alone, or after the names of its groups if several share it."""

    name: tuple[str, ...]
    values: Any  # what can be sliced, or a function of the first row and the row after the last
    unit: str | None = None  # blanks around it are removed; None in place of an empty text
    target: str | None = None  # by a code of the format, in the form of ``--map``
    #: Type and CF attributes of stored numbers, which are packed.
    dtype: Any = None
    attributes: Mapping[str, Any] | None = None
    #: The first values as text, of times that may be local, or where there may be a time zone.
    cells: Sequence[str] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", str(self.unit or "").strip() or None)

    def read(self, start: int, stop: int) -> Any:
        """Return the values of rows."""
        is_function = callable(self.values)
        return self.values(start, stop) if is_function else np.asarray(self.values[start:stop])


def first_texts(values: Any) -> list[str]:
    """Return the first values as text, none of numbers."""
    first = np.asarray(values[:_HEAD_ROWS])
    texts = [] if first.dtype.kind in "biuf" else first.astype(str).tolist()
    return ["" if text == "NaT" else text for text in texts]


class StoredArray:
    """Numbers that a library reads from an open file, in rows along the dimension `along`.

    The columns of an array of two dimensions lie in the same chunks of the file, so they share what
    was read last.
    """

    def __init__(self, values: Any, along: int):
        self.values, self.along = values, along
        self._held: tuple[tuple[int, int], Array] = (-1, -1), np.empty((0, 0))

    def make_columns(
        self, names: Sequence[str], attributes: Mapping[str, Any]
    ) -> list[TableColumn]:
        """Make a column, with these CF attributes, of each place along the other dimension."""
        unit = attribute_text(attributes.get("units"))
        return [
            TableColumn(
                (name,), partial(self._read_rows, place), unit, None, self.values.dtype, attributes
            )
            for place, name in enumerate(names)
        ]

    def _read_rows(self, place: int, start: int, stop: int) -> Array:
        rows = slice(start, stop)
        if len(self.values.shape) == 1:
            return self._read_box(rows)
        held = self._held  # one object, so that threads cannot mix the rows of two blocks
        if held[0] != (start, stop):
            every = slice(None)
            box = (rows, every) if self.along == 0 else (every, rows)
            held = self._held = (start, stop), self._read_box(box)
        return np.asarray(held[1].take(place, axis=1 - self.along))

    def _read_box(self, box: Any) -> Array:
        with nullcontext() if isinstance(self.values, xr.Variable) else library_lock():
            return np.asarray(self.values[box])


@dataclass(frozen=True)
class Table:
    """Columns of one length, and the stamps: numbers of a unit, or dates without one.

    Stamps without a name are not the time of the log, but only of channels. Without stamps a column
    of the table may hold the time.
    """

    rows: int
    columns: Sequence[TableColumn]
    stamps: TableColumn | None = None


#: Tables of a file, and notes on it.
TablesOfFile = tuple[Sequence[Table], Sequence[str]]
FindTables = Callable[[Path, ReadOptions], TablesOfFile | AbstractContextManager[TablesOfFile]]


class Messages:
    """Stamps and numbers of messages of one kind, a row each.

    Examples
    --------
    >>> messages = Messages()
    >>> messages.add(0, {"x": 1.0})
    >>> messages.add(10, {"x": 2.0, "t": 20.5})
    >>> [column.values.tolist() for column in messages.make_table("imu").columns]
    [[1.0, 2.0], [nan, 20.5]]
    """

    def __init__(self) -> None:
        self.stamps: array[int] = array("q")
        self.columns: dict[str, array[float]] = {}

    def add(self, stamp: int, values: Mapping[str, float]) -> None:
        """Add a message; fields that it lacks are NaN, and a stamp beyond 64 bits is NaT."""
        for name, value in values.items():
            column = self.columns.setdefault(name, array("d"))
            self._fill_column(column)
            column.append(value)
        self.stamps.append(stamp if abs(stamp) < 2**63 else NAT)

    def make_table(
        self,
        *group: str,
        time_unit: str | None = None,
        targets: Mapping[str, str] | None = None,
        may_be_local: bool = False,
    ) -> Table:
        """Return the columns with the names of their group, and targets of fields as of ``--map``.

        Without `time_unit` the stamps are nanoseconds since 1970, in UTC or in local time.
        """
        for column in self.columns.values():
            self._fill_column(column)
        stamps = np.frombuffer(self.stamps, dtype=np.int64)
        columns = [
            TableColumn((*group, name), np.frombuffer(column), target=(targets or {}).get(name))
            for name, column in self.columns.items()
        ]
        clock = stamps if time_unit else stamps.view("datetime64[ns]")
        cells = first_texts(clock) if may_be_local else ()
        return Table(len(stamps), columns, TableColumn(("time",), clock, time_unit, cells=cells))

    def _fill_column(self, column: array[float]) -> None:
        if len(column) < len(self.stamps):
            column.extend([np.nan] * (len(self.stamps) - len(column)))


def _plain_names(names: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the last part of each name if that is unique, otherwise all parts joined by dots.

    Examples
    --------
    >>> _plain_names([("imu", "wx"), ("imu", "temp"), ("probe", "temp")])
    ['wx', 'imu.temp', 'probe.temp']
    """
    counts = Counter(name[-1] for name in names)
    return [
        name[-1] if counts[name[-1]] == 1 else ".".join(part for part in name if part)
        for name in names
    ]


@dataclass(frozen=True)
class _PlannedTables:
    """Tables with one plan."""

    tables: list[Table]
    stored: list[TableColumn]  # those of all tables by source number, the stamps of each first
    first: list[int]  # first source number of each table, and that of the end of the last
    plan: Plan
    decoders: dict[int, Decoder]
    main: list[int]  # tables with gyro axes, each with separate stamps

    def plan_of(self, place: int) -> Plan:
        """Return the plan of the columns of one table."""
        begin, end = self.first[place : place + 2]
        columns = [column for column in self.plan.columns if begin <= column.source < end]
        if self.tables[place].stamps is not None:
            columns = [c for c in columns if c.role != "time" or c.source == begin]
        return replace(self.plan, columns=columns)

    def fetch(self, source: int, start: int, stop: int) -> Any:
        """Return the values of a column, decoded."""
        values = self.stored[source].read(start, stop)
        return self.decoders[source](values) if source in self.decoders else values

    def read(self, place: int, plan: Plan, notes: Sequence[str] = ()) -> xr.Dataset:
        """Read the columns of one table into a raw log."""
        rows = self.tables[place].rows
        check_stored(plan.path, rows, len(plan.columns), plan.options.limits)
        return read_columns(plan, rows, self.fetch, notes=notes)


def _leave_out_unplaced(planned: _PlannedTables) -> _PlannedTables:
    """Leave out, with notes, tables whose rows have no place on the time of the log."""
    plans = [planned.plan_of(place) for place in range(len(planned.tables))]
    is_dated = {
        place: planned.plan.options.epoch is not None
        or time.time_unit is None
        or time.time_unit.epoch is not None
        for place, time in enumerate(plan.time for plan in plans)
        if time is not None
    }
    kinds = {is_dated[place] for place in planned.main if place in is_dated}
    undated = {place for place, kind in is_dated.items() if kind != max(kinds, default=kind)}
    unstamped = set(range(len(plans))) - set(is_dated) - set(planned.main)
    plan = planned.plan
    for reason, places in (
        ("they have no stamps", unstamped),
        ("some stamps of the file are dates and others need --epoch", undated),
    ):
        left_out = [c for place in sorted(places) for c in plans[place].columns if c.role != "time"]
        plan = replace(
            plan,
            columns=[column for column in plan.columns if column not in left_out],
            notes=[*plan.notes, *describe_left_out(reason, [column.name for column in left_out])],
        )
    main = [place for place in planned.main if place not in undated]
    return replace(planned, plan=plan, main=main)


def _plan_tables(path: Path, tables: Sequence[Table], options: ReadOptions) -> _PlannedTables:
    names = iter(_plain_names([column.name for table in tables for column in table.columns]))
    filled: list[Table] = []
    stored: list[TableColumn] = []
    first: list[int] = []
    described: list[FileColumn] = []
    for table in tables:
        own_names = list(islice(names, len(table.columns)))
        if not own_names or not (table.rows or table.columns[0].attributes is not None):
            continue
        first.append(len(stored))
        if table.stamps is not None:
            is_first_clock = all(held.stamps is None for held in filled)
            header = table.stamps.name[-1] if is_first_clock else ""
            described.append(
                _describe_column(table.stamps, header, stamped=table.stamps.unit is None)
            )
            stored.append(table.stamps)
        filled.append(table)
        described += map(_describe_column, table.columns, own_names)
        stored += table.columns
    if not filled:
        raise FormatError(
            f"{path.name}: it holds no values; copy it again, or check what the logger wrote"
        )
    plan = plan_columns(path, described, options)
    for begin, table in zip(first, filled, strict=True):
        if table.stamps is not None:
            _add_clock(plan, begin, described, is_named=bool(table.stamps.name[-1]))
    plan, decoders = fold_packing(plan, stored)
    main_columns = plan.of("gyro") or plan.of("channel")
    holders = {bisect_right(first, column.source) - 1 for column in main_columns}
    main = sorted(holders) if plan.of("gyro") else [min(holders, default=0)]
    planned = _PlannedTables(filled, stored, [*first, len(stored)], plan, decoders, main)
    return _leave_out_unplaced(planned)


def _describe_column(column: TableColumn, name: str, *, stamped: bool = False) -> FileColumn:
    calendar = attribute_text((column.attributes or {}).get("calendar")) or None
    described = describe_cells(name, column.unit, column.cells)
    stamped = stamped or described.stamped
    return replace(described, calendar=calendar, stamped=stamped, target=column.target)


def _add_clock(plan: Plan, source: int, described: Sequence[FileColumn], *, is_named: bool) -> None:
    """Plan the stamps of a table, as planned if both clocks are stored in one unit."""
    own, time = described[source], plan.time
    if (time is None and is_named) or any(column.source == source for column in plan.of("time")):
        return  # the user leaves out the stamps, or they are planned
    planned = Column(source, own.header, "time", "time", "ns")
    if time is not None and _form_of(described[time.source]) == _form_of(own):
        planned = replace(time, source=source)
    elif own.stored is not None:
        try:
            unit = parse_time_unit(own.stored, own.calendar)
        except UnitError as error:
            plan.refuse(UnitError, str(error))
            return
        planned = replace(planned, time_unit=unit, epoch=plan.options.epoch_ns)
    plan.columns.append(planned)


def _form_of(column: FileColumn) -> tuple[str | None, str | None, bool]:
    return column.stored, column.calendar, column.stamped


def scan_tables(
    path: Path, form: str, tables: Sequence[Table], options: ReadOptions, notes: Sequence[str] = ()
) -> FileSummary:
    """Summarise tables, with the first and last stamps of the table with the gyro axes."""
    planned = _plan_tables(path, tables, options)
    main = planned.main[0]
    plan, rows = planned.plan_of(main), planned.tables[main].rows
    summary = summarise_columns(form, plan, rows, planned.fetch, notes)
    axes, channels = (
        tuple(column.name for column in planned.plan.of(role)) for role in ("gyro", "channel")
    )
    return replace(summary, axes=axes, channels=channels)


def read_tables(
    path: Path, tables: Sequence[Table], options: ReadOptions, *, notes: Sequence[str] = ()
) -> xr.Dataset:
    """Return the raw log of the tables with gyro axes; other channels keep separate stamps."""
    planned = _plan_tables(path, tables, options)
    planned.plan.check()
    notes = [*notes, *float32_note(planned.plan, [column.dtype for column in planned.stored])]
    main: list[xr.Dataset] = []
    channel_logs: list[xr.Dataset] = []
    for place in range(len(planned.tables)):
        plan = planned.plan_of(place)
        if place in planned.main:
            if main:
                plan, notes = replace(plan, notes=[]), []
            main.append(planned.read(place, plan, notes))
        elif plan.of("channel"):
            plan = replace(plan, signal=None, kind=None, notes=[])
            channel_logs.append(planned.read(place, plan))
    log = attach_channels(concatenate(main) if len(main) > 1 else main[0], channel_logs)
    if "axis_rows" in log.attrs:
        return log
    return log.assign_attrs(source_files=[path.name], row_start=[0])


def make_reader(
    form: str | Callable[[Path], str],
    find_tables: FindTables,
    find_heads: FindTables | None = None,
) -> tuple[Callable[[Path, ReadOptions], FileSummary], Callable[[Path, ReadOptions], xr.Dataset]]:
    """Make the functions `scan` and `read` of a format whose tables are read as a whole.

    `form` is the name of the format, or finds that of a file. `find_heads` finds the tables for
    `scan` if that can leave out their values. Both finders may be context managers that keep the
    file open.
    """

    def scan(path: Path, options: ReadOptions) -> FileSummary:
        """Summarise columns, rows, and first and last stamps."""
        with _keep_open((find_heads or find_tables)(path, options)) as (tables, notes):
            name = form if isinstance(form, str) else form(path)
            return scan_tables(path, name, tables, options, notes)

    def read(path: Path, options: ReadOptions) -> xr.Dataset:
        """Return the raw log of a file; see `gyrostab.ingest.read_log`."""
        with _keep_open(find_tables(path, options)) as (tables, notes):
            return read_tables(path, tables, options, notes=notes)

    return scan, read


def _keep_open(
    tables: TablesOfFile | AbstractContextManager[TablesOfFile],
) -> AbstractContextManager[TablesOfFile]:
    return tables if isinstance(tables, AbstractContextManager) else nullcontext(tables)


def library(name: str, path: Path, *, extra: str) -> Any:
    """Import a format library."""
    try:
        return import_module(name)
    except ImportError as error:
        raise OptionError(
            f"{path.name}: reading it needs {name}; install it with pip install 'gyrostab[{extra}]'"
        ) from error
