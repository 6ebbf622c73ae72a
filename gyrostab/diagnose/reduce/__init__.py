"""Reduction of a log to block statistics, the only input of all later steps."""
