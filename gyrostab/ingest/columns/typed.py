"""Shared code of formats with typed columns: batches of rows, conversion of numbers and stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.ingest.columns.plan import Column, Plan
from gyrostab.ingest.columns.raw_log import ConvertedBlock, RawLogBuilder, summary_of
from gyrostab.ingest.columns.stamps import (
    NANOSECOND,
    NAT,
    add_weeks,
    cells_to_ns,
    integers_to_ns,
    numbers_to_ns,
)
from gyrostab.ingest.options import FileSummary
from gyrostab.store.threads import map_in_order
from gyrostab.time.stamps import to_nanoseconds

#: Largest number of rows, and of bytes of all columns, that are converted at one time.
BATCH_ROWS = 2**20
BATCH_BYTES = 2**26
END_ROWS = 64

Batch = TypeVar("Batch")
#: Column number, first row, row after the last one -> values.
Fetch = Callable[[int, int, int], Any]


def _to_floats(values: Any) -> tuple[Floats, int]:
    """Convert values to float64, NaN where missing, and count the cells that are not numbers."""
    if np.ma.isMaskedArray(values):
        mask = np.ma.getmaskarray(values)
        plain, words = _to_floats(np.ma.getdata(values))
        plain[mask] = np.nan
        return plain, words
    array = np.asarray(values)
    if array.dtype.kind in "biuf":
        with np.errstate(invalid="ignore"):  # damaged bytes may be a signalling NaN
            fresh = array.flags.owndata and array.flags.writeable
            return array.astype(np.float64, copy=not fresh), 0
    out = np.full(array.shape, np.nan)
    if array.dtype.kind == "c":
        return out, array.size
    words = 0
    for index, value in enumerate(array.ravel()):
        try:
            out[index] = float(value) if value is not None else np.nan
        except (TypeError, ValueError):
            words += bool(str(value).strip())
    return out, words


def to_stamps(values: Any, column: Column) -> Ints:
    """Convert a column of dates, numbers or text to stamps [ns since 1970]."""
    mask = np.ma.getmaskarray(values) if np.ma.isMaskedArray(values) else None
    array = np.ma.getdata(values) if mask is not None else np.asarray(values)
    unit = column.time_unit
    if array.dtype.kind == "M":
        stamps = to_nanoseconds(array, far_as_nat=True)
        if unit is None:
            stamps = integers_to_ns(stamps, NANOSECOND, column.epoch)
    elif unit is None or array.dtype.kind not in "iuf":
        stamps = cells_to_ns(
            ["" if value is None else str(value) for value in array],
            unit,
            column.epoch,
            column.date_order,
        )
    else:
        stamps = numbers_to_ns(array, unit, column.epoch)
    return stamps if mask is None else np.where(mask, NAT, stamps)


def read_columns(plan: Plan, rows: int, fetch: Fetch, *, notes: Sequence[str] = ()) -> xr.Dataset:
    """Build the raw log of columns that can be fetched by ranges of rows."""
    step = batch_rows(len(plan.columns))
    spans = ((start, min(start + step, rows)) for start in range(0, rows, step))

    def take(span: tuple[int, int]) -> dict[int, Any]:
        return {column.source: fetch(column.source, *span) for column in plan.columns}

    return read_column_batches(plan, spans, take, notes=notes)


def read_column_batches(
    plan: Plan,
    batches: Iterable[Batch],
    take: Callable[[Batch], dict[int, Any]],
    *,
    notes: Sequence[str] = (),
    parallel: bool = False,
) -> xr.Dataset:
    """Build the raw log of batches of rows; `take` returns the columns of one by their numbers.

    `take` is thread-safe if `parallel`.
    """
    builder = RawLogBuilder(plan)

    def convert(batch: Batch) -> ConvertedBlock:
        columns, values, words = take(batch), {}, 0
        for column in [*builder.weeks, *builder.gyro, *builder.channels]:
            values[column.source], not_numbers = _to_floats(columns[column.source])
            if column.role == "channel":
                words += not_numbers + int(np.isinf(values[column.source]).sum())
        time = builder.time
        stamps = None if time is None else to_stamps(columns[time.source], time)
        return builder.prepare(values, stamps, words=words)

    for converted in map_in_order(convert, batches) if parallel else map(convert, batches):
        builder.add(converted)
    return builder.finish(notes)


def batch_rows(columns: int) -> int:
    """Return the number of rows to convert at one time.

    Examples
    --------
    >>> batch_rows(4), batch_rows(1000)
    (1048576, 8384)
    """
    return min(max(BATCH_BYTES // (8 * max(columns, 1)), 2**10), BATCH_ROWS) // 8 * 8


def float32_note(plan: Plan, dtypes: Sequence[Any]) -> list[str]:
    """Return a warning if the stamps are stored in single precision."""
    time = plan.time
    if time is None or str(dtypes[time.source]) not in ("float32", "float", ">f4", "<f4"):
        return []
    return [
        f"the stamps in {time.header!r} are stored as float32, which keeps 7 digits; expect "
        "jitter, or store them as float64 or integers"
    ]


def summarise_columns(
    form: str, plan: Plan, rows: int, fetch: Fetch, notes: Sequence[str] = ()
) -> FileSummary:
    """Summarise a file, with the first and last stamps fetched from the two ends."""
    time = plan.time
    if time is None or not rows:
        return summary_of(plan, form, rows, notes=notes)
    ends = []
    for span in ((0, min(END_ROWS, rows)), (max(0, rows - END_ROWS), rows)):
        stamps = to_stamps(fetch(time.source, *span), time)
        for column in plan.of("week"):
            stamps = add_weeks(stamps, _to_floats(fetch(column.source, *span))[0])
        ends.append(stamps)
    head, tail = ends
    return summary_of(plan, form, rows, head=head, tail=tail, notes=notes)
