"""Readers of the chunks of NetCDF (HDF5) logs, side by side, with one thread and with two.

    python benchmarks/hdf5_chunks.py --output docs/decisions/0010-hdf5-chunks.md

Every reader reads `rate` of a log as doubles, chunk by chunk. The readers take turns in one
process, and the table has the least wall and processor time of all rounds. `xarray` is a slice of a
lazy variable (`netcdf4` engine); `netCDF4` and `h5py` are plain reads of the library with the
conversion of counts of gyrostab (h5py has no zstd); `gyrostab` is what `open_log` does. A log of
five hours is larger than the chunk cache of the NetCDF library, from which a second pass over a
shorter one would be served.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import xarray as xr
from foreign import write_own
from page import machine, make_parser, renew, table

from gyrostab import to_netcdf
from gyrostab.arrays import Floats
from gyrostab.io.opening import open_log
from gyrostab.kernels.encoding.counts import from_counts
from gyrostab.store.lazy import read_into
from gyrostab.store.private import library_lock

Read = Callable[[int, int, int], Floats]


def readers_of(path: Path) -> tuple[dict[str, Read], list[tuple[int, int, int]]]:
    """Functions that read a span of a row, by name, and the spans: row, begin and end of chunks."""
    data, lock = open_log(path).rate.data, library_lock()
    lazy = xr.open_dataset(path, chunks=None, decode_times=False).variables["rate"]
    plain = netCDF4.Dataset(path)["rate"]
    length, scale, fill = plain.chunking()[1], float(plain.scale_factor), int(plain._FillValue)
    plain.set_auto_maskandscale(False)

    def decode(counts: Any) -> Floats:
        out = np.empty(counts.size)
        from_counts(counts, scale, fill, out=out)
        return out

    def read_netcdf(row: int, begin: int, end: int) -> Floats:
        with lock:
            counts = plain[row, begin:end]
        return decode(counts)

    def read_directly(row: int, begin: int, end: int) -> Floats:
        out = np.empty(end - begin)
        read_into(data, row, begin, out)
        return out

    readers: dict[str, Read] = {
        "xarray": lambda row, begin, end: np.asarray(lazy[row, begin:end].values),
        "netCDF4": read_netcdf,
        "gyrostab": read_directly,
    }
    if path.stem == "zlib":
        stored = h5py.File(path)["rate"]
        readers["h5py"] = lambda row, begin, end: decode(stored[row, begin:end])
    size = data.shape[1]
    spans = [
        (row, begin, min(begin + length, size))
        for row in range(data.shape[0])
        for begin in range(0, size, length)
    ]
    return readers, spans


def measure(read: Read, spans: list[tuple[int, int, int]], threads: int) -> tuple[float, float]:
    """Wall and processor time of reading all spans [s]."""
    with ThreadPoolExecutor(threads) as pool:
        begun, used = time.perf_counter(), time.process_time()
        for _ in pool.map(lambda span: float(read(*span)[0]), spans):
            pass
        return time.perf_counter() - begun, time.process_time() - used


def main() -> None:
    """Write the logs, let the readers take turns, and print the table."""
    options = make_parser(__doc__)
    options.add_argument("--hours", type=float, default=5.0)
    options.add_argument("--rounds", type=int, default=10)
    options.add_argument("--folder", type=Path)
    given = options.parse_args()
    lines = []
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        zlib = write_own(Path(folder, "zlib.nc"), given.hours)
        zstd = to_netcdf(open_log(zlib), Path(folder, "zstd.nc"), compression="zstd")
        for path in (zlib, zstd):
            readers, spans = readers_of(path)
            for span in spans:
                for read in readers.values():
                    np.testing.assert_array_equal(read(*span), readers["gyrostab"](*span))
            for threads in (1, 2):
                times: dict[str, list[tuple[float, float]]] = {name: [] for name in readers}
                for _ in range(given.rounds):
                    for name, read in readers.items():
                        times[name].append(measure(read, spans, threads))
                best = {name: np.min(timings, axis=0) for name, timings in times.items()}
                for name, (wall, used) in best.items():
                    ratio = wall / best["gyrostab"][0]
                    figures = (f"{1e3 * wall:.0f}", f"{1e3 * used:.0f}", f"{ratio:.2f}")
                    lines.append([path.stem, str(threads), name, *figures])
    head = ["compression", "threads", "reader", "ms", "processor [ms]", "ratio"]
    text = f"{table(head, lines)}\n\n{machine()}"
    print(text)
    renew(given.output, "readers", text)


if __name__ == "__main__":
    main()
