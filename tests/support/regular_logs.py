"""Regular logs of counts, cut into pieces, for the tests of archives."""

from __future__ import annotations

import numpy as np
import xarray as xr

from gyrostab.ingest.gap_table import gap_variables
from gyrostab.time.grid import grid_times, time_coordinate

RATE = 50.0
START = int(np.datetime64("2026-03-01T10:00:00", "ns").astype(np.int64))
SIZE = 6000


def signal(size: int = SIZE, *, seed: int = 5, holes: float = 0.05) -> np.ndarray:
    """Return two axes of counts, with stretches missing in both."""
    rng = np.random.default_rng(seed)
    values = np.round(rng.normal(0, 180, (2, size)))
    for start in rng.integers(0, size, int(holes * size / 10)):
        values[:, start : start + rng.integers(1, 20)] = np.nan
    return values


def nan_runs(values: np.ndarray) -> np.ndarray:
    """Return the table of gaps of samples (axis, time) missing in every axis."""
    bad = np.isnan(values).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]))).reshape(-1, 2)
    length = edges[:, 1] - edges[:, 0]
    return np.stack([edges[:, 0], edges[:, 1], length, 0 * length, 0 * length], axis=1)


def log_of(
    values: np.ndarray,
    first: int = 0,
    *,
    rate: float = RATE,
    start: int = START,
    shift: int = 0,
    axes: str = "xy",
) -> xr.Dataset:
    """Make a lazy regular log from sample `first` of a grid on, with its clock `shift` ns late."""
    begin = int(grid_times(start, rate, first)) + shift
    log = xr.Dataset(
        {
            "rate": (("axis", "time"), values, {"units": "degree hour-1"}),
            **gap_variables(nan_runs(values), begin, rate),
        },
        coords={"axis": list(axes), **time_coordinate(begin, rate, values.shape[1])},
        attrs={"kind": "rate", "sampling_rate_hz": rate},
    )
    return rechunked(log, 700)


def rechunked(log: xr.Dataset, length: int) -> xr.Dataset:
    return log.assign(rate=log.rate.chunk(time=length, axis=1))


def cut(values: np.ndarray, *spans: tuple[int, int], **options) -> list[xr.Dataset]:
    return [log_of(values[:, a:b], a, **options) for a, b in spans]


def said(log: xr.Dataset) -> str:
    return " | ".join(log.attrs["notes"])
