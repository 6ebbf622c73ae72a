"""Align a channel that may drive the gyro, and its rate of change, with the windows at each lag."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import MissingUnitError, OptionError, SchemaError, TimeError, UnitError
from gyrostab.kernels.regression.trend import window_trend
from gyrostab.schema import is_rate_of_change
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import HOUR, INNER, ON_DISK, parse_unit

# A gap is bridged if it is at most as long as a window or this many sample spacings of the channel.
MAX_GAP_SPACINGS = 3.0

#: A name with its power in a unit: "m", "/s2", "s^-1".
_POWER = re.compile(r"(/?)\s*([^\s\d/*^.()+-]+)(?:\^|\*\*)?([+-]?\d+)?")


@dataclass(frozen=True)
class Driver:
    """A channel of the product or a file, or its rate of change (`derived`), by (lag, window).

    `of_product` marks a channel that the product holds in the same unit.
    """

    name: str
    label: str
    units: str
    values: Floats
    derived: bool = False
    of_product: bool = False


def align_drivers(
    product: xr.Dataset, channels: Sequence[str | xr.DataArray], lags: Ints, step: float
) -> list[Driver]:
    """Average channels over the windows, for every lag.

    Parameters
    ----------
    product : xarray.Dataset
        Product with ``time`` and ``time_bounds``.
    channels : sequence of str or DataArray
        Channels of the product, or with a separate time coordinate.
    lags : int64 (n_lags,)
        Lags by which the gyro follows the channels [steps].
    step : float
        Step of the windows [s].

    Returns
    -------
    list of Driver
        A single channel and its rate of change, or several channels without theirs; then a name
        such as ``temperature_rate`` is the rate of change of a channel. NaN where they are unknown.
        Gaps up to one window or three spacings of the channel are interpolated; nothing is
        extrapolated.
    """
    if not channels:
        raise OptionError("give at least one channel, for instance temperature")
    if len(channels) == 1:
        return _align_channel(product, channels[0], lags, step)
    of_files = {str(item.name): item for item in channels if not isinstance(item, str)}
    drivers = []
    for channel in channels:
        rate_of = channel
        if isinstance(channel, str) and channel not in product:
            name = channel.removesuffix("_rate")
            rate_of = of_files.get(name, name)
        drivers.append(_align_channel(product, rate_of, lags, step)[0 if rate_of is channel else 1])
    names = [driver.name for driver in drivers]
    if len(set(names)) < len(names):
        raise OptionError(f"the channels {', '.join(names)} are not all different; name each once")
    return drivers


def _align_channel(
    product: xr.Dataset, channel: str | xr.DataArray, lags: Ints, step: float
) -> list[Driver]:
    """Average a channel and its rate of change over the windows, for every lag."""
    if isinstance(channel, str):
        if channel not in product.data_vars or product[channel].dims != ("time",):
            missing = f" {channel!r}" if _channel_names(product) else "s"
            lack = (
                f"{channel!r} of the product has dimensions {product[channel].dims}, and a channel "
                "lies on time only"
                if channel in product.data_vars
                else f"the product has no channel{missing}"
            )
            raise OptionError(f"{lack}; {suggest_channels(product, channel)}")
        name = channel
        factor, offset, units = _convert_units(product[channel], f"product[{channel!r}]")
        mean, rate = _align_product_channel(product, channel, lags, step)
    else:
        name = str(channel.name or "channel")
        name += "_of_file" * (name in product.variables)
        factor, offset, units = _convert_units(channel, "channel")
        mean, rate = _align_file_channel(channel, product, lags, step)
    mean, rate = mean * factor + offset, rate * factor
    label = name.replace("_", " ")
    return [
        Driver(
            name,
            label,
            units,
            mean,
            derived=is_rate_of_change(name, product),
            of_product=isinstance(channel, str) and product[name].attrs["units"] == units,
        ),
        Driver(
            f"{name}_rate",
            f"rate of change of {label}",
            _multiply_units(_difference_unit(units), {"hour": -1}),
            rate,
            derived=True,
        ),
    ]


def _convert_units(channel: xr.DataArray, expression: str) -> tuple[float, float, str]:
    """Return factor and offset to the inner unit of a channel, and that unit.

    Inner units are kept, and units that are not known, such as m/s.
    """
    text = channel.attrs.get("units")
    if text in INNER.values():
        return 1.0, 0.0, str(text)
    if text is None:
        raise MissingUnitError(
            f"channel {str(channel.name)!r} has no units; set them, for instance "
            f"{expression}.attrs['units'] = 'degC' ('1' for a number without a unit)"
        )
    try:
        unit = parse_unit(str(text))
    except UnitError:
        return 1.0, 0.0, _multiply_units(str(text), {})
    if unit.quantity == "rate":  # the rate of a tool, not that of a gyro
        return unit.factor / HOUR, 0.0, INNER["rotation_rate"]
    return unit.factor, unit.offset, INNER[unit.quantity]


def other_channels(product: xr.Dataset, drivers: Sequence[Driver]) -> list[str]:
    """List the channels of the product except the drivers and their rates of change."""
    bare = {driver.name.removesuffix("_of_file").removesuffix("_rate") for driver in drivers}
    excluded = bare | {f"{name}_rate" for name in bare} | {driver.name for driver in drivers}
    return [name for name in _channel_names(product) if name not in excluded]


def suggest_channels(product: xr.Dataset, unusable: str) -> str:
    """Say which channels of the product could be given instead of one that cannot be used."""
    usable = [
        name
        for name in _channel_names(product)
        if name not in (unusable, f"{unusable}_rate") and np.isfinite(product[name].values).any()
    ]
    if not usable:
        return "give a file with --channel"
    return f"it has {', '.join(usable)}; give another, or a file with --channel"


def _channel_names(product: xr.Dataset) -> list[str]:
    numeric = (
        name for name, v in product.data_vars.items() if v.dims == ("time",) and v.dtype.kind == "f"
    )
    return [str(name) for name in numeric]


def _grid_positions(product: xr.Dataset, step: float) -> Ints:
    time = to_nanoseconds(product["time"].values)
    return np.asarray(np.rint((time - time[0]) / 1e9 / step), dtype=np.int64)


def _shift_by_lags(series: Floats, lead: int, place: Ints, lags: Ints) -> Floats:
    """Take the values one lag earlier, for each lag; `series` begins `lead` steps early."""
    at = place[None, :] - lags[:, None] + lead
    return np.where(at >= 0, series[np.maximum(at, 0)], np.nan)


def _bridge_gaps(series: Floats, max_windows: float) -> Floats:
    """Interpolate over gaps of at most `max_windows` windows, in place; nothing is extrapolated."""
    present = np.flatnonzero(np.isfinite(series))
    wide = np.diff(present)
    for hole in np.flatnonzero((wide > 1) & (wide - 1 <= max_windows)):
        left, right = present[hole], present[hole + 1]
        series[left : right + 1] = np.linspace(series[left], series[right], right - left + 1)
    return series


def _window_length_ns(product: xr.Dataset) -> int:
    """Find the length of a window [ns]."""
    bounds = to_nanoseconds(product["time_bounds"].values)
    return int(np.median(bounds[:, 1] - bounds[:, 0]))


def _align_product_channel(product: xr.Dataset, name: str, lags: Ints, step: float) -> list[Floats]:
    place = _grid_positions(product, step)
    mean = np.full(int(place[-1]) + 1, np.nan)
    mean[place] = product[name].values
    apart = np.diff(np.flatnonzero(np.isfinite(mean)))
    max_windows = (
        max(
            _window_length_ns(product) / 1e9 / step,
            MAX_GAP_SPACINGS * float(np.median(apart)) if apart.size else 0.0,
        )
        + 1e-6
    )
    mean = _bridge_gaps(mean, max_windows)
    rate = np.full(mean.size, np.nan)
    if f"{name}_rate" in product.data_vars:
        rate[place] = product[f"{name}_rate"].values
        rate = _bridge_gaps(rate, max_windows)
    if np.isfinite(rate).sum() < 2 / 3 * np.isfinite(mean).sum():  # most windows hold one value
        rate = _difference_means(mean, step)
    return [_shift_by_lags(row, 0, place, lags) for row in (mean, rate)]


def _difference_means(mean: Floats, step: float) -> Floats:
    """Differentiate a row of window means [per hour] by central differences."""
    slope = np.full(mean.size, np.nan)
    slope[1:-1] = (mean[2:] - mean[:-2]) / (2.0 * step / HOUR)
    return slope


def _align_file_channel(
    channel: xr.DataArray, product: xr.Dataset, lags: Ints, step: float
) -> list[Floats]:
    """Average and differentiate a channel with a separate time coordinate over the windows.

    A channel with fewer than two values per window is interpolated to the window centres instead.
    """
    values, stamps = _check_channel(channel, product)
    place, lead = _grid_positions(product, step), int(lags[-1])
    start = np.rint(np.arange(-lead, place[-1] + 1) * step * 1e9).astype(np.int64)
    start += to_nanoseconds(product["time_bounds"].values[0, 0])
    start[lead + place] = to_nanoseconds(product["time_bounds"].values[:, 0])
    length = _window_length_ns(product)
    first, last = np.searchsorted(stamps, start), np.searchsorted(stamps, start + length)
    held = last - first
    spacing = float(np.median(np.diff(stamps))) if stamps.size > 1 else 0.0
    longest = max(length, MAX_GAP_SPACINGS * spacing)
    if spacing > 0.5 * length:
        mean = interpolate_values(values, stamps, start + length // 2, longest)
        rate = _difference_means(mean, step)
    else:
        mean, rate = window_trend(values, (stamps - stamps[0]) / 1e9, first, last)
        thin = held < 0.5 * np.median(held[held > 0])
        mean[thin] = rate[thin] = np.nan
        max_windows = longest / 1e9 / step + 1e-6
        mean, rate = _bridge_gaps(mean, max_windows), _bridge_gaps(rate * HOUR, max_windows)
    return [_shift_by_lags(row, lead, place, lags) for row in (mean, rate)]


def interpolate_values(values: Floats, stamps: Ints, at: Ints, longest: float) -> Floats:
    """Interpolate between values that are at most `longest` apart; NaN elsewhere."""
    following = np.clip(np.searchsorted(stamps, at), 1, max(stamps.size - 1, 1))
    if stamps.size < 2:
        return np.full(at.size, np.nan)
    apart = stamps[following] - stamps[following - 1]
    share = (at - stamps[following - 1]) / np.maximum(apart, 1)
    is_stamp = (share == 0.0) | (share == 1.0)
    inside = (at >= stamps[0]) & (at <= stamps[-1]) & ((apart <= longest) | is_stamp)
    return np.where(
        inside, values[following - 1] + share * (values[following] - values[following - 1]), np.nan
    )


def _check_channel(channel: xr.DataArray, product: xr.Dataset) -> tuple[Floats, Ints]:
    if channel.ndim != 1 or channel.dtype.kind not in "iuf":
        raise SchemaError(
            f"channel {channel.name!r} must hold numbers along one dimension, time; it has "
            f"dimensions {channel.dims}"
        )
    dim = channel.dims[0]
    if dim not in channel.coords or channel[dim].dtype.kind != "M":
        raise SchemaError(f"channel {channel.name!r} has no datetime coordinate {dim!r}; add one")
    good = np.isfinite(channel.values) & ~np.isnat(channel[dim].values)
    stamps = to_nanoseconds(channel[dim].values[good])
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], channel.values[good][order].astype(np.float64)
    bounds = to_nanoseconds(product["time_bounds"].values)
    if not stamps.size:
        raise SchemaError(f"channel {channel.name!r} holds no value; give one with values")
    if stamps[-1] < bounds[0, 0] or stamps[0] >= bounds[-1, 1]:
        extent = f"{_stamp_text(stamps[0])} to {_stamp_text(stamps[-1])}"
        raise TimeError(
            f"channel {channel.name!r} spans {extent}, the product {_stamp_text(bounds[0, 0])} to "
            f"{_stamp_text(bounds[-1, 1])}: they do not overlap; if the file is in local time, "
            "give its offset from UTC with unit (--unit time=UTC-06:00), and if its time is a "
            "number, the zero of it with epoch (--epoch)"
        )
    return values, stamps


def _stamp_text(stamp: Any) -> str:
    return str(np.datetime64(int(stamp), "ns").astype("datetime64[s]"))


def _unit_powers(units: str) -> dict[str, int]:
    """Return the powers of a unit: ``{"m": 1, "s": -1}`` for ``"m/s"``."""
    text = units.replace("·", " ").replace(" per ", "/")
    if _POWER.sub("", text).strip(" *.()") not in ("", "1"):
        raise UnitError(f"unit {units!r}: write it as a product of powers, for instance 'm s-1'")
    powers: dict[str, int] = {}
    for slash, name, power in _POWER.findall(text):
        powers[name] = powers.get(name, 0) + int(power or 1) * (-1 if slash else 1)
    return powers


def _difference_unit(units: str) -> str:
    """Give the unit of a difference: kelvin for degrees Celsius.

    UDUNITS takes "g" for the gram, which it is in any unit but that of an acceleration.
    """
    if units in (INNER["acceleration"], ON_DISK[INNER["acceleration"]]):
        return "standard_free_fall"
    return units.replace("degree_Celsius", "K")


def _multiply_units(units: str, more: dict[str, int]) -> str:
    powers = _unit_powers(units)
    for name, power in more.items():
        powers[name] = powers.get(name, 0) + power
    words = [name if power == 1 else f"{name}{power}" for name, power in powers.items() if power]
    return " ".join(words) or "1"


def slope_units(units: str, driver: str) -> str:
    """Give the unit of a sensitivity, spelled for UDUNITS.

    Examples
    --------
    >>> slope_units(INNER["rate"], INNER["temperature"]), slope_units("microradian", "K hour-1")
    ('degree hour-1 K-1', 'microradian K-1 hour')
    >>> slope_units(INNER["rate"], "9.80665 m s-2"), slope_units(INNER["rate"], "g cm-3")
    ('degree hour-1 standard_free_fall-1', 'degree hour-1 g-1 cm3')
    """
    below = {name: -power for name, power in _unit_powers(_difference_unit(driver)).items()}
    return _multiply_units(_difference_unit(units), below)
