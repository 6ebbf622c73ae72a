"""Compare the times of the DAVAR kernels, in turns, with peers and a bare loop on as many terms.

x1, x2 and vibration are the shapes of Wang et al., Sensors 16 (2016); the archive is a piece of a
multi-day log of three axes at 400 Hz. The bare loop squares and adds second differences of one
averaging factor in the first-level cache, in numba and, if gcc is installed, in C: what a processor
can do that is given one averaging factor at a time. Run it on an idle machine:

    python benchmarks/kernels.py --quick                        # short records, one repeat
    python benchmarks/kernels.py --output docs/performance.md
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import allantools
import dask
import numba
import numpy as np
import xarray as xr
from page import machine, make_parser, renew, table

from gyrostab import davar, make_log
from gyrostab.allan.plan import last_sample, make_plan, units_of_work
from gyrostab.kernels.allan.integrate import present_runs
from gyrostab.kernels.allan.surface import WorkUnit, surface_unit
from gyrostab.kernels.workspace import Workspace
from tests.support.published import published_sums

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
        total += energy(
            theta[a : a + n], theta[a + k : a + k + n], theta[a + 2 * k : a + 2 * k + n]
        )
    return total


def in_turns(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the best wall time of each call; calls alternate, so that load affects all alike."""
    best = dict.fromkeys(calls, np.inf)
    for turn in range(repeats + 1):
        for label, call in calls.items():
            start = time.perf_counter()
            call()
            if turn:  # the first compiles and warms up
                best[label] = min(best[label], time.perf_counter() - start)
    return best


def bare(terms: float) -> Callable[[], object]:
    """The bare loop over so many terms."""
    theta = np.cumsum(np.random.default_rng(0).standard_normal(1208))
    return lambda: numba_loop(theta, 1000, 100, round(terms / 1000))


def number_of_terms(parts: list[np.ndarray], unit: WorkUnit) -> float:
    """Second differences that the kernel forms: those within unbroken runs."""
    total = 0.0
    for part in parts:
        starts, stops = present_runs(part)
        for k in unit.ks:
            total += np.maximum(stops - starts - 2 * k + 1, 0).sum()
    return float(total)


def rooflines() -> dict[str, float]:
    """Terms per second of the bare loop [1e9/s], n = 1000, k = 100."""
    n, k, turns = 1000, 100, 20_000
    theta = np.cumsum(np.random.default_rng(0).standard_normal(n + 2 * k + 8))
    loops: dict[str, Callable[[], object]] = {"numba": lambda: numba_loop(theta, n, k, turns)}
    pointer = theta.ctypes.data_as(ctypes.c_void_p)
    arguments = [ctypes.c_long(value) for value in (n, k, turns)]
    with tempfile.TemporaryDirectory() as folder:
        for width in ("256", "512") if shutil.which("gcc") else ():
            library = Path(folder) / f"loop{width}.so"
            flags = f"-O3 -march=native -ffast-math -mprefer-vector-width={width} -shared -fPIC"
            command = ["gcc", *flags.split(), "-x", "c", "-o", library, "-"]
            if not subprocess.run(command, input=C_LOOP.encode(), capture_output=True).returncode:
                loop = ctypes.CDLL(str(library)).energy
                loop.restype = ctypes.c_double
                loops[f"C, {width}-bit vectors"] = partial(loop, pointer, *arguments)
    return {name: n * turns / took / 1e9 for name, took in in_turns(loops, 9).items()}


def pieces(x: np.ndarray, unit: WorkUnit) -> list[np.ndarray]:
    return [
        row[part.start * unit.step : last_sample(part, unit)]
        for row in np.atleast_2d(x)
        for part in units_of_work(row.size, unit)
    ]


def allantools_loop(x: np.ndarray, window: int, step: int, taus: np.ndarray) -> None:
    for start in range(0, x.size - window + 1, step):
        allantools.oadev(x[start : start + window], rate=RATE, data_type="freq", taus=taus)


