"""Time and peak memory of `gyrostab run` on files of other programs, one stamp per sample.

    python benchmarks/foreign.py --hours 12 200 --output docs/scaling.md --folder FOLDER

For each length and format the script writes one archive of three axes at 400 Hz (int64 nanoseconds,
doubles in deg/h), runs `gyrostab run` on it in a child process, reads the same file with xarray in
another child process, records the time (after imports) and the peak resident memory of both, and
deletes the archive before it writes the next one. Archives are written block by block, so memory
stays below 1 GiB at any length. 200 h need up to 10 GB of disk for one archive and 10 GB for
temporary columns; a CSV file of 200 h has 18 GB. Give --folder on a disk with 60 GB free: it is
TMPDIR of the runs. The first format is the reference.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from page import in_new_process, machine, make_parser, memory, renew, table
from scaling import AXES, COUNT, RATE, WINDOW, run_log, write_store

from gyrostab.arrays import Floats, Ints

START_NS = 1_777_593_600_000_000_000  # 2026-05-01
BLOCK_ROWS = 2**19
AXIS_NAMES = "xyz"[:AXES]
MAP = [f"gyro_{axis}" for axis in AXIS_NAMES]
Block = tuple[int, Ints, Floats]


def blocks(hours: float) -> Iterator[Block]:
    """First row, stamps [ns since 1970] and values [deg/h], shape (axis, row), block by block."""
    rows = round(hours * 3600 * RATE)
    for number, begin in enumerate(range(0, rows, BLOCK_ROWS)):
        draw = np.random.default_rng((7, number))
        size = min(BLOCK_ROWS, rows - begin)
        stamps = START_NS + np.arange(begin, begin + size) * round(1e9 / RATE)
        yield begin, stamps, COUNT * np.rint(180.0 * draw.standard_normal((AXES, size)) + 300.0)


def write_netcdf(path: Path, hours: float, *, kind: str = "NETCDF4", packed: bool = False) -> Path:
    """Write a CF file with one variable per axis: doubles, or packed and deflated counts."""
    import netCDF4

    with netCDF4.Dataset(path, "w", format=kind) as file:
        file.Conventions = "CF-1.11"
        file.createDimension("time", round(hours * 3600 * RATE))
        options: dict[str, Any] = (
            {"zlib": True, "complevel": 1, "shuffle": True, "chunksizes": (2**18,)}
            if packed
            else {}
        )
        time = file.createVariable("time", "i8", ("time",), **options)
        time.units, time.calendar = "nanoseconds since 1970-01-01", "proleptic_gregorian"
        gyro = [
            file.createVariable(name, "i4" if packed else "f8", ("time",), **options)
            for name in MAP
        ]
        for variable in gyro:
            variable.units = "deg/h"
            if packed:
                variable.scale_factor = COUNT
        for begin, stamps, values in blocks(hours):
            time[begin : begin + stamps.size] = stamps
            for variable, axis in zip(gyro, values, strict=True):
                variable[begin : begin + stamps.size] = axis
    return path


def write_zarr(path: Path, hours: float, *, version: int) -> Path:
    """A store as xarray writes it, with the default codecs of its version."""
    import zarr

    rows = round(hours * 3600 * RATE)
    group = zarr.open_group(path, mode="w", zarr_format=version)
    arrays = {}
    for name, kind in (("time", "i8"), *((name, "f8") for name in MAP)):
        dims: dict[str, Any] = {"dimension_names": ["time"]} if version == 3 else {}
        arrays[name] = group.create_array(
            name, shape=(rows,), chunks=(BLOCK_ROWS,), dtype=kind, **dims
        )
        arrays[name].attrs["units"] = "nanoseconds since 1970-01-01" if name == "time" else "deg/h"
        if version == 2:
            arrays[name].attrs["_ARRAY_DIMENSIONS"] = ["time"]
    for begin, stamps, values in blocks(hours):
        for name, part in zip(arrays, (stamps, *values), strict=True):
            arrays[name][begin : begin + stamps.size] = part
    return path


def write_parquet(path: Path, hours: float) -> Path:
    """Nanosecond timestamps and doubles in row groups of the default size."""
    import pyarrow as pa
    from pyarrow import parquet

    fields = [
        pa.field("time", pa.timestamp("ns")),
        *(pa.field(name, pa.float64(), metadata={"units": "deg/h"}) for name in MAP),
    ]
    with parquet.ParquetWriter(path, pa.schema(fields)) as file:
        for _, stamps, values in blocks(hours):
            columns = [pa.array(stamps.view("datetime64[ns]")), *map(pa.array, values)]
            file.write_table(pa.table(columns, schema=pa.schema(fields)))
    return path


def write_hdf5(path: Path, hours: float, *, matlab: bool = False) -> Path:
    """Vectors as h5py lays them out, or row vectors in deflated chunks as MATLAB does."""
    import h5py

    rows = round(hours * 3600 * RATE)
    options: dict[str, Any] = (
        {"chunks": (2**16, 1), "compression": "gzip", "compression_opts": 3} if matlab else {}
    )
    with h5py.File(path, "w", userblock_size=512 if matlab else 0) as file:
        arrays = {}
        for name, kind in (("time", "i8"), *((name, "f8") for name in MAP)):
            arrays[name] = file.create_dataset(
                name, (rows, 1) if matlab else (rows,), kind, **options
            )
            arrays[name].attrs["units"] = "ns" if name == "time" else "deg/h"
            if matlab:
                arrays[name].attrs["MATLAB_class"] = np.bytes_(
                    b"int64" if kind == "i8" else b"double"
                )
        for begin, stamps, values in blocks(hours):
            for name, part in zip(arrays, (stamps, *values), strict=True):
                arrays[name][begin : begin + stamps.size] = part[:, None] if matlab else part
    if matlab:
        with path.open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file, HDF5 schema 1.00".ljust(124) + b"\x00\x02IM")
    return path


def write_csv(path: Path, hours: float) -> Path:
    """Nanoseconds since 1970 and decimals."""
    import pyarrow as pa
    from pyarrow import csv

    with path.open("wb") as file:
        file.write(
            ",".join(["time [ns]", *(f"{name} [{COUNT:g} deg/h]" for name in MAP)]).encode() + b"\n"
        )
        for _, stamps, values in blocks(hours):
            counts = np.rint(values / COUNT).astype(np.int64)
            text = pa.table([pa.array(stamps), *map(pa.array, counts)], names=["time", *MAP])
            csv.write_csv(text, file, csv.WriteOptions(include_header=False, quoting_style="none"))
    return path


def write_own(path: Path, hours: float) -> Path:
    """The working store of gyrostab: Zarr, or NetCDF by way of it."""
    if path.suffix == ".zarr":
        return write_store(path, hours)
    from gyrostab import to_netcdf
    from gyrostab.io.opening import open_log

    store = write_store(path.with_suffix(".tmp.zarr"), hours)
    to_netcdf(open_log(store), path)
    shutil.rmtree(store)
    return path


#: Name in the table -> ending of the archive, and what writes it.
FORMATS: dict[str, tuple[str, Callable[[Path, float], Path]]] = {
    "own-zarr": ("zarr", write_own),
    "own-netcdf": ("nc", write_own),
    "netcdf": ("nc", write_netcdf),
    "netcdf-packed": ("nc", partial(write_netcdf, packed=True)),
    "netcdf-classic": ("nc", partial(write_netcdf, kind="NETCDF3_64BIT_DATA")),
    "zarr2": ("zarr", partial(write_zarr, version=2)),
    "zarr3": ("zarr", partial(write_zarr, version=3)),
    "parquet": ("parquet", write_parquet),
    "hdf5": ("h5", write_hdf5),
    "matlab": ("mat", partial(write_hdf5, matlab=True)),
    "csv": ("csv", write_csv),
}


def run_file(path: Path, workers: int) -> dict[str, float]:
    """Run in this process, with temporary files next to the file."""
    os.environ["TMPDIR"] = tempfile.tempdir = str(path.parent)
    warnings.simplefilter("ignore")
    return run_log(path, WINDOW, {"workers": workers})


def read_xarray(path: Path, _: int) -> dict[str, float]:
    """Read every value once in this process."""
    import xarray as xr

    begun = time.perf_counter()
    engine = "zarr" if path.suffix == ".zarr" else None
    with xr.open_dataset(path, chunks={"time": 2**21}, engine=engine) as data:
        for name in data.data_vars:
            float(data[name].mean())
    return {"seconds": time.perf_counter() - begun, "peak": memory()}


def measure(
    work: Callable[[Path, int], dict[str, float]], path: Path, given: argparse.Namespace
) -> dict[str, float]:
    """Return the shortest time and the largest peak of several runs."""
    results = [in_new_process(work, path, given.workers) for _ in range(given.rounds)]
    return {
        **min(results, key=lambda result: result["seconds"]),
        "peak": max(result["peak"] for result in results),
    }


def compare(folder: Path, hours: float, given: argparse.Namespace) -> list[list[str]]:
    """One row of the table for each format."""
    rows = []
    reference = 0.0
    for name in given.formats:
        ending, write = FORMATS[name]
        path = write(folder / f"{name}.{ending}", hours)
        os.sync()  # so that the run does not compete with the writing of its input
        size = sum(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())
        run = measure(run_file, path, given)
        read = ["", ""]
        if ending in ("nc", "zarr") and not name.startswith("own"):
            peer = measure(read_xarray, path, given)
            read = [f"{peer['seconds']:.2f}", f"{peer['peak']:.0f}"]
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        reference = reference or run["seconds"]
        rows.append([
            f"{hours:g} h", name, f"{size / 1e9:.2f}", f"{run['seconds']:.2f}",
            f"{run['seconds'] / reference:.1f}", f"{run['processor']:.2f}", f"{run['peak']:.0f}",
            *read,
        ])  # fmt: skip
        print(*rows[-1], sep=" | ", flush=True)
    return rows


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--hours", type=float, nargs="+", default=[12.0])
    parser.add_argument("--formats", nargs="+", choices=list(FORMATS), default=list(FORMATS))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where the archives are made")
    given = parser.parse_args()
    rows = []
    for hours in given.hours:
        with tempfile.TemporaryDirectory(dir=given.folder) as name:
            rows += compare(Path(name), hours, given)
    head = [
        "length", "format", "GB", "seconds", "times own", "processor [s]", "peak MiB",
        "xarray: seconds", "peak MiB",
    ]  # fmt: skip
    machine_line = f"{machine()}; {given.workers} workers, best of {given.rounds}."
    text = f"{table(head, rows)}\n\n{machine_line}"
    print(text)
    renew(given.output, "foreign", text)


if __name__ == "__main__":
    main()
