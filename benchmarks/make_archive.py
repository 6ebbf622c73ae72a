"""Make a big archive of gyro logs for timing.

The files hold counts with white noise and a slow walk, gaps, and a temperature.

    python benchmarks/make_archive.py ARCHIVE --hours 200 --rate 400 --axes 3 --format nc --gaps
    0.02 --overlap 5s --seed 1

The same options give the same samples. No more than one file is in memory, and one being written.
200 hours of three axes at 400 Hz are 8.64e8 samples: 1.5 GB as NetCDF, 2.2 GB as Zarr, 7 GB as CSV.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

import gyrostab
from gyrostab.schema import GAP_CAUSES
from gyrostab.time.grid import grid_times, time_coordinate

START = pd.Timestamp("2026-01-01").as_unit("ns").value
WHITE = 180.0  # standard deviation of the white noise [counts]
# step of the random walk from one second to the next, times the square root of the rate [counts]
WALK = 0.02
GAP_SECONDS = (0.5, 60.0)
PIECE = 2**18  # samples that are made at one time


def main(arguments: list[str] | None = None) -> list[Path]:
    """Write the archive; the files made."""
    options = parse(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    per_file = round(options.file_hours * 3600 * options.rate)
    total = round(options.hours * 3600 * options.rate)
    extra = round(pd.Timedelta(options.overlap).total_seconds() * options.rate)
    begun = time.perf_counter()
    walk = np.zeros(options.axes)
    made: list[Path] = []
    with ThreadPoolExecutor(1) as pool:
        writing: Future[None] | None = None
        for number, first in enumerate(range(0, total, per_file)):
            size = min(per_file, total - first)
            counts, walk, missing = samples(options, number, walk, size)
            if shared := min(extra, total - first - size):
                following, _, hidden = samples(options, number + 1, walk, shared)
                counts, missing = (
                    np.concatenate([counts, following], axis=1),
                    np.concatenate([missing, hidden]),
                )
            path = options.folder / f"log-{number:04d}.{options.format}"
            if writing is not None:
                writing.result()
            writing = pool.submit(write, path, counts, missing, first, options)
            made.append(path)
        if writing is not None:
            writing.result()
    seconds = time.perf_counter() - begun
    n = total * options.axes
    print(
        f"{len(made)} files, {n:,} samples in {seconds:.1f} s: {n / seconds / 1e6:.1f} Msamples/s",
        file=sys.stderr,
    )
    return made


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="folder to write into")
    parser.add_argument("--hours", type=float, default=200.0)
    parser.add_argument("--rate", type=float, default=400.0, help="sampling rate in Hz")
    parser.add_argument("--axes", type=int, default=3, choices=range(1, 7))
    parser.add_argument("--format", choices=["nc", "zarr", "csv"], default="nc")
    parser.add_argument("--file-hours", type=float, default=1.0)
    parser.add_argument(
        "--gaps", type=float, default=0.0, help="share of the samples that are missing"
    )
    parser.add_argument(
        "--overlap", default="0s", help="how much of the next file each file holds too"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scale", type=float, default=0.02, help="one count in degree per hour")
    return parser.parse_args(arguments)


def samples(
    options: argparse.Namespace, number: int, walk: NDArray[np.float64], size: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the first `size` samples of a file: counts (axis, time), last walk, missing samples.

    They follow from the seed, the number of the file and the end of the walk before it; so two
    files agree where they overlap.
    """
    per_second = max(1, round(options.rate))
    counts = np.empty((options.axes, size), dtype=np.int32)
    ends = walk.copy()
    for axis in range(options.axes):
        steps, noise = (
            np.random.default_rng([options.seed, number, axis, stream]) for stream in (0, 1)
        )
        slow = walk[axis] + np.cumsum(
            steps.standard_normal(-(-size // per_second)) * WALK * np.sqrt(per_second)
        )
        ends[axis] = slow[-1] if slow.size else walk[axis]
        for begin in range(0, size, PIECE):
            stop = min(size, begin + PIECE)
            white = noise.standard_normal(stop - begin, dtype=np.float32)
            white *= np.float32(WHITE)
            second = np.arange(begin // per_second, -(-stop // per_second))
            level = np.repeat(slow[second].astype(np.float32), per_second)
            white += level[begin - second[0] * per_second :][: stop - begin]
            counts[axis, begin:stop] = np.rint(white, out=white)
    missing = np.zeros(size, dtype=bool)
    for begin, stop in gaps(options, np.random.default_rng([options.seed, number])):
        missing[begin:stop] = True
    return counts, ends, missing


def gaps(options: argparse.Namespace, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return the gaps of a file; the last one extends beyond the end of the file."""
    whole = round(options.file_hours * 3600 * options.rate)
    left = round(options.gaps * whole)
    spans = []
    while left > 0:
        length = min(left, max(1, round(rng.uniform(*GAP_SECONDS) * options.rate)))
        begin = whole - length if not spans else int(rng.integers(1, max(2, whole - length)))
        spans.append((begin, begin + length))
        left -= length
    return spans


def write(
    path: Path,
    counts: NDArray[np.int32],
    missing: NDArray[np.bool_],
    first: int,
    options: argparse.Namespace,
) -> None:
    """Write one file."""
    if options.format == "csv":
        write_csv(path, counts, missing, first, options)
        return
    log = regular_log(counts, missing, first, options)
    if options.format == "zarr":
        gyrostab.to_zarr(log, path, overwrite=True)
    else:
        gyrostab.to_netcdf(log, path, overwrite=True, compression="zstd")


def regular_log(
    counts: NDArray[np.int32], missing: NDArray[np.bool_], first: int, options: argparse.Namespace
) -> xr.Dataset:
    """Return the file as a log in degree per hour, with a temperature every second."""
    present = np.flatnonzero(~missing)
    a, b = int(present[0]), int(present[-1]) + 1
    counts, missing = counts[:, a:b], missing[a:b]
    start = int(grid_times(START, options.rate, first + a))
    edges = np.flatnonzero(np.diff(missing.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    gap = grid_times(start, options.rate, edges).view("datetime64[ns]")
    seconds = np.arange(0, counts.shape[1], max(1, round(options.rate)))
    values = counts * options.scale
    for gap_begin, gap_stop in edges:
        values[:, gap_begin:gap_stop] = np.nan
    flags = {
        "flag_values": np.arange(len(GAP_CAUSES), dtype=np.int8),
        "flag_meanings": " ".join(GAP_CAUSES),
    }
    log = xr.Dataset(
        {
            "rate": (
                ("axis", "time"),
                values,
                {"units": "degree hour-1", "long_name": "rotation rate"},
            ),
            "temperature": (
                "time_temperature",
                temperature((first + a + seconds) / options.rate),
                {"units": "degree_Celsius"},
            ),
            "gap_start": ("gap", gap[:, 0], {"long_name": "first missing sample"}),
            "gap_end": ("gap", gap[:, 1], {"long_name": "first present sample after the gap"}),
            "gap_samples": (
                "gap",
                edges[:, 1] - edges[:, 0],
                {"long_name": "samples missing", "units": "1"},
            ),
            "gap_rows": (
                "gap",
                np.zeros(len(edges), dtype=np.int64),
                {"long_name": "rows concerned", "units": "1"},
            ),
            "gap_cause": (
                "gap",
                np.zeros(len(edges), dtype=np.int8),
                {"long_name": "cause of the gap", **flags},
            ),
        },
        coords={
            "axis": list("xyzuvw"[: options.axes]),
            "time_temperature": grid_times(start, options.rate, seconds).view("datetime64[ns]"),
        },
        attrs={
            "sampling_rate_hz": options.rate,
            "kind": "rate",
            "source_files": [],
            "notes": [],
            "history": f"made with seed {options.seed}",
        },
    )
    log = log.assign_coords(time_coordinate(start, options.rate, counts.shape[1])).chunk(
        axis=1, time=PIECE
    )
    log["rate"].encoding = {"dtype": np.dtype("i4"), "scale_factor": options.scale}
    return log


def temperature(seconds: NDArray[np.floating]) -> NDArray[np.float64]:
    """A tool that warms up and then follows its depth [degree Celsius]."""
    return np.round(
        25.0 + 40.0 * (1.0 - np.exp(-seconds / 7200.0)) + 10.0 * np.sin(seconds / 9000.0), 3
    )


def write_csv(
    path: Path,
    counts: NDArray[np.int32],
    missing: NDArray[np.bool_],
    first: int,
    options: argparse.Namespace,
) -> None:
    """Write one file as text: nanoseconds since 1970, counts, a temperature every second."""
    import pyarrow as pa
    from pyarrow import csv

    rows = np.flatnonzero(~missing)
    full = (first + rows) % max(1, round(options.rate)) == 0
    names = [
        "time [ns]",
        *(f"gyro_{axis} [{options.scale:.12g} deg/h]" for axis in "xyzuvw"[: options.axes]),
        "temperature [degC]",
    ]
    columns = [
        pa.array(grid_times(START, options.rate, first + rows)),
        *(pa.array(axis[rows]) for axis in counts),
    ]
    columns.append(pa.array(temperature((first + rows) / options.rate), mask=~full))
    csv.write_csv(pa.table(columns, names=names), path, csv.WriteOptions(quoting_style="none"))


if __name__ == "__main__":
    main()
