"""What a fleet costs a run, and what 10 000 runs would take.

    python benchmarks/fleet.py [--runs 100 400] [--workers 2] [--output docs/scaling.md]

Synthetic runs of 10 min (three axes, 10 Hz, one NetCDF log each, fifty runs a tool) are analysed
with windows of 1 min by `gyrostab fleet`, as a separate process. Two numbers of runs give the fixed
cost of a call and the cost of a run; from these 10 000 runs are extrapolated. Processor time of all
processes counts, because the wall time depends on what else the machine does.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from page import machine, renew

RATE_HZ, MINUTES, RUNS_PER_TOOL, TARGET = 10.0, 10, 50, 10_000
WINDOW = ("--window", "1min", "--step", "30s", "--taus", "20")


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


def measure(*arguments: object) -> tuple[float, float]:
    """Run a command of gyrostab; return wall time and processor time of all its processes [s]."""
    command = [sys.executable, "-m", "gyrostab", *map(str, arguments), "--quiet-progress"]
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return time.perf_counter() - begun, usage.ru_utime + usage.ru_stime


def measure_all(archive: Path, folder: Path, workers: int) -> dict[str, tuple[float, float]]:
    """Measure the steps of a fleet, from the first look at the archive to a call without news."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    table, output = folder / "files.parquet", folder / "fleet.zarr"
    common = ("--workers", workers)
    analyse = ("fleet", table, "-o", output, *WINDOW, *common)
    return {
        "index": measure("index", archive, "-o", table, *common),
        "index, nothing new": measure("index", archive, "-o", table, *common),
        "fleet without reports": measure(*analyse, "--no-reports"),
        "fleet, nothing new": measure(*analyse, "--no-reports"),
        "reports": measure(*analyse),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, nargs=2, default=[100, 400])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    few, many = sorted(given.runs)
    found = []
    with tempfile.TemporaryDirectory() as name:
        for runs in (few, many):
            archive = Path(name, f"archive{runs}")
            write_archive(archive, runs)
            found.append(measure_all(archive, Path(name, "out"), given.workers))
            print(runs, found[-1], flush=True)
        store = Path(name, "out", "fleet.zarr")
        size = sum(path.stat().st_size for path in store.rglob("*") if path.is_file()) / many
        items = sum(1 for _ in store.rglob("*")) / many
    rows = []
    for step in found[0]:
        (_, before), (wall, after) = (one[step] for one in found)
        cost = (after - before) / (many - few)
        fixed = max(after - many * cost, 0.0)
        total = (fixed + TARGET * cost) / 60.0
        cells = (f"{wall:.1f}", f"{after:.1f}", f"{fixed:.1f}", f"{1e3 * cost:.1f}", f"{total:.1f}")
        rows.append(f"| {step} | {' | '.join(cells)} |")
    head = (
        f"| step | {many} runs [s] | processor [s] | fixed [s] | a run [ms] "
        f"| {TARGET} runs, processor [min] |"
    )
    text = "\n".join([head, "|---|---|---|---|---|---|", *rows])
    text += (
        f"\n\nMeasured with {few} and {many} runs of {MINUTES} min, extrapolated to {TARGET}; one "
        f"run takes {size / 1e6:.2f} MB and {items:.0f} files and folders.\n\n{machine()}; "
        f"{given.workers} workers."
    )
    print(text)
    if given.output:
        renew(given.output, "fleet", text)


if __name__ == "__main__":
    main()
