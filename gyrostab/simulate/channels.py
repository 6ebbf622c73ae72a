"""Channels of a simulated log, made from functions of time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.schema import RESERVED_NAMES
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import time_coordinate
from gyrostab.time.stamps import stamp_ns
from gyrostab.units import INNER, parse_unit

#: Longest log [s].
MAX_DURATION_S = 1e9
#: Table of a profile: rows of a time [s] and what holds there.
Points = Sequence[Sequence[float]]
#: Attribute of a channel whose values hold until the next one instead of running towards it.
HELD = {"interpolation": "previous"}
_EAGER = 2**20  # longer channels are computed chunk by chunk, when they are used


def inner_unit(unit: str, values: Any) -> tuple[str, Any]:
    """Convert a channel to the internal unit; keep an unknown unit."""
    if unit in INNER.values():
        return unit, values
    try:
        source = parse_unit(unit)
    except ValueError:
        return unit, values
    if source.quantity == "rate":  # of a tool, not of a gyro's output
        return INNER["rotation_rate"], values * (
            source.factor / parse_unit(INNER["rotation_rate"]).factor
        )
    return INNER[source.quantity], values * source.factor + source.offset


def convert_units(environment: xr.Dataset) -> xr.Dataset:
    """Convert every channel to its unit in memory, lazy ones lazily."""
    changed = {}
    for name, variable in environment.data_vars.items():
        if "units" in variable.attrs:
            unit, values = inner_unit(str(variable.attrs["units"]), variable.data)
            changed[name] = (variable.dims, values, variable.attrs | {"units": unit})
    return environment.assign(changed)


def check_points(
    points: Any, where: str, columns: Sequence[str], *, optional: bool = False
) -> Floats:
    """Rows of numbers, the first of which is a time that does not fall; none if `optional`."""
    if optional and not len(points):
        return np.empty((0, len(columns)))
    try:
        table = np.asarray(points, dtype=np.float64)
    except (ValueError, TypeError):
        table = np.empty(0)
    if (
        table.ndim != 2
        or table.shape[0] == 0
        or table.shape[1] != len(columns)
        or not np.isfinite(table).all()
    ):
        raise OptionError(
            f"{where}: {points!r} is not a list of [{', '.join(columns)}]; "
            f"write for instance [{[0.0] * len(columns)}]"
        )
    if np.any(np.diff(table[:, 0]) < 0):
        raise OptionError(f"{where}: the times {table[:, 0].tolist()} do not rise; sort them")
    return table


def piecewise(points: Floats, *, held: bool) -> Callable[[Floats], Floats]:
    """Make a function of time through `points` (time, value), piecewise constant or linear."""
    times, values = points.T

    def at(seconds: Floats) -> Floats:
        if held:
            return np.asarray(
                values[np.maximum(np.searchsorted(times, seconds, side="right") - 1, 0)]
            )
        return np.asarray(np.interp(seconds, times, values))

    return at


def channel(
    name: str,
    unit: str,
    values: Callable[[Floats], Floats],
    *,
    duration: Any,
    start: Any = "1970-01-01",
    sensor_rate: float = 1.0,
    attributes: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """Sample a function of the seconds since the start as a channel with its own time axis.

    Parameters
    ----------
    name, unit : str
        Name of the channel and its unit in memory (`gyrostab.units.INNER`).
    values : callable
        Seconds since the start -> values; called for stretches of time, in any order.
    duration : str or float
        Length of the log, whose end the channel reaches; a number is in seconds.
    start : str or int
        First stamp, ISO 8601.
    sensor_rate : float
        Samples in a second [Hz].
    attributes : mapping, optional
        More attributes.

    Returns
    -------
    xarray.Dataset
        The channel on ``time_<name>``; lazy where it is long.

    Examples
    --------
    >>> found = channel("supply_voltage", "V", lambda t: 28.0 - t / 3600, duration="1h")
    >>> found.supply_voltage.sizes
    Frozen({'time_supply_voltage': 3601})
    """
    if name in RESERVED_NAMES:
        raise OptionError(
            f"channel {name!r}: variables of gyrostab have this name; choose another one"
        )
    if not 0 < sensor_rate <= 1e5:
        raise OptionError(
            f"channel {name!r}: the sensor rate {sensor_rate!r} must be a number of Hz "
            "above 0 and up to 1e5"
        )
    size = count_channel_samples(duration_seconds(duration, "duration"), sensor_rate)
    dim = f"time_{name}"
    attrs = {"units": unit, "long_name": name.replace("_", " "), **(attributes or {})}
    coordinates = time_coordinate(stamp_ns(start), sensor_rate, size, name=dim)
    return xr.Dataset(
        {name: (dim, _sample_values(values, size, sensor_rate), attrs)}, coords=coordinates
    )


def count_channel_samples(seconds: float, sensor_rate: float) -> int:
    """Return the samples of a channel from the start of a log to its end, or the first after it."""
    return math.ceil(seconds * sensor_rate - 1e-6) + 1


def _sample_values(values: Callable[[Floats], Floats], size: int, rate: float) -> Any:
    def part(first: int, count: int) -> Floats:
        return np.asarray(values((first + np.arange(count)) / rate), dtype=np.float64)

    if size <= _EAGER:
        return part(0, size)
    import dask
    import dask.array as da

    make = dask.delayed(part, pure=False)
    spans = [(first, min(_EAGER, size - first)) for first in range(0, size, _EAGER)]
    return da.concatenate(
        [da.from_delayed(make(first, count), (count,), dtype=np.float64) for first, count in spans]
    )


def combine(*parts: xr.Dataset) -> xr.Dataset:
    """Merge environments: their channels, and their concatenated gap tables.

    Raises
    ------
    OptionError
        When two of them have a channel of the same name, or one has that of the times of another.

    Examples
    --------
    >>> from gyrostab.simulate.environment import steps
    >>> warm = steps("temperature", "degC", [[0, 60]], duration="1h")
    >>> sorted(combine(warm, steps("vibration", "g", [[0, 1]], duration="1h")).data_vars)
    ['temperature', 'vibration']
    """
    names: list[Any] = []
    stamps = {str(name) for part in parts for name in part.coords}
    channel_groups, tables = [], []
    for part in parts:
        gaps = [name for name, variable in part.variables.items() if variable.dims == ("gap",)]
        if gaps:
            tables.append(part[gaps])
        channels = part.drop_vars(gaps)
        twice = [name for name in channels.data_vars if name in names]
        of_times = [name for name in channels.data_vars if str(name) in stamps]
        if of_times:
            raise OptionError(
                f"the environment has a channel {of_times[0]!r}, which is the name of the times of "
                "another channel; rename it (channel = ...)"
            )
        if twice:
            raise OptionError(
                f"the environment has the channel {twice[0]!r} twice; leave one out, "
                "or rename it (channel = ...)"
            )
        names += list(channels.data_vars)
        channel_groups.append(channels)
    table = [xr.concat(tables, dim="gap", data_vars="all").sortby("gap_start")] if tables else []
    return xr.merge(
        [*channel_groups, *table],
        combine_attrs="drop_conflicts",
        join="exact",
        compat="no_conflicts",
    )
