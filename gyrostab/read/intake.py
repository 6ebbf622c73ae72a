"""From blocks of columns, as a format delivers them, to the raw log: units, counts of what is unreadable, labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.read.buffers import SPILL_BYTES, Buffers, Stored, lazily, put, take, together
from gyrostab.read.columns import Column, Plan
from gyrostab.read.options import FileSummary, ReadOptions
from gyrostab.read.stamps import NAT
from gyrostab.schema import SIGNAL_UNITS

__all__ = ["Intake", "summary_of"]

#: How many bad places a note names.
NAMED = 10
#: A file with a larger share of unreadable rows is refused.
MAX_UNREADABLE = 0.5

Values = dict[int, NDArray[np.float64]]
Locate = Callable[[Sequence[int]], list[str]]


def _row_names(first: int) -> Locate:
    return lambda rows: [f"row {first + row}" for row in rows]


class Intake:
    """Collects the blocks of one file and makes the raw log of them.

    Parameters
    ----------
    plan : Plan
        What each column is.
    options : ReadOptions
        What the user said.
    limit : int
        Size [bytes] above which the columns move to disk.
    """

    def __init__(self, plan: Plan, options: ReadOptions, *, limit: int = SPILL_BYTES):
        self.plan, self.options = plan, options
        self.time = plan.time
        self.gyro, self.channels = plan.of("gyro"), plan.of("channel")
        dtypes: dict[int, Any] = {column.source: np.float64 for column in [*self.gyro, *self.channels]}
        if self.time is not None:
            dtypes[self.time.source] = np.int64
        self.buffers = Buffers(dtypes, limit=limit, rows_of=[column.source for column in self.gyro])
        self.bad_rows = self.bad_cells = self.cells = self.cell_rows = 0
        self.bad_places: list[str] = []
        self.cell_places: list[str] = []
        self.bad_index: list[NDArray[np.int64]] = []
        self.low, self.high = np.iinfo(np.int64).max, NAT
        self.whole: dict[int, tuple[float, float] | None] = {column.source: (0.0, 0.0) for column in [*self.gyro, *self.channels]}

    def add(self, values: Values, stamps: NDArray[np.int64] | None, *, words: int = 0, locate: Locate | None = None) -> None:
        """Take one block.

        Parameters
        ----------
        values : dict of int to ndarray
            Column number -> values in the file's unit, NaN where unreadable or empty. Changed in place.
        stamps : ndarray of int64 or None
            Stamps [ns since 1970], `NAT` where unreadable; None without a time column.
        words : int
            Cells of channels that hold something that is no number (empty ones are not filled, which is no fault).
        locate : callable, optional
            Row numbers within the block -> how a message calls them.
        """
        size = len(next(iter(values.values()))) if values else len(stamps) if stamps is not None else 0
        if size == 0:
            return
        locate = locate or _row_names(self.buffers.rows)
        bad = stamps == NAT if stamps is not None else np.zeros(size, dtype=bool)
        missing = [self._clean(column, values[column.source]) for column in [*self.gyro, *self.channels]]
        self.bad_cells += words + int(np.count_nonzero(bad))
        gyro_missing = [mask for mask in missing[: len(self.gyro)] if mask is not None]
        self.bad_cells += sum(int(np.count_nonzero(mask)) for mask in gyro_missing)
        if self.gyro and all(mask is not None for mask in missing):
            bad = bad | np.logical_and.reduce([mask for mask in missing if mask is not None])
        if bad.any():
            self._note_rows(np.flatnonzero(bad), locate)
        self._note_cells([mask & ~bad for mask in gyro_missing], locate)
        block: dict[int, Any] = dict(values)
        if stamps is not None and self.time is not None:
            good = stamps[~bad] if bad.any() else stamps
            if len(good):
                self.low, self.high = min(self.low, int(good.min())), max(self.high, int(good.max()))
            block[self.time.source] = stamps
        self.buffers.add(block)

    def _clean(self, column: Column, values: NDArray[np.float64]) -> NDArray[np.bool_] | None:
        """Convert to the inner unit in place, infinities to NaN; the mask of what is missing, or None when nothing is."""
        from gyrostab.kernels.rows import clean_column

        missing, low, high, whole = clean_column(values, column.factor, column.offset)
        span = self.whole[column.source]
        if span is not None and missing < len(values):
            self.whole[column.source] = (min(span[0], low), max(span[1], high)) if whole else None
        return np.isnan(values) if missing else None

    def _packing(self, columns: Sequence[Column]) -> dict[str, Any]:
        """The encoding of columns of whole numbers that have one factor; none for others."""
        spans = [self.whole[column.source] for column in columns]
        factors = {column.factor for column in columns if column.offset == 0.0}
        if None in spans or len(factors) != 1 or any(column.offset != 0.0 for column in columns):
            return {}
        reach = max(max(-low, high) for low, high in filter(None, spans))
        dtype = next((kind for kind in ("int16", "int32") if reach < np.iinfo(kind).max), None)
        return {"dtype": np.dtype(dtype), "scale_factor": factors.pop()} if dtype else {}

    def _note_rows(self, rows: NDArray[np.int64], locate: Locate) -> None:
        self.bad_rows += len(rows)
        self.bad_index.append(rows + self.buffers.rows)
        if len(self.bad_places) < NAMED:
            self.bad_places += locate([int(row) for row in rows[: NAMED - len(self.bad_places)]])

    def _note_cells(self, masks: list[NDArray[np.bool_]], locate: Locate) -> None:
        if masks and (rows := np.flatnonzero(np.logical_or.reduce(masks))).size:
            self.cells += sum(int(np.count_nonzero(mask)) for mask in masks)
            self.cell_rows += len(rows)
            if len(self.cell_places) < NAMED:
                self.cell_places += locate([int(row) for row in rows[: NAMED - len(self.cell_places)]])

    def finish(self, notes: Sequence[str] = ()) -> xr.Dataset:
        """The raw log.

        Raises
        ------
        FormatError
            When there is no row, or more than half of them are unreadable.
        """
        name, rows = self.plan.path.name, self.buffers.rows
        if rows == 0:
            raise FormatError(f"{name}: there is a header but no data row below it; copy it again, or look at what the logger wrote")
        if self.bad_rows > MAX_UNREADABLE * rows:
            share, first = self.bad_rows / rows, self.bad_places[0]
            what = "the separator, the columns that --map names and the units of time"
            raise FormatError(f"{name}: {share:.0%} of {rows} rows are unreadable, the first is {first}; look at it, and check {what}")
        columns = self.buffers.finish()
        stamps = self._stamps(columns)
        dataset = self._dataset({key: lazily(column) for key, column in columns.items()}, stamps)
        dataset.attrs.update(
            source_files=[name],
            row_start=[0],
            notes=[f"{name}: {note}" for note in [*self.plan.notes, *notes, *self._faults(rows)]],
            unreadable_rows=self.bad_rows,
            unreadable_cells=self.bad_cells,
            unmatched_options=list(self.plan.unmatched),
            headers=[summary.header for summary in self.plan.summaries],
        )
        return dataset

    def _stamps(self, columns: dict[int, NDArray[Any] | Stored]) -> Any:
        if self.time is None:
            return None
        stamps = columns.pop(self.time.source)
        if self.bad_index and self.low <= self.high:
            rows = np.concatenate(self.bad_index)
            written = take(stamps, rows)
            put(stamps, rows[(written < self.low) | (written > self.high)], NAT)  # scratch numbers in a junk row are no stamp
        return lazily(stamps.view("datetime64[ns]"))

    def _dataset(self, columns: dict[int, Any], stamps: Any) -> xr.Dataset:
        data: dict[str, Any] = {}
        coords: dict[str, Any] = {}
        if self.gyro and self.plan.signal is not None:
            axes = [column.name for column in self.gyro]
            stack = together([columns[column.source] for column in self.gyro])
            data[self.plan.signal] = (("axis", "row"), stack, {"units": SIGNAL_UNITS[self.plan.signal]}, self._packing(self.gyro))
            coords["axis"] = np.array(axes, dtype=str)
        for column in self.channels:
            data[column.name] = ("row", columns[column.source], {"units": column.units}, self._packing([column]))
        if stamps is not None:
            coords["time"] = ("row", stamps)
        dataset = xr.Dataset(data, coords=coords, attrs={"kind": self.plan.kind} if self.plan.kind else {})
        if self.options.rate is not None:
            dataset.attrs["declared_rate_hz"] = float(self.options.rate)
        if self.options.start is not None and stamps is None:
            dataset.attrs["start"] = self.options.start
        return dataset

    def _faults(self, rows: int) -> list[str]:
        notes = []
        if self.bad_rows:
            notes.append(f"{self.bad_rows} of {rows} rows are unreadable: {_places(self.bad_places, self.bad_rows)}")
        if self.cell_places:
            where = _places(self.cell_places, self.cell_rows)
            notes.append(f"{self.cells} gyro cells hold no number in rows that are readable otherwise: {where}")
        if self.options.start is not None and self.time is not None:
            notes.append("--start is not used: the file has its own time column")
        return notes


def _places(places: Sequence[str], total: int) -> str:
    """Bad places in a row: ``lines 7, 8, 9 and others``."""
    kind = places[0].split(" ")[0]
    numbers = ", ".join(place.removeprefix(f"{kind} ") for place in places)
    return f"{kind}{'s' * (len(places) > 1)} {numbers}{' and others' * (total > len(places))}"


def summary_of(
    plan: Plan,
    form: str,
    rows: int | None,
    *,
    head: Sequence[int] | NDArray[np.int64] = (),
    tail: Sequence[int] | NDArray[np.int64] = (),
    notes: Sequence[str] = (),
) -> FileSummary:
    """What a cheap look tells of a file.

    Parameters
    ----------
    plan : Plan
        What each column is, and what stands in the way of reading.
    form : str
        Name of the format.
    rows : int or None
        Number of rows, where it is known.
    head, tail : sequence of int
        Stamps at the two ends [ns since 1970], `NAT` where unreadable.
    notes : sequence of str
        What the reader says.
    """
    first, last = (next((np.datetime64(int(stamp), "ns") for stamp in end if stamp != NAT), None) for end in (head, tail[::-1]))
    return FileSummary(
        path=plan.path,
        format=form,
        columns=plan.summaries,
        axes=tuple(column.name for column in plan.of("gyro")),
        channels=tuple(column.name for column in plan.of("channel")),
        first=first,
        last=last,
        n_rows=rows,
        notes=(*(f"{plan.path.name}: {note}" for note in [*notes, *plan.notes]), *(str(problem) for problem in plan.problems)),
    )
