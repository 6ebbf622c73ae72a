"""Convert pandas tables to logs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import GyrostabError, MissingUnitError, SchemaError, TimeError
from gyrostab.ingest.columns.headers import FileColumn, split_header
from gyrostab.ingest.combine import warn_notes
from gyrostab.ingest.options import ReadOptions
from gyrostab.schema import texts

#: An option of a command with its value, as messages on files advise it.
_OPTION = re.compile(
    r"--(map|unit|missing-value|kind|rate|max-gap|axis)\b"
    r'(?: ("[^"]*=[^"]*"|[^\s,;:()]+=[^\s,;:()]+)'
    r"|(?<=kind) (angle|rate)\b|(?<=rate|alue) (HZ|[\d.e+-]+))?"
)
_KEYWORD = re.compile(r"\b(kind|map|max_gap|rate|units)=")
#: Patterns of advice that only concerns files, and their replacements.
_FILE_ADVICE = (
    ("; gyrostab scan DataFrame inspects each column", ""),
    (
        "If it holds channels of another log, give it as --channel DataFrame",
        "Say which column is one: map={'NAME': 'gyro_x'}",
    ),
    (
        "the separator, the columns that --map names and the unit of time",
        "the columns and the index",
    ),
    (
        r"check the time column and its unit, or leave it out \(--map\) and give --rate HZ",
        "correct the times, or use gyrostab.make_log(values, rate=..., unit=...)",
    ),
    (
        "leave out --rate to use the stamps, or correct --rate, --epoch or the unit of the time "
        "column",
        "leave rate out to use the times, or correct the times",
    ),
)


def from_dataframe(
    df: pd.DataFrame | pd.Series,
    *,
    units: str | Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    missing_value: float | Sequence[float] = (),
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
        Unit of all gyro columns (``"deg/s"``), or of angles (``"deg"``), or units by column
        (``{"gyro": "deg/s", "temperature": "degC"}``). By default those in the names of the columns
        (``"gyro_x [deg/s]"``), or in ``df.attrs["units"]``.
    map : mapping, optional
        Column name -> contract name: ``{"wx": "gyro_x"}``; ``"-"`` drops a column.
    missing_value : float or sequence of float, optional
        Numbers that mean a missing value in columns of the gyro and of channels, before units are
        converted: ``-999.25``.
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
        of gaps, such as `gyrostab.regularise` returns.

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

    with keyword_advice():
        raw = _read_frame(df, units=units, map=map, missing_value=missing_value, kind=kind)
        log = regularise(raw, rate=rate, max_gap=max_gap)
    log.attrs["notes"] = [_name_keywords(note) for note in texts(log, "notes")]
    warn_notes(log)
    return log


def _read_frame(
    frame: pd.DataFrame | pd.Series,
    *,
    units: str | Mapping[str, str] | None,
    map: Mapping[str, str] | None,
    **given: Any,
) -> xr.Dataset:
    """Read a pandas table into a raw log, by the rules and with options for files."""
    from gyrostab.ingest.columns.plan_roles import plan_columns
    from gyrostab.ingest.columns.typed import read_columns
    from gyrostab.ingest.reading import refuse_unused_options

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
    headers = [str(column) for column in table.columns]
    units = frame.attrs.get("units") if units is None else units
    options = _make_options(headers, units=units, map=map, **given)
    stamps = index.to_numpy()

    def fetch(source: int, begin: int, end: int) -> Any:
        return stamps[begin:end] if source == 0 else table.iloc[begin:end, source - 1].to_numpy()

    try:
        columns = [FileColumn("time", stamped=True), *(FileColumn(header) for header in headers)]
        plan = plan_columns(Path("DataFrame"), columns, options)
        raw = read_columns(plan, len(table), fetch)
        refuse_unused_options([raw])
    except MissingUnitError as error:
        problem, _, advice = str(error).partition("; give")
        stem, unit = ("angle", "deg") if "--unit angle=" in advice else ("gyro", "deg/s")
        raise MissingUnitError(
            f"{problem}; give it: gyrostab.from_dataframe(df, units={unit!r}), "
            f"units={{{stem!r}: {unit!r}, 'temperature': 'degC'}}, df.attrs['units'] = {unit!r}, "
            f"or the name of the column, '{stem}_x [{unit}]'"
        ) from error
    return raw


def _make_options(
    headers: Sequence[str],
    *,
    units: str | Mapping[str, str] | None,
    map: Mapping[str, str] | None,
    **given: Any,
) -> ReadOptions:
    """Convert keywords to options for files; a unit of all axes lets x, y and z name axes."""
    renamed = {str(key): name for key, name in (map or {}).items()}
    if not isinstance(units, Mapping):
        keys = {key.strip().lower() for key in renamed}
        lows = {header: split_header(header)[0].lower() for header in headers}
        renamed |= {
            header: f"gyro_{low}"
            for header, low in lows.items()
            if low in ("x", "y", "z") and keys.isdisjoint((low, header.strip().lower()))
        }
    units_by_name = {"gyro": str(units)} if isinstance(units, str) else dict(units or {})
    return ReadOptions(map=renamed, unit=units_by_name, **given)


@contextmanager
def keyword_advice(call: str = "") -> Iterator[None]:
    """Let errors name keywords of functions, where those on files name options of commands.

    They also name the `call` that takes the keywords, if it is given.
    """
    try:
        yield
    except GyrostabError as error:
        message = _name_keywords(str(error))
        if call and _KEYWORD.search(message) and "gyrostab." not in message:
            message += f"; {call} has these options and returns a log"
        error.args = (message,)
        raise


def _name_keywords(message: str) -> str:
    """Name keywords in the place of options, and leave out what only concerns files.

    Examples
    --------
    >>> _name_keywords('DataFrame: keep one: --map "x y=gyro_x" --unit gyro=deg/s or --kind rate')
    "DataFrame: keep one: map={'x y': 'gyro_x'}, units={'gyro': 'deg/s'} or kind='rate'"
    """

    def name_keyword(match: re.Match[str]) -> str:
        option = match[1].replace("-", "_")
        value = next(filter(None, match.groups()[1:]), "").strip('"')
        keyword = "units" if option == "unit" else option
        key, equals, target = value.rpartition("=")
        if equals:
            return f"{keyword}={{{key!r}: {target!r}}}"
        if not value or value == "HZ":
            return keyword + f"={value}" * bool(value)
        is_number = option in ("rate", "missing_value")
        return f"{keyword}={value if is_number else repr(value)}"

    for text, replacement in _FILE_ADVICE:
        message = re.sub(text, replacement, message)
    return _OPTION.sub(name_keyword, message.replace('" --unit ', '", --unit '))


def _check_index(table: pd.DataFrame) -> pd.DatetimeIndex:
    """Return the stamps in UTC; raise an error if they run backwards."""
    index: Any = table.index
    columns: Any = table.columns
    if isinstance(columns, pd.MultiIndex):
        raise SchemaError(
            f"the columns of the DataFrame have {columns.nlevels} levels; join them to one name "
            "each: df.columns = df.columns.map('_'.join)"
        )
    if isinstance(index, pd.MultiIndex) and (advice := _advise_levels(index)):
        raise SchemaError(f"the index of the DataFrame has {index.nlevels} levels; {advice}")
    if not isinstance(index, pd.DatetimeIndex):
        dated = [repr(name) for name, kind in table.dtypes.items() if kind.kind == "M"]
        advice = (
            "transpose it: df.T"
            if isinstance(columns, pd.DatetimeIndex)
            else "convert it: df.to_timestamp()"
            if isinstance(index, pd.PeriodIndex)
            else "convert it: df.set_index(df.index.to_datetimeindex(time_unit='ns'))"
            if isinstance(index, xr.CFTimeIndex)
            else f"set one: df.set_index({next(iter(dated), 'pd.DatetimeIndex(...)')})"
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


def _advise_levels(index: pd.MultiIndex) -> str:
    """Return the calls that remove a level without times of an index of several; or ""."""
    dated = [isinstance(level, pd.DatetimeIndex) for level in index.levels]
    if sum(dated) != 1:
        return ""
    number = dated.index(False)
    level = number if index.names[number] is None else str(index.names[number])
    return (
        f"take one part of the other, df.xs({index.levels[number][0]!r}, level={level!r}), or "
        f"make a column of each part of a Series, series.unstack({level!r})"
    )
