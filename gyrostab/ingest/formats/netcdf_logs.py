"""Regular logs in NetCDF files and Zarr stores, of gyrostab and of other programs."""

from __future__ import annotations

import io
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import FormatError, SchemaError, TimeError
from gyrostab.ingest.concat.grid import log_span
from gyrostab.ingest.formats.netcdf_variables import open_undecoded
from gyrostab.ingest.limits import check_declared
from gyrostab.ingest.options import ColumnSummary, FileSummary, ReadOptions
from gyrostab.ingest.uniform import as_uniform
from gyrostab.schema import SIGNAL_UNITS, log_channels, signal_name
from gyrostab.store.attributes import read_attribute
from gyrostab.store.cf import from_disk
from gyrostab.store.damage import check_blosc_chunks, check_global_heaps
from gyrostab.store.read import open_stored
from gyrostab.store.remote import find_url
from gyrostab.store.times import decode_stamps

_CALENDARS = ("standard", "gregorian", "proleptic_gregorian")
_VALID_RANGES = {"valid_range", "valid_min", "valid_max"}
_OTHER_CONTENT = {"surface": "a dynamic Allan variance", "product": "a product"}


def open_log(path: Path, options: ReadOptions) -> xr.Dataset | None:
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
    """Return whether a file has signal, axes, stamps and sampling rate, as a regular log has.

    The signal of a NetCDF file needs a fill value: without one, samples that were not written have
    that of the library, which xarray does not take for missing.
    """
    with open_undecoded(path) as stored:
        stamps = stored.variables.get("time")
        signals = [stored.variables[name] for name in SIGNAL_UNITS if name in stored.variables]
        return (
            "sampling_rate_hz" in stored.attrs
            and "axis" in stored.variables
            and any(path.is_dir() or "_FillValue" in signal.attrs for signal in signals)
            and stamps is not None
            and _is_dated(stamps)
            and all(_decodes_as_cf(variable.attrs) for variable in stored.variables.values())
        )


class _BoundedFile(io.BufferedReader):
    """A file that allocates no more bytes than it holds, whatever is asked for."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(min(size or 0, os.fstat(self.fileno()).st_size))


def _check_classic_header(path: Path) -> None:
    """Refuse a file of CDF-1 or CDF-2 whose header asks for more than the file holds.

    The NetCDF library would allocate whatever a damaged header asks for; scipy maps the file.
    """
    with path.open("rb") as file:
        if file.read(4) not in (b"CDF\1", b"CDF\2"):
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


def _decodes_as_cf(attributes: dict[Any, Any]) -> bool:
    """Return whether xarray decodes numbers by the CF conventions; 0 is the default of Zarr."""
    is_default_fill = not np.all(attributes.get("_FillValue", 1))
    return not is_default_fill and not _VALID_RANGES & set(attributes)


def _is_dated(stamps: xr.Variable) -> bool:
    """Return whether xarray reads stamps as dates of a recording."""
    if stamps.attrs.get("calendar", "standard") not in _CALENDARS:
        return False
    try:
        return bool(decode_stamps(stamps[:1]).dtype.kind == "M")
    except Exception:  # whatever it raises on other units and calendars
        return False


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
