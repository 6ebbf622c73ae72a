"""Regular logs in NetCDF files and Zarr stores, of gyrostab and of other programs."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError, SchemaError, TimeError
from gyrostab.ingest.columns.stamps import names_epoch
from gyrostab.ingest.concat.grid import log_span
from gyrostab.ingest.formats.netcdf_classic import check_classic_header
from gyrostab.ingest.formats.netcdf_variables import with_default_fill
from gyrostab.ingest.formats.packing import decode_variables
from gyrostab.ingest.limits import check_declared, check_stored
from gyrostab.ingest.options import ColumnSummary, FileSummary, ReadOptions
from gyrostab.ingest.uniform import as_uniform
from gyrostab.schema import SIGNAL_UNITS, log_channels, signal_name
from gyrostab.store.attributes import decode_attributes, read_attribute
from gyrostab.store.blosc_chunks import check_blosc_chunks
from gyrostab.store.cf import from_disk
from gyrostab.store.hdf5_heaps import check_global_heaps
from gyrostab.store.read import open_stored
from gyrostab.store.remote import find_url

#: Options to open a file with xarray; numbers and stamps are decoded when they are read.
_UNDECODED: dict[str, Any] = {
    "chunks": None,
    "mask_and_scale": False,
    "decode_times": False,
    "create_default_indexes": False,
}
_OTHER_CONTENT = {"surface": "a dynamic Allan variance", "product": "a product"}


def open_log(path: Path, options: ReadOptions) -> xr.Dataset | None:
    """Open a regular log, of gyrostab or with a stamp for each sample; None for other files."""
    if url := find_url(path):
        return _open_remote(path, url)
    if path.is_file():
        check_classic_header(path)  # before the library allocates what a damaged header asks for
    content = read_attribute(path, "gyrostab_content")
    if content == "log":
        check = partial(check_declared, given=options.limits)
        return _open_own(path, open_stored(path, strict=options.strict, check=check))
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
        return _make_uniform(path, log)
    except TimeError:
        return None  # its rows are placed by their stamps, like those of other files


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
    return _open_own(path, stored)


def _as_in_memory(path: Path, log: xr.Dataset) -> xr.Dataset:
    """Convert units, names of axes and attributes to their form in memory."""
    if path.is_dir():
        log = log[sorted(log.variables, key=str)]  # the order within a directory is arbitrary
    for variable in log.variables.values():
        variable.attrs = decode_attributes(variable.attrs)
    log = log.assign_coords(
        axis=_read_labels(path, log["axis"]) if log["axis"].ndim else str(log["axis"].values)
    )
    log.attrs = decode_attributes(log.attrs)
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


def _open_own(path: Path, stored: xr.Dataset) -> xr.Dataset:
    """Open a log that gyrostab wrote."""
    return _make_uniform(path, from_disk(stored, path.name))


def _make_uniform(path: Path, log: xr.Dataset) -> xr.Dataset:
    try:
        log = as_uniform(log)
    except (SchemaError, TimeError) as error:
        log.close()
        raise type(error)(f"{path.name}: {error}") from error
    log.attrs.setdefault("source_files", [path.name])
    return log


def summarise_log(path: Path, log: xr.Dataset) -> FileSummary:
    """Summarise a regular log."""
    signal, axes = signal_name(log), [str(axis) for axis in log["axis"].values]
    columns = [
        ColumnSummary(axis, f"gyro_{axis}", "gyro", signal, SIGNAL_UNITS[signal]) for axis in axes
    ]
    channels = log_channels(log)
    columns += [
        ColumnSummary(name, name, "channel", None, str(log[name].attrs.get("units", "")))
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
