"""Time the text reader beside pyarrow alone, on a clean comma separated log: python benchmarks/read_text.py [ROWS]."""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv

from gyrostab.read import read_log


def make(path: Path, rows: int) -> None:
    cells = [f"{a:.5f},{b:.5f},{c:.5f},{t:.2f}\n" for a, b, c, t in np.random.default_rng(0).normal(size=(10_000, 4))]
    with path.open("w") as file:
        file.write("time [s],gyro_x [deg/h],gyro_y [deg/h],gyro_z [deg/h],temperature [degC]\n")
        for row in range(rows):
            file.write(f"{1767225600 + row // 400}.{row % 400 * 25:04d},{cells[row % len(cells)]}")


def timed(work: Callable[[], Any]) -> tuple[float, float]:
    best = [np.inf, np.inf]
    for _ in range(3):
        wall, busy = time.perf_counter(), time.process_time()
        work()
        best = [min(best[0], time.perf_counter() - wall), min(best[1], time.process_time() - busy)]
    return best[0], best[1]


def main() -> None:
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 6_000_000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        make(path, rows)
        ours = timed(lambda: read_log(path))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        options = csv.ConvertOptions(column_types={"time [s]": pa.float64()})
        peers = {"pyarrow, whole file": timed(lambda: csv.read_csv(path, convert_options=options))}
        peers["pyarrow, streamed"] = timed(lambda: [None for _ in csv.open_csv(path, convert_options=options)])
        print(f"{rows:,} rows, {path.stat().st_size / 2**20:.0f} MiB; wall and processor time [s], best of 3")
        print(f"{'gyrostab':22s}{ours[0]:7.2f}{ours[1]:7.2f}   peak {peak:.0f} MiB, stamps exact, columns on disk above 128 MiB")
        for name, (wall, busy) in peers.items():
            print(f"{name:22s}{wall:7.2f}{busy:7.2f}   gyrostab takes {ours[0] / wall:.2f} and {ours[1] / busy:.2f} times as long")


if __name__ == "__main__":
    main()
