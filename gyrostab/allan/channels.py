"""Averages of the channels of a log (temperature, vibration ...) over the windows of a surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import TimeError
from gyrostab.kernels.regression.trend import window_trend
from gyrostab.schema import find_unusable_channels, log_channels
from gyrostab.store.lazy import fill_masked, read_slice
from gyrostab.time.grid import first_stamp, grid_times
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import HOUR, INNER

TEMPERATURE_RATE = "K hour-1"


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
        ``<channel>(time)`` [unit of the channel, if it has one] and, for temperatures,
        ``<channel>_rate(time)`` [K hour-1]; dask arrays if the channel is one and `part` is None.

    Raises
    ------
    TimeError
        When the times of a channel run backwards.
    """
    out: dict[str, xr.Variable] = {}
    rate, start = float(log.attrs["sampling_rate_hz"]), first_stamp(log)
    selected, inside = groups, slice(None)
    if part is not None:
        selected = [
            group for group in groups if group.start < part.stop and group.stop > part.start
        ]
        inside = slice(part.start - selected[0].start, part.stop - selected[0].start)
    unusable = find_unusable_channels(log)
    for name in log_channels(log):
        if name in unusable:
            continue
        channel = log[name]
        stamps = None
        if channel.dims != ("time",):
            stamps = to_nanoseconds(log.variables[f"time_{name}"].values)
            if (np.diff(stamps) < 0).any():
                raise TimeError(
                    f"time_{name} runs backwards; put the channel in the order of time: "
                    f"log.sortby('time_{name}')"
                )

        bounds = []
        for group in selected:
            first = np.arange(group.start, group.stop) * step
            edges = np.stack([first, first + window])
            if stamps is not None:
                edges = np.searchsorted(stamps, grid_times(start, rate, edges))
            bounds.append(edges)
        trends = _find_trends(channel.data, stamps, rate, bounds, lazy=part is None)
        mean, slope = trends[:, inside]
        units = {key: channel.attrs[key] for key in ("units",) if key in channel.attrs}
        label = str(channel.attrs.get("long_name", name.replace("_", " ")))
        out[name] = xr.Variable(
            ("time",), mean, {"long_name": f"{label}, mean of the window", **units}
        )
        if units.get("units") == INNER["temperature"]:
            out[f"{name}_rate"] = xr.Variable(
                ("time",),
                slope * HOUR,
                {
                    "long_name": f"rate of change of {label}, slope over the window",
                    "units": TEMPERATURE_RATE,
                },
            )
    return out


def _fit_trends(values: Any, stamps: Ints | None, rate: float, a: Ints, b: Ints) -> Floats:
    data = np.ascontiguousarray(fill_masked(values), dtype=np.float64)
    seconds = np.arange(data.size) / rate if stamps is None else (stamps - stamps[:1]) / 1e9
    return np.asarray(window_trend(data, seconds, a, b))


def _find_trends(
    data: Any, stamps: Ints | None, rate: float, bounds: Sequence[Ints], *, lazy: bool
) -> Any:
    """Compute mean and slope of the windows of each group, with these `bounds` (2, n)."""
    lazy = lazy and isinstance(data, da.Array)
    parts = []
    for edges in bounds:
        low, high = int(edges[0, 0]), int(edges[1, -1])
        piece = None if stamps is None else stamps[low:high]
        if lazy:
            trends = dask.delayed(_fit_trends, pure=False)(
                data[low:high], piece, rate, *(edges - low)
            )
            parts.append(da.from_delayed(trends, (2, edges.shape[1]), dtype=np.float64))
        else:
            values = read_slice(data, low, high)
            parts.append(_fit_trends(values, piece, rate, *(edges - low)))
    return (da if lazy else np).concatenate(parts, axis=1)
