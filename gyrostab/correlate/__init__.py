"""Coefficients and window means against temperature or another channel."""

from __future__ import annotations

from gyrostab.correlate.core import correlate
from gyrostab.correlate.dataset import join
from gyrostab.correlate.table import format_correlation

__all__ = ["correlate", "format_correlation", "join"]
