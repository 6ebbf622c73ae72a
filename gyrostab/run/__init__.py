"""The main job: logs to product in parts that survive a stop, in threads, in processes or on a cluster."""

from gyrostab.run.checks import check_windows
from gyrostab.run.core import load_log, run, samples_of
from gyrostab.store.output import check_output

__all__ = ["check_output", "check_windows", "load_log", "run", "samples_of"]
