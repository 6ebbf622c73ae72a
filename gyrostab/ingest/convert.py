"""Convert data in memory to logs: changed logs, DataArrays, pandas tables."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import (
    GyrostabError,
    MissingUnitError,
    OptionError,
    SchemaError,
    TimeError,
    UnitError,
)
from gyrostab.ingest.uniform import advise_dates, as_uniform
from gyrostab.schema import SIGNAL_LONG_NAMES, SIGNAL_UNITS, texts
from gyrostab.store.private import is_in_memory
from gyrostab.store.read import MIN_LAZY_VALUES, make_variable_lazy
from gyrostab.store.write import declare_counts
from gyrostab.units import HOUR, Unit, known_units, parse_unit

#: An option of a command with its value, as messages on files advise it.
_OPTION = re.compile(
    r"--(map|unit|kind|rate|max-gap|axis)\b"
    r'(?: ("[^"]*=[^"]*"|[^\s,;:()]+=[^\s,;:()]+)'
    r"|(?<=kind) (angle|rate)\b|(?<=rate) (HZ|[\d.e+-]+))?"
)
#: Advice that only concerns files, and its replacement.
_FILE_ADVICE = (
    ("; gyrostab scan DataFrame inspects each column", ""),
    (
        "the separator, the columns that --map names and the unit of time",
        "the columns and the index",
    ),
    (
        "check the time column and its unit, or leave it out (--map) and give --rate HZ",
        "correct the times, or use gyrostab.make_log(values, rate=..., unit=...)",
    ),
)


def as_log(data: Any) -> xr.Dataset:
    """Convert any supported object to a regular log; functions that take a log call this first.

    Parameters
    ----------
    data : xarray.Dataset, xarray.DataArray, pandas.DataFrame or pandas.Series
        A log, also after xarray operations (see `gyrostab.ingest.uniform.as_uniform`); a signal
        with units on ``time`` or ``(axis, time)``; a table with a DatetimeIndex and units in the
        names of its columns or in ``attrs["units"]``.

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
        return as_uniform(_dataset_of(data, None, None)[0])
    if isinstance(data, pd.DataFrame | pd.Series):
        return from_dataframe(data)
    return as_uniform(_keep_on_disk(data) if isinstance(data, xr.Dataset) else data)


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


def from_dataframe(
    df: pd.DataFrame | pd.Series,
    *,
    units: str | Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    kind: str | None = None,
    rate: float | None = None,
    max_gap: str | float = "10D",
) -> xr.Dataset:
    """Make a regular log from a pandas table with a time index.

    Parameters
    ----------
    df : pandas.DataFrame or Series
        A column for each gyro axis (``gyro_x`` or ``x``; ``angle_x``) and channel (``temperature``
        ...), with a DatetimeIndex (UTC, or with a time zone) that does not run backwards. Samples
        may be missing.
    units : str or mapping, optional
        Unit of all gyro columns (``"deg/s"``), or units by column (``{"gyro": "deg/s",
        "temperature": "degC"}``). By default those in the names of the columns (``"gyro_x
        [deg/s]"``), or in ``df.attrs["units"]``.
    map : mapping, optional
        Column name -> contract name: ``{"wx": "gyro_x"}``; ``"-"`` drops a column.
    kind : {"rate", "angle"}, optional
        How angle columns are meant: ``"angle"`` cumulative, ``"rate"`` increments.
    rate : float, optional
        Sampling rate [Hz]; found from the index when not given.
    max_gap : str or float
        As for `gyrostab.regularise`.

    Returns
    -------
    xarray.Dataset
        ``rate(axis, time)`` [degree hour-1] or ``angle(axis, time)`` [degree], channels and table
        of gaps, as from `gyrostab.regularise`.

    Raises
    ------
    MissingUnitError
        When the gyro columns carry no unit.
    SchemaError
        When the index does not hold times.
    TimeError
        When the index runs backwards, or has no sampling rate.
    FormatError, OptionError, UnitError
        When no column is a gyro axis, or an option or unit is not understood.

    Examples
    --------
    >>> index = pd.date_range("2026-01-01", periods=4, freq="10ms").delete(2)
    >>> log = from_dataframe(pd.DataFrame({"gyro_x": [1.0, 2.0, 4.0]}, index), units="deg/h")
    >>> log.rate.values, log.attrs["sampling_rate_hz"]
    (array([[ 1.,  2., nan,  4.]]), 100.0)
    """
    from gyrostab.ingest.grid.regularise import regularise

    with _keyword_advice():
        raw = _read_frame(df, units=units, map=map, kind=kind)
        log = regularise(raw, rate=rate, max_gap=max_gap)
    log.attrs["notes"] = [_name_keywords(note) for note in texts(log, "notes")]
    _warn_notes(log)
    return log


