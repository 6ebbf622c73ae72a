"""NetCDF and Zarr: regular logs (opened lazily), and foreign files of variables on one dimension.

In a foreign file the columns of a two-dimensional variable are named ``name/label``, with the label
from the coordinate of the short dimension, or ``name/0`` without such a coordinate; ``gyro/x`` and
``rate/x`` are gyro axes.
"""

from __future__ import annotations

import io
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError, SchemaError, TimeError
from gyrostab.ingest.columns.headers import AXIS_PATTERN, split_header
from gyrostab.ingest.columns.plan import describe_left_out
from gyrostab.ingest.columns.stamps import names_epoch
from gyrostab.ingest.concat.grid import log_span
from gyrostab.ingest.formats.recognise import make_matcher, read_head
from gyrostab.ingest.formats.tables import (
    MAX_COLUMNS,
    StoredArray,
    Table,
    TableColumn,
    TablesOfFile,
    make_reader,
)
from gyrostab.ingest.limits import check_chunk, check_declared
from gyrostab.ingest.options import ColumnSummary, FileSummary, ReadOptions
from gyrostab.ingest.uniform import as_uniform
from gyrostab.schema import SIGNAL_UNITS, log_channels, signal_name
from gyrostab.store.attributes import read_attribute
from gyrostab.store.cf import from_disk
from gyrostab.store.damage import check_blosc_chunks, check_global_heaps
from gyrostab.store.read import open_stored, open_zarr
from gyrostab.store.remote import find_url
from gyrostab.store.times import decode_stamps

#: Names of variables whose columns are gyro axes.
_SIGNALS = ("gyro", "rate")
_CALENDARS = ("standard", "gregorian", "proleptic_gregorian")
_VALID_RANGES = {"valid_range", "valid_min", "valid_max"}
_OTHER_CONTENT = {"surface": "a dynamic Allan variance", "product": "a product"}

_is_netcdf = make_matcher(b"CDF", ".nc", ".nc4", ".cdf", ".netcdf")


def matches(path: Path) -> bool:
    """Return whether the path is a NetCDF file, by suffix or first bytes, or a Zarr store."""
    if path.is_dir():
        return any((path / name).exists() for name in ("zarr.json", ".zgroup", ".zmetadata"))
    return _is_netcdf(path)


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise variables, sizes, and first and last stamps."""
    log = _open_log(path, options)
    if log is None:
        return _scan_tables(path, options)
    with log:
        return _summarise_log(path, log)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Open a regular log lazily, or read the raw log of a foreign file; see `read_log`."""
    log = _open_log(path, options)
    return _read_tables(path, options) if log is None else log


@contextmanager
def _open_tables(path: Path, options: ReadOptions) -> Iterator[TablesOfFile]:
    with _open_undecoded(path) as stored:
        yield _find_tables(path, stored, options)


_scan_tables, _read_tables = make_reader(
    lambda path: "zarr" if path.is_dir() else "netcdf", _open_tables
)


def _find_tables(path: Path, stored: xr.Dataset, options: ReadOptions) -> TablesOfFile:
    """Return a table of the main dimension, those of others that have stamps, and notes.

    The main dimension is the longest of those with gyro axes, otherwise the longest.
    """
    variables, sizes = _find_variables(path, stored, options.limits), stored.sizes
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
    stamped.pop(main_dim, None)
    columns: dict[Any, list[TableColumn]] = {dim: [] for dim in (main_dim, *stamped)}
    clocks: dict[Any, TableColumn] = {}
    left_out: list[str] = []
    for name, variable in numeric.items():
        dim = next((dim for dim in columns if dim in variable.dims), main_dim)
        variable_columns = _columns_of(variables, name, dim)
        if name == stamped.get(dim):
            clocks[dim] = replace(variable_columns[0], name=("",))
        else:
            columns[dim] += variable_columns
        left_out += [] if variable_columns else [name]
    texts = [n for n, v in variables.items() if v.dtype.kind in "OSUT" and main_dim in v.dims]
    notes = [
        *describe_left_out(f"they do not run along {main_dim!r} alone", left_out),
        *describe_left_out("they hold text, not numbers", texts),
    ]
    return [Table(sizes[dim], part, clocks.get(dim)) for dim, part in columns.items()], notes


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


