"""Make a long archive of gyro logs for timing.

The files hold counts with white noise and a slow walk, gaps, and a temperature.

    python benchmarks/make_archive.py ARCHIVE --hours 200 --rate 400 --format nc --gaps 0.02

The same options give the same samples. No more than one file is in memory. 200 hours of three axes
at 400 Hz are 8.64e8 samples: 1.5 GB as NetCDF, 2.2 GB as Zarr, 7 GB as CSV.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from page import make_parser

import gyrostab
from gyrostab.arrays import Bools, Floats
from gyrostab.ingest.gap_table import gap_variables

START = np.datetime64("2026-01-01", "ns")
SCALE = 0.02  # one count [deg/h]
WHITE = 180.0  # standard deviation of the white noise [counts]
# step of the random walk from one second to the next, times the square root of the rate [counts]
WALK = 0.02
GAP_SECONDS = (0.5, 60.0)
FORMATS = ("nc", "zarr", "csv")


def main() -> None:
    parser = make_parser(__doc__, has_page=False)
    parser.add_argument("folder", type=Path, help="folder to write into")
    parser.add_argument("--hours", type=float, default=200.0)
    parser.add_argument("--rate", type=int, default=400, help="sampling rate in Hz")
    parser.add_argument("--format", choices=FORMATS, default="nc")
    parser.add_argument(
        "--gaps", type=float, default=0.0, help="share of the samples that are missing"
    )
    given = parser.parse_args()
    make_archive(given.folder, given.format, given.hours, given.rate, gaps=given.gaps)


def make_archive(
    folder: Path,
    form: str,
    hours: float,
    rate: int,
    *,
    axes: str = "xyz",
    file_hours: float = 1.0,
    gaps: float = 0.0,
    overlap_s: float = 0.0,
) -> list[Path]:
    """Write the files, each with the first `overlap_s` of the next one; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    per_file, total = (round(length * 3600 * rate) for length in (file_hours, hours))
    level, made = np.zeros(len(axes)), []
    for number, first in enumerate(range(0, total, per_file)):
        size = min(per_file, total - first)
        counts, level = draw_counts(number, size, rate, level)
        counts[:, draw_missing(number, per_file, rate, gaps)[:size]] = np.nan
        if shared := min(round(overlap_s * rate), total - first - size):
            following, _ = draw_counts(number + 1, shared, rate, level)
            following[:, draw_missing(number + 1, per_file, rate, gaps)[:shared]] = np.nan
            counts = np.concatenate([counts, following], axis=1)
        path = folder / f"log-{number:04d}.{form}"
        if form == "csv":
            write_csv(path, counts, axes, first, rate)
        else:
            log = make_log(counts, axes, first, rate)
            if form == "zarr":
                gyrostab.to_zarr(log, path, overwrite=True)
            else:
                gyrostab.to_netcdf(log, path, overwrite=True, compression="zstd")
        made.append(path)
    return made


def draw_counts(number: int, size: int, rate: int, level: Floats) -> tuple[Floats, Floats]:
    """Return the first `size` samples of a file (axis, time), and the level of the walk after them.

    They follow from the number of the file and the level before it, so two files agree where they
    overlap.
    """
    steps, white = np.random.default_rng([1, number]).spawn(2)
    seconds = -(-size // rate)
    # second by second, so that the beginning of a file does not depend on its length
    drift = steps.standard_normal((seconds, level.size)).cumsum(axis=0)
    walk = level + WALK * np.sqrt(rate) * drift
    noise = WHITE * white.standard_normal((size, level.size), dtype=np.float32)
    return np.rint(noise + walk.repeat(rate, axis=0)[:size]).T, walk[-1]


def draw_missing(number: int, size: int, rate: int, share: float) -> Bools:
    """Return which samples of a file are missing; the first gap extends to the end of the file."""
    rng, missing = np.random.default_rng([2, number]), np.zeros(size, bool)
    left, begin = round(share * size), size
    while left > 0:
        length = min(left, max(1, round(rng.uniform(*GAP_SECONDS) * rate)))
        begin = size - length if begin == size else int(rng.integers(1, max(2, size - length)))
        missing[begin : begin + length] = True
        left -= length
    return missing


def make_log(counts: Floats, axes: str, first: int, rate: int) -> xr.Dataset:
    """Return the file as a log in degree per hour, with a temperature every second."""
    present = np.flatnonzero(np.isfinite(counts[0]))
    begin, end = int(present[0]), int(present[-1]) + 1
    start = START + np.timedelta64((first + begin) * 10**9 // rate, "ns")
    values = SCALE * counts[:, begin:end]
    log = gyrostab.make_log(values, rate=rate, unit="deg/h", axis=list(axes), start=str(start))
    lost = np.isnan(values[0]).astype(np.int8)
    edges = np.flatnonzero(np.diff(lost, prepend=0, append=0)).reshape(-1, 2)
    gaps = np.column_stack([edges, np.diff(edges), np.zeros_like(edges)])
    log = log.assign(gap_variables(gaps, int(start.astype(np.int64)), rate))
    seconds = (first + np.arange(begin, end, rate)) / rate
    log = log.assign_coords(time_temperature=log["time"].values[::rate])
    heat = ("time_temperature", temperature(seconds), {"units": "degree_Celsius"})
    log = log.assign(temperature=heat)
    log["rate"].encoding = {"dtype": np.dtype("i4"), "scale_factor": SCALE}
    return log


def temperature(seconds: Floats) -> Floats:
    """A tool that warms up and then follows its depth [degree Celsius]."""
    warm_up = 40.0 * (1.0 - np.exp(-seconds / 7200.0))
    return np.round(25.0 + warm_up + 10.0 * np.sin(seconds / 9000.0), 3)


def write_csv(path: Path, counts: Floats, axes: str, first: int, rate: int) -> None:
    """Write one file as text: nanoseconds since 1970, counts, a temperature every second."""
    import pyarrow as pa
    from pyarrow import csv

    rows = np.flatnonzero(np.isfinite(counts[0]))
    samples = first + rows
    columns = {
        "time [ns]": START.astype(np.int64) + samples * 10**9 // rate,
        **{
            f"gyro_{axis} [{SCALE:g} deg/h]": values[rows].astype(np.int32)
            for axis, values in zip(axes, counts, strict=True)
        },
        "temperature [degC]": pa.array(temperature(samples / rate), mask=samples % rate != 0),
    }
    csv.write_csv(pa.table(columns), path, csv.WriteOptions(quoting_style="none"))


if __name__ == "__main__":
    main()
