"""Estimate of a run: its windows, and time, memory and size from a part that is computed."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gyrostab.allan.davar import davar_parts
from gyrostab.allan.plan import make_plan
from gyrostab.io.datasets import to_netcdf
from gyrostab.jobs.engine import compute_part
from gyrostab.jobs.load import check_run_options, load_log
from gyrostab.progress import watch_compiler
from gyrostab.time.durations import format_duration
from gyrostab.wording import format_rounded


def estimate_run(
    paths: Sequence[str | Path],
    *,
    reading: Mapping[str, Any],
    windows: Mapping[str, Any],
    fitting: Mapping[str, Any] | None,
    workers: int | None = None,
) -> Iterator[str]:
    """Describe what `gyrostab.jobs.run.run` would do, without writing its output.

    First the record, its windows and averaging times, which need few compiled kernels; then time,
    memory and size of the output.

    The first part is computed on one core; the processor time and the size of the rest are taken to
    be in proportion to the number of windows. Cores that are busy with other programs need longer.
    """
    check_run_options(reading=reading, windows=windows, fitting=fitting)
    with _measure_work() as work_s:
        log = load_log(paths, **reading)
        plan, parts = make_plan(log, **windows), davar_parts(log, **windows)
        rate = float(log.attrs["sampling_rate_hz"])
        total, first, tau = parts[-1].stop, parts[0], plan.taus
        yield "\n".join(
            [
                f"record     {format_duration(log.sizes['time'] / rate, ' ')} at {rate:.6g} Hz, "
                f"axes {', '.join(plan.signal['axis'].values)}",
                f"windows    {total} of {format_duration(plan.unit.window / rate, ' ')}, one every "
                f"{format_duration(plan.unit.step / rate, ' ')}, "
                f"in {len(parts)} part{'s' * (len(parts) > 1)}",
                f"averaging  {tau.size} times from {format_duration(tau[0], ' ')} to "
                f"{format_duration(tau[-1], ' ')}",
            ]
        )
        base = _measure_part(log, slice(0, 1), windows, fitting)  # compiles or loads the kernels
        opened = work_s()
        size = _measure_part(log, first, windows, fitting)
        share = total / first.stop
        worked = (work_s() - opened) * share
    cores = workers or os.cpu_count() or 1
    seconds = opened + worked / min(cores, len(parts))
    yield "\n".join(
        [
            f"time       about {_round_duration(seconds)} on {cores} idle cores "
            f"({_round_duration(opened + worked)} of processor time)",
            f"memory     {_peak_mb():.0f} MB with one core",
            f"output     about {format_rounded((base + (size - base) * share) / 1e6)} MB",
        ]
    )


def _round_duration(seconds: float) -> str:
    """Format a length of time to two digits, in its largest unit.

    Examples
    --------
    >>> _round_duration(43.21), _round_duration(1512.0)
    ('43 s', '25 min')
    """
    return format_duration(float(f"{seconds:.2g}"), " ")


@contextmanager
def _measure_work() -> Iterator[Callable[[], float]]:
    """Measure the processor time of this process [s], without what it spends on compiling.

    The run that follows does not compile again.
    """
    compiling_s = 0.0

    def follow_compiler(begins: bool) -> None:
        nonlocal compiling_s
        compiling_s += -time.process_time() if begins else time.process_time()

    with watch_compiler(follow_compiler) as watch:
        watch()
        yield lambda: time.process_time() - compiling_s


def _measure_part(log: Any, part: slice, windows: Any, fitting: Any) -> int:
    """Compute a part; return its size as a file [bytes]."""
    product = compute_part(log, part, windows, fitting)
    with tempfile.TemporaryDirectory() as folder:
        return to_netcdf(product, Path(folder) / "part.nc").stat().st_size


def _peak_mb() -> float:
    """Return the peak of the memory of this process [MB]; NaN where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
