"""NetCDF and Zarr: regular logs (opened lazily), and foreign files of variables on one dimension.

In a foreign file the columns of a two-dimensional variable are named ``name/label``, with the label
from the coordinate of the short dimension, or ``name/0`` without such a coordinate; ``gyro/x`` and
``rate/x`` are gyro axes.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError, SchemaError, TimeError
from gyrostab.ingest.columns.headers import AXIS_PATTERN, split_header
from gyrostab.ingest.columns.stamps import names_epoch
from gyrostab.ingest.combine import with_channels
from gyrostab.ingest.concat.grid import log_span
from gyrostab.ingest.formats.netcdf_classic import read_classic_header
from gyrostab.ingest.formats.netcdf_variables import (
    StoredVariable,
    open_variables,
    with_default_fill,
)
from gyrostab.ingest.formats.packing import decode_variables
from gyrostab.ingest.formats.recognise import begins_like
from gyrostab.ingest.formats.stored import StoredColumn, StoredTable, plan_stored
from gyrostab.ingest.limits import check_declared, check_stored
from gyrostab.ingest.options import ColumnSummary, FileSummary, ReadOptions
from gyrostab.ingest.uniform import as_uniform
from gyrostab.schema import SIGNAL_UNITS, log_channels, signal_name, texts
from gyrostab.store.attributes import decode_attributes, decode_json
from gyrostab.store.blosc_chunks import check_blosc_chunks
from gyrostab.store.cf import from_disk
from gyrostab.store.hdf5_heaps import check_global_heaps
from gyrostab.store.netcdf_log import StoredLog, open_netcdf_log, read_attribute
from gyrostab.store.read import open_stored
from gyrostab.store.remote import find_url
from gyrostab.store.safe_names import ORIGINAL_NAME
from gyrostab.store.times import index_dim, parse_time_grids
from gyrostab.time.grid import grid_times, time_coordinate
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import ON_DISK

MAX_COLUMNS = 64
#: Names of variables whose columns are gyro axes.
_SIGNALS = ("gyro", "rate")
CHECKED_BLOCKS = 33
#: Options to open a file with xarray; numbers and stamps are decoded when they are read.
_UNDECODED: dict[str, Any] = {
    "chunks": None,
    "mask_and_scale": False,
    "decode_times": False,
    "create_default_indexes": False,
}
_OTHER_CONTENT = {"surface": "a dynamic Allan variance", "product": "a product"}


def matches(path: Path) -> bool:
    """Return whether the path is a NetCDF file, by suffix or first bytes, or a Zarr store."""
    if path.is_dir():
        return any((path / name).exists() for name in ("zarr.json", ".zgroup", ".zmetadata"))
    return begins_like(path, b"CDF", ".nc", ".nc4", ".cdf", ".netcdf")


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise variables, sizes, and first and last stamps."""
    if path.is_file():
        read_classic_header(path)
        stored = open_netcdf_log(path, brief=True)
        summary = None if stored is None else _summarise_stored(path, stored, options)
        if summary is not None:
            return summary
    log = _open_remote(path) if find_url(path) else _open_log(path, options)
    if log is not None:
        with log:
            return _summarise_log(path, log)
    with open_variables(path, options.limits) as variables:
        table, slower = _plan_file(path, variables, options)
        summary = table.scan("zarr" if path.is_dir() else "netcdf")
        names = [column.name for part in slower for column in part.plan.of("channel")]
        return replace(summary, channels=tuple(dict.fromkeys([*summary.channels, *names])))


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Open a regular log lazily, or read the raw log of a foreign file; see `read_log`."""
    log = _open_remote(path) if find_url(path) else _open_log(path, options)
    if log is not None:
        return log
    with open_variables(path, options.limits) as variables:
        table, slower = _plan_file(path, variables, options)
        return _add_slower_channels(table.read(), slower)


def _open_remote(path: Path) -> xr.Dataset:
    """Open a Zarr log of gyrostab at an address."""
    stored = open_stored(path)
    content = str(stored.attrs.get("gyrostab_content", ""))
    if content != "log":
        raise FormatError(
            f"{find_url(path)}: is {_OTHER_CONTENT.get(content, 'a Zarr store of another program')}"
            ", not a log of gyrostab; open it with xarray and give it to gyrostab.davar, or copy "
            "it here and use gyrostab ingest"
        )
    log = as_uniform(from_disk(stored, path.name))
    log.attrs.setdefault("source_files", [path.name])
    return log


def _open_log(path: Path, options: ReadOptions) -> xr.Dataset | None:
    """Open a regular log, of gyrostab or with a stamp for each sample; None for other files."""
    if path.is_file():
        read_classic_header(path)  # before the library allocates what a damaged header asks for
    content = read_attribute(path, "gyrostab_content")
    if content == "log":
        return _open_own(path, options)
    if path.is_file():
        check_global_heaps(path)
    if content in _OTHER_CONTENT and not options.channels_only:
        raise FormatError(
            f"{path.name}: is {_OTHER_CONTENT[content]} that gyrostab wrote, not a log; give the "
            "log that it was made from"
        )
    if path.is_dir():
        check_blosc_chunks(path)
    regular = _open_regular(path)
    if regular is None:
        return None
    log = _as_in_memory(path, decode_variables(path, regular))  # an index would load every stamp
    log.set_close(regular.close)
    check_stored(path, log.sizes.get("time", 0), log.sizes.get("axis", 1), options.limits)
    try:
        return _with_uniform_time(log)
    except SchemaError as error:
        raise SchemaError(f"{path.name}: {error}") from error
    except TimeError:
        log.close()
        return None  # its rows are placed by their stamps, like those of other files


def _as_in_memory(path: Path, log: xr.Dataset) -> xr.Dataset:
    """Convert units, names of axes and attributes to their form in memory."""
    if path.is_dir():
        log = log[sorted(log.variables, key=str)]  # the order within a directory is arbitrary
    for name in log.variables:
        units = log[name].attrs.get("units")
        if units in ON_DISK.values():
            log[name].attrs["units"] = next(
                inner for inner, disk in ON_DISK.items() if disk == units
            )
    log = log.assign_coords(
        axis=_read_labels(path, log["axis"]) if log["axis"].ndim else str(log["axis"].values)
    )
    decode_json(log.attrs)
    log.attrs = {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in log.attrs.items()
    }
    log.attrs.setdefault("source_files", [path.name])
    return log


def _open_regular(path: Path) -> xr.Dataset | None:
    """Open a regular log of another program undecoded, with its default fill values."""
    zarr_format, attributes = (
        _read_group(path) if path.is_dir() else (0, {"sampling_rate_hz": None})
    )
    if "sampling_rate_hz" not in attributes:
        return None
    engine: Any = "zarr" if path.is_dir() else "netcdf4"
    extra: Any = {"consolidated": False} if path.is_dir() else {}
    stored = xr.open_dataset(path, engine=engine, **_UNDECODED, **extra)
    if not _is_regular(stored):
        stored.close()
        return None
    for variable in stored.variables.values():
        if engine == "netcdf4":
            variable.attrs = with_default_fill(variable.attrs, variable.dtype)
        elif zarr_format == 2 and not variable.attrs.get("_FillValue", 1):
            del variable.attrs["_FillValue"]  # 0 is the default of Zarr
    return stored


def _is_regular(stored: xr.Dataset) -> bool:
    """Return whether a dataset has signal, axes, stamps and sampling rate, as a regular log has."""
    has_signal = any(name in stored.variables for name in SIGNAL_UNITS)
    has_stamps = "time" in stored.variables and names_epoch(
        str(stored.variables["time"].attrs.get("units", ""))
    )
    return (
        has_signal
        and has_stamps
        and "sampling_rate_hz" in stored.attrs
        and "axis" in stored.variables
    )


def _read_group(path: Path) -> tuple[int, dict[str, Any]]:
    """Return format and attributes of a Zarr group, also of one that xarray cannot open."""
    import zarr

    group = zarr.open_group(path, mode="r")
    return group.metadata.zarr_format, dict(group.attrs)


def _read_labels(path: Path, labels: xr.DataArray) -> NDArray[np.str_]:
    """Return the names of the axes as text; damaged names may hold invalid code points."""
    values = np.atleast_1d(labels.values)
    if values.dtype.kind == "U" and values.size:
        codes = np.ascontiguousarray(values).view(
            np.dtype(np.uint32).newbyteorder(values.dtype.byteorder)
        )
        if codes.size and codes.max() > sys.maxunicode:
            raise FormatError(f"{path.name}: the names of its axes are damaged; copy it again")
    return np.array([str(label) for label in values], dtype=str)


def _open_own(path: Path, options: ReadOptions) -> xr.Dataset:
    """Open a log that gyrostab wrote."""
    check = partial(check_declared, given=options.limits)
    stored = open_stored(path, strict=options.strict, check=check)
    log = from_disk(stored, path.name)
    try:
        log = as_uniform(log)
    except SchemaError as error:
        log.close()
        raise SchemaError(f"{path.name}: {error}") from error
    log.attrs.setdefault("source_files", [path.name])
    return log


def _with_uniform_time(log: xr.Dataset) -> xr.Dataset:
    """Return the log on a computed time axis; raise `TimeError` if its stamps are not uniform.

    Stamps that agree with the declared rate in `CHECKED_BLOCKS` blocks are not read in full,
    because a lost or doubled sample shifts every stamp after it.
    """
    rate, size = float(log.attrs["sampling_rate_hz"]), log.sizes["time"]
    stored = log["time"].variable

    def stamps(start: int, stop: int) -> Any:
        return to_nanoseconds(stored[start:stop].values)

    if size > CHECKED_BLOCKS * 1024 and np.isfinite(rate) and rate > 0:
        begin = int(stamps(0, 1)[0])
        for first in np.unique(np.linspace(0, size - 1024, CHECKED_BLOCKS).astype(int)):
            block = stamps(int(first), int(first) + 1024)
            if np.any(
                np.abs(block - grid_times(begin, rate, np.arange(first, first + len(block)))) > 1000
            ):
                break
        else:
            log = log.drop_vars("time").assign_coords(time_coordinate(begin, rate, size))
    return as_uniform(log)


def _summarise_stored(path: Path, stored: StoredLog, options: ReadOptions) -> FileSummary | None:
    """Summarise a log as it is on disk; None where decoding finds more, or what is wrong."""
    check_declared(path, stored.variables, given=options.limits)
    rules = {rule["dim"]: rule for rule in parse_time_grids(stored.variables, path.name).values()}
    signals = [name for name in SIGNAL_UNITS if name in stored.data_vars]
    variables, labels = stored.variables, stored.variables.get("axis")
    if "time" not in rules or len(signals) != 1 or labels is None or labels.ndim != 1:
        return None
    rule, (signal,) = rules["time"], signals
    time = next((dim for dim in ("time", index_dim("time")) if dim in stored.sizes), "")
    is_plain = (
        variables[signal].dims == ("axis", time)
        and stored.sizes[time] == rule["size"] > 0
        and variables[signal].attrs.get("units") == ON_DISK.get(*2 * (SIGNAL_UNITS[signal],))
        and len(set(labels.values.tolist())) == labels.size > 0
        and not any(ORIGINAL_NAME in item.attrs for item in variables.values())
    )
    if not is_plain:
        return None
    ends = rule["first"] + rule["stride"] * np.array([0, rule["size"] - 1])
    time_dims = {
        dim: {time} | {f"time_{dim}", index_dim(f"time_{dim}")} for dim in stored.data_vars
    }
    channels = {
        name: str(decode_attributes(dict(variables[name].attrs)).get("units", ""))
        for name in stored.data_vars
        if variables[name].ndim == 1 and variables[name].dims[0] in time_dims[name]
    }
    return _make_summary(
        path,
        signal,
        labels.values.tolist(),
        channels,
        grid_times(rule["start_ns"], rule["rate_hz"], ends),
        rule["size"],
        decode_attributes(dict(stored.attrs)).get("notes", ()),
    )


def _summarise_log(path: Path, log: xr.Dataset) -> FileSummary:
    return _make_summary(
        path,
        signal_name(log),
        log["axis"].values.tolist(),
        {name: str(log[name].attrs.get("units", "")) for name in log_channels(log)},
        log_span(log),
        log.sizes["time"],
        log.attrs.get("notes", ()),
    )


def _make_summary(
    path: Path,
    signal: str,
    labels: Sequence[Any],
    channels: Mapping[str, str],
    span: Iterable[int],
    size: int,
    notes: Iterable[str],
) -> FileSummary:
    axes = [
        ColumnSummary(str(axis), f"gyro_{axis}", "gyro", signal, SIGNAL_UNITS[signal])
        for axis in labels
    ]
    channel_columns = [
        ColumnSummary(name, name, "channel", None, units) for name, units in channels.items()
    ]
    first, last = (np.datetime64(int(stamp), "ns") for stamp in span)
    return FileSummary(
        path=path,
        format="gyrostab log",
        columns=(*axes, *channel_columns),
        axes=tuple(map(str, labels)),
        channels=tuple(channels),
        first=first,
        last=last,
        n_rows=size,
        notes=tuple(notes),
    )


def _plan_file(
    path: Path, variables: Mapping[str, StoredVariable], options: ReadOptions
) -> tuple[StoredTable, list[StoredTable]]:
    """Plan the variables on the main dimension, and channels on others that have stamps.

    The main dimension is the longest of those with gyro axes, otherwise the longest.
    """
    numeric = [v for v in variables.values() if v.dtype.kind in "iuf" and len(v.shape) in (1, 2)]
    sizes = {dim: size for v in numeric for dim, size in zip(v.dimensions, v.shape, strict=True)}
    lines = Counter(max(v.dimensions, key=lambda d: sizes[d]) for v in numeric)
    if not lines:
        raise FormatError(
            f"{path.name}: there is no numeric variable on a dimension; groups are not searched, "
            "so store variables at the top level"
        )
    with_axes = {
        max(v.dimensions, key=lambda d: sizes[d]) for v in numeric if _holds_axes(v, options)
    }
    main_dim = max(lines, key=lambda d: (d in with_axes, sizes[d], lines[d]))
    stamped = {
        v.dimensions[0]: v
        for v in numeric
        if len(v.shape) == 1 and names_epoch(str(v.attributes.get("units", "")))
    }
    columns: dict[str, list[StoredColumn]] = {dim: [] for dim in (main_dim, *stamped)}
    left_out: list[str] = []
    for variable in numeric:
        dim = next((dim for dim in columns if dim in variable.dimensions), main_dim)
        variable_columns = _columns_of(variables, variable, dim)
        if dim != main_dim and variable is stamped[dim]:
            variable_columns = [replace(variable_columns[0], header="time")]
        columns[dim] += variable_columns
        left_out += [] if variable_columns else [variable.name]
    notes = (
        [f"left out, as they do not run along {main_dim!r} alone: {', '.join(left_out[:20])}"]
        if left_out
        else []
    )
    table = plan_stored(path, columns.pop(main_dim), sizes[main_dim], options, notes=notes)
    channel_options = replace(options, channels_only=True, start=None)
    slower = [
        plan_stored(path, part, sizes[dim], channel_options)
        for dim, part in columns.items()
        if len(part) > 1
    ]
    return table, slower


def _add_slower_channels(log: xr.Dataset, tables: Sequence[StoredTable]) -> xr.Dataset:
    """Add the channels of other dimensions, each on ``time_<channel>``."""
    for table in tables:
        part = table.read()
        part = part.drop_vars([name for name in part.data_vars if name in log.variables])
        lists = {
            name: list(dict.fromkeys([*texts(log, name), *texts(part, name)]))
            for name in ("notes", "headers")
        }
        unmatched = set(texts(log, "unmatched_options")) & set(texts(part, "unmatched_options"))
        log = log.assign_attrs(lists, unmatched_options=sorted(unmatched))
        log = with_channels(log, [part]) if part.data_vars else log
    return log


def _holds_axes(variable: StoredVariable, options: ReadOptions) -> bool:
    """Return whether the name of a variable, or ``--map``, makes it one or several gyro axes."""
    stored = variable.name.lower()
    mapped = [
        target for key, target in options.map.items() if key.lower().partition("/")[0] == stored
    ]
    names = (split_header(text)[0].lower() for text in mapped or [stored])
    return (len(variable.shape) == 2 and stored in _SIGNALS) or any(map(AXIS_PATTERN.match, names))


def _columns_of(
    variables: Mapping[str, StoredVariable], variable: StoredVariable, dim: str
) -> list[StoredColumn]:
    make = partial(StoredColumn, dtype=variable.dtype, attributes=variable.attributes)
    if variable.dimensions == (dim,):
        return [make(variable.name, rows=variable.locate(0, 0))]
    if dim not in variable.dimensions or len(variable.shape) != 2:
        return []
    along = variable.dimensions.index(dim)
    other_dim, size = variable.dimensions[1 - along], variable.shape[1 - along]
    if size > MAX_COLUMNS:
        return []
    labels = [str(place) for place in range(size)]
    if other_dim in variables and variables[other_dim].shape == (size,):
        labels = [
            label.decode(errors="replace") if isinstance(label, bytes) else str(label)
            for label in np.ma.getdata(variables[other_dim].values[:])
        ]
    stem = "gyro_" if variable.name.lower() in _SIGNALS else f"{variable.name}/"
    return [
        make(f"{stem}{label}", rows=variable.locate(along, place))
        for place, label in enumerate(labels)
    ]
