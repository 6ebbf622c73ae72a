"""A log read once, from front to back, as rows of samples cut into whole blocks; and its channels at any instant."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.noise import HOUR
from gyrostab.schema import log_channels, signal_name
from gyrostab.simulate.drivers import Source, make_source
from gyrostab.store import lazy_slices

__all__ = [
    "Stretch",
    "channel_at",
    "channel_means",
    "numeric_channels",
    "read_stretches",
    "row_count",
    "sample_count",
]

Array = NDArray[np.float64]
_READ = 2**20  # samples over all rows that are read at once, unless a chunk holds more
_WORK = 2**19  # samples over all rows that are worked on at once
_LONG = 2**22  # values of a channel that are read at once


class Stretch(NamedTuple):
    """Some blocks of a log.

    Attributes
    ----------
    first : int
        Number of the first block.
    values : ndarray, shape (row, block, sample)
        The axes [degree hour-1], then the channels on the log's time, NaN where missing.
    """

    first: int
    values: Array


def numeric_channels(log: xr.Dataset) -> tuple[list[str], list[str]]:
    """Names of the channels that stand on the log's own time, and of those that have a time of their own."""
    names = [name for name in log_channels(log) if np.issubdtype(log[name].dtype, np.number)]
    return [name for name in names if log[name].dims == ("time",)], [
        name for name in names if log[name].dims != ("time",)
    ]


def sample_count(log: xr.Dataset) -> int:
    """Samples of the rate: an angle log holds one angle more."""
    return int(log.sizes["time"] - (signal_name(log) == "angle"))


def row_count(log: xr.Dataset) -> int:
    """Rows of a `Stretch`."""
    return int(log.sizes["axis"] + len(numeric_channels(log)[0]))


def read_stretches(log: xr.Dataset, size: int) -> Iterator[Stretch]:
    """Read a log in order, every chunk once.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log; its chunks decide what is read at once.
    size : int
        Samples of a block; what is left over at the end of the log is not read out.

    Yields
    ------
    Stretch
    """
    rows = row_count(log)
    together = max(1, _WORK // (rows * size))
    rest, number = np.empty((rows, 0)), 0
    for values in _rates(log):
        values = np.concatenate([rest, values], axis=1) if rest.shape[1] else values
        block_count = values.shape[1] // size
        for low in range(0, block_count, together):
            high = min(low + together, block_count)
            yield Stretch(
                number + low, values[:, low * size : high * size].reshape(rows, high - low, size)
            )
        number += block_count
        rest = np.array(
            values[:, block_count * size :]
        )  # a copy, so that the rest of the values can go


def _rates(log: xr.Dataset) -> Iterator[Array]:
    """Rates and channels, stretch by stretch; a rate from two angles belongs to the instant of the first."""
    name = signal_name(log)
    axes = log.sizes["axis"]
    signal = log[name].transpose("axis", "time").data
    beside = [log[channel].data for channel in numeric_channels(log)[0]]
    before: Array | None = None
    for low, high in _cuts(signal, axes + len(beside)):
        values = _loaded(signal, beside, low, high)
        if name == "angle":
            whole = values if before is None else np.concatenate([before, values], axis=1)
            before = whole[:, -1:].copy()
            values = whole[:, :-1].copy()
            values[:axes] = np.diff(whole[:axes], axis=1) * (
                float(log.attrs["sampling_rate_hz"]) * HOUR
            )
        yield values


def _cuts(signal: Any, rows: int) -> Iterator[tuple[int, int]]:
    """Stretches that end where chunks end."""
    chunks: Sequence[int] = signal.chunks[1] if hasattr(signal, "chunks") else (signal.shape[1],)
    if len(chunks) == 1 and not hasattr(signal, "chunks"):
        step = max(1, _READ // rows)
        yield from (
            (low, min(low + step, signal.shape[1])) for low in range(0, signal.shape[1], step)
        )
        return
    low = high = 0
    for chunk in chunks:
        high += chunk
        if (high - low) * rows >= _READ:
            yield low, high
            low = high
    if high > low:
        yield low, high


def _loaded(signal: Any, beside: Sequence[Any], low: int, high: int) -> Array:
    import dask

    components = dask.compute(signal[:, low:high], *(channel[low:high] for channel in beside))
    out = np.empty((signal.shape[0] + len(beside), high - low))
    out[: signal.shape[0]] = components[0]
    for row, component in enumerate(components[1:], start=signal.shape[0]):
        out[row] = component
    return out


def channel_at(
    source: Source, instants: NDArray[np.int64], carry: float | None
) -> tuple[Array, float | None]:
    """Values of a channel at rising `instants` [ns since 1970], and what the call for the next ones must be given."""
    stretch = source.stretch(int(instants[0]) - 1, int(instants[-1]))
    component = (
        None
        if stretch is None
        else (stretch, lazy_slices.read_slice(source.values, stretch.low, stretch.high))
    )
    return source.at(instants, component, carry)


def channel_means(log: xr.Dataset, name: str, edges: NDArray[np.int64], *, rms: bool) -> Array:
    """Mean of a channel that has a time of its own over stretches of time; between two of its values where a stretch holds none.

    Parameters
    ----------
    log : xarray.Dataset
        The log.
    name : str
        The channel.
    edges : ndarray of int64, shape (n + 1,)
        Ends of the stretches, rising [ns since 1970].
    rms : bool
        Root mean square in place of the mean.

    Returns
    -------
    ndarray, shape (n,)
        NaN where the channel is silent for longer than three of its usual intervals.
    """
    stamps = log[f"time_{name}"].values.astype("datetime64[ns]").astype(np.int64)
    data = log[name].data
    ends = np.searchsorted(stamps, edges)
    sums, counts = np.zeros(edges.size - 1), np.zeros(edges.size - 1)
    low = 0
    while low < edges.size - 1:
        high = max(int(np.searchsorted(ends, ends[low] + _LONG, side="right")) - 1, low + 1)
        values = np.asarray(lazy_slices.read_slice(data, ends[low], ends[high]), dtype=np.float64)
        good = np.isfinite(values)
        at = np.repeat(np.arange(low, high), np.diff(ends[low : high + 1]))[good]
        sums += np.bincount(at, (values**2 if rms else values)[good], minlength=sums.size)
        counts += np.bincount(at, minlength=sums.size)
        low = high
    with np.errstate(invalid="ignore", divide="ignore"):
        means = sums / counts
    means = np.sqrt(means) if rms else means
    if stamps.size > 1 and stamps.size <= _LONG:
        means = (
            _bridged(means, make_source(log, name), edges, 3 * float(np.median(np.diff(stamps))))
            if (counts > 0).any()
            else means
        )
    return means


def _bridged(means: Array, source: Source, edges: NDArray[np.int64], longest: float) -> Array:
    """Fill stretches without a value from the values on either side, where these are no farther apart than `longest` [ns]."""
    middle = edges[:-1] + np.diff(edges) // 2
    known = source.stamps
    assert known is not None
    after = np.searchsorted(known, middle)
    inside = (after > 0) & (after < known.size)
    near = inside & (
        known[np.clip(after, 1, known.size - 1)] - known[np.clip(after - 1, 0, known.size - 2)]
        <= longest
    )
    fill = np.isnan(means) & near
    if fill.any():
        means = means.copy()
        means[fill] = source.at(middle[fill], None, None)[0]
    return means
