"""Attributes of datasets and variables in files, by the CF and ACDD conventions.

References
----------
CF conventions 1.11, section 3.1 (units); ACDD 1.3.
"""

from __future__ import annotations

import json
import re
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.schema import escape_text, texts
from gyrostab.store.damage import check_global_heaps
from gyrostab.store.output.content import read_json
from gyrostab.store.private import library_lock
from gyrostab.store.remote import find_url
from gyrostab.store.safe_names import is_storable, make_name_storable
from gyrostab.time.stamps import time_of_day
from gyrostab.units import ON_DISK, on_disk

_CONVENTIONS = "CF-1.11, ACDD-1.3"
#: Attribute that describes a file -> its text for each kind.
_DESCRIPTIONS = {
    "title": {
        "product": "Dynamic Allan variance of a gyro log, "
        "with the noise coefficients Q, N, B, K and R of every window",
        "surface": "Dynamic Allan variance of a gyro log",
        "log": "Gyro log on a uniform time axis",
        "dataset": "Gyro stability data",
    },
    "summary": {
        "product": "Allan variance of each axis of a gyro by time and averaging time, in windows "
        "that slide along the log, and the five noise terms of IEEE Std 952 fitted to each window: "
        "quantization Q, angle random walk N, bias instability B, rate random walk K and rate ramp "
        "R, with standard errors and 95 % upper limits. Missing samples are left out, not "
        "interpolated.",
        "surface": "Allan variance of each axis of a gyro by time and averaging time, in windows "
        "that slide along the log. Missing samples are left out, not interpolated.",
        "log": "Rotation rate or angle of each axis of a gyro and the channels that were logged "
        "with it, with missing samples as NaN and a table of the gaps.",
        "dataset": "Results of an analysis of gyro noise.",
    },
}
_KEYWORDS = "gyroscope, rotation rate, noise, stability, Allan variance"
JSON_NAMES = "json_attributes"
_NETCDF_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")

# Names that UDUNITS reads as intended. An integer power may follow; UDUNITS misreads a fractional
# one without an error, so none passes.
_SAFE_UNIT_NAMES = (
    "degree_Celsius|standard_free_fall|degree|hour|microradian|radian|"
    "s|m|K|V|W|Pa|T|uT|Hz|kg|percent|"
    "ms|min|h|mm|cm|km|ft|L|mL|N|kN|bar|mbar|hPa|kPa|MPa|psi|A|mA|mV|kV|mW|kW|ohm|mT|nT|kHz|rpm"
)
_FACTOR = rf"(?:{_SAFE_UNIT_NAMES})(?:\^?-?[1-9])?"
_SAFE_UNIT = re.compile(rf"{_FACTOR}(?:(?: {_FACTOR})*|/(?:{_SAFE_UNIT_NAMES})(?:\^?[1-9])?)")


def encode_attributes(attrs: dict[str, Any]) -> dict[str, Any]:
    """Convert attributes to NetCDF types; a unit that UDUNITS misreads goes to `source_units`."""
    if "units" in attrs:
        units = on_disk(str(attrs["units"]))
        if units in ("1", *ON_DISK.values()) or _SAFE_UNIT.fullmatch(units):
            attrs["units"] = units
        else:
            attrs["source_units"] = attrs.pop("units")
    for name in [name for name in attrs if not is_storable(str(name))]:
        attrs[make_name_storable(str(name), attrs, kind="attribute")] = attrs.pop(name)
    coded = []
    for name, value in attrs.items():
        attrs[name] = value = _convert_value(value)
        if isinstance(value, str):
            attrs[name] = escape_text(value)
        if not _is_netcdf_value(value):
            # in ASCII: Octave cannot list a file with other characters in a global attribute
            attrs[name] = json.dumps(value, default=str)
            coded.append(name)
    if coded:
        attrs[JSON_NAMES] = json.dumps(coded)
    return attrs


def _convert_value(value: Any) -> Any:
    """Convert a value of numpy to one of Python; an array that NetCDF can hold stays.

    Examples
    --------
    >>> _convert_value(np.datetime64("2026-05-01T00:00", "s")), _convert_value(np.eye(2, dtype=int))
    ('2026-05-01T00:00:00', [[1, 0], [0, 1]])
    """
    if not isinstance(value, np.ndarray | np.generic) or _is_netcdf_value(value):
        return value
    if value.dtype.kind not in "mM":
        return value.tolist()
    return value.astype(str).tolist() if value.ndim else str(value)


