"""Time the DAVAR kernels beside their peers on the data sets of Wang et al., Sensors 16 (2016).

x1: 6 000 samples, window 1000, step 30.  x2: 600 000 samples, window 2000, step 300.  vibration: 372 000 samples,
window 2000, step 1000. All taus up to half the window less one, and 32 in even log spacing. Prints medians of the wall
time and the ratio to a loop over allantools.oadev, measured in the same run. Run it on an idle machine:

    make bench            # about five minutes
    python benchmarks/kernels.py --quick
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable

import allantools
import dask
import numba
import numpy as np

from gyrostab import davar, make_log

RATE = 100.0
SHAPES = {"x1": (6_000, 1000, 30), "x2": (600_000, 2000, 300), "vibration": (372_000, 2000, 1000)}


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    """Median wall time of a call, after one that compiles and warms up."""
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def allantools_loop(x: np.ndarray, window: int, step: int, taus: np.ndarray) -> None:
    for start in range(0, x.size - window + 1, step):
        allantools.oadev(x[start : start + window], rate=RATE, data_type="freq", taus=taus)


def measure(name: str, taus: str, repeats: int, slow: bool) -> list[tuple[str, float]]:
    n, window, step = SHAPES[name]
    x = np.random.default_rng(0).standard_normal(n)
    log = make_log(x, rate=RATE, unit="deg/h")
    longest = (window // 2 - 1) / RATE
    options = {"window": window, "step": step, "taus": "all" if taus == "all" else 32, "tau_max": longest}
    values = np.asarray(davar(log, **options).tau)
    rows = []
    if slow:
        rows.append(("allantools.oadev, a loop", median_seconds(lambda: allantools_loop(x, window, step, values), 1)))
        rows.append(("classical, numpy (method='direct')", median_seconds(lambda: davar(log, method="direct", **options), 1)))
    rows.append(("recursion as printed (method='recursive')", median_seconds(lambda: davar(log, method="recursive", **options), repeats)))
    with dask.config.set(scheduler="sync"):
        rows.append(("block sums, 1 thread (default)", median_seconds(lambda: davar(log, **options), repeats)))
    return rows


def archive(repeats: int) -> None:
    """Throughput on a piece of a multi-day archive: 3 axes at 400 Hz, window 5 min, step 1 min, 38 taus up to 100 s."""
    log = make_log(np.random.default_rng(1).standard_normal((3, 6_000_000)), rate=400.0, unit="deg/h")
    print("\narchive piece, 3 x 6e6 samples at 400 Hz, window 5 min, step 1 min: Msamples/s")
    for overlap in ("full", "octave"):
        for scheduler in ("sync", "threads"):
            with dask.config.set(scheduler=scheduler):
                seconds = median_seconds(lambda overlap=overlap: davar(log, window="5min", step="1min", overlap=overlap), repeats)
            print(f"  overlap={overlap:7s} {scheduler:8s} {18 / seconds:8.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave out x2 with all taus for the slow peers, one repeat")
    arguments = parser.parse_args()
    repeats = 1 if arguments.quick else 5
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, numba {numba.__version__}, numpy {np.__version__}")
    print(f"1-minute load before the run: {os.getloadavg()[0]:.2f}")
    for name in SHAPES:
        for taus in ("32", "all"):
            slow = not (arguments.quick and name != "x1" and taus == "all")
            rows = measure(name, taus, repeats, slow)
            print(f"\n{name}, {taus} taus: seconds, ratio to the first line")
            for label, seconds in rows:
                print(f"  {label:44s} {seconds:10.4f} {rows[0][1] / seconds:8.1f}x")
    archive(repeats)


if __name__ == "__main__":
    main()
