"""Time the DAVAR kernels beside their peers and beside the bare loop, all in one run.

x1, x2 and vibration are the shapes of Wang et al., Sensors 16 (2016); the archive is a piece of a multi-day log of three
axes at 400 Hz. The bare loop squares and adds second differences of one averaging factor in the first-level cache, in
numba and, where gcc is there, in C: what a processor can do that is given one averaging factor at a time. Run it on an
idle machine:

    make bench                                                      # ten minutes or so
    python benchmarks/kernels.py --quick                            # short records, one repeat
    python benchmarks/kernels.py --output docs/performance.md       # renew the part of the document between its marks
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path

import allantools
import dask
import numba
import numpy as np
from page import renew

from gyrostab import davar, make_log
from gyrostab.kernels.surface import Unit, surface_unit
from gyrostab.plan import last_sample, units_of_work
from gyrostab.windows import averaging_factors, thin

RATE = 100.0
SHAPES = {"x1": (6_000, 1000, 30), "x2": (600_000, 2000, 300), "vibration": (372_000, 2000, 1000)}
C_LOOP = """
double energy(const double *t, long n, long k, long turns) {
    double total = 0;
    for (long j = 0; j < turns; j++) {
        const double *a = t + (j & 7), *b = a + k, *c = b + k;
        for (long i = 0; i < n; i++) { double d = c[i] - 2 * b[i] + a[i]; total += d * d; }
    }
    return total;
}
"""


@numba.njit(fastmath={"reassoc", "contract", "nsz", "arcp"})
def energy(a, b, c):
    total = 0.0
    for i in range(a.size):
        d = c[i] - 2.0 * b[i] + a[i]
        total += d * d
    return total


@numba.njit
def numba_loop(theta, n, k, turns):
    total = 0.0
    for j in range(turns):
        a = j & 7
        total += energy(theta[a : a + n], theta[a + k : a + k + n], theta[a + 2 * k : a + 2 * k + n])
    return total


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Median wall time of a call, after one that compiles and warms up."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def rooflines() -> dict[str, float]:
    """Terms per second of the bare loop [1e9/s], n = 1000, k = 100."""
    n, k, turns = 1000, 100, 20_000
    theta = np.cumsum(np.random.default_rng(0).standard_normal(n + 2 * k + 8))
    found = {"numba": n * turns / seconds(lambda: numba_loop(theta, n, k, turns), 9) / 1e9}
    if shutil.which("gcc"):
        with tempfile.TemporaryDirectory() as folder:
            for width in ("256", "512"):
                library = Path(folder) / f"loop{width}.so"
                flags = ["-O3", "-march=native", "-ffast-math", f"-mprefer-vector-width={width}", "-shared", "-fPIC", "-x", "c"]
                if subprocess.run(["gcc", *flags, "-o", library, "-"], input=C_LOOP.encode(), capture_output=True, check=False).returncode:
                    continue  # a processor without such vectors
                loop = ctypes.CDLL(str(library)).energy
                loop.restype = ctypes.c_double
                pointer = theta.ctypes.data_as(ctypes.c_void_p)
                arguments = [ctypes.c_long(value) for value in (n, k, turns)]
                found[f"C, {width}-bit vectors"] = n * turns / seconds(lambda: loop(pointer, *arguments), 9) / 1e9  # noqa: B023
    return found


def make_unit(ks: np.ndarray, window: int, step: int, rate: float, octave: bool) -> Unit:
    shifts = thin(ks) if octave else np.zeros_like(ks)
    ks = np.unique(ks >> shifts << shifts)
    return Unit(window, step, ks, thin(ks) if octave else np.zeros_like(ks), False, 1 / rate, False, 0.3, 0.1)


def pieces(x: np.ndarray, unit: Unit) -> list[np.ndarray]:
    return [row[one.start * unit.step : last_sample(one, unit)] for row in np.atleast_2d(x) for one in units_of_work(row.size, unit)]


def allantools_loop(x: np.ndarray, window: int, step: int, taus: np.ndarray) -> None:
    for start in range(0, x.size - window + 1, step):
        allantools.oadev(x[start : start + window], rate=RATE, data_type="freq", taus=taus)


def shape(name: str, taus: str, repeats: int, quick: bool, roof: float) -> Iterator[str]:
    n, window, step = SHAPES[name]
    n = n // 10 if quick and name != "x1" else n
    x = np.random.default_rng(0).standard_normal(n)
    log = make_log(x, rate=RATE, unit="deg/h")
    options = {"window": window, "step": step, "taus": "all" if taus == "all" else 32, "tau_max": (window // 2 - 1) / RATE}
    tau = np.asarray(davar(log, **options).tau)
    unit = make_unit(np.round(tau * RATE).astype(np.int64), window, step, RATE, octave=False)
    parts = pieces(x, unit)
    terms = float(((n - window) // step * step + window - 2 * unit.ks + 1).sum())
    few = max(1, repeats // 3)
    calls: list[tuple[str, Callable[[], object], int]] = [
        ("`allantools.oadev`, a loop", lambda: allantools_loop(x, window, step, tau), few),
        ("classical, numpy", lambda: davar(log, method="direct", **options), few),
        ("recursion as printed, numba", lambda: davar(log, method="recursive", **options), repeats),
        ("block sums, kernel", lambda: [surface_unit(part, unit) for part in parts], repeats),
        ("block sums, `davar`", lambda: davar(log, **options), repeats),
    ]
    yield f"\n**{name}**, {n} samples, window {window}, step {step}, {tau.size} averaging times\n"
    yield "| one thread | seconds | times as fast as allantools | share of the bare loop |\n|---|---|---|---|"
    first = 0.0
    with dask.config.set(scheduler="sync"):
        for label, call, times in calls:
            took = seconds(call, times)
            first = first or took
            share = f"{terms / took / 1e9 / roof:.2f}" if label.startswith("block") else ""
            yield f"| {label} | {took:.4f} | {first / took:.1f} | {share} |"


def with_gaps(x: np.ndarray) -> np.ndarray:
    """The same record with 13 % missing, in gaps of 2150 samples on average."""
    rng = np.random.default_rng(2)
    x = x.copy()
    for row in x:
        for start in rng.integers(0, row.size, round(0.138 * row.size / 2150)):
            row[start : start + int(rng.exponential(2150))] = np.nan
    return x


def archive(repeats: int, quick: bool, roof: float) -> Iterator[str]:
    samples = 1_500_000 if quick else 6_000_000
    x = np.random.default_rng(1).standard_normal((3, samples)).astype(np.float32)
    window, step = 120_000, 24_000
    ks = averaging_factors(40, rate=400.0, window=window, tau_max=None)
    yield f"\n**archive**, 3 axes of {samples} samples (float32) at 400 Hz, window 5 min, step 1 min, {ks.size} averaging times to 100 s\n"
    yield "| terms | missing | kernel, 1 thread | kernel, 2 threads | ratio | share of the bare loop | `davar`, 1 | `davar`, 2 |"
    yield "|---|---|---|---|---|---|---|---|"
    for octave in (False, True):
        unit = make_unit(ks, window, step, 400.0, octave)
        for record in (x, with_gaps(x)):
            parts = pieces(record, unit)
            speeds = []
            for workers in (1, 2):
                with ThreadPoolExecutor(workers) as pool:
                    took = seconds(lambda: list(pool.map(lambda part: surface_unit(part, unit), parts)), repeats)  # noqa: B023
                speeds.append(record.size / took / 1e6)
            log = make_log(record, rate=400.0, unit="deg/h")
            options = {"window": "5min", "step": "1min", "overlap": "octave" if octave else "full"}
            for workers in (1, 2):
                with dask.config.set(scheduler="threads", num_workers=workers):
                    speeds.append(record.size / seconds(lambda: davar(log, **options), repeats) / 1e6)  # noqa: B023
            missing = np.isnan(record).mean()
            share = speeds[0] * 1e6 * (0.5**unit.shifts).sum() * (1 - missing) / 1e9 / roof
            yield (
                f"| {options['overlap']} | {missing:.0%} | {speeds[0]:.0f} | {speeds[1]:.0f} | {speeds[1] / speeds[0]:.2f} | {share:.2f} "
                f"| {speeds[2]:.0f} | {speeds[3]:.0f} |"
            )


def processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    return f"{names[0] if names else 'processor not named'}, {os.cpu_count()} cores, numba {numba.__version__}, numpy {np.__version__}"


def report(quick: bool) -> Iterator[str]:
    repeats = 1 if quick else 5
    yield f"{processor()}; {date.today().isoformat()}; 1-minute load before the run {os.getloadavg()[0]:.2f}; medians of {repeats}.\n"
    roofs = rooflines()
    yield "Bare loop, 1e9 terms per second: " + ", ".join(f"{name} {value:.2f}" for name, value in roofs.items()) + "."
    for name in SHAPES:
        for taus in ("32", "all"):
            yield from shape(name, taus, repeats, quick, roofs["numba"])
    yield from archive(repeats, quick, roofs["numba"])
    yield "\nShares are of the numba loop; the archive is in millions of samples per second."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="records of a tenth or a quarter, one repeat")
    parser.add_argument("--output", type=Path, help="Markdown document whose part between the marks is renewed")
    arguments = parser.parse_args()
    lines = []
    for line in report(arguments.quick):
        print(line, flush=True)
        lines.append(line)
    if arguments.output:
        renew(arguments.output, "kernels", "\n".join(lines))


if __name__ == "__main__":
    main()
