"""Many regular logs to one: their samples on one grid, lazily, with one table of gaps."""

from gyrostab.ingest.concat.axes import group_axes, split_axes
from gyrostab.ingest.concat.core import join_logs, log_span
from gyrostab.ingest.concat.notes import some, together

__all__ = ["group_axes", "join_logs", "log_span", "some", "split_axes", "together"]
