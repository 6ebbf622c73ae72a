"""LAS well logs (versions 1.2 and 2, text): a curve by its mnemonic, with the unit of its header. A curve ``TIME`` is the time."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError
from gyrostab.read.arrays import holds_dates
from gyrostab.read.buffers import SPILL_BYTES
from gyrostab.read.optional import library
from gyrostab.read.options import FileSummary, ReadOptions
from gyrostab.read.tables import Table, read_tables, scan_tables

__all__ = ["matches", "read", "scan"]


def matches(path: Path) -> bool:
    """Whether the file is called ``.las`` and begins with a section, as well logs do and clouds of laser points do not."""
    if not path.is_file() or path.suffix.lower() != ".las":
        return False
    with path.open("rb") as file:
        return any(line.lstrip().startswith(b"~") for line in file.read(8192).splitlines())


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Curves, rows, and the stamps of the two ends."""
    return scan_tables(path, "las", [_table(path)], options)


def read(path: Path, options: ReadOptions, *, limit: int = SPILL_BYTES) -> xr.Dataset:
    """The raw log of a LAS file; see `gyrostab.read.read_log`."""
    return read_tables(path, [_table(path)], options, limit=limit)


def _table(path: Path) -> Table:
    lasio = library("lasio", path, extra="las")
    try:
        curves = lasio.read(str(path)).curves
    except Exception as error:  # of many kinds on damaged files
        raise FormatError(f"{path.name}: this LAS file cannot be read ({error}); it may be cut off, copy it again") from error
    units = tuple(None if holds_dates(curve.data) else str(curve.unit or "").strip() or None for curve in curves)
    columns = tuple(partial(_part, np.asarray(curve.data)) for curve in curves)
    dates = next((curve.data for curve in curves if curve.mnemonic.upper() in ("TIME", "DATETIME") and holds_dates(curve.data)), None)
    names = tuple("" if dates is not None and curve.data is dates else str(curve.mnemonic) for curve in curves)
    rows = len(curves[0].data) if len(curves) else 0
    return Table(rows, names, units, columns, None if dates is None else partial(_part, np.asarray(dates)))


def _part(values: Any, start: int, stop: int) -> Any:
    return values[start:stop]
