"""One of several logs: its samples, and the samples of the common grid that they take."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.schema import signal_name
from gyrostab.store.lazy import read_slice
from gyrostab.time.grid import TimeGridIndex, first_stamp, grid_times


@dataclass(frozen=True, eq=False)
class Source:
    """A regular log: file name, first stamp [ns since 1970], rate [Hz], number of samples."""

    name: str
    log: xr.Dataset
    start: int
    rate: float
    size: int

    @cached_property
    def end(self) -> int:
        """Stamp of the last sample [ns since 1970]."""
        return int(grid_times(self.start, self.rate, self.size - 1))

    @cached_property
    def axes(self) -> list[str]:
        """Names of the axes in the order of the rows; cached, as the look-up in xarray is slow."""
        return [str(axis) for axis in self.log["axis"].values]


@dataclass(frozen=True, eq=False)
class PlacedLog:
    """A log placed on the common grid."""

    source: Source
    #: (n, 3): first sample of the grid, first sample of the log, length; more than one where the
    #: log's rate differs from the grid's.
    runs: NDArray[np.int64]
    off: float  # offset of its samples from those of the grid [samples]
    #: A stamp of its clock [ns since 1970] and the corresponding sample of the grid.
    clock: tuple[int, int]
    #: Cause (number in schema.GAP_CAUSES) of the gap before it; -1 if the stamps define the gap.
    cause: int = -1

    @property
    def first(self) -> int:
        """First sample of the grid that it takes."""
        return int(self.runs[0, 0])

    @property
    def end(self) -> int:
        """Sample of the grid after its last one."""
        return int(self.runs[-1, 0] + self.runs[-1, 2])

    def on_grid(self, samples: Any) -> NDArray[np.int64]:
        """Return the grid samples of log samples, extrapolated beyond the ends of the log."""
        samples = np.asarray(samples, dtype=np.int64)
        which = np.clip(
            np.searchsorted(self.runs[:, 1], samples, side="right") - 1, 0, len(self.runs) - 1
        )
        return np.asarray(self.runs[which, 0] + samples - self.runs[which, 1])


def read_log_slice(source: Source, begin: int, end: int) -> NDArray[np.float64]:
    """Read the signal of some samples (axis, sample); NaN beyond the ends of a log."""
    data = source.log.variables[signal_name(source.log)].data
    values = np.full((data.shape[0], end - begin), np.nan)
    low, high = min(max(begin, 0), source.size), max(min(end, source.size), 0)
    if high > low:
        values[:, low - begin : high - begin] = read_slice(data, low, high)
    return values


def source_of(log: xr.Dataset, name: str) -> Source:
    """Return a regular log with its first stamp, rate and size."""
    index = log.xindexes.get("time")
    if isinstance(index, TimeGridIndex):
        return Source(name, log, index.start, index.rate, log.sizes["time"])
    return Source(
        name, log, first_stamp(log), float(log.attrs["sampling_rate_hz"]), log.sizes["time"]
    )


def log_span(log: xr.Dataset) -> tuple[int, int]:
    """Return the first and last stamp of a regular log [ns since 1970]."""
    source = source_of(log, "")
    return source.start, source.end


def runs_of(first: int, off: float, size: int, ratio: float) -> NDArray[np.int64]:
    """Return the runs of a log whose sample n lies at grid sample ``first + off + n * ratio``.

    A log that is faster than the grid (ratio < 1) drops a sample now and then; a slower one leaves
    samples of the grid empty.

    Examples
    --------
    >>> runs_of(10, 0.25, 8, 1.1).tolist()  # sample 3 lies at 13.55, sample 4 at 14.65
    [[10, 0, 3], [14, 3, 5]]
    """
    if ratio == 1.0 or size == 1:
        return np.array([[first, 0, size]], dtype=np.int64)

    def shift(n: Any) -> Any:
        return np.rint(off + n * (ratio - 1.0)).astype(np.int64)

    steps = np.arange(1, abs(int(shift(np.int64(size - 1)) - shift(np.int64(0)))) + 1)
    way = 1 if ratio > 1.0 else -1
    at = np.ceil((shift(np.int64(0)) + way * (steps - 0.5) - off) / (ratio - 1.0)).astype(np.int64)
    at = np.clip(at, 1, size - 1)
    at += shift(at) != shift(np.int64(0)) + way * steps  # ties round to even
    begin = np.concatenate([[0], at])
    begin = np.unique(begin[begin < size])
    end = np.append(begin[1:], size)
    if way < 0:
        begin[1:] += 1  # the grid sample of the dropped one is taken
    is_nonempty = end > begin
    begin, end = begin[is_nonempty], end[is_nonempty]
    return np.stack([first + begin + shift(begin), begin, end - begin], axis=1)
