"""Convert data in memory to logs: changed logs, DataArrays."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import MissingUnitError, OptionError, SchemaError, TimeError, UnitError
from gyrostab.ingest.columns.headers import quantity_of
from gyrostab.ingest.combine import warn_notes
from gyrostab.ingest.dataframe import from_dataframe, keyword_advice
from gyrostab.ingest.formats.packing import Packing
from gyrostab.ingest.uniform import advise_dates, as_uniform
from gyrostab.schema import (
    RESERVED_NAMES,
    SIGNAL_LONG_NAMES,
    SIGNAL_UNITS,
    find_unusable_channels,
    log_channels,
    name_axes,
    refuse_multi_index,
)
from gyrostab.store.cf import DECODING
from gyrostab.store.lazy import convert_values, hide_infinite
from gyrostab.store.private import is_in_memory
from gyrostab.store.read import MIN_LAZY_VALUES, make_variable_lazy
from gyrostab.store.write import declare_counts
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import check_rate
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import HOUR, INNER, Unit, known_units, parse_unit


def as_log(data: Any, *, converts_channels: bool = True) -> xr.Dataset:
    """Convert any supported object to a regular log; functions that take a log call this first.

    Parameters
    ----------
    data : xarray.Dataset, xarray.DataArray, pandas.DataFrame or pandas.Series
        A log, even after xarray operations (see `gyrostab.ingest.uniform.as_uniform`); a signal
        with units on ``time`` or ``(axis, time)``; a table with a DatetimeIndex and units in the
        names of its columns or in ``attrs["units"]``.
    converts_channels : bool
        Convert the known units of channels of a Dataset to the inner ones, as those of the signal.

    Returns
    -------
    xarray.Dataset
        Regular log: uniform time, NaN where samples are missing, consistent attributes.

    Raises
    ------
    SchemaError, TimeError, UnitError, OptionError
        When the object has another type, its time is not uniform or not in order, or its units are
        unknown.
    """
    if isinstance(data, xr.DataArray):
        with keyword_advice("gyrostab.from_dataarray(da, ...)"):
            log = as_uniform(_dataset_of(data, None, None)[0])
        warn_notes(log)
        return log
    if isinstance(data, pd.DataFrame | pd.Series):
        with keyword_advice("gyrostab.from_dataframe(df, ...)"):
            return from_dataframe(data)
    if isinstance(data, xr.Dataset):
        data = _decode_packed(_reset_channels(_keep_on_disk(data)))
        data = _convert_units(data, channels=converts_channels)
    return as_uniform(data)


def _reset_channels(log: xr.Dataset) -> xr.Dataset:
    """Make variables of channels that are coordinates."""
    coordinates = [
        name
        for name, array in log.coords.items()
        if name not in log.dims
        and name not in RESERVED_NAMES
        and array.dims in (("time",), (f"time_{name}",))
        and array.dtype.kind in "iuf"
    ]
    return log.reset_coords(coordinates) if coordinates else log


def _decode_packed(log: xr.Dataset) -> xr.Dataset:
    """Decode the signal and channels that xarray has read without decoding (`mask_and_scale`)."""
    names = {"rate", "angle", *log_channels(log)} & set(log.data_vars)
    packed = {name: log.variables[name] for name in names if _is_packed(log.variables[name])}
    return log.assign({name: _decode_variable(name, array) for name, array in packed.items()})


def _is_packed(variable: xr.Variable) -> bool:
    """Whether attributes say how integers are decoded; decoded values are floats."""
    return variable.dtype.kind in "iu" and not DECODING.isdisjoint(variable.attrs)


def _decode_variable(name: Any, variable: xr.Variable) -> xr.Variable:
    packing = Packing.from_attributes(str(name), variable.dtype, variable.attrs)
    values = convert_values(variable.data, packing.read_values, np.float64)
    attrs = {key: value for key, value in variable.attrs.items() if key not in DECODING}
    return xr.Variable(variable.dims, values, attrs)


def _convert_units(log: xr.Dataset, *, channels: bool = True) -> xr.Dataset:
    """Convert the units of the gyro signal, and of channels, to the inner ones.

    A unit that does not fit the name of its variable is kept, as is one that is not known.
    """
    unusable, converted = find_unusable_channels(log), {}
    signals = [name for name in SIGNAL_UNITS if name in log.data_vars]
    for name in dict.fromkeys([*signals, *(log_channels(log) if channels else ())]):
        variable = log.variables[name]
        quantity = name if name in signals else quantity_of(name)
        text = str(variable.attrs.get("units", INNER["number"]))
        is_number = name not in unusable and variable.dtype.kind in "biuf"
        if not is_number or text in ([INNER[name]] if name in signals else INNER.values()):
            continue
        with suppress(UnitError):
            unit = parse_unit(text, quantity)
            if quantity in (None, "number", unit.quantity):
                attrs = {**variable.attrs, "units": INNER[unit.quantity]}
                data = variable.data * unit.factor + unit.offset
                converted[name] = xr.Variable(variable.dims, data, attrs)
    return log.assign(converted) if converted else log


def _keep_on_disk(log: xr.Dataset) -> xr.Dataset:
    """Make dask arrays of long variables that xarray has not read yet, to read them in parts."""
    unread = {
        name: make_variable_lazy(array.variable, Path(str(array.encoding.get("source", "log"))))
        for name, array in log.data_vars.items()
        if array.size >= MIN_LAZY_VALUES
        and array.chunks is None
        and array.dtype.kind in "iuf"
        and not is_in_memory(array.variable)
    }
    return log.assign(unread) if unread else log


def from_dataarray(
    da: xr.DataArray,
    *,
    units: str | None = None,
    kind: str | None = None,
    rate: float | None = None,
    max_gap: str | float = "10D",
) -> xr.Dataset:
    """Make a regular log from a DataArray.

    Parameters
    ----------
    da : xarray.DataArray
        On ``time`` or on ``axis`` and ``time`` in any order, with a datetime64 coordinate ``time``
        that does not run backwards. Samples may be missing; infinite values become NaN. Numeric
        coordinates on ``time``, such as a temperature, become channels. A lazy array on a uniform
        time axis stays lazy.
    units : str, optional
        Unit of the values; ``da.attrs["units"]`` by default.
    kind : {"rate", "angle"}, optional
        How angles are meant: ``"angle"`` cumulative, ``"rate"`` increments. An array called
        ``angle`` is cumulative.
    rate : float, optional
        Sampling rate [Hz]; found from the stamps when not given.
    max_gap : str or float
        As for `gyrostab.regularise`.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree].

    Raises
    ------
    MissingUnitError, UnitError
        When the unit is not given or not known.
    SchemaError
        When dimensions or coordinates are others.
    TimeError
        When ``time`` runs backwards, or has no sampling rate.
    OptionError
        When the values are angles of unknown kind, or another option is invalid.

    Examples
    --------
    >>> time = pd.date_range("2026-01-01", periods=3, freq="10ms")
    >>> data = xr.DataArray([1.0, 2.0, 4.0], {"time": time}, attrs={"units": "deg/s"})
    >>> log = from_dataarray(data)
    >>> log.rate.values, log.attrs["sampling_rate_hz"]
    (array([[ 3600.,  7200., 14400.]]), 100.0)
    """
    if rate is not None:
        check_rate(rate, "rate")
    longest_gap = duration_seconds(max_gap, "max_gap")
    log, increments = _dataset_of(da, units, kind)
    try:
        regular_log = as_uniform(log)
    except TimeError:
        stamps = np.asarray(log["time"].values)
        if rate is None and (np.isnat(stamps).any() or np.any(stamps[1:] < stamps[:-1])):
            raise
        from gyrostab.ingest.grid.regularise import regularise

        raw = (
            log.drop_vars("time")
            .rename_dims(time="row")
            .assign_coords(time=("row", to_nanoseconds(stamps).view("datetime64[ns]")))
        )
        with keyword_advice():
            regular_log = regularise(
                raw.assign_attrs(source_files=["DataArray"]), rate=rate, max_gap=longest_gap
            )
    warn_notes(regular_log)
    if rate is not None and abs(rate / regular_log.attrs["sampling_rate_hz"] - 1) > 1e-6:
        raise TimeError(
            f"rate={rate:g} Hz, but the time of the DataArray says "
            f"{regular_log.attrs['sampling_rate_hz']:.9g} Hz; leave rate out"
        )
    if increments:
        regular_log["rate"] = regular_log["rate"].copy(
            data=regular_log["rate"].data * (regular_log.attrs["sampling_rate_hz"] * HOUR)
        )
    return regular_log


def _dataset_of(da: xr.DataArray, units: str | None, kind: str | None) -> tuple[xr.Dataset, bool]:
    """Convert an array to a log with unchecked time; also return whether it has increments."""
    _check_array(da)
    unit, name, increments = _find_signal(da, units, kind)
    axes = name_axes(da)
    array = da if "axis" in da.dims else da.drop_vars("axis", errors="ignore").expand_dims("axis")
    signal = array.variable.transpose("axis", "time")
    if _is_packed(signal):
        signal = _decode_variable(da.name or "DataArray", signal)
    given = signal.data  # read once: xarray reads a variable of a file anew
    values = hide_infinite(given)
    data = values * unit.factor if unit.factor != 1.0 else values
    packing = (
        declare_counts(signal.dtype, unit.factor)
        if signal.dtype.kind in "iu" and not increments
        else {}
    )
    attrs = {"long_name": SIGNAL_LONG_NAMES[name], **signal.attrs, "units": SIGNAL_UNITS[name]}
    log_attrs: dict[str, Any] = {"kind": name}
    if isinstance(values, np.ndarray) and (count := int(np.isinf(given).sum())):
        log_attrs["unreadable_cells"] = count
        log_attrs["notes"] = [f"DataArray: {count} gyro cells are infinite and become NaN"]
    bare = _convert_units(_decode_packed(_reset_channels(array.coords.to_dataset())))
    if unusable := find_unusable_channels(bare.reset_coords()):
        log_attrs["notes"] = [
            *log_attrs.get("notes", ()),
            *(f"DataArray: {key!r} is left out: {reason}" for key, reason in unusable.items()),
        ]
    bare = bare.drop_vars([coord for coord in bare.coords if coord not in ("time", "axis")])
    log = bare.assign({name: (("axis", "time"), data, attrs, packing)})
    return log.assign_coords(axis=axes).assign_attrs(log_attrs), increments


def _check_array(da: Any) -> None:
    """Raise `SchemaError` unless this is a gyro signal over dates, and over axes if it has them."""
    if not isinstance(da, xr.DataArray):
        raise SchemaError(
            f"this is a {type(da).__name__}; give an xarray.DataArray, for instance the variable "
            "of a Dataset that holds the gyro, dataset['gyro']"
        )
    refuse_multi_index(da, "DataArray")
    if "unit_label" in da.attrs:
        raise SchemaError(
            f"this is {da.attrs.get('long_name', da.name)} by window, not a gyro signal; give the "
            "log, or the whole product"
        )
    if set(da.dims) not in ({"time"}, {"axis", "time"}):
        raise SchemaError(
            f"the DataArray has dimensions {da.dims}; a log has 'time', or 'axis' and 'time': "
            "rename them, da.rename(...)"
        )
    if "time" not in da.coords or da["time"].dtype.kind != "M":
        advice = advise_dates(da["time"].values, "da") if "time" in da.coords else ""
        raise SchemaError(
            "the DataArray has no datetime64 coordinate 'time'; "
            + (
                f"convert its dates: {advice}"
                if advice
                else "give it one, or use gyrostab.make_log(values, rate=..., unit=...)"
            )
        )


def _find_signal(da: xr.DataArray, units: str | None, kind: str | None) -> tuple[Unit, str, bool]:
    """Return the unit of an array, the name of its signal, and whether it holds increments."""
    unit = _unit_of(da, units)
    if kind not in (None, "rate", "angle"):
        raise OptionError(f"kind={kind!r}: give 'rate' or 'angle'")
    if unit.quantity == "angle" and kind is None and da.name != "angle":
        raise OptionError(
            f"the values are angles ({unit.text}): give kind='angle' if they are cumulative, "
            "kind='rate' if increments"
        )
    increments = unit.quantity == "angle" and kind == "rate"
    if unit.quantity == "rate" and kind == "angle":
        raise OptionError(f"kind='angle', but {unit.text!r} is a unit of rates; leave kind out")
    name = "angle" if unit.quantity == "angle" and not increments else "rate"
    return unit, name, increments


def _unit_of(da: xr.DataArray, units: str | None) -> Unit:
    text = da.attrs.get("units") if units is None else units
    if text is None:
        raise MissingUnitError(
            "the DataArray has no units; give them: gyrostab.from_dataarray(da, units='deg/s'), "
            "or da.attrs['units']"
        )
    unit = parse_unit(str(text))
    if unit.quantity not in SIGNAL_UNITS:
        raise UnitError(
            f"unit {text!r} of the DataArray is a unit of {unit.quantity}; units of rates are "
            f"{known_units('rate')}"
        )
    return unit