def _read_frame(
    frame: pd.DataFrame | pd.Series,
    *,
    units: str | Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    kind: str | None = None,
) -> xr.Dataset:
    """Read a pandas table into a raw log, by the rules for files."""
    from gyrostab.ingest.columns.headers import FileColumn, split_header
    from gyrostab.ingest.columns.plan import plan_columns
    from gyrostab.ingest.columns.typed import read_columns
    from gyrostab.ingest.options import ReadOptions
    from gyrostab.ingest.reading import check_options

    table = (
        frame.to_frame("x" if frame.name is None else frame.name)
        if isinstance(frame, pd.Series)
        else frame
    )
    if not isinstance(table, pd.DataFrame):
        raise SchemaError(
            f"this is a {type(frame).__name__}; give a pandas DataFrame or Series with a "
            "DatetimeIndex"
        )
    index = _check_index(table)
    if table.empty:
        raise SchemaError(
            f"the DataFrame has {len(table)} rows and {table.shape[1]} columns; a log needs at "
            "least two rows and a column for a gyro axis"
        )
    units = frame.attrs.get("units") if units is None else units
    headers = [str(column) for column in table.columns]
    renamed = dict(map or {})
    if not isinstance(units, Mapping):
        keys = {key.strip().lower() for key in renamed}
        lows = {header: split_header(header)[0].lower() for header in headers}
        renamed |= {
            header: f"gyro_{low}"
            for header, low in lows.items()
            if low in ("x", "y", "z") and keys.isdisjoint((low, header.strip().lower()))
        }
    units_by_name = {"gyro": str(units)} if isinstance(units, str) else dict(units or {})
    options = ReadOptions(map=renamed, unit=units_by_name, kind=kind)
    stamps = index.to_numpy()

    def fetch(source: int, begin: int, end: int) -> Any:
        return stamps[begin:end] if source == 0 else table.iloc[begin:end, source - 1].to_numpy()

    try:
        columns = [FileColumn("time", stamped=True), *(FileColumn(header) for header in headers)]
        plan = plan_columns(Path("DataFrame"), columns, options)
        raw = read_columns(plan, options, len(table), fetch)
        check_options([raw])
    except MissingUnitError as error:
        problem = str(error).split("; give")[0]
        raise MissingUnitError(
            f"{problem}; give it: gyrostab.from_dataframe(df, units='deg/s'), "
            "units={'gyro': 'deg/s', 'temperature': 'degC'}, df.attrs['units'] = 'deg/s', or the "
            "name of the column, 'gyro_x [deg/s]'"
        ) from error
    return raw


@contextmanager
def _keyword_advice() -> Iterator[None]:
    """Let errors name keywords of functions, where those on files name options of commands."""
    try:
        yield
    except GyrostabError as error:
        error.args = (_name_keywords(str(error)),)
        raise


def _name_keywords(message: str) -> str:
    """Name keywords in the place of options, and leave out what only concerns files.

    Examples
    --------
    >>> _name_keywords('DataFrame: keep one: --map "x y=gyro_x" --unit gyro=deg/s or --kind rate')
    "DataFrame: keep one: map={'x y': 'gyro_x'}, units={'gyro': 'deg/s'} or kind='rate'"
    """

    def name_keyword(match: re.Match[str]) -> str:
        option, value = (
            match[1].replace("-", "_"),
            next(filter(None, match.groups()[1:]), "").strip('"'),
        )
        keyword = "units" if option == "unit" else option
        key, equals, target = value.rpartition("=")
        if equals:
            return f"{keyword}={{{key!r}: {target!r}}}"
        if not value or value == "HZ":
            return keyword + f"={value}" * bool(value)
        return f"{keyword}={value if option == 'rate' else repr(value)}"

    for text, replacement in _FILE_ADVICE:
        message = message.replace(text, replacement)
    return _OPTION.sub(name_keyword, message.replace('" --unit ', '", --unit '))


