"""Convert files and arrays to regular logs.

A reader of `gyrostab.ingest.formats` reads a file into a raw log: rows with their stamps as
written. `gyrostab.ingest.grid` places the rows on a uniform time axis with NaN at every missing
sample.

Each format is one module with ``matches(path)``, ``scan(path, options)`` and ``read(path,
options)``, found by the entry point group ``gyrostab.readers``; another package adds a format with
such an entry point.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gyrostab.ingest.files import readers as readers
    from gyrostab.ingest.files import scan_file as scan_file
    from gyrostab.ingest.gap_table import gap_variables as gap_variables
    from gyrostab.ingest.options import ColumnSummary as ColumnSummary
    from gyrostab.ingest.options import FileSummary as FileSummary
    from gyrostab.ingest.options import ReadOptions as ReadOptions
    from gyrostab.ingest.reading import read_channel as read_channel
    from gyrostab.ingest.reading import read_log as read_log

#: Public name -> module, imported on first use: the command line needs `limits` only.
_MODULES = {
    "ColumnSummary": "options",
    "FileSummary": "options",
    "ReadOptions": "options",
    "gap_variables": "gap_table",
    "read_channel": "reading",
    "read_log": "reading",
    "readers": "files",
    "scan_file": "files",
}

__all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
