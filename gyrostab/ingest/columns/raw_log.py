"""Build the raw log from blocks of columns: units, counts of unreadable cells, labels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Bools, Floats, Ints
from gyrostab.errors import FormatError
from gyrostab.ingest.columns.pieces import Buffers, find_even
from gyrostab.ingest.columns.plan import Column, Plan
from gyrostab.ingest.columns.stamps import DATENUM, NAT, TurningClock, add_weeks
from gyrostab.ingest.options import FileSummary
from gyrostab.schema import SIGNAL_UNITS
from gyrostab.store.lazy import convert_values, read_slice, stack_rows
from gyrostab.store.write import pack_counts
from gyrostab.units import DAY
from gyrostab.wording import list_some

#: Largest number of bad places that a note lists.
MAX_NAMED_PLACES = 10
#: Largest share of unreadable rows; a file with more is refused.
MAX_UNREADABLE_SHARE = 0.5

#: Rows at the beginning, or around an extreme, in which a code for missing values is searched.
_CODE_ROWS = 2**18
#: A code repeats, is farther from the other values than their range times this number, and the
#: latter have at least so many different values, unlike the states of a switch.
_MIN_CODE_REPEATS, _MIN_CODE_DISTANCE, _MIN_READINGS = 3, 3.0, 16
#: Common codes for missing values in well logs.
_COMMON_CODES = (-999.25, -9999.0)
_CODE_ROUNDING = 2.0**-23  # relative difference of equal numbers, one of single precision

#: Row numbers within a block -> names of the rows for messages.
Locate = Callable[[Sequence[int]], list[str]]
#: Row number within a block -> the cell that cannot be read, or the row, as it is written.
Quote = Callable[[int], str]
Values = dict[int, Floats]


class ColumnRange(NamedTuple):
    """Numbers of missing values and of codes among them, and range of the other values.

    The range is in the unit of the file.
    """

    missing: int
    declared: int
    low: float
    high: float
    is_whole: bool  # whether the other values are whole numbers


class ConvertedBlock(NamedTuple):
    """A converted block of rows for `RawLogBuilder.add`; row numbers count from its first row."""

    rows: int
    values: Values  # in the inner unit, by column number
    stamps: Ints | None
    ranges: dict[int, ColumnRange]  # by column number
    #: Unreadable rows, and other rows with an unreadable gyro cell.
    bad_rows: Ints
    cell_rows: Ints
    #: Unreadable cells, and unreadable gyro cells of `cell_rows`.
    bad_cells: int
    cells: int


@dataclass
class _Statistics:
    """What the blocks of a column held so far."""

    column: Column
    missing: int = 0
    declared: int = 0  # number of those missing values that were a code
    is_whole: bool = True  # whether all numbers are whole, in the unit of the file
    reach: float = 0.0  # largest magnitude in that unit
    #: Extremes in the inner unit, with their rows.
    lowest: tuple[float, int] = (np.inf, 0)
    highest: tuple[float, int] = (-np.inf, 0)

    def add(self, cells: Floats, first: int, summary: ColumnRange) -> None:
        """Add a block from row `first` on."""
        self.missing += summary.missing
        self.declared += summary.declared
        if summary.missing == cells.size:
            return
        self.is_whole &= summary.is_whole
        ends = summary.low, summary.high
        self.reach = max(self.reach, -summary.low, summary.high)
        low, high = sorted(end * self.column.factor + self.column.offset for end in ends)
        if low < self.lowest[0]:
            self.lowest = low, first + int(np.nanargmin(cells))
        if high > self.highest[0]:
            self.highest = high, first + int(np.nanargmax(cells))


class RawLogBuilder:
    """Collect the blocks of one file and build its raw log."""

    def __init__(self, plan: Plan):
        self.plan, self.options = plan.check(), plan.options
        self.time = plan.time
        self.gyro, self.channels = plan.of("gyro"), plan.of("channel")
        self.weeks = plan.of("week")
        dtypes: dict[int, Any] = {
            column.source: np.float64 for column in [*self.gyro, *self.channels]
        }
        if self.time is not None:
            dtypes[self.time.source] = "datetime64[ns]"
        self.buffers = Buffers(dtypes)
        self.bad_cells = self.gyro_cells = 0  # the latter in rows that are readable otherwise
        self.bad_rows, self.cell_rows = _Places(), _Places()
        #: Range of the stamps of readable rows [ns since 1970]; high < low if there are none.
        self.low, self.high = np.iinfo(np.int64).max, NAT
        unit = None if self.time is None else self.time.time_unit
        self.clock = TurningClock() if unit is not None and unit.epoch is None else None
        self.statistics = {
            column.source: _Statistics(column) for column in [*self.gyro, *self.channels]
        }

    def prepare(self, values: Values, stamps: Ints | None, *, words: int = 0) -> ConvertedBlock:
        """Convert one block in place; thread-safe.

        `values` are in the unit of the file by column number, NaN where unreadable or empty;
        `stamps` [ns since 1970] are `NAT` where unreadable; `words` counts the channel cells whose
        text is not a number (empty cells do not count).
        """
        size = (
            len(next(iter(values.values()))) if values else len(stamps) if stamps is not None else 0
        )
        if stamps is not None:
            for column in self.weeks:
                stamps = add_weeks(stamps, values[column.source])
        bad = stamps == NAT if stamps is not None else np.zeros(size, dtype=bool)
        columns = [*self.gyro, *self.channels]
        is_unreadable, ranges = np.zeros((len(columns), size), dtype=bool), {}
        for column, mask in zip(columns, is_unreadable, strict=True):
            cells = values[column.source]
            np.logical_not(np.isfinite(cells), out=mask)
            ranges[column.source] = clean_column(
                cells, column.factor, column.offset, self.options.missing_value
            )
        gyro = is_unreadable[: len(self.gyro)]
        bad_cells = words + int(np.count_nonzero(bad) + np.count_nonzero(gyro))
        if self.gyro:
            bad = bad | is_unreadable.all(axis=0)
        gyro &= ~bad
        return ConvertedBlock(
            size,
            values,
            stamps,
            ranges,
            np.flatnonzero(bad),
            np.flatnonzero(gyro.any(axis=0)),
            bad_cells,
            int(np.count_nonzero(gyro)),
        )

    def add(
        self, converted: ConvertedBlock, locate: Locate | None = None, quote: Quote | None = None
    ) -> None:
        """Add one block; messages name its rows by `locate` and `quote`."""
        if converted.rows == 0:
            return
        first = self.buffers.rows
        for source, statistics in self.statistics.items():
            statistics.add(converted.values[source], first, converted.ranges[source])
        locate = locate or (lambda rows: [f"row {first + row}" for row in rows])
        self.bad_rows.add(converted.bad_rows, locate, quote)
        self.cell_rows.add(converted.cell_rows, locate, quote)
        self.bad_cells += converted.bad_cells
        self.gyro_cells += converted.cells
        block: dict[int, Any] = {source: converted.values[source] for source in self.statistics}
        stamps = converted.stamps
        if stamps is not None and self.time is not None:
            stamps = stamps if self.clock is None else self.clock.continue_stamps(stamps)
            block[self.time.source] = find_even(stamps.view("datetime64[ns]"))
            good = np.delete(stamps, converted.bad_rows) if converted.bad_rows.size else stamps
            self.low = int(good.min(initial=self.low))
            self.high = int(good.max(initial=self.high))
        self.buffers.add(block)

    def _packing_of(self, columns: Sequence[Column]) -> dict[str, Any]:
        """Return the encoding of columns of whole numbers with one factor; empty for others."""
        statistics = [self.statistics[column.source] for column in columns]
        laws = {(column.factor, column.offset) for column in columns}
        factor, offset = laws.pop()
        if laws or offset != 0.0 or not all(part.is_whole for part in statistics):
            return {}
        return pack_counts(max(part.reach for part in statistics), factor)

    def finish(self, notes: Sequence[str] = ()) -> xr.Dataset:
        """Return the raw log; `FormatError` if more than half of the rows are unreadable."""
        name, rows = self.plan.path.name, self.buffers.rows
        if rows == 0:
            raise FormatError(
                f"{name}: there is a header but no data row below it; copy it again, or check "
                "what the logger wrote"
            )
        self._check_share(name, rows)
        columns = self.buffers.finish()
        notes = [
            *self.plan.notes,
            *notes,
            *describe_codes(self.statistics.values(), columns),
            *self._describe_declared(),
            *self._describe_faults(rows),
            *(self.clock.describe() if self.clock is not None else ()),
        ]
        if self.options.start is not None and self.time is not None:
            notes.append("--start is not used: the file has its own time column")
        stamps = self._finish_stamps(columns)
        dataset = self._make_dataset(columns, stamps)
        dataset.attrs.update(
            source_files=[name],
            row_start=[0],
            notes=[f"{name}: {note}" for note in notes],
            unreadable_rows=self.bad_rows.total,
            unreadable_cells=self.bad_cells,
            unmatched_options=self.plan.unmatched,
            headers=[summary.header for summary in self.plan.summaries],
        )
        return dataset

    def _check_share(self, name: str, rows: int) -> None:
        """Refuse a file of which more than half of the rows are unreadable."""
        if self.bad_rows.total > MAX_UNREADABLE_SHARE * rows:
            share, first = self.bad_rows.total / rows, self.bad_rows.names[0]
            written = f": {self.bad_rows.first}" if self.bad_rows.first else ""
            suspects = (
                "the separator, the columns that --map names and the unit of time (stamps lie "
                "in the years 1678 to 2262)"
            )
            unit = None if self.time is None else self.time.time_unit
            if unit is not None and unit.epoch is None and unit.ns == int(DAY) * 10**9:
                suspects += f"; of serial dates of MATLAB it is --unit time={DATENUM}"
            raise FormatError(
                f"{name}: {100 * share:.0f} % of {rows} rows are unreadable, the first is {first}"
                f"{written}; look at it, and check {suspects}"
            )

    def _describe_declared(self) -> list[str]:
        """Return a note on the cells that `missing_value` made missing."""
        counts = [
            f"{statistics.declared} of {statistics.column.header!r}"
            for statistics in self.statistics.values()
            if statistics.declared
        ]
        codes = " or ".join(f"{code:.10g}" for code in self.options.missing_value)
        return [f"cells that are {codes} are missing: {list_some(counts, 5)}"] if counts else []

    def _describe_faults(self, rows: int) -> list[str]:
        """Return notes on unreadable rows, and on gyro cells in other rows."""
        notes, bad = [], self.bad_rows
        if bad.total:
            notes.append(f"{bad.total} of {rows} rows are unreadable: {bad.describe()}")
        unreadable = [
            self.statistics[column.source].missing - self.statistics[column.source].declared
            for column in self.gyro
        ]
        empty = unreadable.count(rows)
        cells = self.gyro_cells - empty * (rows - bad.total)  # empty axes have a note later
        if cells:
            places = "" if empty else f": {self.cell_rows.describe()}"
            notes.append(
                f"{cells} gyro cells hold no number in rows that are readable otherwise{places}"
            )
        return notes

    def _finish_stamps(self, columns: dict[int, Any]) -> Any:
        if self.time is None:
            return None
        stamps = columns.pop(self.time.source)
        if not self.bad_rows.total or self.low > self.high:
            return stamps
        hide = partial(_hide_others, low=self.low, high=self.high)
        return convert_values(stamps, hide, "datetime64[ns]")

    def _make_dataset(self, columns: dict[int, Any], stamps: Any) -> xr.Dataset:
        data: dict[str, Any] = {}
        coords: dict[str, Any] = {}
        if self.gyro and self.plan.signal is not None:
            axes = [column.name for column in self.gyro]
            data[self.plan.signal] = (
                ("axis", "row"),
                stack_rows([columns[column.source] for column in self.gyro]),
                {"units": SIGNAL_UNITS[self.plan.signal]},
                self._packing_of(self.gyro),
            )
            coords["axis"] = np.array(axes, dtype=str)
        for column in self.channels:
            data[column.name] = (
                "row",
                columns[column.source],
                {"units": column.units},
                self._packing_of([column]),
            )
        if stamps is not None:
            coords["time"] = ("row", stamps)
        dataset = xr.Dataset(
            data, coords=coords, attrs={"kind": self.plan.kind} if self.plan.kind else {}
        )
        if self.clock is not None and self.time is not None:
            dataset.attrs["clock_zero"] = self.time.epoch
        if self.options.rate is not None:
            dataset.attrs["declared_rate_hz"] = float(self.options.rate)
        if self.options.start is not None and stamps is None:
            dataset.attrs["start"] = self.options.start
        return dataset


def find_codes(values: Floats, codes: Sequence[float]) -> Bools:
    """Return which values are one of the codes for missing values, up to single precision.

    Examples
    --------
    >>> find_codes(np.array([0.5, -999.25, 999.99, np.nan]), (-999.25, float(np.float32(999.99))))
    array([False,  True,  True, False])
    """
    pairs = np.isclose(values[:, None], np.array(codes), rtol=_CODE_ROUNDING, atol=0.0)
    return np.asarray(pairs.any(axis=1))


def clean_column(
    values: Floats, factor: float, offset: float, codes: Sequence[float] = ()
) -> ColumnRange:
    """Convert in place, ``values * factor + offset``; infinite values and codes become NaN."""
    is_code = find_codes(values, codes)
    is_known = np.isfinite(values) & ~is_code
    missing = values.size - int(np.count_nonzero(is_known))
    known = values[is_known] if missing else values
    low, high = float(known.min(initial=np.inf)), float(known.max(initial=-np.inf))
    is_whole = all((part == np.rint(part)).all() for part in (known[:64], known))
    values[~is_known] = np.nan
    if factor != 1.0 or offset != 0.0:
        with np.errstate(over="ignore"):
            values *= factor
            values += offset
    return ColumnRange(missing, int(np.count_nonzero(is_code)), low, high, is_whole)


def _hide_others(stamps: NDArray[np.datetime64], low: int, high: int) -> NDArray[np.datetime64]:
    """Hide the stamps outside the range of readable rows: bad rows may hold other numbers."""
    bits = stamps.view(np.int64)
    return np.where((bits < low) | (bits > high), NAT, bits).view("datetime64[ns]")


def summary_of(
    plan: Plan,
    form: str,
    rows: int | None,
    *,
    head: Sequence[int] | Ints = (),
    tail: Sequence[int] | Ints = (),
    notes: Sequence[str] = (),
) -> FileSummary:
    """Summarise a file without reading all of its data.

    `head` and `tail` are stamps at the two ends [ns since 1970], `NAT` where unreadable.
    """
    first, last = (
        next((np.datetime64(int(stamp), "ns") for stamp in end if stamp != NAT), None)
        for end in (head, tail[::-1])
    )
    return FileSummary(
        path=plan.path,
        format=form,
        columns=tuple(plan.summaries),
        axes=tuple(column.name for column in plan.of("gyro")),
        channels=tuple(column.name for column in plan.of("channel")),
        first=first,
        last=last,
        n_rows=rows,
        notes=(
            *(f"{plan.path.name}: {note}" for note in [*notes, *plan.notes]),
            *(str(problem) for problem in plan.problems),
        ),
    )


class _Places:
    """Number of bad places, the names of the first ones, and the first one as it is written."""

    def __init__(self) -> None:
        self.total, self.names, self.first = 0, list[str](), ""

    def add(self, rows: Ints, locate: Locate, quote: Quote | None = None) -> None:
        if quote is not None and rows.size and not self.total:
            self.first = f"{quote(int(rows[0])):.100}"
        self.total += len(rows)
        if room := MAX_NAMED_PLACES - len(self.names):
            self.names += locate(rows[:room].tolist())

    def describe(self) -> str:
        """Join the names: ``lines 7 ('oops'), 8, 9 and others``."""
        kind, names = self.names[0].split(" ")[0], self.names
        numbers = [name.removeprefix(f"{kind} ") for name in names]
        numbers[0] += f" ({self.first})" if self.first else ""
        others = " and others" * (self.total > len(names))
        return f"{kind}{'s' * (len(names) > 1)} {', '.join(numbers)}{others}"


def describe_codes(columns: Iterable[_Statistics], values: Mapping[int, Any]) -> list[str]:
    """Return notes on codes for missing values.

    They repeat far outside all other values, or are common codes and the only value. They are
    searched in the first rows, and around the extremes that are far outside those.
    """
    notes = []
    for statistics in columns:
        column = statistics.column
        common = [code * column.factor + column.offset for code in _COMMON_CODES]
        begin, rows = 0, _read_window(values[column.source], 0)
        readings = rows[np.isfinite(rows)]
        code = _find_code(readings, common)
        for value, row in (statistics.lowest, statistics.highest):
            if code is None and row >= _CODE_ROWS and _is_far(value, readings):
                begin = row - _CODE_ROWS // 2
                rows = _read_window(values[column.source], begin)
                readings = rows[np.isfinite(rows)]
                code = _find_code(readings, common)
        if code is None:
            continue
        count = int((readings == code).sum())
        written = f"{(code - column.offset) / column.factor:.10g}"
        is_common = _is_common(code, common)
        place = f"{len(rows)} rows from row {begin} on" if begin else f"the first {len(rows)} rows"
        notes.append(
            f"{column.header!r} is {written} in {count} of "
            f"{place}{', far outside all other values' if count < len(readings) else ''}; "
            f"{'it is a common' if is_common else 'if that is a'} code for a missing value"
            f"{':' if is_common else ','} read it as missing with --missing-value {written}"
        )
    return notes


def _read_window(values: Any, begin: int) -> Floats:
    return np.asarray(read_slice(values, begin, begin + _CODE_ROWS), dtype=np.float64)


def _is_far(value: float, readings: Floats) -> bool:
    """Return whether a value is far outside others, in terms of their range."""
    low, high = readings.min(initial=np.inf), readings.max(initial=-np.inf)
    return bool(max(low - value, value - high) > _MIN_CODE_DISTANCE * (high - low))


def _is_common(value: float, common: Sequence[float]) -> bool:
    return bool(np.isclose(value, common, rtol=1e-9).any())


def _find_code(values: Floats, common: Sequence[float]) -> float | None:
    """Return the lowest or highest value if it repeats far outside all others; zero is a reading.

    A value that is one of the `common` codes may be the only one, or the others may be few: a slow
    sensor has them in most rows.

    Examples
    --------
    >>> _find_code(np.r_[np.arange(100.0), [-999.25] * 3], []), _find_code(np.arange(100.0), [])
    (-999.25, None)
    >>> _find_code(np.r_[[20.0, 21.0] * 9, [-999.25] * 99], [-999.25])
    -999.25
    """
    for code in (values.min(initial=np.inf), values.max(initial=-np.inf)):
        others, is_common = values[values != code], _is_common(code, common)
        if is_common and values.size and not others.size:
            return float(code)
        repeats = len(values) - len(others)
        if code == 0 or repeats < _MIN_CODE_REPEATS or not (is_common or repeats < len(others)):
            continue
        if _is_far(code, others) and (is_common or len(np.unique(others)) >= _MIN_READINGS):
            return float(code)
    return None