def _check_index(table: pd.DataFrame) -> pd.DatetimeIndex:
    """Return the stamps in UTC; raise an error if they run backwards."""
    index: Any = table.index
    columns: Any = table.columns
    if not isinstance(index, pd.DatetimeIndex):
        advice = (
            "transpose it: df.T"
            if isinstance(columns, pd.DatetimeIndex)
            else "convert it: df.to_timestamp()"
            if isinstance(index, pd.PeriodIndex)
            else "convert it: df.set_index(df.index.to_datetimeindex(time_unit='ns'))"
            if isinstance(index, xr.CFTimeIndex)
            else "set one: df.set_index(pd.DatetimeIndex(...))"
        )
        raise SchemaError(
            f"the index of the DataFrame holds {index.inferred_type}, not times; {advice}"
        )
    index = index.tz_convert("UTC").tz_localize(None) if index.tz is not None else index
    places = np.flatnonzero(index.notna())  # rows without a stamp are placed by their neighbours
    if not index[places].is_monotonic_increasing:
        values = index[places].to_numpy()
        at = int(places[np.argmax(values[1:] < values[:-1])])
        raise TimeError(
            f"the index of the DataFrame runs backwards after row {at} ({index[at]}); sort it: "
            "df.sort_index()"
        )
    return pd.DatetimeIndex(index)


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
        that does not run backwards. Samples may be missing. A lazy array on a uniform time axis
        stays lazy.
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
        When the values are angles of unknown kind.

    Examples
    --------
    >>> time = pd.date_range("2026-01-01", periods=3, freq="10ms")
    >>> data = xr.DataArray([1.0, 2.0, 4.0], {"time": time}, attrs={"units": "deg/s"})
    >>> log = from_dataarray(data)
    >>> log.rate.values, log.attrs["sampling_rate_hz"]
    (array([[ 3600.,  7200., 14400.]]), 100.0)
    """
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
            .assign_coords(time=("row", stamps.astype("datetime64[ns]")))
        )
        with _keyword_advice():
            regular_log = regularise(
                raw.assign_attrs(source_files=["DataArray"]), rate=rate, max_gap=max_gap
            )
        _warn_notes(regular_log)
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
    axes = (
        [str(axis) for axis in np.atleast_1d(da["axis"].values)]
        if "axis" in da.coords
        else list("xyz"[: da.sizes.get("axis", 1)])
    )
    if len(axes) < da.sizes.get("axis", 1):
        raise SchemaError(
            f"the DataArray has {da.sizes['axis']} axes without names; give them: "
            "da.assign_coords(axis=[...])"
        )
    array = da if "axis" in da.dims else da.drop_vars("axis", errors="ignore").expand_dims("axis")
    signal = array.variable.transpose("axis", "time")
    data = signal.data * unit.factor if unit.factor != 1.0 else signal.data
    packing = (
        declare_counts(signal.dtype, unit.factor)
        if signal.dtype.kind in "iu" and not increments
        else {}
    )
    attrs = {"long_name": SIGNAL_LONG_NAMES[name], **da.attrs, "units": SIGNAL_UNITS[name]}
    bare = array.coords.to_dataset().drop_vars(
        [coord for coord in array.coords if coord not in ("time", "axis")]
    )
    log = bare.assign({name: (("axis", "time"), data, attrs, packing)})
    return log.assign_coords(axis=axes).assign_attrs(kind=name), increments


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


def _warn_notes(log: xr.Dataset) -> None:
    for note in texts(log, "notes"):
        warnings.warn(note, stacklevel=3)
