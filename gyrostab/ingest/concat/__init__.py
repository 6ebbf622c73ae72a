"""Concatenate regular logs lazily: their samples on one grid, with one table of gaps."""

from gyrostab.ingest.concat.axes import group_axes, split_axes
from gyrostab.ingest.concat.core import concatenate_logs, log_span
from gyrostab.ingest.concat.notes import absence_notes, merge_notes

__all__ = [
    "absence_notes",
    "concatenate_logs",
    "group_axes",
    "log_span",
    "merge_notes",
    "split_axes",
]
