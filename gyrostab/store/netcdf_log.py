"""Open NetCDF logs of gyrostab with h5py alone, which takes less time than the NetCDF library.

That library reads 4 MiB of every file, and xarray does more with what it reads. docs/scaling.md
compares them. The difference counts where thousands of files are opened.

References
----------
NetCDF users guide, "NetCDF-4 file format": how dimensions and attributes are stored in HDF5.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.store.attributes import JSON_NAMES
from gyrostab.store.hdf5_heaps import check_global_heaps
from gyrostab.store.layout import has_known_filters
from gyrostab.store.output.content import read_json
from gyrostab.store.private import library_lock
from gyrostab.store.remote import find_url
from gyrostab.store.safe_names import ORIGINAL_NAME
from gyrostab.store.times import GRID, follows_rule, parse_time_grids

#: Attributes of a variable that xarray moves to its encoding.
_ENCODED = ("_FillValue", "scale_factor")
#: Attributes of the library: dimensions, by number, and the name of one that is a dimension itself.
_FIRST_DIMENSION, _DIMENSIONS, _NAME = "_Netcdf4Dimid", "_Netcdf4Coordinates", "NAME"
_UNREAD = {b"CLASS", b"DIMENSION_LIST", b"REFERENCE_LIST", b"_NCProperties"}
#: How the name of a dataset begins that is only a dimension.
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
#: Attributes that change what values or coordinates mean; gyrostab writes none of them in a log.
_FOREIGN = {"_Unsigned", "add_offset", "coordinates", "dtype", "missing_value"}
#: Attributes that a summary needs, or that are checked.
_BRIEF = {
    name.encode()
    for name in (
        *_ENCODED, *_FOREIGN, _FIRST_DIMENSION, _DIMENSIONS, _NAME, GRID, JSON_NAMES,
        ORIGINAL_NAME, "calendar", "gyrostab_content", "notes", "source_units", "units",
    )
}  # fmt: skip
_MAX_READ_VALUES = 2**17


@dataclass(frozen=True)
class StoredLog:
    """A log as it is on disk; the fields are those of a dataset, which takes longer to make."""

    variables: dict[Any, xr.Variable]
    data_vars: tuple[str, ...]
    coords: tuple[str, ...]
    sizes: dict[Any, int]
    attrs: dict[Any, Any]

    def close(self) -> None:
        """Do nothing, as the file is closed."""


def open_netcdf_log(path: Path, *, brief: bool = False) -> StoredLog | None:
    """Open a NetCDF log as it is on disk, with neither decoded times nor indexes.

    Parameters
    ----------
    brief : bool
        Read only the attributes that a summary of the log needs, and of the stamps the last.
        Nothing is read from heaps, which need no check then.

    Returns
    -------
    StoredLog or None
        A variable with a value for each sample holds NaN in place of its values, and in its
        encoding the layout on disk. Stamps that follow their rule are reduced to it. None unless
        everything is as `gyrostab.io.to_netcdf` writes it for a log; xarray opens other files.

    Raises
    ------
    FormatError
        When the library would not return from a global heap.
    """
    try:
        with library_lock():
            file = _open_file(path)
            if file is None:
                return None
            values = _open_values(file)
            if not brief:
                check_global_heaps(path, skip=_find_data(values.values()))
            attrs = _read_attributes(file, brief=brief)
            variables = _open_variables(values, brief=brief)
            for name, rule in parse_time_grids(variables, path).items():
                if variables[name].ndim:
                    ends = (-1,) if brief else (0, -1)
                    start = _reduce_stamps(variables.pop(name), rule, values[name], ends)
                    variables[f"{name}_start"] = start
    except FormatError:
        raise
    except Exception:  # the libraries raise errors of many kinds; xarray finds what is wrong
        return None
    sizes = {dim: size for item in variables.values() for dim, size in item.sizes.items()}
    return StoredLog(
        variables,
        tuple(name for name in variables if name not in sizes),
        tuple(name for name in variables if name in sizes),
        sizes,
        attrs,
    )


def read_attribute(path: Path, name: str) -> str:
    """Read an attribute that gyrostab wrote for a NetCDF file or Zarr store; empty without it."""
    from h5py import h5f

    if find_url(path) or path.is_dir():
        attributes = read_json(path / ".zattrs")
        return str(attributes.get(name, "")) if isinstance(attributes, dict) else ""
    try:
        with library_lock():
            attribute = _open_attribute(h5f.open(os.fsencode(path), h5f.ACC_RDONLY), name)
            if attribute is not None and _has_variable_length(attribute):
                check_global_heaps(path)
            return "" if attribute is None else str(_read_value(attribute))
    except Exception:  # whatever the library raises on damaged bytes and other formats
        return ""


def _open_file(path: Path) -> Any:
    """Open a file; None for anything but a log of gyrostab."""
    from h5py import h5f

    file = h5f.open(os.fsencode(path), h5f.ACC_RDONLY)
    attribute = _open_attribute(file, "gyrostab_content")
    if attribute is None or _has_variable_length(attribute):
        return None  # text of variable length is in a heap that is not checked yet
    return file if _read_value(attribute) == "log" else None


def _open_attribute(file: Any, name: str) -> Any:
    from h5py import h5a

    return h5a.open(file, name.encode()) if h5a.exists(file, name.encode()) else None


def _open_values(file: Any) -> dict[str, Any]:
    """Open the values of the variables in a file, in the order in which they were made."""
    from h5py import h5, h5d

    names: list[bytes] = []
    file.links.iterate(names.append, idx_type=h5.INDEX_CRT_ORDER)
    return {name.decode(): h5d.open(file, name) for name in names}


def _read_attributes(place: Any, *, brief: bool) -> dict[str, Any]:
    """Read the attributes of a file or variable, in the order in which they were made."""
    from h5py import h5, h5a

    names: list[bytes] = []
    h5a.iterate(place, names.append, index_type=h5.INDEX_CRT_ORDER)
    return {
        name.decode(): _read_value(h5a.open(place, name), from_heap=not brief)
        for name in names
        if name not in _UNREAD and (not brief or name in _BRIEF)
    }


def _has_variable_length(attribute: Any) -> bool:
    kind = attribute.get_type()
    return not hasattr(kind, "is_variable_str") or bool(kind.is_variable_str())


def _read_value(attribute: Any, *, from_heap: bool = True) -> Any:
    """Read an attribute as a text, a number or an array of numbers; `ValueError` for others.

    Texts of variable length are in a heap, and are others unless `from_heap`.
    """
    kind, size = attribute.get_type(), attribute.get_storage_size()
    is_text = hasattr(kind, "is_variable_str")
    if is_text and not size:
        return ""
    if is_text and not kind.is_variable_str():
        text = np.empty((), f"S{size}")  # its dtype would take longer to find
        attribute.read(text, kind)
        return text.item().replace(b"\0", b"").decode()
    if is_text and not from_heap:
        raise ValueError("a text of variable length")
    value = np.empty(attribute.shape, kind.dtype)
    if not is_text and value.dtype.kind not in "iuf":
        raise ValueError(f"attribute of type {value.dtype}")
    attribute.read(value)  # with the type of the file, the library would put pointers into objects
    if is_text:
        content = value.item()
        return content.decode() if isinstance(content, bytes) else str(content)
    return value.ravel()[0] if value.size == 1 else value


def _find_data(values: Iterable[Any]) -> list[tuple[int, int]]:
    """Find first byte and size of the chunks of variables."""
    from h5py import h5d

    chunks: list[tuple[int, int]] = []
    for variable in values:
        if variable.get_create_plist().get_layout() == h5d.CHUNKED:
            variable.chunk_iter(lambda chunk: chunks.append(chunk[2:]))  # byte_offset and size
    return sorted(chunks)


def _open_variables(values: dict[str, Any], *, brief: bool) -> dict[Any, xr.Variable]:
    """Open the variables; `ValueError` when one must be decoded, or is laid out otherwise."""
    attributes = {name: _read_attributes(item, brief=brief) for name, item in values.items()}
    names = {attrs[_FIRST_DIMENSION]: name for name, attrs in attributes.items() if _NAME in attrs}
    variables = {}
    for name, attrs in attributes.items():
        attrs.pop(_FIRST_DIMENSION, None)
        if not attrs.pop(_NAME, "").startswith(_NO_VARIABLE):
            dims = tuple(names[number] for number in np.ravel(attrs.pop(_DIMENSIONS, ())))
            variables[name] = _open_variable(name, dims, attrs, values[name])
    return variables


def _open_variable(
    name: str, dims: tuple[str, ...], attrs: dict[str, Any], values: Any
) -> xr.Variable:
    encoding = {key: attrs.pop(key) for key in _ENCODED if key in attrs}
    dtype, is_packed = values.dtype, "scale_factor" in encoding
    if _FOREIGN & set(attrs):
        raise ValueError(name)
    if GRID in attrs and dims:
        data = np.broadcast_to(dtype.type(0), values.shape)
    elif dims and dims[-1].startswith("time") and (dtype.kind == "f" or is_packed):
        plist = values.get_create_plist()
        chunks = plist.get_chunk()
        missing = encoding["scale_factor"] * np.nan if is_packed else dtype.type(np.nan)
        if not has_known_filters(plist) or max(chunks[:-1], default=1) > 1:
            raise ValueError(name)
        if is_packed and (missing.dtype != np.float64 or "_FillValue" not in encoding):
            raise ValueError(name)
        encoding |= {"dtype": dtype, "chunksizes": chunks}
        data = np.broadcast_to(missing, values.shape)
    elif encoding or math.prod(values.shape) > _MAX_READ_VALUES:
        raise ValueError(name)
    else:
        data = _read_part(values, (0,) * len(dims), values.shape)
    if dtype == "S1":  # letters of labels
        attrs.pop("_Encoding", None)
        dims = dims[:-1]
        texts = data.view(f"S{data.shape[-1]}")[..., 0]
        data = np.array([text.decode() for text in texts.ravel()]).reshape(texts.shape)
    elif dtype.kind not in "iuf":
        raise ValueError(name)
    return xr.Variable(dims, data, attrs, encoding)


def _read_part(values: Any, start: tuple[int, ...], shape: tuple[int, ...]) -> NDArray[Any]:
    """Read a part of a variable; indexing in h5py takes three times as long for a few numbers."""
    from h5py import h5s

    part = np.empty(shape, values.dtype)
    if part.size:
        place = values.get_space()
        if shape:
            place.select_hyperslab(start, shape)
        values.read(h5s.create_simple(shape) if shape else h5s.create(h5s.SCALAR), place, part)
    return part


def _reduce_stamps(
    stamps: xr.Variable, rule: dict[str, Any], values: Any, ends: tuple[int, ...]
) -> xr.Variable:
    """Reduce stamps to the rule of a time axis; `ValueError` when they do not follow it at `ends`.

    A chunk of stamps takes a tenth of the time of a summary.
    """
    end_stamps = np.concatenate([_read_part(values, (at % stamps.size,), (1,)) for at in ends])
    if stamps.shape != (rule["size"],) or not follows_rule(end_stamps, stamps.attrs, rule):
        raise ValueError("another program has changed the stamps")
    return xr.Variable((), 0, stamps.attrs)
