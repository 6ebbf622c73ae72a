"""What a fleet costs a run, and what 10 000 runs would take.

    python benchmarks/fleet.py --output docs/scaling.md

Synthetic runs of 10 min (three axes, 10 Hz, one NetCDF log each, fifty runs a tool) are analysed
with windows of 1 min, one after the other in this process. Two numbers of runs give the fixed cost
of a call and the cost of a run; from these 10 000 runs are extrapolated. Processor time counts,
because the wall time depends on what else the machine does; the work of the runs divides over
worker processes. The peak of the memory is that of this process from its start.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from page import machine, make_parser, memory, renew, table

RATE_HZ, MINUTES, RUNS_PER_TOOL, TARGET = 10.0, 10, 50, 10_000
WINDOW = {"window": "1min", "step": "30s", "taus": "20"}


def write_archive(folder: Path, runs: int) -> None:
    """Write white noise with a slow walk, one folder a run."""
    from gyrostab import make_log, to_netcdf

    for number in range(runs):
        draw = np.random.default_rng(number)
        noise = draw.standard_normal((3, round(60 * MINUTES * RATE_HZ)))
        values = 5.0 + noise + 0.01 * noise.cumsum(axis=1)
        start = f"2026-01-{1 + number % 28:02}T{number // 28 % 24:02}:00:00"
        log = make_log(values, rate=RATE_HZ, unit="deg/h", start=start)
        place = folder / f"tool{number // RUNS_PER_TOOL:03}" / f"run{number:05}"
        place.mkdir(parents=True, exist_ok=True)
        to_netcdf(log, place / "log.nc", overwrite=True)


class Cost(NamedTuple):
    """Processor time and elapsed time of a call [s], and the peak of the memory so far [MiB]."""

    processor: float
    elapsed: float
    peak: float


def measure(call: Callable[..., object], *arguments: object, **options: object) -> Cost:
    """Measure a call in this process."""
    begun = time.process_time(), time.monotonic()
    call(*arguments, scheduler="threads", **options)
    spent = time.process_time() - begun[0], time.monotonic() - begun[1]
    return Cost(*spent, memory())


def measure_all(archive: Path, output: Path, *, reports: bool) -> dict[str, Cost]:
    """Measure the steps of a fleet, from the first look at the archive to a call without news."""
    from gyrostab.jobs.fleet import run_fleet, write_file_table

    table = output.with_suffix(".parquet")
    analyse = partial(measure, run_fleet, [table], output, windows=WINDOW)
    costs = {
        "list the files": measure(write_file_table, [archive], table),
        "list them again": measure(write_file_table, [archive], table),
        "analyse": analyse(reports=False),
        "a call without news": analyse(reports=False),
    }
    return costs | ({"reports": analyse()} if reports else {})


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--runs", type=int, nargs=2, default=[60, 1000])
    given = parser.parse_args()
    few, many = sorted(given.runs)
    measured: dict[str, list[tuple[int, Cost]]] = {}
    with tempfile.TemporaryDirectory() as name:
        for runs in (1, few, many):  # the first compiles
            archive, output = Path(name, f"archive{runs}"), Path(name, f"fleet{runs}")
            write_archive(archive, runs)
            for step, cost in measure_all(archive, output, reports=runs < many).items():
                measured.setdefault(step, []).append((runs, cost))
                print(runs, step, cost, flush=True)
        size = sum(path.stat().st_size for path in output.glob("tool*/*")) / many
        pages = [path.stat().st_size for path in Path(name).glob("fleet*/reports/*/*")]
    rows = []
    for step, costs in measured.items():
        (fewer, before), (runs, after) = costs[-2:]
        per_run = (after.processor - before.processor) / (runs - fewer)
        fixed = max(after.processor - runs * per_run, 0.0)
        spent = [f"{after.processor:.1f}", f"{after.elapsed:.1f}", f"{after.peak:.0f}"]
        total = (fixed + TARGET * per_run) / 60.0
        rows.append([step, runs, *spent, f"{fixed:.2f}", f"{1e3 * per_run:.1f}", f"{total:.1f}"])
    head = ["step", "runs", "processor [s]", "elapsed [s]", "peak [MiB]", "fixed [s]", "a run [ms]",
            f"{TARGET} runs [min]"]  # fmt: skip
    text = (
        f"{table(head, rows)}\n\n"
        f"The last three columns are processor time, from calls with {few} and {many} runs of "
        f"{MINUTES} min, for reports with 1 and {few}. "
        f"A product takes {size / 1e3:.0f} kB, a report {np.mean(pages) / 1e3:.0f} kB.\n\n"
        f"{machine()}."
    )
    print(text)
    renew(given.output, "fleet", text)


if __name__ == "__main__":
    main()
