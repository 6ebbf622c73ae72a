"""The whole analysis in parts that survive a stop, in threads, in processes or on a cluster."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gyrostab.jobs.job import is_lock as is_lock
    from gyrostab.jobs.job import lock_job as lock_job
    from gyrostab.jobs.load import load_log as load_log
    from gyrostab.jobs.schedule import open_pool as open_pool
    from gyrostab.jobs.schedule import run_calls as run_calls

__all__ = ["is_lock", "load_log", "lock_job", "open_pool", "run_calls"]

_HOME = {
    "is_lock": "job",
    "load_log": "load",
    "lock_job": "job",
    "open_pool": "schedule",
    "run_calls": "schedule",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
