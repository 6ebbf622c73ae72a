"""Work and memory of the readers stay within the bytes that are there, and within limits that a message names."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import netCDF4
import numpy as np
import pytest

from gyrostab.read import ReadOptions, arrays
from gyrostab.read import netcdf as netcdf_reader


def write_stamped_netcdf(path: Path, rows: int) -> Path:
    """A CF file with an int64 stamp per sample at 400 Hz."""
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("time", rows)
        time = file.createVariable("time", "i8", ("time",))
        time.units = "nanoseconds since 1970-01-01"
        gyro = file.createVariable("gyro_x", "f8", ("time",))
        gyro.units = "deg/h"
        time[:] = np.arange(rows) * 2_500_000
        gyro[:] = np.arange(rows) % 7 + 0.5
    return path


def peak_of(work: Callable[[], object]) -> int:
    """Bytes that Python and numpy allocate at most while `work` runs."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_foreign_netcdf_takes_no_more_memory_when_it_is_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "BATCH_ROWS", 2**16)
    short, long = (write_stamped_netcdf(tmp_path / f"{rows}.nc", rows) for rows in (300_000, 1_500_000))
    netcdf_reader.read(short, ReadOptions(), limit=2**20)  # loads modules
    peaks = [peak_of(lambda path=path: netcdf_reader.read(path, ReadOptions(), limit=2**20)) for path in (short, long)]
    assert peaks[1] < peaks[0] + 2**21
