"""What the formats of typed columns share: batches of rows, numbers of any type to float64, stamps to nanoseconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.read.buffers import SPILL_BYTES
from gyrostab.read.columns import Column, Plan
from gyrostab.read.intake import Intake, summary_of
from gyrostab.read.options import FileSummary, ReadOptions
from gyrostab.read.stamps import NAT, cells_to_ns, dates_to_ns, floats_to_ns, integers_to_ns, looks_iso, signed_counts

__all__ = ["Fetch", "holds_dates", "read_columns", "summarise", "to_floats", "to_stamps"]

BATCH_ROWS = 2**20
ENDS = 64

#: Column number, first row, row after the last one -> values.
Fetch = Callable[[int, int, int], Any]


def to_floats(values: Any) -> tuple[NDArray[np.float64], int]:
    """Values as a new float64 array with NaN for what is missing, and how many cells hold something that is no number."""
    if np.ma.isMaskedArray(values):
        mask = np.ma.getmaskarray(values)
        plain, words = to_floats(np.ma.getdata(values))
        plain[mask] = np.nan
        return plain, words
    array = np.asarray(values)
    if array.dtype.kind in "biuf":
        return array.astype(np.float64), 0
    out = np.full(array.shape, np.nan)
    words = 0
    for index, value in enumerate(array.ravel()):
        try:
            out[index] = float(value) if value is not None else np.nan
        except (TypeError, ValueError):
            words += bool(str(value).strip())
    return out, words


def to_stamps(values: Any, column: Column, options: ReadOptions) -> NDArray[np.int64]:
    """Stamps [ns since 1970] of a column of dates, numbers or text."""
    mask = np.ma.getmaskarray(values) if np.ma.isMaskedArray(values) else None
    array = np.ma.getdata(values) if mask is not None else np.asarray(values)
    unit = column.time_unit
    if array.dtype.kind == "M":
        stamps = dates_to_ns(array)
    elif unit is None or array.dtype.kind not in "iuf":
        stamps = cells_to_ns(["" if value is None else str(value) for value in array], unit, options.epoch_ns)
    elif array.dtype.kind == "f":
        stamps = floats_to_ns(array, unit, options.epoch_ns)
    else:
        stamps = integers_to_ns(signed_counts(array), unit, options.epoch_ns)
    return stamps if mask is None else np.where(mask, NAT, stamps)


def holds_dates(values: Any) -> bool:
    """Whether a sample of a column is dates, or text that looks like dates."""
    array = np.asarray(values)
    return array.dtype.kind == "M" or (array.dtype.kind in "OUST" and any(isinstance(v, str) and looks_iso(v) for v in array[:50]))


def read_columns(
    plan: Plan, options: ReadOptions, rows: int, fetch: Fetch, *, notes: Sequence[str] = (), limit: int = SPILL_BYTES
) -> xr.Dataset:
    """The raw log of columns that can be fetched by ranges of rows."""
    intake = Intake(plan.check(), options, limit=limit)
    for start in range(0, rows, BATCH_ROWS):
        stop = min(start + BATCH_ROWS, rows)
        take_batch(intake, options, {column.source: fetch(column.source, start, stop) for column in plan.columns})
    return intake.finish(notes)


def take_batch(intake: Intake, options: ReadOptions, batch: dict[int, Any]) -> None:
    """Convert one batch of columns and hand it to the intake."""
    values, words = {}, 0
    for column in [*intake.gyro, *intake.channels]:
        values[column.source], odd = to_floats(batch[column.source])
        words += odd if column.role == "channel" else 0
    stamps = None if intake.time is None else to_stamps(batch[intake.time.source], intake.time, options)
    intake.add(intake.prepare(values, stamps, words=words))


def float32_note(plan: Plan, dtypes: Sequence[Any]) -> list[str]:
    """A warning when the stamps are stored with 24 bits only."""
    time = plan.time
    if time is None or str(dtypes[time.source]) not in ("float32", "float", ">f4", "<f4"):
        return []
    return [
        f"the stamps in {time.header!r} are stored as float32, which keeps 7 digits; expect jitter, or store them as float64 or integers"
    ]


def summarise(form: str, plan: Plan, options: ReadOptions, rows: int, fetch: Fetch, notes: Sequence[str] = ()) -> FileSummary:
    """A summary with the first and last stamps fetched from the two ends."""
    time = plan.time
    if time is None or not rows:
        return summary_of(plan, form, rows, notes=notes)
    head, tail = (to_stamps(fetch(time.source, *span), time, options) for span in ((0, min(ENDS, rows)), (max(0, rows - ENDS), rows)))
    return summary_of(plan, form, rows, head=head, tail=tail, notes=notes)
