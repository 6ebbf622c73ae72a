"""Many regular logs to one: their samples on one grid, lazily, with one table of gaps."""

from gyrostab.join.core import join_logs, log_span
from gyrostab.join.notes import some, together

__all__ = ["join_logs", "log_span", "some", "together"]
