"""Safe names for variables whose own names no file can hold; they are restored on opening."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Container, Iterable, Mapping
from typing import Any

import xarray as xr

# NetCDF User's Guide, "Permitted characters in netCDF names"; Zarr adds that a name is part of a
# path, and reserves two underscores.
_STORABLE = re.compile(
    r"(?!__)[A-Za-z0-9_\x80-\ud7ff\ue000-\U0010ffff][^/\x00-\x1f\x7f\ud800-\udfff]*(?<! )"
)
# NetCDF allows 256, a file name 255, and a suffix for the time axis is added
_MAX_NAME_BYTES = 200
ORIGINAL_NAME = "original_name"


def is_storable(name: str) -> bool:
    """Whether NetCDF and Zarr can hold a variable or dimension of this name.

    Examples
    --------
    >>> [is_storable(name) for name in ("température 2", "a/b", "{{7*7}}", ".zattrs")]
    [True, False, False, False]
    """
    return _STORABLE.fullmatch(name) is not None and len(name.encode()) <= _MAX_NAME_BYTES


def make_name_storable(name: str, used_names: Iterable[Any], *, kind: str = "channel") -> str:
    """Make a name that files can hold, not among those `used_names`.

    Examples
    --------
    >>> make_name_storable("{{7*7}}", ["channel_7_7"])
    'channel_7_7_2'
    """
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")[: _MAX_NAME_BYTES // 2]
    plain = plain if plain[:1].isalpha() else f"{kind}_{plain}".rstrip("_")
    safe, number = plain, 1
    while safe in used_names:
        number += 1
        safe = f"{plain}_{number}"
    return safe


def make_names_storable(dataset: xr.Dataset) -> xr.Dataset:
    """Rename the variables whose names no file can hold; warn, and keep the names in ``long_name``.

    Examples
    --------
    >>> with warnings.catch_warnings(record=True):
    ...     make_names_storable(xr.Dataset({"{{7*7}}": 1.0}))["channel_7_7"].attrs["long_name"]
    '{{7*7}}'
    """
    used_names = {str(name) for name in (*dataset.variables, *dataset.dims)}
    safe: dict[str, str] = {}
    for name in (str(name) for name in dataset.variables if not is_storable(str(name))):
        if name not in (f"time_{channel}" for channel in dataset.variables):
            safe[name] = make_name_storable(name, used_names)
            used_names.add(safe[name])
    if not safe:
        return dataset
    renamed = _rename_with_times(dataset, safe, used_names)
    for name, safe_name in safe.items():
        renamed[safe_name].attrs = {
            "long_name": name,
            **renamed[safe_name].attrs,
            ORIGINAL_NAME: json.dumps(name),
        }
    renamings = ", ".join(f"{name!a} as {safe_name!r}" for name, safe_name in safe.items())
    warnings.warn(
        "a file cannot hold a channel of this name, so it is stored under another one: "
        f"{renamings}",
        stacklevel=5,
    )
    return renamed


def restore_names(dataset: xr.Dataset) -> xr.Dataset:
    """Restore the names that `make_names_storable` replaced."""
    originals: dict[Any, str] = {}
    for name, variable in dataset.variables.items():
        if ORIGINAL_NAME in variable.attrs:
            originals[name] = json.loads(variable.attrs.pop(ORIGINAL_NAME))
    if not originals:
        return dataset
    return _rename_with_times(dataset, originals, dataset.dims)


def _rename_with_times(
    dataset: xr.Dataset, names: Mapping[Any, str], used_names: Container[Any]
) -> xr.Dataset:
    """Rename variables, and the time axes called after them that are among `used_names`."""
    times = {f"time_{name}": f"time_{new_name}" for name, new_name in names.items()}
    return dataset.rename(
        {**names, **{name: new_name for name, new_name in times.items() if name in used_names}}
    )
