"""From files to product, compared with merely reading the files, with 1 and 2 workers.

The files are NetCDF (int32, zstd), Zarr (int32, blosc) and CSV.

    python benchmarks/end_to_end.py --output docs/performance.md

Prints a Markdown table, and puts it into its place in a page. Every figure is the best of some
runs, each in a separate, warm process: kernels compiled, files in the cache of the system.
Beside the time on the clock stands the processor time of all threads, which says more where the
machine has other work to do. The peer reads every sample as a double into memory: xarray, one file
after the other in as many threads as there are workers, or for CSV pyarrow, as a table. Beside it
stands the same by gyrostab's own reader, chunk by chunk through dask.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from make_archive import make_archive
from page import in_new_process, machine, make_parser, renew, table

FORMATS = {"nc": "NetCDF, int32, zstd", "zarr": "Zarr, int32, blosc", "csv": "CSV"}
TARGETS = {"nc": 2.0, "zarr": 2.0, "csv": 1.5}
Timing = tuple[float, float]  # least seconds of some runs: on the clock, and of the processor


def main() -> None:
    """Make the archives, measure, print."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "--hours", type=float, default=48.0, help="length of the NetCDF and Zarr archives"
    )
    parser.add_argument("--csv-hours", type=float, default=12.0, help="length of the CSV archive")
    parser.add_argument("--rate", type=int, default=400)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="gyrostab-io-") as root:
        rows = [row for form in options.formats for row in compare(form, Path(root, form), options)]
    head = [
        "archive", "hours", "workers", "terms", "peer reads [s]", "own reader [s]",
        "whole run [s]", "Msamples/s", "run / peer", "target", "run / own reader",
        "processor: peer [s]", "own reader [s]", "run [s]", "run / peer",
    ]  # fmt: skip
    text = (
        f"{machine()}; {options.rate:g} Hz, 3 axes, files of one hour with gaps; best of "
        f"{options.repeat}.\n\n{table(head, rows)}"
    )
    print(text)
    renew(options.output, "end to end", text)


def compare(form: str, folder: Path, options: argparse.Namespace) -> list[list[str]]:
    """The rows of one format."""
    hours = options.csv_hours if form == "csv" else options.hours
    files = make_archive(folder, form, hours, options.rate, gaps=0.02)
    samples = 3 * hours * 3600 * options.rate / 1e6
    rows = []
    for workers in options.workers:

        def measure(work: Callable[..., Timing], workers: int = workers) -> Timing:
            return in_new_process(work, files, workers, options.repeat)

        peer = measure(read_arrow if form == "csv" else read_xarray)
        own = None if form == "csv" else measure(read_own)
        run = measure(run_whole)
        clock, processor = (
            [f"{timing[i]:.2f}" if timing else "" for timing in (peer, own, run)] for i in range(2)
        )
        rows.append([
            FORMATS[form], f"{hours:g}", str(workers), *clock,
            f"{samples / run[0]:.1f}", f"{run[0] / peer[0]:.2f}", f"<= {TARGETS[form]:g}",
            f"{run[0] / own[0]:.2f}" if own else "", *processor, f"{run[1] / peer[1]:.2f}",
        ])  # fmt: skip
    return rows


def best(work: Callable[[], object], repeat: int) -> Timing:
    clock, processor = [], []
    for _ in range(repeat):
        begun, used = time.perf_counter(), time.process_time()
        work()
        clock.append(time.perf_counter() - begun)
        processor.append(time.process_time() - used)
    return min(clock), min(processor)


def read_xarray(files: list[Path], workers: int, repeat: int) -> Timing:
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


def read_own(files: list[Path], workers: int, repeat: int) -> Timing:
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


def read_arrow(files: list[Path], workers: int, repeat: int) -> Timing:
    """Every file as a table of pyarrow."""
    import pyarrow
    from pyarrow import csv

    pyarrow.set_cpu_count(workers)
    return best(lambda: [csv.read_csv(file).num_rows for file in files], repeat)


def run_whole(files: list[Path], workers: int, repeat: int) -> Timing:
    """Time ``gyrostab run``, after a first run on the first file."""
    from gyrostab.cli import main as command

    with tempfile.TemporaryDirectory(prefix="gyrostab-io-") as folder:
        options = f"--window 10min --step 1min --workers {workers}".split()
        options += ["-o", f"{folder}/product.nc", "--overwrite", "--quiet-progress"]

        def work(names: list[Path]) -> None:
            with contextlib.redirect_stdout(io.StringIO()):
                code = command(["run", *map(str, names), *options])
            if code:
                raise SystemExit(code)

        work(files[:1])
        return best(lambda: work(files), repeat)


if __name__ == "__main__":
    main()
