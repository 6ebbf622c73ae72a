"""Coefficients and window means against temperature or another channel."""

from __future__ import annotations

from gyrostab.correlate.core import correlate
from gyrostab.correlate.dataset import join
from gyrostab.correlate.judge import correlation_rows, format_correlation

__all__ = ["correlate", "correlation_rows", "format_correlation", "join"]
