"""Read a pandas table with a time index as a raw log, by the rules for files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import SchemaError, TimeError
from gyrostab.ingest.columns.plan import plan_columns, split_header
from gyrostab.ingest.columns.typed import read_columns
from gyrostab.ingest.files import check_options
from gyrostab.ingest.options import ReadOptions

__all__ = ["read_frame"]


def read_frame(
    frame: pd.DataFrame | pd.Series,
    *,
    units: str | Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    kind: str | None = None,
) -> xr.Dataset:
    """Read a pandas table into a raw log; parameters and errors as for `gyrostab.from_dataframe`.

    Returns
    -------
    xarray.Dataset
        Raw log by ``row``, as from `gyrostab.read_log`.
    """
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
    units = frame.attrs.get("units") if units is None else units
    headers = [str(column) for column in table.columns]
    renamed = dict(map or {})
    if not isinstance(units, Mapping):
        renamed |= {
            header: f"gyro_{split_header(header)[0].lower()}"
            for header in headers
            if _is_axis_name(split_header(header)[0])
        }
    given = {"gyro": str(units)} if isinstance(units, str) else dict(units or {})
    options = ReadOptions(map=renamed, unit=given, kind=kind)
    stamps = index.to_numpy()

    def fetch(source: int, begin: int, end: int) -> Any:
        return stamps[begin:end] if source == 0 else table.iloc[begin:end, source - 1].to_numpy()

    plan = plan_columns(Path("DataFrame"), ["time", *headers], options, stamped=[0])
    raw = read_columns(plan, options, len(table), fetch)
    check_options([raw])
    return raw


def _is_axis_name(name: str) -> bool:
    """Return whether a column has the bare name of an axis: x, y, z."""
    return len(name) == 1 and name.lower() in "xyz"


def _check_index(table: pd.DataFrame) -> pd.DatetimeIndex:
    """Return the stamps in UTC; raise an error if they run backwards."""
    index: Any = table.index
    columns: Any = table.columns
    if not isinstance(index, pd.DatetimeIndex):
        advice = (
            "transpose it: df.T"
            if isinstance(columns, pd.DatetimeIndex)
            else "set one: df.set_index(pd.DatetimeIndex(...))"
        )
        raise SchemaError(
            f"the index of the DataFrame holds {index.inferred_type}, not times; {advice}"
        )
    index = index.tz_convert("UTC").tz_localize(None) if index.tz is not None else index
    if not index.is_monotonic_increasing:
        values = index.to_numpy()
        at = int(np.argmax(values[1:] < values[:-1]))
        raise TimeError(
            f"the index of the DataFrame runs backwards after row {at} ({index[at]}); sort it: "
            "df.sort_index()"
        )
    return pd.DatetimeIndex(index)
