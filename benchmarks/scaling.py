"""How time and memory of a run grow with log length, averaging times and window over step.

    python benchmarks/scaling.py --output docs/scaling.md

Each run is the whole `gyrostab run` (read, DAVAR, fit, write) in a separate process, from a Zarr
store of integer counts of three axes at 400 Hz, so that its peak memory is its own. The best of
several rounds counts, after imports. The constant cost of any run (tables, compiled kernels) is
fitted together with the exponent. The processor time of all threads is given next to the wall time;
it is the better measure on a busy machine.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from page import in_new_process, machine, make_parser, memory, renew, table

RATE, AXES, COUNT = 400.0, 3, 0.02
WINDOW = {"window": "10min", "step": "1min", "taus": "40"}


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


def run_log(path: Path, windows: dict[str, str], options: dict[str, Any]) -> dict[str, float]:
    """Run in this process: seconds on the clock, of the processor and of each stage; MiB."""
    from gyrostab.jobs.run import run

    stages: list[tuple[str, float]] = []

    def stage(label: str, *_: object, **__: object) -> None:
        if not stages or stages[-1][0] != label:
            stages.append((label, time.perf_counter()))

    begun, used = time.perf_counter(), time.process_time()
    output = path.with_name("product.nc")
    run([str(path)], str(output), windows=windows, overwrite=True, stage=stage, **options)
    end, used = time.perf_counter(), time.process_time() - used
    spans = {
        label: after - before
        for (label, before), (_, after) in zip(stages, [*stages[1:], ("", end)], strict=True)
    }
    return {**spans, "seconds": end - begun, "processor": used, "peak": memory()}


def measure(path: Path, windows: dict[str, str], given: argparse.Namespace) -> dict[str, float]:
    """Return the best wall and processor time of several runs, and their largest memory peak."""
    options = {"workers": given.workers, "scheduler": given.scheduler}
    results = [in_new_process(run_log, path, windows, options) for _ in range(given.rounds)]
    return {
        **min(results, key=lambda result: result["seconds"]),
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


def against_length(folder: Path, given: argparse.Namespace) -> str:
    rows: list[list[str]] = []
    times: dict[str, list[float]] = {"seconds": [], "processor": []}
    for hours in given.hours:
        result = measure(write_store(folder / "log.zarr", hours), WINDOW, given)
        samples = AXES * hours * 3600 * RATE
        for name, values in times.items():
            values.append(result[name])
        rows.append([
            f"{hours:g} h", f"{samples / 1e6:.1f}", f"{result['seconds']:.2f}",
            *(f"{result.get(stage, 0.0):.2f}" for stage in ("reading", "computing", "writing")),
            f"{samples / result['seconds'] / 1e6:.1f}", *costs(result, samples),
        ])  # fmt: skip
        print(*rows[-1], sep=" | ", flush=True)
    head = ["length", "10^6 samples", "seconds", "of that open", "compute", "write", "Msamples/s"]
    text = table([*head, *COSTS], rows)
    for name, label in (("seconds", "Time"), ("processor", "Processor time")):
        if len(given.hours) > 4:
            text += f"\n\n{label}: {exponent(given.hours, times[name])}."
    return text


COSTS = ("processor [s]", "processor [ns a sample]", "peak MiB")


def costs(result: dict[str, float], samples: float) -> list[str]:
    used = result["processor"]
    return [f"{used:.2f}", f"{1e9 * used / samples:.1f}", f"{result['peak']:.0f}"]


def against_options(folder: Path, given: argparse.Namespace) -> str:
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
    ):
        windows = {**WINDOW, **change}
        result = measure(store, windows, given)
        cost = costs(result, AXES * hours * 3600 * RATE)
        rows.append([*windows.values(), f"{result['seconds']:.2f}", *cost])
    head = ["window", "step", "taus", "seconds", *COSTS]
    return f"Log of {hours:g} h.\n\n{table(head, rows)}"


def main() -> None:
    parser = make_parser(__doc__)
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
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        text = "\n\n".join([
            "### Time and memory against length",
            against_length(Path(name), given),
            "### Against averaging times, and window over step",
            against_options(Path(name), given),
            f"{machine()}; {given.scheduler}, {given.workers} workers, best of {given.rounds}.",
        ])  # fmt: skip
    print(text)
    renew(given.output, "scaling", text)


if __name__ == "__main__":
    main()
