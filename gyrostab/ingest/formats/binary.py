"""Raw binary files: records by a layout file, or messages of a known sensor.

See `gyrostab.ingest.formats.layout` for the layouts. Messages are numbered by their counter: the
time follows from it and ``--rate``, and lost messages are gaps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view

from gyrostab.arrays import Ints
from gyrostab.errors import FormatError, OptionError
from gyrostab.ingest.formats.layout import (
    Field,
    RecordLayout,
    find_layout_file,
    find_messages,
    find_record_layout,
    layout_path,
    unwrap_counter,
)
from gyrostab.ingest.formats.tables import Table, TableColumn, TablesOfFile, make_reader
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.time.grid import check_span, grid_times

SUFFIXES = (".bin", ".raw")


def matches(path: Path) -> bool:
    """Return whether the file has a layout file, or its suffix is ``.bin`` or ``.raw``."""
    return (
        path.is_file()
        and path.suffix.lower() != ".toml"
        and (path.suffix.lower() in SUFFIXES or has_layout(path))
    )


def has_layout(path: Path) -> bool:
    """Return whether a file has a layout file named after it."""
    return not path.is_dir() and layout_path(path).is_file()


def list_layouts(paths: Iterable[Path]) -> list[Path]:
    """List the layout files by which files are read, each once."""
    places = (find_layout_file(path) for path in paths if matches(path))
    return list(dict.fromkeys(filter(None, places)))


def _make_tables(path: Path, options: ReadOptions, *, needs_rate: bool) -> TablesOfFile:
    """Return the table of all records; messages are searched in the whole file."""
    layout = find_record_layout(path)
    rows, extra_bytes = divmod(path.stat().st_size - layout.header, layout.size)
    starts = None
    if layout.sync and rows > 0:
        raw = np.memmap(path, dtype=np.uint8, mode="r", offset=layout.header)
        starts = find_messages(raw, layout.sync, layout.size)
        rows, extra_bytes = len(starts), len(raw) - len(starts) * layout.size
    if rows < 1:
        raise FormatError(
            f"{path.name}: it holds no record by the layout {layout.place} "
            f"({path.stat().st_size} bytes, but {layout.header} of header and {layout.size} a "
            "record); copy it again, or correct the layout"
        )
    fetch = partial(_read_field, path, layout, starts)
    stamps, notes = _count_time(path, layout, fetch, rows, options, needs_rate=needs_rate)
    if layout.sync:
        notes.insert(0, f"read as messages of {layout.place}{layout.note and ': '}{layout.note}")
    if extra_bytes:
        expected = "part of a message" if layout.sync else f"a whole record of {layout.size} bytes"
        where = "" if layout.sync else "the last "
        notes.append(f"{where}{extra_bytes} bytes are not {expected}; is the layout right?")
    columns = [TableColumn((field.name,), partial(fetch, field)) for field in layout.fields]
    return [Table(rows, columns, stamps)], notes


_scan_tables, _read_tables = make_reader(
    "binary",
    partial(_make_tables, needs_rate=True),
    find_heads=partial(_make_tables, needs_rate=False),
)


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise fields, number of records, and first and last stamps; searches all messages."""
    return _scan_tables(path, _date_first_message(path, options))


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a binary file; see `gyrostab.ingest.read_log`."""
    return _read_tables(path, _date_first_message(path, options))


def _date_first_message(path: Path, options: ReadOptions) -> ReadOptions:
    """Count numbered messages from ``--start``, as their first one is at zero."""
    if options.epoch is not None or find_record_layout(path).counter is None:
        return options
    return replace(options, start=None, epoch=options.start)


def _count_time(
    path: Path,
    layout: RecordLayout,
    fetch: Any,
    rows: int,
    options: ReadOptions,
    *,
    needs_rate: bool,
) -> tuple[TableColumn | None, list[str]]:
    """Return the stamps by the counter of the layout, and a note on lost messages."""
    counter = layout.counter
    if counter is None or (options.rate is None and not needs_rate):
        return None, []
    if options.rate is None:
        raise OptionError(
            f"{path.name}: the messages of {layout.place} are numbered; give their rate with "
            f"--rate HZ (and the time of the first with --start){layout.note and '; '}{layout.note}"
        )
    counts = unwrap_counter(fetch(counter, 0, rows), counter.turn)
    steps, times = np.unique(np.diff(counts), return_counts=True)
    step = max(int(steps[times.argmax()]) if len(steps) else 1, 1)
    numbers = (counts + step // 2) // step
    lost = int(numbers[-1]) + 1 - rows
    notes = [f"by their counter, {lost} messages were lost"] if lost > 0 else []
    rate = float(options.rate)
    check_span(0, rate, int(numbers[-1]) + 1, path.name)
    return TableColumn(("time",), grid_times(0, rate, numbers), "ns"), notes


def _read_field(
    path: Path, layout: RecordLayout, starts: Ints | None, field: Field, begin: int, stop: int
) -> Any:
    """Return the values of a field in a range of records, which begin at `starts`, or adjoin."""
    raw = np.memmap(path, dtype=np.uint8, mode="r", offset=layout.header)
    width = field.dtype.itemsize
    if starts is None:
        first = begin * layout.size + field.offset
        values = np.array(np.ndarray(stop - begin, field.dtype, raw, first, layout.size))
    else:
        values = sliding_window_view(raw, width)[starts[begin:stop] + field.offset]
        values = values.view(field.dtype)[:, 0]
    if field.dtype.kind != "V":
        return values.astype(values.dtype.newbyteorder("="))
    cells = values.view(np.uint8).reshape(-1, width)
    wide = np.pad(cells, ((0, 0), (0, 1) if layout.order == ">" else (1, 0)))
    return (wide.view(f"{layout.order}i4")[:, 0] >> 8).astype(np.int32)
