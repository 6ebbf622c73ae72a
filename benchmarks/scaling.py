"""How time and memory of a run grow with log length, averaging times and window over step.

    python benchmarks/scaling.py [--hours 1 2 5 10 20 50 100 200] [--workers 2] [--rounds 3]
    [--output docs/scaling.md]

Each run is the whole `gyrostab run` (read, DAVAR, fit, write) in a separate process, from a Zarr
store of integer counts of three axes at 400 Hz, so that its peak memory is its own. The best of
several rounds counts. The constant cost of any run (tables, compiled kernels) is fitted together
with the exponent. The processor time of all threads is given next to the wall time; it is the
better measure on a busy machine. The tables are Markdown; `--output docs/scaling.md` inserts them
there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from page import machine, renew

RATE, AXES, COUNT = 400.0, 3, 0.02
WINDOW = {"window": "10min", "step": "1min", "taus": "40"}

# One run; prints its seconds, on the clock, of the processor and stage by stage, and its peak
# memory [MiB].
_RUN = """
import json, resource, sys, time
def work(paths, output, windows, options):
    from gyrostab.jobs.run import run
    stages = []
    def stage(label, total=0, done=None, unit="samples"):
        if not stages or stages[-1][0] != label:
            stages.append((label, time.perf_counter()))
    start, used = time.perf_counter(), time.process_time()
    run(paths, output, windows=windows, overwrite=True, stage=stage, **options)
    end = time.perf_counter()
    following = [*stages[1:], ("", end)]
    spans = {label: after - before for (label, before), (_, after) in zip(stages, following)}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    used = time.process_time() - used
    print(json.dumps({"seconds": end - start, "processor": used, "peak": peak, "spans": spans}))
if __name__ == "__main__":
    work(*json.loads(sys.argv[1]))