@contextmanager
def _open_undecoded(path: Path) -> Iterator[xr.Dataset]:
    """Open a file or store with xarray, which decodes neither numbers nor stamps."""
    options: dict[str, Any] = {
        "chunks": None, "decode_cf": False, "create_default_indexes": False
    }  # fmt: skip
    try:
        if path.is_dir():
            stored = open_zarr(str(path), path.name, consolidated=False, **options)
        else:
            stored = xr.open_dataset(path, engine="netcdf4", **options)
    except KeyError as error:
        if "dimension" not in str(error):
            raise
        raise FormatError(
            f"{path.name}: an array does not name its dimensions; give it the attribute "
            "_ARRAY_DIMENSIONS (Zarr format 2) or dimension_names (format 3)"
        ) from error
    with stored:
        yield stored


def _find_variables(
    path: Path, stored: xr.Dataset, limits: Mapping[str, float]
) -> dict[str, xr.Variable]:
    """Return the variables, with the fill value of the format if they have none.

    `FormatError` if a chunk is too large. In Zarr format 2 the fill value of an array marks missing
    values, except for 0, which is its default.
    """
    variables = {str(name): variable for name, variable in stored.variables.items()}
    for name, variable in variables.items():
        chunks = variable.encoding.get("chunks" if path.is_dir() else "chunksizes") or ()
        check_chunk(path, name, variable.dtype.itemsize * math.prod(map(int, chunks)), limits)
        if not path.is_dir():
            variable.attrs = _with_default_fill(variable.attrs, variable.dtype)
        elif not (path / "zarr.json").exists() and not np.all(variable.attrs.get("_FillValue", 1)):
            del variable.attrs["_FillValue"]
    return dict(sorted(variables.items())) if path.is_dir() else variables


def _with_default_fill(attributes: dict[Any, Any], dtype: Any) -> dict[Any, Any]:
    """Add the default fill value of the NetCDF library; bytes have none (users guide)."""
    import netCDF4

    if (
        {"_FillValue", "_Unsigned"} & set(attributes)
        or dtype.kind not in "iuf"
        or dtype.itemsize == 1
    ):
        return attributes
    return {**attributes, "_FillValue": dtype.type(netCDF4.default_fillvals[dtype.str[1:]])}


def _open_log(path: Path, options: ReadOptions) -> xr.Dataset | None:
    """Open a regular log, of gyrostab or with a stamp for each sample; None for other files."""
    if url := find_url(path):
        return _open_remote(path, url)
    if path.is_file():
        _check_classic_header(path)
    content = read_attribute(path, "gyrostab_content")
    if content != "log":
        if path.is_file():
            check_global_heaps(path)
        if content in _OTHER_CONTENT and not options.channels_only:
            raise FormatError(
                f"{path.name}: is {_OTHER_CONTENT[content]} that gyrostab wrote, not a log; give "
                "the log that it was made from"
            )
        if path.is_dir():
            check_blosc_chunks(path)
        if not _is_regular(path):
            return None
    check = partial(check_declared, given=options.limits)
    stored = open_stored(path, strict=options.strict, check=check)
    if path.is_dir() and content != "log":
        stored = stored[sorted(stored.variables, key=str)]  # as the order in a folder is arbitrary
    try:
        return _open_regular(path, stored)
    except TimeError:
        if content == "log":
            raise
        return None  # its rows are placed by their stamps, like those of other files


