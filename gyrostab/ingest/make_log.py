"""Make a log from an array in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr

from gyrostab.errors import MissingUnitError, OptionError, UnitError
from gyrostab.ingest.columns.headers import KNOWN_CHANNEL_PATTERN, example_unit, quantity_of
from gyrostab.schema import RESERVED_NAMES, SIGNAL_LONG_NAMES, SIGNAL_UNITS
from gyrostab.store.lazy import hide_infinite
from gyrostab.store.write import declare_counts
from gyrostab.time.grid import check_rate, check_span, time_coordinate
from gyrostab.time.stamps import stamp_ns
from gyrostab.units import INNER, known_units, parse_unit


def make_log(
    values: Any,
    *,
    rate: float,
    unit: str,
    start: Any = "1970-01-01T00:00:00",
    axis: Sequence[str] | None = None,
    kind: str = "rate",
    channels: Mapping[str, tuple[Any, str]] | None = None,
) -> xr.Dataset:
    """Make a regular log from uniformly sampled values.

    Parameters
    ----------
    values : array_like, shape (time,) or (axis, time)
        Rotation rate or cumulative angle; NaN marks a missing sample, and infinite and masked
        values become NaN. numpy or dask, float or integer; of labelled objects, the values only.
    rate : float
        Sampling rate [Hz].
    unit : str
        Unit of the values, for instance ``"deg/s"`` or ``"0.1 arcsec/s"``.
    start : str or datetime
        Time of the first sample; text is ISO 8601, UTC unless it has an offset. A bare number is
        refused.
    axis : sequence of str, optional
        Names of the axes; x, y, z by default.
    kind : {"rate", "angle"}
        Kind of the values: rates or cumulative angles.
    channels : mapping, optional
        Name -> (values on the same time, unit), for instance ``{"temperature": (t, "degC")}``;
        numpy or dask. A channel of another name keeps a unit that is not known, such as m/s.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree], and the channels.

    Raises
    ------
    OptionError
        When values, rate, start, kind or the name of a channel are invalid.
    MissingUnitError, UnitError
        When a unit is missing or unknown, or does not fit `kind` or a channel.

    Examples
    --------
    >>> log = make_log(np.zeros((3, 1000)), rate=100.0, unit="deg/s", start="2026-01-01")
    >>> log.rate.dims, log.rate.units
    (('axis', 'time'), 'degree hour-1')
    """
    if kind not in SIGNAL_UNITS:
        raise OptionError(f"kind={kind!r}: give 'rate' or 'angle'")
    check_rate(rate, "rate")
    if not isinstance(unit, str):
        raise MissingUnitError(f"unit={unit!r}: give the unit of the values, for instance 'deg/s'")
    parsed = parse_unit(unit)
    if parsed.quantity != kind:
        raise OptionError(f"unit {unit!r} is a unit of {parsed.quantity}, but kind is {kind!r}")
    data = _real_numbers(values, "the values")
    packing = declare_counts(data.dtype, parsed.factor) if data.dtype.kind in "iu" else {}
    data = data[None, :] if data.ndim == 1 else data
    given = "xyz"[: len(data) if data.ndim else 0] if axis is None else axis
    names = [str(name) for name in given]
    if data.ndim != 2 or len(names) != data.shape[0]:
        raise OptionError(
            f"values of shape {data.shape} do not fit the axes {names}; give values as (axis, "
            "time) and one name per axis"
        )
    if len(set(names)) < len(names):
        raise OptionError(f"axis={names}: give each axis another name")
    if parsed.factor != 1.0:
        data = data * parsed.factor
    check_span(stamp_ns(start), rate, data.shape[1], "make_log")
    coordinates = time_coordinate(stamp_ns(start), rate, data.shape[1])
    attrs = {"units": SIGNAL_UNITS[kind], "long_name": SIGNAL_LONG_NAMES[kind]}
    log = xr.Dataset(
        {kind: (("axis", "time"), data, attrs, packing)},
        coords=coordinates,
        attrs={"sampling_rate_hz": float(rate), "kind": kind},
    ).assign_coords(axis=names)
    for name, channel in (channels or {}).items():
        log[name] = _channel_variable(name, channel, data.shape[1])
    return log


def _real_numbers(values: Any, label: str) -> Any:
    """Return an array, in dask if it is, with NaN in the place of infinite and masked values."""
    try:
        is_array = isinstance(values, da.Array | np.ma.MaskedArray)
        data: Any = values if is_array else np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise OptionError(f"{label} are not an array: {error}") from error
    if data.dtype.kind not in "biuf":
        raise OptionError(
            f"{label} are of type {data.dtype}; give real numbers, and NaN where one is missing"
        )
    return hide_infinite(data)


def _channel_variable(name: str, channel: Any, size: int) -> xr.Variable:
    """Return a channel in its inner unit, by the rules for files."""
    if name in RESERVED_NAMES:
        raise OptionError(
            f"channel {name!r}: variables of gyrostab have this name; choose another one"
        )
    quantity = quantity_of(name)
    example = example_unit(quantity)
    if not (
        isinstance(channel, tuple | list) and len(channel) == 2 and isinstance(channel[1], str)
    ):
        raise MissingUnitError(
            f"channel {name!r} carries no unit; give values and unit: "
            f"channels={{{name!r}: (values, {example!r})}}"
        )
    values, text = _real_numbers(channel[0], f"the values of channel {name!r}"), channel[1]
    if values.shape != (size,):
        raise OptionError(
            f"channel {name!r} has values of shape {values.shape}, and the log {size} samples; "
            "give one value per sample, NaN where it is missing"
        )
    is_named = KNOWN_CHANNEL_PATTERN.match(name) and quantity != "number"  # a ramp has any unit
    try:
        unit = parse_unit(text, quantity)
    except UnitError:
        unit = None
    if is_named and quantity is not None and (unit is None or unit.quantity != quantity):
        raise UnitError(
            f"channel {name!r}: {text!r} is not a unit of {quantity}; known are "
            f"{known_units(quantity)}"
        )
    if unit is None:
        return xr.Variable("time", values * 1.0, {"units": text})
    converted = values * unit.factor + unit.offset
    return xr.Variable("time", converted, {"units": INNER[unit.quantity]})
