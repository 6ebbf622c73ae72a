"""The whole analysis in parts that survive a stop, in threads, in processes or on a cluster."""

from gyrostab.jobs.job import is_lock, lock_job
from gyrostab.jobs.load import load_log
from gyrostab.jobs.schedule import open_pool, run_calls

__all__ = ["is_lock", "load_log", "lock_job", "open_pool", "run_calls"]