def _open_regular(path: Path, stored: xr.Dataset) -> xr.Dataset:
    try:
        log = as_uniform(from_disk(stored, path.name))
    except (SchemaError, TimeError) as error:
        stored.close()
        raise type(error)(f"{path.name}: {error}") from error
    log.attrs.setdefault("source_files", [path.name])
    return log


def _open_remote(path: Path, url: str) -> xr.Dataset:
    """Open a Zarr log of gyrostab at an address."""
    stored = open_stored(path)
    content = str(stored.attrs.get("gyrostab_content", ""))
    if content != "log":
        raise FormatError(
            f"{url}: is {_OTHER_CONTENT.get(content, 'a Zarr store of another program')}"
            ", not a log of gyrostab; open it with xarray and give it to gyrostab.davar, or copy "
            "it here and use gyrostab ingest"
        )
    return _open_regular(path, stored)


def _is_regular(path: Path) -> bool:
    """Return whether a file has signal, axes, stamps and sampling rate, as xarray decodes them.

    The signal of a NetCDF file needs a fill value: without one, samples that were not written have
    that of the library, which xarray does not take for missing.
    """
    with _open_undecoded(path) as stored:
        stamps = stored.variables.get("time")
        signals = [stored.variables[name] for name in SIGNAL_UNITS if name in stored.variables]
        return (
            "sampling_rate_hz" in stored.attrs
            and "axis" in stored.variables
            and any(path.is_dir() or "_FillValue" in signal.attrs for signal in signals)
            and stamps is not None
            and _is_dated(stamps)
            and all(
                np.all(item.attrs.get("_FillValue", 1))  # 0 is the default of Zarr
                and not _VALID_RANGES & set(item.attrs)
                for item in stored.variables.values()
            )
        )


class _BoundedFile(io.BufferedReader):
    """A file that allocates no more bytes than it holds, whatever is asked for."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(min(size or 0, os.fstat(self.fileno()).st_size))


def _check_classic_header(path: Path) -> None:
    """Refuse a file of CDF-1 or CDF-2 whose header asks for more than the file holds.

    The NetCDF library would allocate whatever a damaged header asks for; scipy maps the file.
    """
    if not read_head(path).startswith((b"CDF\1", b"CDF\2")):
        return
    from scipy.io import netcdf_file

    class Header(netcdf_file):
        def _read_gatt_array(self) -> None:
            self._read_att_array()  # type: ignore[attr-defined]  # they would replace members of the same names

    try:
        Header(_BoundedFile(path.open("rb", buffering=0)), mmap=True).close()
    except Exception as error:  # scipy raises errors of many kinds on damaged headers
        raise FormatError(
            f"{path.name}: the header of this NetCDF file is damaged or cut off ({error}); copy "
            "it again"
        ) from error


def _is_dated(stamps: xr.Variable) -> bool:
    """Return whether xarray reads stamps as dates of a recording."""
    if stamps.attrs.get("calendar", "standard") not in _CALENDARS:
        return False
    try:
        return bool(decode_stamps(stamps[:1]).dtype.kind == "M")
    except Exception:  # whatever it raises on other units and calendars
        return False


def _summarise_log(path: Path, log: xr.Dataset) -> FileSummary:
    """Summarise a regular log."""
    signal, axes = signal_name(log), [str(axis) for axis in log["axis"].values]
    columns = [ColumnSummary(axis, f"gyro_{axis}", "gyro", SIGNAL_UNITS[signal]) for axis in axes]
    channels = log_channels(log)
    columns += [
        ColumnSummary(name, name, "channel", str(log[name].attrs.get("units", "")))
        for name in channels
    ]
    first, last = (np.datetime64(int(stamp), "ns") for stamp in log_span(log))
    return FileSummary(
        path=path,
        format="gyrostab log",
        columns=tuple(columns),
        axes=tuple(axes),
        channels=tuple(channels),
        first=first,
        last=last,
        n_rows=log.sizes["time"],
        notes=tuple(log.attrs.get("notes", ())),
    )
