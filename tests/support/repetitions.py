"""Cases that repeat a test with other random numbers."""

from __future__ import annotations

from typing import Any

import pytest


def first_of(*values: Any) -> list[Any]:
    """Return values of which `make test` takes the first, and `make test-full` the others too."""
    return [values[0], *(pytest.param(value, marks=pytest.mark.full) for value in values[1:])]
