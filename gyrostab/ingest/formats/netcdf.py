"""NetCDF and Zarr: regular logs (opened lazily), and foreign files of variables on one dimension.

In a foreign file the columns of a two-dimensional variable are named ``name/label``, with the label
from the coordinate of the short dimension, or ``name/0`` without such a coordinate; ``gyro/x`` and
``rate/x`` are gyro axes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.headers import AXIS_PATTERN, split_header
from gyrostab.ingest.columns.stamps import names_epoch
from gyrostab.ingest.combine import with_channels
from gyrostab.ingest.formats.netcdf_logs import open_log, summarise_log
from gyrostab.ingest.formats.netcdf_variables import find_variables, open_undecoded
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import (
    StoredArray,
    Table,
    TableColumn,
    read_tables,
    scan_tables,
)
from gyrostab.ingest.options import FileSummary, ReadOptions
from gyrostab.schema import texts

MAX_COLUMNS = 64
#: Names of variables whose columns are gyro axes.
_SIGNALS = ("gyro", "rate")

_is_netcdf = make_matcher(b"CDF", ".nc", ".nc4", ".cdf", ".netcdf")


def matches(path: Path) -> bool:
    """Return whether the path is a NetCDF file, by suffix or first bytes, or a Zarr store."""
    if path.is_dir():
        return any((path / name).exists() for name in ("zarr.json", ".zgroup", ".zmetadata"))
    return _is_netcdf(path)


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise variables, sizes, and first and last stamps."""
    log = open_log(path, options)
    if log is not None:
        with log:
            return summarise_log(path, log)
    with open_undecoded(path) as stored:
        form = "zarr" if path.is_dir() else "netcdf"
        main, slower, notes = _find_tables(path, stored, options)
        summary = scan_tables(path, form, [main], options, notes)
        others = (scan_tables(path, form, [table], _for_channels(options)) for table in slower)
        names = [name for other in others for name in other.channels]
        return replace(summary, channels=tuple(dict.fromkeys([*summary.channels, *names])))


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Open a regular log lazily, or read the raw log of a foreign file; see `read_log`."""
    log = open_log(path, options)
    if log is not None:
        return log
    with open_undecoded(path) as stored:
        main, slower, notes = _find_tables(path, stored, options)
        log = read_tables(path, [main], options, notes=notes)
        for table in slower:
            log = _add_channels(log, read_tables(path, [table], _for_channels(options)))
        return log


def _for_channels(options: ReadOptions) -> ReadOptions:
    return replace(options, channels_only=True, start=None)


def _find_tables(
    path: Path, stored: xr.Dataset, options: ReadOptions
) -> tuple[Table, list[Table], list[str]]:
    """Return a table of the main dimension, those of others that have stamps, and notes.

    The main dimension is the longest of those with gyro axes, otherwise the longest.
    """
    variables, sizes = find_variables(path, stored, options.limits), stored.sizes
    numeric = {n: v for n, v in variables.items() if v.dtype.kind in "iuf" and v.ndim in (1, 2)}
    lines = Counter(max(v.dims, key=lambda d: sizes[d]) for v in numeric.values())
    if not lines:
        raise FormatError(
            f"{path.name}: there is no numeric variable on a dimension; groups are not searched, "
            "so store variables at the top level"
        )
    with_axes = {
        max(v.dims, key=lambda d: sizes[d])
        for name, v in numeric.items()
        if _holds_axes(name, v, options)
    }
    main_dim = max(lines, key=lambda d: (d in with_axes, sizes[d], lines[d]))
    stamped = {
        v.dims[0]: name
        for name, v in numeric.items()
        if v.ndim == 1 and names_epoch(str(v.attrs.get("units", "")))
    }
    columns: dict[Any, list[TableColumn]] = {dim: [] for dim in (main_dim, *stamped)}
    left_out: list[str] = []
    for name, variable in numeric.items():
        dim = next((dim for dim in columns if dim in variable.dims), main_dim)
        variable_columns = _columns_of(variables, name, dim)
        if dim != main_dim and name == stamped[dim]:
            variable_columns = [replace(variable_columns[0], name=("time",))]
        columns[dim] += variable_columns
        left_out += [] if variable_columns else [name]
    notes = (
        [f"left out, as they do not run along {main_dim!r} alone: {', '.join(left_out[:20])}"]
        if left_out
        else []
    )
    main = Table(sizes[main_dim], columns.pop(main_dim))
    slower = [Table(sizes[dim], part) for dim, part in columns.items() if len(part) > 1]
    return main, slower, notes


def _add_channels(log: xr.Dataset, part: xr.Dataset) -> xr.Dataset:
    """Add the channels of another dimension, each on ``time_<channel>``."""
    part = part.drop_vars([name for name in part.data_vars if name in log.variables])
    lists = {
        name: list(dict.fromkeys([*texts(log, name), *texts(part, name)]))
        for name in ("notes", "headers")
    }
    unmatched = set(texts(log, "unmatched_options")) & set(texts(part, "unmatched_options"))
    log = log.assign_attrs(lists, unmatched_options=sorted(unmatched))
    return with_channels(log, [part]) if part.data_vars else log


def _holds_axes(name: str, variable: xr.Variable, options: ReadOptions) -> bool:
    """Return whether the name of a variable, or ``--map``, makes it one or several gyro axes."""
    stored = name.lower()
    mapped = [
        target for key, target in options.map.items() if key.lower().partition("/")[0] == stored
    ]
    names = (split_header(text)[0].lower() for text in mapped or [stored])
    return (variable.ndim == 2 and stored in _SIGNALS) or any(map(AXIS_PATTERN.match, names))


def _columns_of(variables: Mapping[str, xr.Variable], name: str, dim: Any) -> list[TableColumn]:
    variable = variables[name]
    if variable.dims == (dim,):
        return StoredArray(variable, 0).make_columns([name], variable.attrs)
    if dim not in variable.dims or variable.ndim != 2:
        return []
    along = variable.dims.index(dim)
    other_dim, size = str(variable.dims[1 - along]), variable.shape[1 - along]
    if size > MAX_COLUMNS:
        return []
    labels = [str(place) for place in range(size)]
    if other_dim in variables and variables[other_dim].shape == (size,):
        labels = [
            label.decode(errors="replace") if isinstance(label, bytes) else str(label)
            for label in variables[other_dim].values
        ]
    stem = "gyro_" if name.lower() in _SIGNALS else f"{name}/"
    names = [f"{stem}{label}" for label in labels]
    return StoredArray(variable, along).make_columns(names, variable.attrs)
