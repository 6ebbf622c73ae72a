"""What it costs to open a NetCDF log of gyrostab, for an index of files or for a run.

    python benchmarks/opening.py [--output docs/scaling.md]

Logs of 10 min at 10 Hz and of 1 h at 400 Hz (three axes) are opened directly and through xarray, in
turn in one process; the NetCDF library alone and xarray alone are the rivals. Processor time
counts: the lowest of several rounds of some files each.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import netCDF4
import numpy as np
import xarray as xr
from page import machine, renew

ROUNDS, FILES = 12, 5


def write_logs(folder: Path, rate: float, seconds: int) -> list[Path]:
    """Write logs of white noise."""
    from gyrostab import make_log, to_netcdf

    draw = np.random.default_rng(1)
    values = draw.integers(-9999, 9999, (3, round(seconds * rate))) * 0.001
    log = make_log(values, rate=rate, unit="deg/h", start="2026-01-01")
    return [to_netcdf(log, folder / f"{rate:.0f}-{number}.nc") for number in range(FILES)]


def read_attributes(path: Path) -> None:
    """Open a file with the NetCDF library, and read its attributes alone."""
    with netCDF4.Dataset(path) as stored:
        for item in (stored, *stored.variables.values()):
            dict(item.__dict__)


def measure(calls: dict[str, tuple[Callable[[Path], Any], bool]], paths: list[Path]) -> list[float]:
    """Measure calls in turn, with or without direct opening: processor time a file [ms]."""
    best = dict.fromkeys(calls, np.inf)
    for _ in range(ROUNDS):
        for name, (call, is_direct) in calls.items():
            with ExitStack() as stack:
                for module in () if is_direct else ("store.read", "ingest.formats.netcdf"):
                    target = f"gyrostab.{module}.open_netcdf_log"
                    stack.enter_context(patch(target, lambda path, **_: None))
                begun = time.thread_time()
                for path in paths:
                    call(path)
                best[name] = min(best[name], 1e3 * (time.thread_time() - begun) / len(paths))
    return list(best.values())


def main() -> None:
    from gyrostab.ingest.files import read_file, scan_file
    from gyrostab.ingest.options import ReadOptions

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    options = ReadOptions()
    calls: dict[str, tuple[Callable[[Path], Any], bool]] = {
        "index": (scan_file, True),
        "index through xarray": (scan_file, False),
        "run": (lambda path: read_file(path, options), True),
        "run through xarray": (lambda path: read_file(path, options), False),
        "netCDF4.Dataset": (read_attributes, True),
        "xarray.open_dataset": (lambda path: xr.open_dataset(path).close(), True),
    }
    lines = ["| log | MB | " + " | ".join(calls) + " |", "|---" * (2 + len(calls)) + "|"]
    with tempfile.TemporaryDirectory() as folder:
        for name, rate, seconds in (("10 min, 10 Hz", 10.0, 600), ("1 h, 400 Hz", 400.0, 3600)):
            paths = write_logs(Path(folder), rate, seconds)
            costs = measure(calls, paths)
            size = paths[0].stat().st_size / 1e6
            cells = [name, f"{size:.2g}", *(f"{cost:.1f}" for cost in costs)]
            lines.append(f"| {' | '.join(cells)} |")
    text = "\n".join(lines) + f"\n\nProcessor time a file [ms]. {machine()}."
    print(text)
    if given.output:
        renew(given.output, "opening", text)


if __name__ == "__main__":
    main()
