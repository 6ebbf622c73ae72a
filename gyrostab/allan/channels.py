"""Averages of the channels of a log (temperature, vibration ...) over the windows of a surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import TimeError
from gyrostab.kernels.regression.trend import window_trend
from gyrostab.schema import log_channels
from gyrostab.store.lazy import read_slice
from gyrostab.time.grid import first_stamp, grid_times
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import HOUR, INNER

TEMPERATURE_RATE = "K hour-1"
#: Largest number of values of a channel that are read at once for all windows of a part.
_MAX_VALUES_READ_AT_ONCE = 2**20


def window_channels(
    log: xr.Dataset, window: int, step: int, groups: Sequence[slice], *, part: slice | None = None
) -> dict[str, xr.Variable]:
    """Average every channel over each window, and find the rate of change of every temperature.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log; a channel lies on ``time`` or on its own ``time_<channel>``.
    window, step : int
        Length and step of the windows [samples of the log].
    groups : sequence of slice
        Windows that are computed together, so that a long channel is never loaded whole; all
        windows, in order.
    part : slice, optional
        Compute only these windows, immediately and in the calling thread.

    Returns
    -------
    dict of str to xarray.Variable
        ``<channel>(time)`` [unit of the channel] and, for temperatures, ``<channel>_rate(time)`` [K
        hour-1]; dask arrays if the channel is one and `part` is None.

    Raises
    ------
    TimeError
        When the times of a channel run backwards.
    """
    out: dict[str, xr.Variable] = {}
    rate, start = float(log.attrs["sampling_rate_hz"]), first_stamp(log)
    for name in log_channels(log):
        channel = log[name]
        if not np.issubdtype(channel.dtype, np.number):
            continue
        stamps = None
        if channel.dims != ("time",):
            stamps = to_nanoseconds(log.variables[f"time_{name}"].values)
            if (np.diff(stamps) < 0).any():
                raise TimeError(
                    f"time_{name} runs backwards; put the channel in the order of time: "
                    f"log.sortby('time_{name}')"
                )

        def ends(
            group: slice, stamps: NDArray[np.int64] | None = stamps
        ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
            first = np.arange(group.start, group.stop) * step
            if stamps is None:
                return first, first + window
            return tuple(
                np.searchsorted(stamps, grid_times(start, rate, edge))
                for edge in (first, first + window)
            )  # type: ignore[return-value]

        mean, slope = _average_windows(channel.data, stamps, rate, groups, ends, part)
        units = channel.attrs.get("units", "1")
        label = str(channel.attrs.get("long_name", name.replace("_", " ")))
        out[name] = xr.Variable(
            ("time",), mean, {"long_name": f"{label}, mean of the window", "units": units}
        )
        if units == INNER["temperature"]:
            out[f"{name}_rate"] = xr.Variable(
                ("time",),
                slope * HOUR,
                {
                    "long_name": f"rate of change of {label}, slope over the window",
                    "units": TEMPERATURE_RATE,
                },
            )
    return out


def _fit_trends(
    values: Any,
    stamps: NDArray[np.int64] | None,
    rate: float,
    a: NDArray[np.int64],
    b: NDArray[np.int64],
) -> NDArray[np.float64]:
    data = np.ascontiguousarray(values, dtype=np.float64)
    seconds = np.arange(data.size) / rate if stamps is None else (stamps - stamps[:1]) / 1e9
    return np.asarray(window_trend(data, seconds, a, b))


def _average_windows(
    data: Any,
    stamps: NDArray[np.int64] | None,
    rate: float,
    groups: Sequence[slice],
    ends: Callable[[slice], tuple[NDArray[np.int64], NDArray[np.int64]]],
    part: slice | None,
) -> tuple[Any, Any]:
    """Compute mean and slope of each window; `ends` gives the bounds of the windows of a group."""
    lazy = isinstance(data, da.Array) and part is None
    selected = slice(0, groups[-1].stop) if part is None else part
    chosen = [
        group for group in groups if group.start < selected.stop and group.stop > selected.start
    ]
    bounds = [ends(group) for group in chosen]
    first, last = int(bounds[0][0][0]), int(bounds[-1][1][-1])
    together = (
        None if lazy or last - first > _MAX_VALUES_READ_AT_ONCE else read_slice(data, first, last)
    )
    parts = []
    for a, b in bounds:
        low, high = int(a[0]), int(b[-1])
        piece = None if stamps is None else stamps[low:high]
        if lazy:
            trends = dask.delayed(_fit_trends, pure=False)(
                data[low:high], piece, rate, a - low, b - low
            )
            parts.append(da.from_delayed(trends, (2, a.size), dtype=np.float64))
        else:
            values = (
                read_slice(data, low, high)
                if together is None
                else together[low - first : high - first]
            )
            parts.append(_fit_trends(values, piece, rate, a - low, b - low))
    trends_of_windows = (da if lazy else np).concatenate(parts, axis=1)[
        :, selected.start - chosen[0].start : selected.stop - chosen[0].start
    ]
    return trends_of_windows[0], trends_of_windows[1]
