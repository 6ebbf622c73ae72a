"""Readers: logs of any format to the raw log, rows with their stamps as they were written.

Each format is one module with ``matches(path)``, ``scan(path, options)`` and ``read(path, options)``, found by the entry
point group ``gyrostab.readers``; another package adds a format by declaring such an entry point.
"""

from gyrostab.read.channel import read_channel
from gyrostab.read.files import read_log, readers, scan_file
from gyrostab.read.options import ColumnSummary, FileSummary, ReadOptions

__all__ = ["ColumnSummary", "FileSummary", "ReadOptions", "read_channel", "read_log", "readers", "scan_file"]
