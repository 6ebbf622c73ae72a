"""Inspect every column of a file, whether or not it can be read as a gyro log."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.errors import FormatError, GyrostabError
from gyrostab.ingest.columns.dates import DAY_FIRST, EITHER_FIRST, MONTH_FIRST
from gyrostab.ingest.columns.plan_time import UNREADABLE
from gyrostab.ingest.files import read_file, scan_file
from gyrostab.ingest.formats.text import read_text_head
from gyrostab.ingest.options import ColumnSummary, FileSummary, ReadOptions

#: Largest number of columns to inspect; a sensor log has tens of them.
MAX_COLUMNS = 100
#: Rows that are inspected at one time.
CHUNK_ROWS = 2**18
#: Share of whole numbers above which a column holds counts; tolerates invalid first rows.
WHOLE_SHARE = 0.999
#: Larger numbers are fill values; the squares of smaller ones can be summed.
MAX_MAGNITUDE = 1e100
#: Blocks of a chunk in which the mean step is taken.
MEAN_STEP_BLOCKS = 64
# Median of |x - y| of two normal values with one standard deviation: sqrt(2) times 0.6745, the
# upper quartile of the normal law.
_MEDIAN_STEP = 0.6745 * math.sqrt(2.0)


@dataclass(frozen=True, kw_only=True)
class ColumnInspection(ColumnSummary):
    """Statistics of one column, in the unit of the file; NaN if the column holds no numbers.

    `scatter` is the standard deviation of a sample about its neighbours, from the median of the
    steps; `held` is the share of samples equal to the previous one, `rising` the share of upward
    steps, `pace` the mean step (median of blocks), `rows` the number of filled rows, and `rate_hz`
    the number of filled rows a second, NaN if the time is unknown.
    """

    rows: int = 0
    low: float = math.nan
    high: float = math.nan
    mean: float = math.nan
    std: float = math.nan
    scatter: float = math.nan
    held: float = 0.0
    rising: float = 0.0
    whole: bool = False
    first: float = math.nan
    pace: float = math.nan
    rate_hz: float = math.nan


@dataclass(frozen=True)
class FileInspection:
    """Inspection of a file: summary, columns, number of rows, and time column if known.

    `date_spans_s` are the lengths of the file by the order of its dates, if they can be read in two
    ways.
    """

    summary: FileSummary
    columns: tuple[ColumnInspection, ...]
    rows: int
    time: ColumnSummary | None
    rate_hz: float
    notes: tuple[str, ...] = ()
    date_spans_s: dict[str, float] = field(default_factory=dict)


def inspect_file(path: str | Path, options: ReadOptions | None = None) -> FileInspection:
    r"""Inspect the first `MAX_COLUMNS` columns of a file, in any format that gyrostab reads.

    `FormatError` when the file cannot be read at all, or holds no numbers.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "log.csv"
    >>> _ = path.write_text("n,wx\n" + "".join(f"{n},{n % 2}\n" for n in range(9)))
    >>> [(column.key, column.low, column.high) for column in inspect_file(path).columns]
    [('n', 0.0, 8.0), ('wx', 0.0, 1.0)]
    """
    path, options = Path(path), options or ReadOptions()
    summary = scan_file(path, options)
    time = next(
        (column for column in summary.columns if column.role == "time" and column.unit is not None),
        None,
    )
    data_columns = [column for column in summary.columns if column is not time]
    names = {f"column_{place}": column for place, column in enumerate(data_columns[:MAX_COLUMNS])}
    chosen = {column.key: f"{name} [1]" for name, column in names.items()}
    chosen.update({column.key: "-" for column in data_columns[MAX_COLUMNS:]})
    chosen.update({key: "-" for key, target in options.map.items() if target in ("", "-")})
    has_unit = time is not None and time.unit not in (None, "ISO 8601", *UNREADABLE)
    unit = {"time": str(time.unit)} if time is not None and has_unit else {}
    is_column = time is not None and (time.key != "time" or time.unit in UNREADABLE)
    if time is not None and (is_column or "time" in options.map):
        # else stamps of the format, not a named column
        chosen[time.key] = "-" if time.unit in UNREADABLE else "time"
    reading = replace(
        options,
        map=chosen,
        unit=unit,
        rate=options.rate or 1.0,
        start=None,
        channels_only=True,
        channel=(),
        kind=None,
    )
    spans: dict[str, float] = {}
    if time is not None and time.unit == EITHER_FIRST:
        spans = {
            order: _span_s(path, replace(reading, unit={"time": order}))
            for order in sorted((DAY_FIRST, MONTH_FIRST), reverse=_has_half_days(path))
        }
        reading = replace(reading, unit={"time": min(spans, key=spans.__getitem__)})
    try:
        log = read_file(path, reading)
    except GyrostabError as error:
        raise FormatError(str(error)) from error
    dims = {name: str(log[name].dims[0]) if name in log.data_vars else "row" for name in names}
    rates = {dim: _row_rate(log, dim) for dim in {"row", *dims.values()}}
    columns = [
        _inspect_column(column, log, name, rates[dims[name]]) for name, column in names.items()
    ]
    if not any(column.rows for column in columns):
        raise FormatError(f"{path.name}: there is no number in any of its columns; is it a log?")
    further = len(data_columns) - MAX_COLUMNS
    notes = [f"{further} further columns are not inspected"] if further > 0 else []
    rows = max((log.sizes[str(log[name].dims[0])] for name in names if name in log), default=0)
    return FileInspection(summary, tuple(columns), rows, time, rates["row"], tuple(notes), spans)


def _has_half_days(path: Path) -> bool:
    """Return whether a text file begins with times such as ``10:00 PM``, of the United States."""
    return bool(re.search(r":\d\d\s*[AaPp][Mm]\b", read_text_head(path)))


def _span_s(path: Path, options: ReadOptions) -> float:
    """Return the time from the first to the last stamp; infinite if most cannot be read."""
    try:
        stamps = np.asarray(read_file(path, options)["time"].values)
    except FormatError:
        return math.inf
    return float((np.nanmax(stamps) - np.nanmin(stamps)) / np.timedelta64(1, "s"))


def _row_rate(log: xr.Dataset, dim: str) -> float:
    """Return the number of rows a second, NaN without stamps."""
    clock = "time" if dim == "row" else dim
    if clock not in log.variables or dim not in log.sizes:
        return math.nan
    paces = []
    for start in range(0, log.sizes[dim], CHUNK_ROWS):
        stamps = np.asarray(log[clock].isel({dim: slice(start, start + CHUNK_ROWS)}).values)
        good = stamps[~np.isnat(stamps)]
        if good.size > 1:
            paces += _mean_steps((good - good[0]) / np.timedelta64(1, "s"))
    pace = float(np.median(paces)) if paces else math.nan
    return 1.0 / pace if pace > 0 else math.nan


def _mean_steps(values: Floats) -> list[float]:
    """Return the mean steps of several blocks; their median ignores restarts, gaps, bursts."""
    blocks = np.array_split(values, min(MEAN_STEP_BLOCKS, max(1, values.size // 8)))
    return [float((block[-1] - block[0]) / (block.size - 1)) for block in blocks if block.size > 1]


def _value_chunks(variable: xr.DataArray) -> Iterator[Floats]:
    dim = str(variable.dims[0])
    for start in range(0, variable.size, CHUNK_ROWS):
        values = np.asarray(
            variable.isel({dim: slice(start, start + CHUNK_ROWS)}).values, dtype=np.float64
        )
        yield values[np.abs(values) < MAX_MAGNITUDE]


def _inspect_column(
    column: ColumnSummary, log: xr.Dataset, name: str, row_rate_hz: float
) -> ColumnInspection:
    chunks: list[tuple[float, ...]] = []
    paces: list[float] = []
    for values in _value_chunks(log[name]) if name in log.data_vars else ():
        if not values.size:
            continue
        first = values[0]
        away = values - (chunks[0][0] if chunks else first)
        steps = np.diff(values)
        scatter = 0.0
        if steps.size:  # most samples may repeat the previous one
            typical = float(np.median(np.abs(steps))) / _MEDIAN_STEP
            scatter = steps.size * (typical or float(np.sqrt(np.mean(steps**2) / 2)))
        is_whole, is_held, is_rising = values == np.rint(values), steps == 0, steps > 0
        counts = values.size, steps.size, is_whole.sum(), is_held.sum(), is_rising.sum()
        sums = away.sum(), (away**2).sum(), scatter
        chunks.append((first, values.min(), values.max(), *sums, *counts))
        paces += _mean_steps(values)
    described = ColumnInspection(**{**vars(column), "key": column.key or column.header})
    if not chunks:
        return replace(described, rate_hz=0.0 * row_rate_hz)
    table = np.array(chunks, dtype=np.float64)
    total, squares, scatters, rows, steps_seen, wholes, held, rising = table[:, 3:].sum(axis=0)
    return replace(
        described,
        rows=int(rows),
        low=float(table[:, 1].min()),
        high=float(table[:, 2].max()),
        mean=float(table[0, 0] + total / rows),
        std=math.sqrt(max(0.0, squares / rows - (total / rows) ** 2)),
        scatter=float(scatters / steps_seen) if steps_seen else math.nan,
        held=float(held / max(1, steps_seen)),
        rising=float(rising / max(1, steps_seen)),
        whole=bool(wholes > WHOLE_SHARE * rows),
        first=float(table[0, 0]),
        pace=float(np.median(paces)) if paces else math.nan,
        rate_hz=row_rate_hz * float(rows) / log[name].size,
    )
