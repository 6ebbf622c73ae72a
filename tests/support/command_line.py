"""A small log, and calls of the command line: for its tests."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gyrostab.cli import main

RATE = 100
N_TRUE = 0.02  # deg/sqrt(h)


def write_log(
    path: Path,
    seconds: float = 60.0,
    *,
    header: str = "time [s],gyro_x [deg/h],gyro_y [deg/h]",
    change: Callable | None = None,
) -> Path:
    """A log of white rate noise of `N_TRUE`; `change` may spoil its list of rows."""
    noise = (
        60.0
        * N_TRUE
        * np.sqrt(RATE)
        * np.random.default_rng(5).standard_normal((round(seconds * RATE), 2))
    )
    rows = [f"{index / RATE:.2f},{x:.4f},{y:.4f}" for index, (x, y) in enumerate(noise)]
    path.write_text("\n".join([header, *(change(rows) if change else rows)]) + "\n")
    return path


def call(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def stopped(code: str, *, exit_code: int, says: str) -> None:
    """Check that `code`, in a separate process, ends with this exit code and these words."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == exit_code, done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr


WINDOW = ("--window", "20s", "--step", "5s")