"""


def write_store(path: Path, hours: float) -> Path:
    """White counts on a slow walk, chunk by chunk, as `gyrostab ingest` stores them."""
    import dask.array as da

    from gyrostab import make_log, to_zarr

    size, chunk = round(hours * 3600 * RATE), round(1200 * RATE)

    def counts(block_info: dict) -> np.ndarray:
        axis, part = block_info[None]["chunk-location"]
        shape = block_info[None]["chunk-shape"]
        draw = np.random.default_rng((axis, part))
        return COUNT * np.rint(
            180.0 * draw.standard_normal(shape)
            + 300.0
            + np.cumsum(0.05 * draw.standard_normal(shape), axis=1)
        )

    values = da.map_blocks(
        counts,
        chunks=((1,) * AXES, da.core.normalize_chunks(chunk, (size,))[0]),
        dtype=float,
        meta=np.empty((0, 0)),
    )
    log = make_log(values, rate=RATE, unit="deg/h", start="2026-05-01")
    signal = log["rate"]
    signal.encoding = {"dtype": "int32", "scale_factor": COUNT}
    return to_zarr(log, path, overwrite=True)


def measure(store: Path, windows: dict[str, str], options: dict[str, object], rounds: int) -> dict:
    """Return the best wall and processor time of several runs, and their largest memory peak."""
    results = []
    for _ in range(rounds):
        command = [
            sys.executable,
            "-c",
            _RUN,
            json.dumps([[str(store)], str(store.with_name("product.nc")), windows, options]),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(done.stderr)
        results.append(json.loads(done.stdout.splitlines()[-1]))
    quickest = min(results, key=lambda result: result["seconds"])
    return {
        **quickest,
        "processor": min(result["processor"] for result in results),
        "peak": max(result["peak"] for result in results),
    }


def exponent(hours: list[float], seconds: list[float]) -> str:
    """Fit ``fixed + factor * hours**exponent`` with equal relative errors; return one line."""
    from scipy.optimize import curve_fit

    def law(length: np.ndarray, fixed: float, factor: float, power: float) -> np.ndarray:
        return np.log(np.exp(fixed) + np.exp(factor) * length**power)

    begin = [np.log(seconds[0]), np.log(seconds[-1] / hours[-1]), 1.0]
    (fixed, factor, power), covariance = curve_fit(law, np.array(hours), np.log(seconds), p0=begin)
    error = float(np.sqrt(covariance[2, 2]))
    return (
        f"{np.exp(fixed):.2f} s + {np.exp(factor):.4f} s (length / h)^p with p = "
        f"{power:.3f} ± {error:.3f}"
    )


def table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(
        [
            "| " + " | ".join(head) + " |",
            "|" + "---|" * len(head),
            *("| " + " | ".join(row) + " |" for row in rows),
        ]
    )


def against_length(folder: Path, given: argparse.Namespace, options: dict[str, object]) -> str:
    rows: list[list[str]] = []
    times: dict[str, list[float]] = {"seconds": [], "processor": []}
    for hours in given.hours:
        result = measure(write_store(folder / "log.zarr", hours), WINDOW, options, given.rounds)
        samples = AXES * hours * 3600 * RATE
        for name, values in times.items():
            values.append(result[name])
        spans = [result["spans"].get(name, 0.0) for name in ("reading", "computing", "writing")]
        rows.append(
            [
                f"{hours:g} h",
                f"{samples / 1e6:.1f}",
                f"{result['seconds']:.2f}",
                *(f"{span:.2f}" for span in spans),
                f"{samples / result['seconds'] / 1e6:.1f}",
                f"{result['processor']:.2f}",
                f"{1e9 * result['processor'] / samples:.1f}",
                f"{result['peak']:.0f}",
            ]
        )
        print(rows[-1], flush=True)
    head = [
        "length",
        "10^6 samples",
        "seconds",
        "of that open",
        "compute",
        "write",
        "Msamples/s",
        "processor [s]",
        "processor [ns a sample]",
        "peak MiB",
    ]
    text = table(head, rows)
    for name, label in (("seconds", "Time"), ("processor", "Processor time")):
        if len(given.hours) > 4:
            text += f"\n\n{label}: {exponent(given.hours, times[name])}."
    return text


def against_options(folder: Path, given: argparse.Namespace, options: dict[str, object]) -> str:
    hours = given.option_hours
    store = write_store(folder / "log.zarr", hours)
    rows = []
    for change in (
        *({"taus": taus} for taus in ("10", "20", "40", "80")),
        *({"step": step} for step in ("10min", "5min", "2min", "1min", "30s")),
        *(
            {"window": window, "step": step}
            for window, step in (("2min", "12s"), ("10min", "1min"), ("1h", "6min"))
        ),
        {"overlap": "octave"},
    ):
        windows = {**WINDOW, **change}
        result = measure(store, windows, options, given.rounds)
        samples = AXES * hours * 3600 * RATE
        named = [
            windows["window"],
            windows["step"],
            windows["taus"],
            windows.get("overlap", "full"),
        ]
        cost = [
            f"{result['seconds']:.2f}",
            f"{result['processor']:.2f}",
            f"{1e9 * result['processor'] / samples:.1f}",
            f"{result['peak']:.0f}",
        ]
        rows.append([*named, *cost])
    return f"Log of {hours:g} h.\n\n" + table(
        [
            "window",
            "step",
            "taus",
            "overlap",
            "seconds",
            "processor [s]",
            "processor [ns a sample]",
            "peak MiB",
        ],
        rows,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--hours", type=float, nargs="+", default=[1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0]
    )
    parser.add_argument(
        "--option-hours",
        type=float,
        default=8.0,
        help="length of the log for the scan of averaging times and step",
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scheduler", default="threads")
    parser.add_argument("--only", choices=("length", "options"))
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    options: dict[str, object] = {"workers": given.workers, "scheduler": given.scheduler}
    parts = []
    with tempfile.TemporaryDirectory() as name:
        if given.only != "options":
            parts.append(
                "### Time and memory against length\n\n"
                + against_length(Path(name), given, options)
            )
        if given.only != "length":
            parts.append(
                "### Against averaging times, and window over step\n\n"
                + against_options(Path(name), given, options)
            )
    parts.append(
        f"{machine()}; {given.scheduler}, {given.workers} workers, best of {given.rounds}."
    )
    text = "\n\n".join(parts)
    print(text)
    if given.output:
        renew(given.output, "scaling", text)


if __name__ == "__main__":
    main()
