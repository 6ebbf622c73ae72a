"""Condition of tests that compare figures with stored pictures."""

from __future__ import annotations

import matplotlib
import pytest

from packaging.version import Version

__all__ = ["same_layout"]

#: Earlier versions of matplotlib place labels and legends elsewhere.
same_layout = pytest.mark.skipif(
    Version(matplotlib.__version__) < Version("3.11"),
    reason="the stored pictures are of matplotlib 3.11",
)
