"""Environment of a simulated tool: functions that make the driving channels.

Times are seconds since the start of the log. ``PROFILES`` lists the functions and the units of
their parameters for models.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.simulate.channels import (
    HELD,
    Points,
    channel,
    check_points,
    combine,
    count_channel_samples,
    inner_unit,
    piecewise,
)
from gyrostab.time.durations import duration_seconds


def _make_from_points(
    name: str,
    unit: str,
    points: Points,
    held: bool,
    duration: Any,
    start: Any,
    sensor_rate: float,
    **extra: Any,
) -> xr.Dataset:
    table = check_points(points, f"points of {name}", ("time [s]", f"{name} [{unit}]"))
    inner, table[:, 1] = inner_unit(unit, table[:, 1])
    return channel(
        name,
        inner,
        piecewise(table, held=held),
        duration=duration,
        start=start,
        sensor_rate=sensor_rate,
        attributes={**(HELD if held else {}), **extra},
    )


def steps(
    channel: str,
    unit: str,
    points: Points,
    *,
    duration: Any,
    start: Any = "1970-01-01",
    sensor_rate: float = 1.0,
) -> xr.Dataset:
    """Make a piecewise constant channel.

    Parameters
    ----------
    channel, unit : str
        Name and unit of the channel.
    points : list of (time, value)
        Each value [unit] holds from its time [s] to the next, and the first one before it too.
    duration : str or float
        Length of the log.
    start : str
        Time of its first sample.
    sensor_rate : float
        Samples of the channel in a second [Hz].

    Examples
    --------
    >>> steps("pressure", "bar", [[0, 1], [2, 300]], duration=4.0).pressure.values
    array([  100000.,   100000., 30000000., 30000000., 30000000.])
    """
    return _make_from_points(channel, unit, points, True, duration, start, sensor_rate)


def ramps(
    channel: str,
    unit: str,
    points: Points,
    *,
    duration: Any,
    start: Any = "1970-01-01",
    sensor_rate: float = 1.0,
) -> xr.Dataset:
    """Make a piecewise linear channel; arguments as for `steps`.

    Examples
    --------
    >>> ramps("temperature", "degC", [[0, 20], [4, 60]], duration=4.0).temperature.values
    array([20., 30., 40., 50., 60.])
    """
    return _make_from_points(channel, unit, points, False, duration, start, sensor_rate)


def vibration(
    points: Points,
    *,
    duration: Any,
    start: Any = "1970-01-01",
    sensor_rate: float = 1.0,
    band: Sequence[float] = (20.0, 2000.0),
) -> xr.Dataset:
    """Make vibration (rms acceleration), on and off or in steps, with a flat band spectrum.

    Parameters
    ----------
    points : list of (time, rms)
        Each rms acceleration [g] holds from its time [s] to the next, and the first one before it
        too. Wang et al. 2016: [[0, 0.02], [330, 13.39], [630, 0.02]].
    band : (float, float)
        Edges of the band [Hz]; Wang et al. 2016: up to 1 g^2/Hz at 700 to 800 Hz.
    duration, start, sensor_rate
        As for `steps`.

    Returns
    -------
    xarray.Dataset
        ``vibration`` [g], with the attributes ``band_hz`` and ``interpolation``.

    Examples
    --------
    >>> shaken = vibration([[0, 0.0], [1, 10.0]], duration=2.0, band=(700, 800)).vibration
    >>> shaken.values, shaken.attrs["band_hz"]
    (array([ 0., 10., 10.]), [700.0, 800.0])
    """
    try:
        low, high = (float(edge) for edge in band)
    except (TypeError, ValueError):
        low = high = math.nan
    if not 0.0 <= low < high:
        raise OptionError(f"band of vibration {band!r}: give [lower, higher] frequency in Hz")
    return _make_from_points(
        "vibration", "g", points, True, duration, start, sensor_rate, band_hz=[low, high]
    )


def chamber(
    *,
    duration: Any,
    start: Any = "1970-01-01",
    low: float = -40.0,
    high: float = 60.0,
    speed: float = 1.0,
    hold: Any = 1800.0,
    first: str = "low",
    lag: Any = 0.0,
    channel: str = "temperature",
    sensor_rate: float = 1.0,
) -> xr.Dataset:
    """Make the temperature of a thermal chamber cycle; by default the test of Li et al. 2013.

    Parameters
    ----------
    low, high : float
        Ends [degC].
    speed : float
        Rate of change between them [degC/min].
    hold : str or float
        Time at each end [s].
    first : {"low", "high"}
        End at which the test begins.
    lag : str or float
        Time constant by which the gyro follows the chamber [s]; 0 for at once.
    channel : str
        Name of the channel.
    duration, start, sensor_rate
        As for `steps`.

    Examples
    --------
    >>> chamber(duration="190min").temperature[::1900].values.round(1)[:6]
    array([-40. , -38.3,  -6.7,  25. ,  56.7,  60. ])
    """
    if not (low < high and speed > 0):
        raise OptionError(
            f"chamber: give low below high and a speed above 0, not {low!r}, {high!r}, {speed!r}"
        )
    if first not in ("low", "high"):
        raise OptionError(f"chamber: first is 'low' or 'high', not {first!r}")
    seconds, wait = duration_seconds(duration, "duration"), _to_seconds(hold)
    way = (high - low) / speed * 60.0
    if (wait + way) * sensor_rate < 1.0:
        raise OptionError(
            f"chamber: half a cycle takes {wait + way:g} s, less than the interval of a sensor "
            f"with {sensor_rate:g} Hz; give a longer hold, a lower speed or a higher sensor_rate"
        )
    count = math.ceil(seconds / (wait + way)) + 1
    begin = np.arange(count) * (wait + way)
    ends = np.where(np.arange(count) % 2 == (first == "high"), low, high)
    table = np.stack([np.stack([begin, begin + wait], axis=1).ravel(), np.repeat(ends, 2)], axis=1)
    return _make_temperature(
        channel, piecewise(table, held=False), seconds, start, sensor_rate, _to_seconds(lag)
    )


def _to_seconds(value: Any) -> float:
    return 0.0 if value == 0 else duration_seconds(value, "time")


def _make_temperature(
    name: str, function: Any, seconds: float, start: Any, sensor_rate: float, lag: float
) -> xr.Dataset:
    felt = function(np.arange(count_channel_samples(seconds, sensor_rate)) / sensor_rate)
    if lag > 0.0:
        from gyrostab.kernels.thermal import lag_values

        felt, _ = lag_values(felt, sensor_rate, lag)

    def values(t: Floats) -> Floats:
        return np.asarray(felt[np.rint(t * sensor_rate).astype(np.int64)])

    return channel(
        name, "degree_Celsius", values, duration=seconds, start=start, sensor_rate=sensor_rate
    )


def trip(
    depths: Points,
    *,
    duration: Any,
    start: Any = "1970-01-01",
    surface: float = 15.0,
    gradient: float = 30.0,
    circulation: Points = (),
    cooling: float = 0.4,
    response: Any = 600.0,
    channel: str = "temperature",
    sensor_rate: float = 1.0,
) -> xr.Dataset:
    """Make the temperature and depth of a tool that is run in hole, drills and is pulled out.

    The tool follows the mud around it with a time constant. Standing mud has the temperature of the
    rock, ``surface + gradient depth``; mud that circulates comes from above and takes a share of
    that warmth away.

    Parameters
    ----------
    depths : list of (time, depth)
        Vertical depth [m], straight between the times [s]. A trip in goes at 300 to 600 m/h,
        drilling at 5 to 30 m/h.
    surface : float
        Temperature of the rock at the surface [degC].
    gradient : float
        Rise with depth [degC/km].
    circulation : list of (from, to)
        Times at which the pumps run [s].
    cooling : float
        Share of ``gradient depth`` that circulating mud takes away [1].
    response : str or float
        Time constant of the tool [s].
    channel : str
        Name of the temperature channel; the depth is ``depth`` [m].
    duration, start, sensor_rate
        As for `steps`.

    Examples
    --------
    >>> down = trip([[0, 0], [7200, 1000]], duration="5h")
    >>> down.temperature[[0, -1]].values.round(1), down.depth.values[-1]
    (array([15., 45.]), np.float64(1000.0))
    """
    table = check_points(depths, "depths of trip", ("time [s]", "depth [m]"))
    ends = ("from [s]", "to [s]")
    pumps = check_points(circulation, "circulation of trip", ends, optional=True)
    depth = piecewise(table, held=False)

    def mud(t: Floats) -> Floats:
        warmth = gradient / 1000.0 * depth(t)
        flows = np.zeros(t.shape, dtype=bool)
        for begin, end in pumps:
            flows |= (t >= begin) & (t < end)
        return np.asarray(surface + warmth * np.where(flows, 1.0 - cooling, 1.0))

    seconds = duration_seconds(duration, "duration")
    warm = _make_temperature(channel, mud, seconds, start, sensor_rate, _to_seconds(response))
    return combine(
        warm, _make_from_points("depth", "m", depths, False, seconds, start, sensor_rate)
    )


def supply(
    *,
    duration: Any,
    start: Any = "1970-01-01",
    full: float = 29.0,
    empty: float = 22.0,
    life: Any = 720_000.0,
    loads: Points = (),
    sensor_rate: float = 1.0,
) -> xr.Dataset:
    """Make the voltage of a discharging battery under load.

    Parameters
    ----------
    full, empty : float
        Voltage without load at the beginning and at the end of its life [V]; flat first, falling
        fast at the end.
    life : str or float
        Life of the battery [s].
    loads : list of (from, to, drop)
        Times [s] at which another load is on, and the voltage that it takes [V].
    duration, start, sensor_rate
        As for `steps`.

    Examples
    --------
    >>> supply(duration=3.0, life=4.0, loads=[[1, 2, 0.5]]).supply_voltage.values.round(2)
    array([29.  , 28.28, 28.11, 26.68])
    """
    columns = ("from [s]", "to [s]", "drop [V]")
    table = check_points(loads, "loads of supply", columns, optional=True)
    end = duration_seconds(life, "life")

    def voltage(t: Floats) -> Floats:
        used = np.clip(t / end, 0.0, 1.0)
        # a plateau that sags, then the end
        level = full - (full - empty) * (0.5 * used**2 + 0.5 * used**8)
        for begin, until, drop in table:
            level = level - drop * ((t >= begin) & (t < until))
        return np.asarray(level)

    return channel(
        "supply_voltage", "V", voltage, duration=duration, start=start, sensor_rate=sensor_rate
    )


def light_power(
    *,
    duration: Any,
    start: Any = "1970-01-01",
    power: float = 1e-4,
    loss: float = 1.0,
    points: Points = (),
    sensor_rate: float = 1.0,
) -> xr.Dataset:
    """Make the optical power at the detector, which falls as the source ages.

    Parameters
    ----------
    power : float
        Power at the start [W].
    loss : float
        Loss in a thousand hours [dB].
    points : list of (time, loss)
        More loss [dB], straight between the times [s]: heat, bends, radiation.
    duration, start, sensor_rate
        As for `steps`.

    Examples
    --------
    >>> found = light_power(duration="1h", loss=0.0, points=[[0, 0], [3600, 3.0103]])
    >>> found.light_power[[0, 1800]].values.round(7)
    array([1.00e-04, 7.07e-05])
    """
    columns = ("time [s]", "loss [dB]")
    table = check_points(points if len(points) else [(0, 0)], "points of light_power", columns)
    more = piecewise(table, held=False)

    def level(t: Floats) -> Floats:
        return np.asarray(power * 10.0 ** (-(loss * t / 3.6e6 + more(t)) / 10.0))

    return channel(
        "light_power", "W", level, duration=duration, start=start, sensor_rate=sensor_rate
    )