def _is_netcdf_value(value: Any) -> bool:
    """Whether an attribute of NetCDF can be a value: text, a number, or a list of them."""
    if isinstance(value, np.ndarray):
        is_native = value.dtype.kind in "US" or value.dtype.str[1:] in _NETCDF_TYPES
        return value.ndim == 1 and is_native
    if isinstance(value, bool | np.generic):
        return False
    if isinstance(value, int):
        return -(2**63) <= value < 2**64
    return isinstance(value, str | float)


def find_version(package: str) -> str:
    """Find the version of an installed package; ``unknown`` where it has no metadata."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def make_global_attributes(dataset: xr.Dataset, kind: str, verb: str) -> dict[str, Any]:
    """Make the attributes of a file: those of the dataset, its description, history and version."""
    now, version = time_of_day(), find_version("gyrostab")
    attrs = dict(dataset.attrs)
    history = attrs.get("history", "")
    lines = [history] if isinstance(history, str) else [str(line) for line in history]
    attrs["history"] = "\n".join(
        [*filter(None, lines), f"{now} gyrostab {version}: {verb}, {kind}"]
    )
    variance = VARIANCES.get(str(attrs.get("variance")), VARIANCES["avar"]).text
    for attribute, by_kind in _DESCRIPTIONS.items():
        descriptions = {name: text.replace("Allan", variance) for name, text in by_kind.items()}
        # the text of an earlier stage is replaced too
        if attrs.get(attribute) in (None, *descriptions.values()):
            attrs[attribute] = descriptions[kind]
    attrs.setdefault("keywords", _KEYWORDS)
    names = texts(dataset, "source_files")
    source = "gyro log: " + ", ".join(names) if names else "gyro log"
    attrs.setdefault("source", source.encode("ascii", "backslashreplace").decode())
    attrs |= {
        "Conventions": _CONVENTIONS,
        "date_created": now,
        "gyrostab_version": version,
        "gyrostab_content": kind,
    }
    attrs.setdefault(
        "references",
        "IEEE Std 952; Wang et al., Sensors 16 (2016) 2081 "
        "(dynamic Allan variance of gyros with missing data)",
    )
    times = dataset.get("time")
    if times is not None and times.dtype.kind == "M" and times.size:
        for end, position in (("start", 0), ("end", -1)):
            # one dimension when the axis is computed
            stamp = np.asarray((times[position] if times.ndim else times).values).ravel()[0]
            attrs[f"time_coverage_{end}"] = f"{stamp.astype('datetime64[us]')}Z"
    return encode_attributes(attrs)


def decode_attributes(attrs: dict[str, Any]) -> dict[str, Any]:
    """Convert attributes of a file back; those that concern only the file are dropped."""
    names = str(attrs.pop(JSON_NAMES, ""))
    known = json.loads(names) if names.startswith("[") else names.split()  # of an earlier version
    for name in set(known) & set(attrs):
        attrs[name] = json.loads(attrs[name])
    for name, value in attrs.items():
        attrs[name] = value.item() if isinstance(value, np.generic) else value
    if "since" in str(attrs.get("units", "")):
        del attrs["units"]
    for name in ("calendar", "ancillary_variables"):
        attrs.pop(name, None)
    if "leap_seconds" in str(attrs.get("units_metadata", "")):
        del attrs["units_metadata"]
    if "source_units" in attrs:
        attrs["units"] = attrs.pop("source_units")
    inner = {stored: units for units, stored in ON_DISK.items()}
    if "units" in attrs:
        attrs["units"] = inner.get(attrs["units"], attrs["units"])
    return attrs


def read_attribute(path: Path, name: str) -> str:
    """Read an attribute that gyrostab wrote for a NetCDF file or Zarr store; empty without it."""
    import h5py

    if find_url(path) or path.is_dir():
        attributes = read_json(path / ".zattrs")
        return str(attributes.get(name, "")) if isinstance(attributes, dict) else ""
    try:
        with library_lock(), h5py.File(path, "r") as file:
            if name not in file.attrs:
                return ""
            kind = file.attrs.get_id(name).get_type()
            if not hasattr(kind, "is_variable_str") or kind.is_variable_str():
                check_global_heaps(path)
            value = file.attrs[name]
            return value.decode() if isinstance(value, bytes) else str(value)
    except Exception:  # whatever the library raises on damaged bytes and other formats
        return ""
