"""From files to product, compared with merely reading the files, with 1 and 2 workers.

The files are NetCDF (int32, zstd), Zarr (int32, blosc) and CSV.

    python benchmarks/end_to_end.py --output docs/performance.md

Prints a Markdown table, and puts it into its place in a page. Every figure is the best of some
runs, each in a separate, warm process: kernels compiled, files in the cache of the system.
Beside the time on the clock stands the processor time of all threads, which says more where the
machine has other work to do. A run uses every second difference (``full``, as by default) or those
that ``--overlap octave`` leaves. The peer reads every sample as a double into memory: xarray, one
file after the other in as many threads as there are workers, or for CSV pyarrow, as a table. Beside
it stands the same by gyrostab's own reader, chunk by chunk through dask.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import make_archive
from page import machine, renew

FORMATS = {"nc": "NetCDF, int32, zstd", "zarr": "Zarr, int32, blosc", "csv": "CSV"}
TARGETS = {"nc": 2.0, "zarr": 2.0, "csv": 1.5}


def main() -> None:
    """Make the archives, measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--hours", type=float, default=48.0, help="length of the NetCDF and Zarr archives"
    )
    parser.add_argument("--csv-hours", type=float, default=12.0, help="length of the CSV archive")
    parser.add_argument("--rate", type=float, default=400.0)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument(
        "--output", type=Path, help="document whose part between the marks is renewed"
    )
    parser.add_argument(
        "--measure", nargs=3, metavar=("WHAT", "WORKERS", "FOLDER"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.measure:
        work, workers, folder = options.measure
        files = sorted(Path(folder).glob("log-*"))
        works = {
            "xarray": read_xarray,
            "own": read_own,
            "pyarrow": read_arrow,
            "full": partial(run_whole, "full"),
            "octave": partial(run_whole, "octave"),
        }
        print(json.dumps(works[work](files, int(workers), options.repeat)))
        return
    with tempfile.TemporaryDirectory(prefix="gyrostab-io-") as root:
        rows = [row for form in options.formats for row in compare(form, Path(root, form), options)]
    head = (
        "| archive | hours | workers | terms | peer reads [s] | own reader [s] | whole run [s] | "
        "Msamples/s | run / peer | target "
        "| run / own reader | processor: peer [s] | own reader [s] | run [s] | run / peer |"
    )
    summary = (
        f"{machine()}; {options.rate:g} Hz, 3 axes, files of one hour with gaps; best of "
        f"{options.repeat}."
    )
    text = "\n".join([f"{summary}\n", head, "|" + "---|" * 15, *rows])
    print(text)
    if options.output:
        renew(options.output, "end to end", text)


def compare(form: str, folder: Path, options: argparse.Namespace) -> list[str]:
    """The rows of one format."""
    hours = options.csv_hours if form == "csv" else options.hours
    make_archive.main(
        [
            str(folder),
            "--hours",
            str(hours),
            "--rate",
            str(options.rate),
            "--format",
            form,
            "--gaps",
            "0.02",
        ]
    )
    samples = 3 * hours * 3600 * options.rate / 1e6
    rows = []
    for workers in options.workers:
        peer = measure("pyarrow" if form == "csv" else "xarray", workers, folder, options)
        own = None if form == "csv" else measure("own", workers, folder, options)
        for terms in ("full", "octave"):
            run = measure(terms, workers, folder, options)
            clock, processor = (
                [f"{timing[i]:.2f}" if timing else "" for timing in (peer, own, run)]
                for i in range(2)
            )
            ratios = [
                f"{run[0] / peer[0]:.2f}",
                f"<= {TARGETS[form]:g}",
                f"{run[0] / own[0]:.2f}" if own else "",
            ]
            cells = [
                FORMATS[form],
                f"{hours:g}",
                str(workers),
                terms,
                *clock,
                f"{samples / run[0]:.1f}",
                *ratios,
                *processor,
            ]
            rows.append("| " + " | ".join([*cells, f"{run[1] / peer[1]:.2f}"]) + " |")
    return rows


def measure(
    work: str, workers: int, folder: Path, options: argparse.Namespace
) -> tuple[float, float]:
    """Seconds on the clock and of the processor, measured in a separate process."""
    command = [
        sys.executable,
        __file__,
        "--repeat",
        str(options.repeat),
        "--measure",
        work,
        str(workers),
        str(folder),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    clock, processor = json.loads(done.stdout.splitlines()[-1])
    return float(clock), float(processor)


def best(work: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Least seconds of some runs: on the clock, and of the processor."""
    clock, processor = [], []
    for _ in range(repeat):
        begun, used = time.perf_counter(), time.process_time()
        work()
        clock.append(time.perf_counter() - begun)
        processor.append(time.process_time() - used)
    return min(clock), min(processor)


def read_xarray(files: list[Path], workers: int, repeat: int) -> tuple[float, float]:
    """Every file as doubles, by what xarray reads it with."""
    import xarray as xr

    def work() -> None:
        logs = [
            xr.open_dataset(file, engine="zarr" if file.is_dir() else "netcdf4") for file in files
        ]  # not in threads: netCDF4 crashes
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(lambda log: log["rate"][:].load().size, logs))
        for log in logs:
            log.close()

    return best(work, repeat)


def read_own(files: list[Path], workers: int, repeat: int) -> tuple[float, float]:
    """Every chunk of every file as doubles, by gyrostab."""
    import dask

    from gyrostab.io.opening import open_log

    def work() -> None:
        logs = [open_log(file) for file in files]
        blocks = [
            log.rate.data.map_blocks(lambda block: block[:, -1:], chunks=(1, 1)) for log in logs
        ]
        with dask.config.set(scheduler="threads", num_workers=workers):
            dask.compute(*blocks)
        for log in logs:
            log.close()

    return best(work, repeat)


def read_arrow(files: list[Path], workers: int, repeat: int) -> tuple[float, float]:
    """Every file as a table of pyarrow."""
    import pyarrow
    from pyarrow import csv

    pyarrow.set_cpu_count(workers)

    def work() -> None:
        for file in files:
            csv.read_csv(file)

    return best(work, repeat)


def run_whole(terms: str, files: list[Path], workers: int, repeat: int) -> tuple[float, float]:
    """Time ``gyrostab run`` with this ``--overlap``, after a first run on the first file."""
    from gyrostab.cli import main as command

    with tempfile.TemporaryDirectory(prefix="gyrostab-io-") as folder:
        options = [
            "-o",
            f"{folder}/product.nc",
            "--window",
            "10min",
            "--step",
            "1min",
            "--overlap",
            terms,
            "--workers",
            str(workers),
        ]

        def work(names: list[Path]) -> None:
            code = command(["run", *map(str, names), *options, "--overwrite", "--quiet-progress"])
            if code:
                raise SystemExit(code)

        work(files[:1])
        return best(lambda: work(files), repeat)


if __name__ == "__main__":
    main()
