"""LAS well logs (versions 1.2 and 2, text): curves by their mnemonics, with the header's units.

A curve ``TIME``, or an index of dates and times, is the time; if the file also has a curve ``DATE``
(real-time logs), ``TIME`` is the time of day.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyrostab.arrays import Array, Ints
from gyrostab.errors import FormatError
from gyrostab.ingest.columns.dates import as_iso, find_order, is_iso
from gyrostab.ingest.columns.headers import is_time_unit
from gyrostab.ingest.columns.stamps import NAT, floats_to_ns, parse_time_unit, texts_to_ns
from gyrostab.ingest.formats.recognise import read_head
from gyrostab.ingest.formats.tables import (
    Table,
    TableColumn,
    TablesOfFile,
    first_texts,
    library,
    make_reader,
)
from gyrostab.ingest.options import ReadOptions
from gyrostab.time.stamps import to_nanoseconds

# Date fields in units of curves -> codes of `datetime.strptime`.
_DATE_CODES = {"yyyy": "%Y", "yy": "%y", "mmm": "%b", "mm": "%m", "dd": "%d"}
#: The line of a header that lets commas separate values; lasio takes them for decimal points.
_COMMAS = re.compile(rb"(?im)^\s*DLM\s*\.\s*COMMA")
#: A cell with a date and a time of day, such as ``14-Mar-26/08:00:00.5``.
_DATE_AND_TIME = re.compile(r"^(\S+?)[T_/:;-](\d{1,2}:\d\d:\d\d(?:\.\d+)?)Z?$")


def matches(path: Path) -> bool:
    """Return whether the file is a ``.las`` well log, not a LAS point cloud."""
    lines = read_head(path).splitlines() if path.suffix.lower() == ".las" else ()
    return any(line.lstrip().startswith(b"~") for line in lines)


def _read_curves(path: Path, options: ReadOptions) -> TablesOfFile:
    if _COMMAS.search(read_head(path)):
        raise FormatError(
            f"{path.name}: commas separate its values (DLM. COMMA, of LAS 3), which is not read; "
            "export the log as LAS 2 or CSV"
        )
    lasio = library("lasio", path, extra="las")
    curves = list(lasio.read(str(path)).curves)
    rows = len(curves[0].data) if curves else 0
    clocks, dates = _find_clock(path, curves, options) if rows else ([], None)
    columns = [
        TableColumn(
            ("" if any(curve is clock for clock in clocks) else str(curve.mnemonic),),
            np.asarray(curve.data),
            None if any(map(is_iso, first_texts(curve.data))) else curve.unit,
            cells=first_texts(curve.data),
        )
        for curve in curves
    ]
    stamps = None if dates is None else TableColumn(("time",), dates, cells=first_texts(dates))
    return [Table(rows, columns, stamps)], ()


def _find_clock(
    path: Path, curves: list[Any], options: ReadOptions
) -> tuple[list[Any], Array | None]:
    """Return the curves of dates and times with their stamps; none where a number counts time."""
    by_name = {curve.mnemonic.upper(): curve for curve in curves}
    time_curves = [by_name[name] for name in ("TIME", "DATETIME") if name in by_name]
    mapped = {name.strip().upper() for name in options.map}
    pair = {"DATE", "TIME"} <= by_name.keys() - mapped
    for curve in time_curves if pair else [*time_curves, *curves[:1]]:
        if any(map(is_iso, first_texts(curve.data))):
            return [curve], np.asarray(curve.data)
        cells = [_DATE_AND_TIME.match(str(cell).strip()) for cell in curve.data]
        if any(cells[:50]):
            days, times = ([cell[part] if cell else "" for cell in cells] for part in (1, 2))
            unit = re.split("[ T_]", str(curve.unit or ""))[0]
            return [curve], _to_stamps(path, curve.mnemonic, days, unit, times)
    if not pair:
        return [], None
    date, time = by_name["DATE"], by_name["TIME"]
    unit = str(date.unit or "").strip()
    days = [  # numbers have lost their leading zeros
        str(int(cell)).zfill(len(unit))
        if isinstance(cell, float) and np.isfinite(cell)
        else str(cell).strip()
        for cell in date.data
    ]
    stamps = _to_stamps(path, "DATE", days, unit, time.data, str(time.unit or "").strip())
    return [date, time], stamps


def _to_stamps(
    path: Path, name: str, days: list[str], date_unit: str, times: Any, time_unit: str = ""
) -> NDArray[np.datetime64]:
    """Combine dates and times of day to stamps."""
    start = _parse_days(days, date_unit)
    if start is None:
        fix = f"write the dates as 2026-03-14, or drop the curve with --map {name}=-"
        raise FormatError(
            f"{path.name}: the order of day and month in the curve {name} ({days[0]!r}) is not "
            f"clear; {fix}"
        )
    clock = pd.Series(times)
    if clock.dtype.kind not in "iuf":
        since = pd.to_timedelta(clock.astype(str).str.strip(), errors="coerce").to_numpy(
            dtype="timedelta64[ns]"
        )
    else:
        numbers = clock.to_numpy(dtype=np.float64)
        if "HHMM" in time_unit.upper():
            numbers = numbers if "SS" in time_unit.upper() else numbers * 100
            numbers = numbers // 10000 * 3600 + numbers // 100 % 100 * 60 + numbers % 100
        unit = parse_time_unit(time_unit if is_time_unit(time_unit) else "s")
        since = floats_to_ns(numbers, unit, 0).view("timedelta64[ns]")
    return np.asarray(start.view("datetime64[ns]") + since)


def _parse_days(days: list[str], unit: str) -> Ints | None:
    """Return the beginnings of days [ns since 1970], by the unit of the curve or by their form."""
    if re.search(r"(?i)yy", unit):
        code = re.sub(
            r"(?i)y{4}|y{2}|m{3}|m{2}|d{2}", lambda part: _DATE_CODES[part[0].lower()], unit
        )
        dates = pd.to_datetime(pd.Series(days), format=code, errors="coerce").to_numpy()
        if not np.isnat(dates).all():
            return to_nanoseconds(dates, far_as_nat=True)
    order = find_order(days[:1000])
    stamps = texts_to_ns([as_iso(day, order or "") or day for day in days])
    return None if order is None or (stamps == NAT).all() else stamps


scan, read = make_reader("las", _read_curves)
