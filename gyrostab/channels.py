"""The channels of a log (temperature, vibration ...) averaged over the windows of a surface."""

from __future__ import annotations

from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.kernels.trend import window_trend
from gyrostab.noise import HOUR
from gyrostab.schema import log_channels
from gyrostab.units import INNER

__all__ = ["window_channels"]

TEMPERATURE_RATE = "K hour-1"


def window_channels(
    log: xr.Dataset, bounds: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64]
) -> dict[str, xr.Variable]:
    """Mean of every channel over each window, and the rate of change of every temperature.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log; a channel lies on ``time`` or on its own ``time_<channel>``.
    bounds : int64 (n_windows, 2)
        First and one-past-last instant of the windows [ns since 1970].
    first, last : int64 (n_windows,)
        The same as sample numbers of the log.

    Returns
    -------
    dict of str to xarray.Variable
        ``<channel>(time)`` [unit of the channel] and, for temperatures, ``<channel>_rate(time)`` [K hour-1]; dask where
        the channel is.
    """
    out: dict[str, xr.Variable] = {}
    for name in log_channels(log):
        channel = log[name]
        if not np.issubdtype(channel.dtype, np.number):
            continue
        if channel.dims == ("time",):
            a, b, stamps = first, last, None
        else:
            stamps = channel[f"time_{name}"].values.astype("datetime64[ns]").astype(np.int64)
            a, b = np.searchsorted(stamps, bounds[:, 0]), np.searchsorted(stamps, bounds[:, 1])
        mean, slope = _means(channel.data, stamps, float(log.attrs["sampling_rate_hz"]), a, b)
        units = channel.attrs.get("units", "1")
        label = str(channel.attrs.get("long_name", name.replace("_", " ")))
        out[name] = xr.Variable(("time",), mean, {"long_name": f"{label}, mean of the window", "units": units})
        if units == INNER["temperature"]:
            out[f"{name}_rate"] = xr.Variable(
                ("time",), slope * HOUR, {"long_name": f"rate of change of {label}, slope over the window", "units": TEMPERATURE_RATE}
            )
    return out


def _trend(values: Any, stamps: NDArray[np.int64] | None, rate: float, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.float64]:
    data = np.ascontiguousarray(values, dtype=np.float64)
    seconds = np.arange(data.size) / rate if stamps is None else (stamps - stamps[:1]) / 1e9
    return np.asarray(window_trend(data, seconds, a, b))


def _means(data: Any, stamps: NDArray[np.int64] | None, rate: float, a: NDArray[np.int64], b: NDArray[np.int64]) -> tuple[Any, Any]:
    """Mean and slope per window, in groups of windows so that a long channel is never held whole."""
    lazy = isinstance(data, da.Array)
    longest = max(1, int(np.max(b - a, initial=1)))
    per_group = max(8, 2**20 // longest)
    parts = []
    for begin in range(0, a.size, per_group):
        group = slice(begin, begin + per_group)
        low, high = int(a[group][0]), int(b[group][-1])
        piece = None if stamps is None else stamps[low:high]
        one = dask.delayed(_trend, pure=False)(data[low:high], piece, rate, a[group] - low, b[group] - low)
        parts.append(da.from_delayed(one, (2, a[group].size), dtype=np.float64))
    both = da.concatenate(parts, axis=1)
    both = both if lazy else both.compute()
    return both[0], both[1]
