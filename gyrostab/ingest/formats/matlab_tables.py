"""MATLAB tables and timetables, by the library mat-io: columns as ``name.variable``."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyrostab.ingest.columns.stamps import dates_to_ns
from gyrostab.ingest.formats.stored import StoredColumn
from gyrostab.ingest.formats.tables import library
from gyrostab.store.rows import LibraryRows

__all__ = ["read_matlab_tables"]

_CLASSES = ("a table", "a timetable")


def read_matlab_tables(path: Path, objects: list[str]) -> Iterator[tuple[int, StoredColumn]]:
    """Yield length and column for all tables in a file; row times are columns too.

    Parameters
    ----------
    path : Path
        MATLAB file of version 5 or 7.3.
    objects : list of str
        What the file holds, such as "a table 'log'"; tables are removed from it.

    Raises
    ------
    OptionError
        When the file holds tables and mat-io is not installed.
    """
    if not any(text.startswith(_CLASSES) for text in objects):
        return
    option = "future.infer_string"  # of all of pandas, and mat-io sets it
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pd.option_context(option, pd.get_option(option)):
            matio = library("matio", path, extra="matlab")
            content = matio.load_from_mat(str(path), add_table_attrs=True)
    for name, table in content.items():
        if not isinstance(table, pd.DataFrame):
            continue
        objects[:] = [text for text in objects if not text.endswith(f" {name!r}")]
        units = table.attrs.get("VariableUnits") or table.attrs.get("varUnits") or []
        if table.index.dtype.kind in "mM":
            yield from _make_column(f"{name}.{table.index.name or 'Time'}", table.index.to_numpy())
        for place, variable in enumerate(table.columns):
            unit = str(units[place]) if place < len(units) else ""
            yield from _make_column(f"{name}.{variable}", table[variable].to_numpy(), unit)


def _make_column(
    header: str, values: NDArray[Any], unit: str = ""
) -> Iterator[tuple[int, StoredColumn]]:
    """Yield length and column of numbers; dates and durations become nanoseconds."""
    if values.dtype.kind == "M":
        values, unit = dates_to_ns(values), "nanoseconds since 1970-01-01"
    elif values.dtype.kind == "m":
        values, unit = values.astype("timedelta64[ns]").view(np.int64), "ns"
    if values.dtype.kind in "biuf":
        attributes = {"units": unit} if unit else {}
        yield len(values), StoredColumn(header, values.dtype, attributes, LibraryRows(values))
