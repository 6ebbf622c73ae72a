"""Files and arrays to regular logs.

A reader of `gyrostab.ingest.formats` turns a file into a raw log: rows with their stamps as they
were written. `gyrostab.ingest.grid` places the rows on a uniform time axis with NaN at every
missing sample.

Each format is one module with ``matches(path)``, ``scan(path, options)`` and ``read(path,
options)``, found by the entry point group ``gyrostab.readers``; another package adds a format by
declaring such an entry point.
"""

from gyrostab.ingest.channel import read_channel
from gyrostab.ingest.files import read_log, readers, scan_file
from gyrostab.ingest.options import ColumnSummary, FileSummary, ReadOptions

__all__ = [
    "ColumnSummary",
    "FileSummary",
    "ReadOptions",
    "read_channel",
    "read_log",
    "readers",
    "scan_file",
]
