"""Reading of a log, once and in order of time, as batches of blocks; and means of channels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.reduce.aligned_channels import interpolate_linearly, read_clock
from gyrostab.schema import find_unusable_channels, log_channels, signal_name
from gyrostab.simulate.drivers import make_source
from gyrostab.store import lazy
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import HOUR

_SAMPLES_PER_READ = 2**20  # over all rows, unless a chunk holds more; limits memory
_SAMPLES_PER_BATCH = 2**19  # over all rows; limits memory
_CHANNEL_VALUES_PER_READ = 2**22  # limits memory


class BlockBatch(NamedTuple):
    """A batch of consecutive blocks of a log."""

    first: int  # index of the first block
    #: (row, block, sample): the axes [degree hour-1], then the channels on the log's time; NaN
    #: where missing.
    values: Floats


def numeric_channels(log: xr.Dataset) -> tuple[list[str], list[str]]:
    """Return the channels on the log's own time, and those with their own time stamps."""
    unusable = find_unusable_channels(log)
    names = [name for name in log_channels(log) if name not in unusable]
    on_log_time = [name for name in names if log[name].dims == ("time",)]
    return on_log_time, [name for name in names if name not in on_log_time]


def count_samples(log: xr.Dataset) -> int:
    """Count the samples of the rate; an angle log has one angle more."""
    return int(log.sizes["time"] - (signal_name(log) == "angle"))


def read_batches(log: xr.Dataset, size: int) -> Iterator[BlockBatch]:
    """Read a log in order of time, every chunk once, as blocks of `size` samples.

    The chunks set the size of the reads. An incomplete block at the end is not read.
    """
    rows = log.sizes["axis"] + len(numeric_channels(log)[0])
    blocks_per_batch = max(1, _SAMPLES_PER_BATCH // (rows * size))
    remainder, number = np.empty((rows, 0)), 0
    for values in _read_rates(log):
        values = np.concatenate([remainder, values], axis=1) if remainder.shape[1] else values
        block_count = values.shape[1] // size
        for low in range(0, block_count, blocks_per_batch):
            high = min(low + blocks_per_batch, block_count)
            yield BlockBatch(
                number + low, values[:, low * size : high * size].reshape(rows, high - low, size)
            )
        number += block_count
        remainder = values[:, block_count * size :].copy()  # a copy, to free the other values


def _read_rates(log: xr.Dataset) -> Iterator[Floats]:
    """Read rates and channels; the rate from two angles belongs to the time of the first."""
    import dask

    name = signal_name(log)
    axes = log.sizes["axis"]
    signal = log[name].transpose("axis", "time").data
    channels = [log[channel].data for channel in numeric_channels(log)[0]]
    last_angle: Floats | None = None
    for low, high in _split_at_chunks(signal, axes + len(channels)):
        parts = dask.compute(signal[:, low:high], *(channel[low:high] for channel in channels))
        values = np.concatenate([np.atleast_2d(part) for part in parts], dtype=np.float64)
        if name == "angle":
            extended = (
                values if last_angle is None else np.concatenate([last_angle, values], axis=1)
            )
            last_angle = extended[:, -1:].copy()
            values = extended[:, :-1].copy()
            values[:axes] = np.diff(extended[:axes], axis=1) * (
                float(log.attrs["sampling_rate_hz"]) * HOUR
            )
        yield values


def _split_at_chunks(signal: Any, rows: int) -> Iterator[tuple[int, int]]:
    """Split the log into reads that end where chunks end."""
    size = signal.shape[1]
    if not hasattr(signal, "chunks"):
        step = max(1, _SAMPLES_PER_READ // rows)
        yield from ((low, min(low + step, size)) for low in range(0, size, step))
        return
    low = high = 0
    for chunk in signal.chunks[1]:
        high += chunk
        if (high - low) * rows >= _SAMPLES_PER_READ:
            yield low, high
            low = high
    if high > low:
        yield low, high


def is_rms_channel(name: str) -> bool:
    """Return whether a channel enters blocks by its root mean square, not by its mean."""
    return name.startswith("vibration")


def channel_means(log: xr.Dataset, name: str, edges: Ints, *, rms: bool) -> Floats:
    """Average a channel with its own time stamps over intervals, interpolating empty intervals.

    The ends of the intervals rise [ns since 1970]. The mean, or the root mean square, is NaN where
    the channel has no value for longer than three of its median intervals.
    """
    data, ends = log[name].data, read_clock(log, name).count_before(edges)
    sums, counts = np.zeros(edges.size - 1), np.zeros(edges.size - 1)
    low = 0
    while low < edges.size - 1:
        high = max(
            int(np.searchsorted(ends, ends[low] + _CHANNEL_VALUES_PER_READ, side="right")) - 1,
            low + 1,
        )
        values = np.asarray(lazy.read_slice(data, ends[low], ends[high]), dtype=np.float64)
        good = np.isfinite(values)
        number = np.repeat(np.arange(low, high), np.diff(ends[low : high + 1]))[good]
        sums += np.bincount(number, (values**2 if rms else values)[good], minlength=sums.size)
        counts += np.bincount(number, minlength=sums.size)
        low = high
    with np.errstate(invalid="ignore", divide="ignore"):
        means = sums / counts
    means = np.sqrt(means) if rms else means
    if not (1 < data.size <= _CHANNEL_VALUES_PER_READ and counts.any()):
        return means
    stamps = to_nanoseconds(log[f"time_{name}"].values)
    source = make_source(log, name)
    assert source.stamps is not None
    line = interpolate_linearly(
        edges[:-1] + np.diff(edges) // 2,
        source.stamps,
        source.values,
        3 * float(np.median(np.diff(stamps))),
        hold_previous=source.held,
    )
    return np.where(np.isnan(means), line, means)


def finite_range(data: Any) -> tuple[float, float]:
    """Return the smallest and largest number; infinite and in reverse order without numbers."""
    import dask.array as da

    array = da.asarray(data)
    finite = da.isfinite(array)
    low, high = da.compute(
        da.where(finite, array, np.inf).min(), da.where(finite, array, -np.inf).max()
    )
    return float(low), float(high)
