"""The linear algebra of these tests uses one thread, as in the commands."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def _one_thread(one_thread: None) -> None:
    """Avoid that the threads of several processes wait for each other."""
