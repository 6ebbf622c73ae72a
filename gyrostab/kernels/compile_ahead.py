"""Compilation of kernels in another process, while this one reads and computes.

numba compiles one function at a time in a process. What another process compiles is loaded from the
cache afterwards. If that process fails, this one compiles what it needs.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from numba.core import event

#: Event of numba that is triggered while this process waits for the other.
WAITING = "gyrostab:compile"

_running: list[subprocess.Popen[bytes]] = []


def start_compilation(module: str, kernel: Any) -> None:
    """Run a module that compiles kernels in another process, unless the cache has `kernel`.

    No process is started on a single processor core, where numba has no cache to write to, or while
    another one runs.

    Parameters
    ----------
    module : str
        Module to run, as with ``python -m``.
    kernel : numba dispatcher
        Kernel that it compiles last.
    """
    stats = getattr(kernel, "stats", None)  # absent where numba is switched off
    folder = stats and stats.cache_path
    if not folder or (os.cpu_count() or 1) < 2 or any(other.poll() is None for other in _running):
        return
    line = kernel.py_func.__code__.co_firstlineno  # files of an earlier source have another
    version = f"py{sys.version_info[0]}{sys.version_info[1]}"
    if any(Path(folder).glob(f"*.{kernel.__name__}-{line}.{version}.nbi")):
        return
    nothing = subprocess.DEVNULL
    command = [sys.executable, "-P", "-m", module]
    try:
        process = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing)
    except OSError:
        return
    _running.append(process)
    atexit.register(process.terminate)  # of a command that stops before it needs the kernels


def await_compilation() -> None:
    """Wait for the process that `start_compilation` started, and notify listeners of `WAITING`."""
    for process in _running:  # several threads may wait for the same process
        if process.poll() is None:
            with event.trigger_event(WAITING):
                process.wait()
