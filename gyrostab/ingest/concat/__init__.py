"""Concatenate regular logs lazily: their samples on one grid, with one table of gaps."""

from gyrostab.ingest.concat.axes import group_axes, split_axes
from gyrostab.ingest.concat.core import absence_notes, concatenate_logs, merge_notes
from gyrostab.ingest.concat.grid import log_span

__all__ = [
    "absence_notes",
    "concatenate_logs",
    "group_axes",
    "log_span",
    "merge_notes",
    "split_axes",
]
