"""LAS well logs (versions 1.2 and 2, text): curves by their mnemonics, with the header's units.

A curve ``TIME`` is the time; if the file also has a curve ``DATE`` (real-time logs), ``TIME`` is
the time of day.
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.stamps import dates_to_ns
from gyrostab.ingest.columns.typed import holds_dates
from gyrostab.ingest.formats.tables import Table, library, read_tables, scan_tables, sliced
from gyrostab.ingest.options import FileSummary, ReadOptions

__all__ = ["matches", "read", "scan"]

# Date fields in units of curves -> codes of `datetime.strptime`.
_DATE_CODES = {"yyyy": "%Y", "yy": "%y", "mmm": "%b", "mm": "%m", "dd": "%d"}


def matches(path: Path) -> bool:
    """Return whether the file is a ``.las`` well log, not a LAS point cloud."""
    if not path.is_file() or path.suffix.lower() != ".las":
        return False
    with path.open("rb") as file:
        return any(line.lstrip().startswith(b"~") for line in file.read(8192).splitlines())


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise curves, rows, and first and last stamps."""
    return scan_tables(path, "las", [_read_curves(path, options)], options)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a LAS file; see `gyrostab.ingest.read_log`."""
    return read_tables(path, [_read_curves(path, options)], options)


def _read_curves(path: Path, options: ReadOptions) -> Table:
    lasio = library("lasio", path, extra="las")
    curves = lasio.read(str(path)).curves
    units = tuple(
        None if holds_dates(curve.data) else str(curve.unit or "").strip() or None
        for curve in curves
    )
    columns = tuple(sliced(np.asarray(curve.data)) for curve in curves)
    clocks = [
        curve
        for curve in curves
        if curve.mnemonic.upper() in ("TIME", "DATETIME") and holds_dates(curve.data)
    ][:1]
    dates = clocks[0].data if clocks else None
    curves_by_name = {
        curve.mnemonic.upper(): curve
        for curve in curves
        if curve.mnemonic.upper() in ("TIME", "DATE")
    }
    named = {name.strip().upper() for name in options.map}
    if not clocks and len(curves_by_name) == 2 and not named & curves_by_name.keys():
        clocks = list(curves_by_name.values())
        dates = _date_and_time(path, curves_by_name["DATE"], curves_by_name["TIME"])
    names = tuple(
        "" if any(curve is clock for clock in clocks) else str(curve.mnemonic) for curve in curves
    )
    rows = len(curves[0].data) if len(curves) else 0
    return Table(
        rows,
        names,
        units,
        columns,
        None if dates is None else sliced(np.asarray(dates)),
    )


def _date_and_time(path: Path, date: Any, time: Any) -> NDArray[np.datetime64]:
    """Combine a curve of dates and a curve of times of day to stamps."""
    import pandas as pd

    days = [
        str(int(cell)) if isinstance(cell, float) and np.isfinite(cell) else str(cell).strip()
        for cell in date.data
    ]
    order = _date_order(str(date.unit or ""), days[:1000])
    if order is None:
        fix = "write the dates as 2026-03-14, or drop the curve with --map DATE=-"
        raise FormatError(
            f"{path.name}: the order of day and month in the curve DATE ({days[0]!r}) is not "
            f"clear; {fix}"
        )
    start = dates_to_ns(
        pd.to_datetime(pd.Series(days), format=order, errors="coerce").to_numpy()
    ).view("datetime64[ns]")
    clock = pd.Series(time.data)
    if clock.dtype.kind not in "iuf":
        since = pd.to_timedelta(clock.astype(str).str.strip(), errors="coerce").to_numpy(
            dtype="timedelta64[ns]"
        )
    else:
        numbers = clock.to_numpy(dtype=np.float64)
        if "HHMM" in str(time.unit).upper():
            numbers = numbers // 10000 * 3600 + numbers // 100 % 100 * 60 + numbers % 100
        usable = np.isfinite(numbers)
        counts = np.rint(np.where(usable, numbers, 0.0) * 1e9).astype(np.int64)
        since = np.where(usable, counts, np.iinfo(np.int64).min).view("timedelta64[ns]")
    return np.asarray(start + since)


def _date_order(unit: str, days: list[str]) -> str | None:
    """Return the date format: that of the curve's unit, or the only one that fits."""
    unit_format = (
        re.sub(r"(?i)y{4}|y{2}|m{3}|m{2}|d{2}", lambda part: _DATE_CODES[part[0].lower()], unit)
        if re.search(r"(?i)yy", unit)
        else ""
    )
    known = (
        "%Y-%m-%d",
        "%Y%m%d",
        "%Y/%m/%d",
        "%d-%b-%y",
        "%d-%b-%Y",
        "%d/%b/%y",
        "%d/%b/%Y",
        "%d %b %Y",
    )
    for order in (unit_format, *known):
        if order and _has_date_format(order, days):
            return order
    unclear = [
        order
        for order in ("%d/%m/%Y", "%m/%d/%Y", "%d/%m/%y", "%m/%d/%y", "%d-%m-%Y", "%m-%d-%Y")
        if _has_date_format(order, days)
    ]
    return unclear[0] if len(unclear) == 1 else None


def _has_date_format(order: str, days: list[str]) -> bool:
    filled = [day for day in days if day and day.lower() != "nan"]
    try:
        for day in filled:
            datetime.strptime(day, order)
    except ValueError:
        return False
    return bool(filled)
