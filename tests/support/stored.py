"""A log of counts, and its chunks on disk, for the tests of the working store."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import xarray as xr

from gyrostab.io.datasets import to_netcdf, to_zarr
from gyrostab.store.lazy import Source, make_dask
from gyrostab.time.grid import time_coordinate

WRITERS = {"nc": to_netcdf, "zarr": to_zarr}
RATE = 100.0
CHUNK = 120_000  # 20 minutes at 100 Hz
FACTOR = 0.1 / 3.0
START = 1_790_000_000_123_456_789


class InMemory(Source):
    """An array in memory as a source."""

    def __init__(self, values):
        self.values, self.shape, self.dtype = values, values.shape, values.dtype

    def __getitem__(self, box):
        return self.values[box]


def make_lazy(values, chunk: int):
    """Wrap an array in memory as a dask array, in chunks along its last dimension."""
    return make_dask(InMemory(values), (*values.shape[:-1], chunk))


def counts_log(
    *, samples: int = 2 * CHUNK + 1000, axes: str = "xy", factor: float = FACTOR, dtype: str = "i4"
) -> xr.Dataset:
    """White noise in counts with a gap, and a channel in counts of another factor."""
    rng = np.random.default_rng(5)
    counts = rng.integers(-500, 700, (len(axes), samples)).astype(float)
    counts[0, 100:200] = np.nan
    log = xr.Dataset(
        {
            "rate": (
                ("axis", "time"),
                counts * factor,
                {"units": "degree hour-1"},
                {"dtype": np.dtype(dtype), "scale_factor": factor},
            ),
            "vibration": (
                "time",
                counts[0] * 0.001,
                {"units": "g"},
                {"dtype": np.dtype("i2"), "scale_factor": 0.001},
            ),
        },
        coords={"axis": list(axes)},
        attrs={"sampling_rate_hz": RATE, "kind": "rate"},
    )
    return log.assign_coords(time_coordinate(START, RATE, samples))


def same_bits(a: xr.DataArray, b: xr.DataArray) -> bool:
    """Equal to the last bit, any NaN being like any other, and zero having no sign."""
    left, right = (
        np.where(np.isnan(x.values), np.float64(np.nan), x.values + 0.0).view(np.int64)
        for x in (a, b)
    )
    return a.dims == b.dims and np.array_equal(left, right)


def stored_kinds(path: Path) -> dict[str, str]:
    """Types on disk as other programs see them."""
    if path.is_dir():
        return {
            array.parent.name: np.dtype(json.loads(array.read_text())["dtype"]).name
            for array in path.glob("*/.zarray")
        }
    with netCDF4.Dataset(path) as file:
        return {
            name: getattr(variable.dtype, "name", "text")
            for name, variable in file.variables.items()
        }


def spoil(path: Path, row: int, number: int, *, how: str = "flip", name: str = "rate") -> None:
    """Damage one chunk of a stored log."""
    if path.is_dir():
        chunk = path / name / f"{row}.{number}"
        content = chunk.read_bytes()
        if how == "remove":
            chunk.unlink()
        elif how == "cut":
            chunk.write_bytes(content[: len(content) // 2])
        else:
            place = len(content) // 2
            chunk.write_bytes(
                content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :]
            )
        return
    with h5py.File(path) as file:
        stored = file[name].id
        info = next(
            i
            for i in map(stored.get_chunk_info, range(stored.get_num_chunks()))
            if i.chunk_offset == (row, number * CHUNK)
        )
    with path.open("r+b") as raw:
        raw.seek(info.byte_offset + info.size // 2)
        byte = raw.read(1)[0]
        raw.seek(info.byte_offset + info.size // 2)
        raw.write(bytes([byte ^ 0x55]))