@numba.njit(fastmath=True)
def recompute(x: np.ndarray, window: int, step: int, ks: np.ndarray) -> np.ndarray:
    """Compute every window anew: a loop over its second differences that the compiler unrolls.

    This is how SigmaTau.jl computes an Allan deviation.
    """
    theta = np.zeros(x.size + 1)
    theta[1:] = np.cumsum(x)
    sums = np.zeros(((x.size - window) // step + 1, ks.size))
    for j in range(sums.shape[0]):
        part = theta[j * step : j * step + window + 1]
        for i, k in enumerate(ks):
            sums[j, i] = energy(part[: -2 * k], part[k:-k], part[2 * k :])
    return sums


@numba.njit(fastmath=True)
def double_means(earlier: np.ndarray, later: np.ndarray, longer: np.ndarray) -> float:
    """Sum the squared changes from mean to mean, and write the means of twice the length."""
    total = 0.0
    for i in range(earlier.size):
        change = later[i] - earlier[i]
        total += change * change
        longer[i] = 0.5 * (earlier[i] + later[i])
    return total


@numba.njit
def favar(x: np.ndarray, window: int, step: int, octaves: int) -> np.ndarray:
    """FAVAR in every window: means of 2m samples follow from means of m, octave by octave."""
    sums = np.zeros(((x.size - window) // step + 1, octaves))
    room = np.empty((octaves, window))
    for j in range(sums.shape[0]):
        means = x[j * step : j * step + window]
        for i in range(octaves):
            size = means.size - (1 << i)
            longer = room[i, :size]
            sums[j, i] = double_means(means[:size], means[1 << i :], longer)
            means = longer
    return sums


def shape(name: str, taus: str, repeats: int, quick: bool) -> Iterator[str]:
    n, window, step = SHAPES[name]
    n = n // 10 if quick and name != "x1" else n
    x = np.random.default_rng(0).standard_normal(n)
    log = make_log(x, rate=RATE, unit="deg/h")
    length = {"window": f"{window}samples", "step": f"{step}samples"}
    options = {
        **length,
        "taus": 32 if taus == "32" else taus,
        "tau_max": (window // 2 - 1) / RATE,
    }
    tau = np.asarray(davar(log, **options).tau)
    unit = make_plan(log, **options).unit
    parts = pieces(x, unit)
    sizes = window, step, (n - window) // step + 1, unit.ks
    slow: dict[str, Callable[[], object]] = {
        "`allantools.oadev`, a loop": lambda: allantools_loop(x, window, step, tau),
        "classical, numpy": lambda: published_sums(x, "direct", *sizes),
        "published recursion, numba": lambda: published_sums(x, "recursive", *sizes),
    }
    fast: dict[str, Callable[[], object]] = {
        "every window anew, numba": lambda: recompute(x, window, step, unit.ks),
        "block sums, kernel": lambda: run_kernel(parts, unit, workers=1),
        "block sums, `davar`": lambda: davar(log, **options),
        "bare loop, as many terms": bare(number_of_terms(parts, unit)),
    }
    if taus == "octave":
        fast = {"FAVAR, every window": lambda: favar(x, window, step, tau.size), **fast}
    yield f"\n**{name}**, {n} samples, window {window}, step {step}, {tau.size} averaging times\n"
    with dask.config.set(scheduler="sync"):
        took = in_turns(slow, max(1, repeats // 2)) | in_turns(fast, 2 * repeats + 3)
    rivals = (next(iter(slow)), "published recursion, numba", "every window anew, numba")
    rows = []
    for label, value in took.items():
        share = took["bare loop, as many terms"] / value
        rows.append([
            label, f"{value:.4f}", *(f"{took[rival] / value:.1f}" for rival in rivals),
            f"{share:.2f}" if label.startswith("block") else "",
        ])  # fmt: skip
    head = ["one thread", "seconds", "times as fast as allantools",
            "times as fast as the recursion", "times as fast as every window anew",
            "share of the bare loop"]  # fmt: skip
    yield table(head, rows)


def with_gaps(x: np.ndarray) -> np.ndarray:
    """The same record with 13 % missing, in gaps of 2150 samples on average."""
    rng = np.random.default_rng(2)
    x = x.copy()
    for row in x:
        for start in rng.integers(0, row.size, round(0.138 * row.size / 2150)):
            row[start : start + int(rng.exponential(2150))] = np.nan
    return x


def archive(repeats: int, quick: bool) -> Iterator[str]:
    samples = 1_500_000 if quick else 6_000_000
    x = np.random.default_rng(1).standard_normal((3, samples)).astype(np.float32)
    records = {"none": x, "in blocks": with_gaps(x)}
    rows = []
    options = {"window": "5min", "step": "1min"}
    calls: dict[str, Callable[[], object]] = {}
    terms = {}
    for name, record in records.items():
        log = make_log(record, rate=400.0, unit="deg/h")
        unit = make_plan(log, **options).unit
        parts = pieces(record, unit)
        terms[name] = number_of_terms(parts, unit)
        for workers in (1, 2):
            calls[f"{name} kernel {workers}"] = partial(run_kernel, parts, unit, workers)
            calls[f"{name} davar {workers}"] = partial(run_davar, log, options, workers)
        calls[f"{name} bare"] = bare(terms[name])
    took = in_turns(calls, repeats + 2)
    for name, record in records.items():
        single, double, davar_single, davar_double = (
            record.size / took[f"{name} {work} {workers}"] / 1e6
            for work in ("kernel", "davar")
            for workers in (1, 2)
        )
        share = took[f"{name} bare"] / took[f"{name} kernel 1"]
        rows.append([
            f"{np.isnan(record).mean():.0%}", f"{terms[name] / record.size:.1f}",
            f"{single:.0f}", f"{double:.0f}", f"{double / single:.2f}", f"{share:.2f}",
            f"{davar_single:.0f}", f"{davar_double:.0f}",
        ])  # fmt: skip
    yield (
        f"\n**archive**, 3 axes of {samples} samples (float32) at 400 Hz, window 5 min, "
        f"step 1 min, {unit.ks.size} averaging times to {unit.ks[-1] / 400:g} s\n"
    )
    head = ["missing", "terms per sample", "kernel, 1 thread", "2 threads", "ratio",
            "share of the bare loop", "`davar`, 1", "`davar`, 2"]  # fmt: skip
    yield table(head, rows)


def run_kernel(parts: list[np.ndarray], unit: WorkUnit, workers: int) -> None:
    if workers == 1:
        space = Workspace()
        for part in parts:
            surface_unit(part, unit, space)
        return
    own = threading.local()
    with ThreadPoolExecutor(
        workers, initializer=lambda: setattr(own, "space", Workspace())
    ) as pool:
        list(pool.map(lambda part: surface_unit(part, unit, own.space), parts))


def run_davar(log: xr.Dataset, options: dict[str, str], workers: int) -> None:
    with dask.config.set(scheduler="threads", num_workers=workers):
        davar(log, **options)


def report(quick: bool) -> Iterator[str]:
    repeats = 1 if quick else 5
    versions = f"numba {numba.__version__}, numpy {np.__version__}"
    yield f"{machine()}; {versions}.\n"
    roofs = ", ".join(f"{name} {value:.2f}" for name, value in rooflines().items())
    yield f"Bare loop, 1e9 terms per second: {roofs}."
    for name in SHAPES:
        for taus in ("32", "octave", "all"):
            yield from shape(name, taus, repeats, quick)
    yield from archive(repeats, quick)
    yield (
        "\nBest of several turns; shares are of the numba loop on as many terms; the archive is in "
        "10^6 samples a second."
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="records of a tenth or a quarter, one repeat"
    )
    arguments = parser.parse_args()
    lines = []
    for line in report(arguments.quick):
        print(line, flush=True)
        lines.append(line)
    renew(arguments.output, "kernels", "\n".join(lines))


if __name__ == "__main__":
    main()
