"""Build the raw log from blocks of columns: units, counts of unreadable cells, labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.clock import ClockBlock, TurningClock, continue_block
from gyrostab.ingest.columns.faults import Faults, Locate, Quote, describe_codes
from gyrostab.ingest.columns.pieces import (
    CHUNK_ROWS,
    Buffers,
    CountsPiece,
    EvenStampsPiece,
    InspectedRows,
    Piece,
    PiecewiseColumn,
    as_lazy,
)
from gyrostab.ingest.columns.plan import Plan
from gyrostab.ingest.columns.plan_draft import Column
from gyrostab.ingest.columns.stamps import NAT
from gyrostab.ingest.options import FileSummary
from gyrostab.schema import SIGNAL_UNITS
from gyrostab.store.lazy import make_dask
from gyrostab.store.row_inspection import RowInspection
from gyrostab.store.write import declare_counts

Values = dict[int, NDArray[np.float64]]

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


class RawLogBuilder:
    """Collect the blocks of one file and build its raw log."""

    def __init__(self, plan: Plan):
        self.plan, self.options = plan.check(), plan.options
        self.time = plan.time
        self.gyro, self.channels = plan.of("gyro"), plan.of("channel")
        dtypes: dict[int, Any] = {
            column.source: np.float64 for column in [*self.gyro, *self.channels]
        }
        if self.time is not None:
            dtypes[self.time.source] = np.int64
        self.buffers = Buffers(dtypes)
        self.grids: dict[int, tuple[float, float] | None] = {
            column.source: (1.0, 1.0) for column in [*self.gyro, *self.channels]
        }  # step and divisor to try when packing; None: not packed
        self.faults = Faults()
        self.low, self.high = np.iinfo(np.int64).max, NAT
        unit = None if self.time is None else self.time.time_unit
        self.continues_clock = unit is not None and unit.epoch is None
        self.clock = TurningClock()
        self.inspections: list[RowInspection] = []
        self.whole: dict[int, tuple[float, float] | None] = {
            column.source: (0.0, 0.0) for column in [*self.gyro, *self.channels]
        }

    def prepare(
        self, values: Values, stamps: NDArray[np.int64] | None, *, words: int = 0
    ) -> ConvertedBlock:
        """Convert one block and pack its columns where possible; thread-safe.

        `values` in the unit of the file by column number, NaN where unreadable or empty, are
        changed in place; `stamps` [ns since 1970] are `NAT` where unreadable; `words` counts the
        channel cells whose text is not a number (empty cells do not count).
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
                stamps, clock = continue_block(stamps)
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
        quote: Quote | None = None,
    ) -> None:
        """Add one block; messages name its rows by `locate` and `quote`."""
        if converted.rows == 0:
            return
        if converted.clock is not None:
            converted = self._shift_stamps(converted, self.clock.continue_from(converted.clock))
        for source, (missing, low, high, is_whole) in converted.ranges.items():
            span = self.whole[source]
            if span is not None and missing < converted.rows:
                self.whole[source] = (min(span[0], low), max(span[1], high)) if is_whole else None
        self.faults.add(converted, self.buffers.rows, locate, quote)
        self.low, self.high = min(self.low, converted.low), max(self.high, converted.high)
        self.inspections += [converted.inspection] if converted.inspection is not None else []
        self.buffers.add(converted.block)

    def _shift_stamps(self, converted: ConvertedBlock, shift: int) -> ConvertedBlock:
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
        """Return the raw log; `FormatError` if more than half of the rows are unreadable."""
        name, rows = self.plan.path.name, self.buffers.rows
        if rows == 0:
            raise FormatError(
                f"{name}: there is a header but no data row below it; copy it again, or check "
                "what the logger wrote"
            )
        self.faults.check(name, rows)
        columns = self.buffers.finish()
        notes = [
            *self.plan.notes,
            *notes,
            *describe_codes([*self.gyro, *self.channels], columns),
            *self.faults.describe(rows, self.gyro),
            *self.clock.describe(),
        ]
        if self.options.start is not None and self.time is not None:
            notes.append("--start is not used: the file has its own time column")
        stamps = self._finish_stamps(columns)
        dataset = self._make_dataset(
            {key: as_lazy(column) for key, column in columns.items()}, stamps
        )
        dataset.attrs.update(
            source_files=[name],
            row_start=[0],
            notes=[f"{name}: {note}" for note in notes],
            unreadable_rows=self.faults.rows.total,
            unreadable_cells=self.faults.cells,
            unmatched_options=list(self.plan.unmatched),
            headers=[summary.header for summary in self.plan.summaries],
        )
        return dataset

    def _finish_stamps(self, columns: dict[int, NDArray[Any] | PiecewiseColumn]) -> Any:
        if self.time is None:
            return None
        stamps = columns.pop(self.time.source)
        if self.faults.index and self.low <= self.high:
            rows = np.concatenate(self.faults.index)
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
            rows = [columns[column.source] for column in self.gyro]
            stack = (
                np.stack(rows)
                if isinstance(rows[0], np.ndarray)
                else make_dask(InspectedRows(rows, self.inspections), (1, CHUNK_ROWS))
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

    `head` and `tail` are stamps at the two ends [ns since 1970], `NAT` where unreadable.
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
