"""Many regular logs to one: their samples on one grid, lazily, with one table of gaps."""

from gyrostab.join.axes import group_axes, split_axes
from gyrostab.join.core import join_logs, log_span
from gyrostab.join.notes import some, together

__all__ = ["group_axes", "join_logs", "log_span", "some", "split_axes", "together"]
