"""Rotation of the tool about its axis: rate, toolface, and gravity in the tool frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import OptionError
from gyrostab.simulate.channels import HELD, Points, channel, check_points, combine
from gyrostab.time.durations import duration_seconds


def _integrate_turns(table: Floats, stick_slip: float, period: float) -> tuple[Any, Any]:
    """Compute rate [deg/s] and angle since the start [deg] from a table (time, rate).

    Stick-slip is added.
    """
    times, rates = table.T
    if times.size == 1:
        times, rates = np.append(times, times + 1.0), np.repeat(rates, 2)
    slope = np.diff(rates) / np.maximum(np.diff(times), 1e-9)
    angles = np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2.0 * np.diff(times))])
    omega = 2.0 * math.pi / period

    def pieces(t: Floats) -> tuple[Floats, Ints]:
        return np.clip(t, times[0], times[-1]), np.clip(
            np.searchsorted(times, t, side="right") - 1, 0, slope.size - 1
        )

    def rate(t: Floats) -> Floats:
        return np.asarray(np.interp(t, times, rates) * (1.0 - stick_slip * np.cos(omega * t)))

    def swing(
        t: Floats, base: Floats, rise: Floats
    ) -> Floats:  # integral of base(t) cos(omega t), base rising by `rise`
        return np.asarray(base * np.sin(omega * t) / omega + rise * np.cos(omega * t) / omega**2)

    # the oscillating part of the angle, up to the beginning of each piece
    part = swing(times[1:], rates[1:], slope) - swing(times[:-1], rates[:-1], slope)
    part = np.where(np.diff(times) > 0.0, part, 0.0)  # a step takes no time
    swung = np.concatenate([[0.0], np.cumsum(part)])

    def angle_from_first_point(t: Floats) -> Floats:
        inside, j = pieces(t)
        base = rates[j] + slope[j] * (inside - times[j])
        plain = angles[j] + (rates[j] + base) / 2.0 * (inside - times[j])
        wave = swung[j] + swing(inside, base, slope[j]) - swing(times[j], rates[j], slope[j])
        beyond = t - inside  # before the first and after the last point the drive holds its rate
        edge = np.where(beyond < 0, rates[0], rates[-1])
        wave = wave + edge * (np.sin(omega * t) - np.sin(omega * inside)) / omega
        return np.asarray(plain + edge * beyond - stick_slip * wave)

    at_start = angle_from_first_point(np.zeros(1))

    def angle(t: Floats) -> Floats:
        return np.asarray(angle_from_first_point(t) - at_start)

    return rate, angle


def rotation(
    points: Points,
    *,
    duration: Any,
    start: Any = "1970-01-01",
    stick_slip: float = 0.0,
    period: Any = 4.0,
    inclination: float = 30.0,
    toolface: float = 0.0,
    axis: str = "",
    accelerations: bool = True,
    sensor_rate: float = 100.0,
) -> xr.Dataset:
    """Make the rotation of the tool about its axis, its toolface, and gravity in its frame.

    Parameters
    ----------
    points : list of (time, rate)
        Rotation rate [deg/s], straight between the times [s]: one point for steady rotation, two
        for a ramp. 120 r/min are 720 deg/s.
    stick_slip : float
        Amplitude of the torsional oscillation as a share of the rate; at 1 the tool stands still
        once in a period [1].
    period : str or float
        Period of the oscillation [s]; 2 to 10 s in wells.
    inclination : float
        Angle of the tool's axis from the plumb line [deg].
    toolface : float
        Toolface at the start [deg].
    axis : str
        Gyro axis along the tool's axis, which feels this rotation; empty when the log shall not
        hold it.
    accelerations : bool
        Whether to give ``accel_x``, ``accel_y``, ``accel_z``.
    sensor_rate : float
        Samples of the channels in a second [Hz]; many in a turn.
    duration, start
        As for `steps`.

    Returns
    -------
    xarray.Dataset
        ``rotation_rate`` [degree s-1], ``toolface`` [degree, 0 to 360], and what accelerometers at
        rest in the tool read [g]: z points down the hole, x to the high side at toolface 0, and the
        tool turns clockwise looking down.

    Examples
    --------
    >>> turning = rotation([[0, 360.0]], duration=0.75, sensor_rate=4.0, inclination=90.0)
    >>> turning.toolface.values, turning.accel_x.values.round(3)
    (array([  0.,  90., 180., 270.]), array([ 1.,  0., -1., -0.]))
    """
    table = check_points(points, "points of rotation", ("time [s]", "rate [deg/s]"))
    if not 0.0 <= stick_slip <= 2.0:
        raise OptionError(f"rotation: stick_slip {stick_slip!r} is outside of 0 to 2")
    rate, angle = _integrate_turns(table, stick_slip, duration_seconds(period, "period"))
    tilt = math.radians(inclination)

    def face(t: Floats) -> Floats:
        return np.asarray(np.radians(angle(t) + toolface))

    made = {
        "rotation_rate": ("degree s-1", rate, {"rotation_axis": axis} if axis else {}),
        "toolface": ("degree", lambda t: np.remainder(angle(t) + toolface, 360.0), HELD),
    }
    if accelerations:
        made |= {
            "accel_x": ("g", lambda t: math.sin(tilt) * np.cos(face(t)), {}),
            "accel_y": ("g", lambda t: -math.sin(tilt) * np.sin(face(t)), {}),
            "accel_z": ("g", lambda t: np.full(t.shape, -math.cos(tilt)), {}),
        }
    timing: dict[str, Any] = {"duration": duration, "start": start, "sensor_rate": sensor_rate}
    return combine(
        *(
            channel(name, unit, values, attributes=more, **timing)
            for name, (unit, values, more) in made.items()
        )
    )
