"""Move channels whose time stamps are late or early to the time of the gyro."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from gyrostab.schema.checks import log_channels
from gyrostab.time.grid import TimeGridIndex, time_coordinate
from gyrostab.time.stamps import NANOSECONDS


def move_channels(log: xr.Dataset, delays: Mapping[str, float]) -> xr.Dataset:
    """Return a log with earlier time stamps of late channels.

    Parameters
    ----------
    log : xarray.Dataset
        A log with its channels, in memory or lazy.
    delays : mapping
        Name of a channel -> by how much its stamps are late [s]; below zero they are early. Names
        that are not those of channels are ignored.

    Returns
    -------
    xarray.Dataset
        The log, in which each of these channels has its own stamps. Lazy values stay lazy.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> log = make_log(np.zeros((1, 3)), rate=1.0, unit="deg/h", start="2026-01-01T00:01")
    >>> log = log.assign(temperature=("time", [20.0, 21.0, 22.0]))
    >>> move_channels(log, {"temperature": 60.0})["time_temperature"].values[0]
    np.datetime64('2026-01-01T00:00:00.000000000')
    """
    moved, channels = log, log_channels(log)
    for name, delay_s in delays.items():
        if name not in channels:
            continue
        (dim,) = log[name].dims
        own, index = f"time_{name}", log.xindexes[dim]
        delay_ns = round(delay_s * NANOSECONDS)
        stamps = (
            time_coordinate(index.start - delay_ns, index.rate, log.sizes[dim], name=own)
            if isinstance(index, TimeGridIndex)
            else xr.Coordinates({own: log[dim].values - np.timedelta64(delay_ns, "ns")})
        )
        variable = log[name].variable
        moved = (
            moved.drop_vars([name, own], errors="ignore")
            .assign_coords(stamps)
            .assign({name: (own, variable.data, variable.attrs)})
        )
    return moved[list(log.data_vars)]
