"""Build the raw log from blocks of columns: units, counts of unreadable cells, labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.pieces import (
    Buffers,
    CountsPiece,
    EvenStampsPiece,
    Piece,
    PiecewiseColumn,
    as_lazy,
    stack_as_rows,
)
from gyrostab.ingest.columns.plan import Plan
from gyrostab.ingest.columns.plan_draft import Column
from gyrostab.ingest.columns.stamps import CLOCK_PERIODS, NAT, continue_clock, find_turn
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.schema import SIGNAL_UNITS
from gyrostab.store.lazy import read_slice
from gyrostab.store.row_inspection import RowInspection
from gyrostab.store.write import declare_counts

#: Largest number of bad places that a note lists.
MAX_NAMED_PLACES = 10
#: Largest share of unreadable rows; a file with more is refused.
MAX_UNREADABLE_SHARE = 0.5

#: Rows at the beginning in which a code for missing values is searched.
_CODE_ROWS = 2**18
#: A code repeats, is farther from the other values than their range times this number, and the
#: latter have at least so many different values, unlike the states of a switch.
_MIN_CODE_REPEATS, _MIN_CODE_DISTANCE, _MIN_READINGS = 3, 3.0, 16

Values = dict[int, NDArray[np.float64]]
Locate = Callable[[Sequence[int]], list[str]]


class ClockBlock(NamedTuple):
    """Stamps of a block whose clock may begin again after a day or a week [ns]."""

    first: int
    last: int  # continued within the block
    typical: float  # step
    turns: list[int]  # periods that were added within the block


_NO_ROWS = np.empty(0, np.int64)


class ConvertedBlock(NamedTuple):
    """A converted block of rows for `RawLogBuilder.add`; row numbers count from its first row."""

    rows: int
    #: Column number -> values in the inner unit, or a piece of the column.
    block: dict[int, NDArray[Any] | Piece]
    #: Column number -> number of missing values, range of the others in the unit of the file, and
    #: whether these are whole numbers.
    ranges: dict[int, tuple[int, float, float, bool]]
    #: Unreadable rows, and other rows with an unreadable gyro cell.
    bad_rows: NDArray[np.int64] = _NO_ROWS
    cell_rows: NDArray[np.int64] = _NO_ROWS
    #: Unreadable cells, and unreadable gyro cells of `cell_rows`.
    bad_cells: int = 0
    cells: int = 0
    #: Range of the stamps of readable rows [ns since 1970]; high < low if there are none.
    low: int = np.iinfo(np.int64).max
    high: int = NAT
    #: Findings of the scan pass over values that stay in the file.
    inspection: RowInspection | None = None
    clock: ClockBlock | None = None


class _Places:
    """Number of bad places, and the names of the first ones."""

    def __init__(self) -> None:
        self.total, self.names = 0, list[str]()

    def add(self, rows: NDArray[np.int64], locate: Locate) -> None:
        self.total += len(rows)
        if room := MAX_NAMED_PLACES - len(self.names):
            self.names += locate(rows[:room].tolist())

    def describe(self) -> str:
        """Join the names: ``lines 7, 8, 9 and others``."""
        kind, names = self.names[0].split(" ")[0], self.names
        numbers = ", ".join(name.removeprefix(f"{kind} ") for name in names)
        return (
            f"{kind}{'s' * (len(names) > 1)} {numbers}{' and others' * (self.total > len(names))}"
        )


class RawLogBuilder:
    """Collect the blocks of one file and build its raw log."""

    def __init__(self, plan: Plan, options: ReadOptions):
        self.plan, self.options = plan, options
        self.time = plan.time
        self.gyro, self.channels = plan.of("gyro"), plan.of("channel")
        dtypes: dict[int, Any] = {
            column.source: np.float64 for column in [*self.gyro, *self.channels]
        }
        if self.time is not None:
            dtypes[self.time.source] = np.int64
        self.buffers = Buffers(dtypes, rows_of=[column.source for column in self.gyro])
        self.grids: dict[int, tuple[float, float] | None] = {
            column.source: (1.0, 1.0) for column in [*self.gyro, *self.channels]
        }  # step and divisor to try when packing; None: not packed
        self.bad_cells = self.cells = 0
        self.bad_rows, self.cell_rows = _Places(), _Places()
        self.missing = dict[int, int]()  # missing values by column number
        self.first_bad_row = ""
        self.bad_index: list[NDArray[np.int64]] = []
        self.low, self.high = np.iinfo(np.int64).max, NAT
        unit = None if self.time is None else self.time.time_unit
        self.continues_clock = unit is not None and unit.epoch is None
        self.last_stamp: int | None = None
        self.turns: list[int] = []
        self.inspections: list[RowInspection] = []
        self.whole: dict[int, tuple[float, float] | None] = {
            column.source: (0.0, 0.0) for column in [*self.gyro, *self.channels]
        }

    def prepare(
        self, values: Values, stamps: NDArray[np.int64] | None, *, words: int = 0
    ) -> ConvertedBlock:
        """Convert one block and pack its columns where possible; thread-safe.

        Parameters
        ----------
        values : dict of int to ndarray
            Column number -> values in the unit of the file, NaN where unreadable or empty. Changed
            in place.
        stamps : ndarray of int64 or None
            Stamps [ns since 1970], `NAT` where unreadable; None without a time column.
        words : int
            Channel cells whose text is not a number (empty cells do not count).
        """
        size = (
            len(next(iter(values.values()))) if values else len(stamps) if stamps is not None else 0
        )
        if size == 0:
            return ConvertedBlock(0, {}, {})
        bad = stamps == NAT if stamps is not None else np.zeros(size, dtype=bool)
        block: dict[int, NDArray[Any] | Piece] = {}
        bad_cells, ranges, masks = words + int(np.count_nonzero(bad)), {}, []
        for column in [*self.gyro, *self.channels]:
            source = column.source
            block[source], ranges[source] = self._convert_column(column, values[source])
            # packed values are not converted yet: infinite ones are not NaN
            masks.append(~np.isfinite(values[source]) if ranges[source][0] else None)
        gyro = [mask for mask in masks[: len(self.gyro)] if mask is not None]
        bad_cells += sum(int(np.count_nonzero(mask)) for mask in gyro)
        if self.gyro and all(mask is not None for mask in masks):
            bad = bad | np.logical_and.reduce([mask for mask in masks if mask is not None])
        bad_rows = np.flatnonzero(bad)
        cell_masks = [mask & ~bad for mask in gyro]
        cell_rows = np.flatnonzero(np.logical_or.reduce(cell_masks)) if cell_masks else _NO_ROWS
        cells = sum(int(np.count_nonzero(mask)) for mask in cell_masks)
        low, high, clock = np.iinfo(np.int64).max, NAT, None
        if stamps is not None and self.time is not None:
            if self.continues_clock:
                stamps, clock = _continue_block(stamps)
            block[self.time.source] = _pack_stamps(stamps)
            good = stamps[~bad] if bad_rows.size else stamps
            if len(good):
                low, high = int(good.min()), int(good.max())
        return ConvertedBlock(
            size, block, ranges, bad_rows, cell_rows, bad_cells, cells, low, high, clock=clock
        )

    def add(
        self,
        converted: ConvertedBlock,
        locate: Locate | None = None,
        quote: Callable[[int], str] | None = None,
    ) -> None:
        """Add one block.

        Parameters
        ----------
        locate : callable, optional
            Row numbers within the block -> names of the rows for messages.
        quote : callable, optional
            Row number within the block -> the row as it is written, for messages.
        """
        if converted.rows == 0:
            return
        if converted.clock is not None:
            converted = self._continue_clock(converted, converted.clock)
        first = self.buffers.rows
        locate = locate or (lambda rows: [f"row {first + row}" for row in rows])
        self.bad_cells += converted.bad_cells
        for source, (missing, low, high, is_whole) in converted.ranges.items():
            self.missing[source] = self.missing.get(source, 0) + missing
            span = self.whole[source]
            if span is not None and missing < converted.rows:
                self.whole[source] = (min(span[0], low), max(span[1], high)) if is_whole else None
        if converted.bad_rows.size:
            if quote is not None and not self.bad_rows.total:
                self.first_bad_row = f": {quote(int(converted.bad_rows[0])):.100}"
            self.bad_rows.add(converted.bad_rows, locate)
            self.bad_index.append(converted.bad_rows + first)
        if converted.cell_rows.size:
            self.cell_rows.add(converted.cell_rows, locate)
            self.cells += converted.cells
        self.low, self.high = min(self.low, converted.low), max(self.high, converted.high)
        self.inspections += [converted.inspection] if converted.inspection is not None else []
        self.buffers.add(converted.block)

    def _continue_clock(self, converted: ConvertedBlock, clock: ClockBlock) -> ConvertedBlock:
        """Continue the stamps of a block where those of the blocks before it end."""
        shift, last = sum(self.turns), self.last_stamp
        turn = 0 if last is None else find_turn(clock.first + shift - last, clock.typical)
        shift += turn
        self.turns += [*([turn] if turn else []), *clock.turns]
        self.last_stamp = clock.last + shift
        if shift == 0 or self.time is None:
            return converted
        piece = converted.block[self.time.source]
        stamps = np.empty(converted.rows, np.int64)
        if isinstance(piece, Piece):
            piece.read_into(0, stamps)
        else:
            stamps[:] = piece
        stamps[stamps != NAT] += shift
        block = {**converted.block, self.time.source: _pack_stamps(stamps)}
        has_range = converted.low <= converted.high
        low, high = converted.low + shift * has_range, converted.high + shift * has_range
        return converted._replace(block=block, low=low, high=high)

    def _convert_column(
        self, column: Column, values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | Piece, tuple[int, float, float, bool]]:
        """Convert a column to the inner unit, packed or in place; return it and its range."""
        from gyrostab.kernels.encoding.compact import find_grid, pack_counts
        from gyrostab.kernels.encoding.rows import clean_column

        grid = self.grids[column.source]
        for search in (True, False):
            if grid is None:
                break
            counts = np.empty(values.size, np.int32)
            fits, missing, low, high, is_whole = pack_counts(values, *grid, counts)
            if fits:
                self.grids[column.source] = grid
                piece = CountsPiece(counts, grid, column.factor, column.offset)
                return piece, (missing, low, high, is_whole)
            grid = find_grid(values) if search else None
        self.grids[column.source] = None  # not on a grid: do not try later blocks
        missing, low, high, is_whole = clean_column(values, column.factor, column.offset)
        return values, (missing, low, high, is_whole)

    def _packing_of(self, columns: Sequence[Column]) -> dict[str, Any]:
        """Return the encoding of columns of whole numbers with one factor; empty for others."""
        spans = [self.whole[column.source] for column in columns]
        factors = {column.factor for column in columns if column.offset == 0.0}
        if None in spans or len(factors) != 1 or any(column.offset != 0.0 for column in columns):
            return {}
        reach = max(max(-low, high) for low, high in filter(None, spans))
        dtype = next((kind for kind in ("int16", "int32") if reach < np.iinfo(kind).max), None)
        return declare_counts(dtype, factors.pop()) if dtype else {}

    def finish(self, notes: Sequence[str] = ()) -> xr.Dataset:
        """Return the raw log.

        Raises
        ------
        FormatError
            When there is no row, or more than half of them are unreadable.
        """
        name, rows = self.plan.path.name, self.buffers.rows
        if rows == 0:
            raise FormatError(
                f"{name}: there is a header but no data row below it; copy it again, or check "
                "what the logger wrote"
            )
        if self.bad_rows.total > MAX_UNREADABLE_SHARE * rows:
            share, first = self.bad_rows.total / rows, self.bad_rows.names[0]
            suspects = (
                "the separator, the columns that --map names and the unit of time (stamps lie "
                "in the years 1678 to 2262)"
            )
            raise FormatError(
                f"{name}: {100 * share:.0f} % of {rows} rows are unreadable, the first is {first}"
                f"{self.first_bad_row}; look at it, and check {suspects}"
            )
        columns = self.buffers.finish()
        notes = [*notes, *self._describe_codes(columns)]
        stamps = self._finish_stamps(columns)
        dataset = self._make_dataset(
            {key: as_lazy(column) for key, column in columns.items()}, stamps
        )
        dataset.attrs.update(
            source_files=[name],
            row_start=[0],
            notes=[
                f"{name}: {note}"
                for note in [*self.plan.notes, *notes, *self._describe_faults(rows)]
            ],
            unreadable_rows=self.bad_rows.total,
            unreadable_cells=self.bad_cells,
            unmatched_options=list(self.plan.unmatched),
            headers=[summary.header for summary in self.plan.summaries],
        )
        return dataset

    def _finish_stamps(self, columns: dict[int, NDArray[Any] | PiecewiseColumn]) -> Any:
        if self.time is None:
            return None
        stamps = columns.pop(self.time.source)
        if self.bad_index and self.low <= self.high:
            rows = np.concatenate(self.bad_index)
            written = stamps[rows] if isinstance(stamps, np.ndarray) else stamps.take_rows(rows)
            outside = (written < self.low) | (written > self.high)
            rows = rows[outside & (written != NAT)]  # a number in a bad row is not a stamp
            if isinstance(stamps, np.ndarray):
                stamps[rows] = NAT
            else:
                stamps.changed, stamps.value = rows, NAT
        return as_lazy(stamps.view("datetime64[ns]"))

    def _make_dataset(self, columns: dict[int, Any], stamps: Any) -> xr.Dataset:
        data: dict[str, Any] = {}
        coords: dict[str, Any] = {}
        if self.gyro and self.plan.signal is not None:
            axes = [column.name for column in self.gyro]
            stack = stack_as_rows(
                [columns[column.source] for column in self.gyro], self.inspections
            )
            data[self.plan.signal] = (
                ("axis", "row"),
                stack,
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
        if self.options.rate is not None:
            dataset.attrs["declared_rate_hz"] = float(self.options.rate)
        if self.options.start is not None and stamps is None:
            dataset.attrs["start"] = self.options.start
        return dataset

    def _describe_codes(self, columns: dict[int, Any]) -> list[str]:
        """Return notes on values that repeat far outside all others, as codes for missing do."""
        notes = []
        for column in [*self.gyro, *self.channels]:
            head = np.asarray(read_slice(columns[column.source], 0, _CODE_ROWS), dtype=np.float64)
            code = _find_code(head[np.isfinite(head)])
            if code is not None:
                number, written = int((head == code).sum()), (code - column.offset) / column.factor
                notes.append(
                    f"{column.header!r} is {written:.10g} in {number} of the first {len(head)} "
                    "rows, far outside all other values; if that is a code for a missing value, "
                    "replace it by nan before the log is read"
                )
        return notes

    def _describe_faults(self, rows: int) -> list[str]:
        notes = []
        if self.bad_rows.total:
            notes.append(
                f"{self.bad_rows.total} of {rows} rows are unreadable: {self.bad_rows.describe()}"
            )
        empty = sum(self.missing.get(column.source, 0) == rows for column in self.gyro)
        cells = self.cells - empty * (rows - self.bad_rows.total)  # empty axes have a note later
        if cells:
            places = "" if empty else f": {self.cell_rows.describe()}"
            notes.append(
                f"{cells} gyro cells hold no number in rows that are readable otherwise{places}"
            )
        if self.turns:
            period = "a day" if max(self.turns) == CLOCK_PERIODS[0] else "a week"
            times = f"{len(self.turns)} time{'s' * (len(self.turns) > 1)}"
            notes.append(
                f"the clock begins again after {period} ({times}) "
                "without a pause; the stamps are continued"
            )
        if self.options.start is not None and self.time is not None:
            notes.append("--start is not used: the file has its own time column")
        return notes


def _find_code(values: NDArray[np.float64]) -> float | None:
    """Return the lowest or highest value if it repeats far outside all others; zero is a reading.

    Examples
    --------
    >>> _find_code(np.r_[np.arange(100.0), [-999.25] * 3]), _find_code(np.arange(100.0))
    (-999.25, None)
    """
    for code in (values.min(initial=np.inf), values.max(initial=-np.inf)):
        others = values[values != code]
        if code == 0 or not _MIN_CODE_REPEATS <= len(values) - len(others) < len(others):
            continue
        low, high = others.min(), others.max()
        if max(low - code, code - high) > _MIN_CODE_DISTANCE * (high - low) and (
            len(np.unique(others)) >= _MIN_READINGS
        ):
            return float(code)
    return None


def _continue_block(
    stamps: NDArray[np.int64],
) -> tuple[NDArray[np.int64], ClockBlock | None]:
    """Continue the readable stamps of a block; the block is None without any."""
    is_good = stamps != NAT
    good = stamps if is_good.all() else stamps[is_good]
    if not good.size:
        return stamps, None
    continued, turns, typical = continue_clock(good)
    clock = ClockBlock(int(good[0]), int(continued[-1]), typical, turns)
    if turns and good is not stamps:
        stamps = stamps.copy()
        stamps[is_good] = continued
        return stamps, clock
    return continued if turns else stamps, clock


def _pack_stamps(stamps: NDArray[np.int64]) -> NDArray[np.int64] | EvenStampsPiece:
    from gyrostab.kernels.encoding.compact import even_steps

    table = even_steps(stamps)
    return stamps if table is None else EvenStampsPiece(table, len(stamps))


def summary_of(
    plan: Plan,
    form: str,
    rows: int | None,
    *,
    head: Sequence[int] | NDArray[np.int64] = (),
    tail: Sequence[int] | NDArray[np.int64] = (),
    notes: Sequence[str] = (),
) -> FileSummary:
    """Summarise a file without reading all of its data.

    Parameters
    ----------
    plan : Plan
        Role and unit of each column, and the problems that prevent reading.
    head, tail : sequence of int
        Stamps at the two ends [ns since 1970], `NAT` where unreadable.
    """
    first, last = (
        next((np.datetime64(int(stamp), "ns") for stamp in end if stamp != NAT), None)
        for end in (head, tail[::-1])
    )
    return FileSummary(
        path=plan.path,
        format=form,
        columns=plan.summaries,
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
