"""Make a log from an array in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import OptionError
from gyrostab.schema import SIGNAL_LONG_NAMES, SIGNAL_UNITS
from gyrostab.store.write import declare_counts
from gyrostab.time.grid import check_rate, check_span, time_coordinate
from gyrostab.time.stamps import stamp_ns
from gyrostab.units import INNER, parse_unit


def make_log(
    values: Any,
    *,
    rate: float,
    unit: str,
    start: str = "1970-01-01T00:00:00",
    axis: Sequence[str] | None = None,
    kind: str = "rate",
    channels: Mapping[str, tuple[Any, str]] | None = None,
) -> xr.Dataset:
    """Make a regular log from uniformly sampled values.

    Parameters
    ----------
    values : array_like, shape (time,) or (axis, time)
        Rotation rate or cumulative angle; NaN marks a missing sample. numpy or dask, float or
        integer.
    rate : float
        Sampling rate [Hz].
    unit : str
        Unit of the values, for instance ``"deg/s"`` or ``"0.1 arcsec/s"``.
    start : str
        Time of the first sample, ISO 8601, UTC.
    axis : sequence of str, optional
        Names of the axes; x, y, z by default.
    kind : {"rate", "angle"}
        Kind of the values: rates or cumulative angles.
    channels : mapping, optional
        Name -> (values on the same time, unit), for instance ``{"temperature": (t, "degC")}``.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree], and the channels.

    Raises
    ------
    OptionError
        When shape, rate, start or kind is invalid.
    UnitError
        When the unit is unknown or does not fit `kind`.

    Examples
    --------
    >>> log = make_log(np.zeros((3, 1000)), rate=100.0, unit="deg/s", start="2026-01-01")
    >>> log.rate.dims, log.rate.units
    (('axis', 'time'), 'degree hour-1')
    """
    if kind not in SIGNAL_UNITS:
        raise OptionError(f"kind={kind!r}: give 'rate' or 'angle'")
    check_rate(rate, "rate")
    parsed = parse_unit(unit)
    if parsed.quantity != kind:
        raise OptionError(f"unit {unit!r} is a unit of {parsed.quantity}, but kind is {kind!r}")
    data = values if hasattr(values, "ndim") else np.asarray(values)
    packing = declare_counts(data.dtype, parsed.factor) if data.dtype.kind in "iu" else {}
    data = data[None, :] if data.ndim == 1 else data
    names = list(axis) if axis is not None else list("xyz")[: data.shape[0]]
    if data.ndim != 2 or len(names) != data.shape[0]:
        raise OptionError(
            f"values of shape {data.shape} do not fit the axes {names}; give values as (axis, "
            "time) and one name per axis"
        )
    if parsed.factor != 1.0:
        data = data * parsed.factor
    check_span(stamp_ns(start), rate, data.shape[1], "make_log")
    coordinates = time_coordinate(stamp_ns(start), rate, data.shape[1])
    attrs = {
        "units": SIGNAL_UNITS[kind],
        "long_name": SIGNAL_LONG_NAMES[kind],
    }
    log = xr.Dataset(
        {kind: (("axis", "time"), data, attrs, packing)},
        coords=coordinates,
        attrs={"sampling_rate_hz": float(rate), "kind": kind},
    ).assign_coords(axis=names)
    for name, (channel, text) in (channels or {}).items():
        unit_of = parse_unit(text)
        converted = np.asarray(channel) * unit_of.factor + unit_of.offset
        log[name] = (("time",), converted, {"units": INNER[unit_of.quantity]})
    return log
