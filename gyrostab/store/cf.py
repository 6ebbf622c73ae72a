"""Encode datasets by the CF conventions, and decode them.

This concerns the order of dimensions, labels and bounds; `store.times` has the times and
`store.attributes` the attributes.

References
----------
CF conventions 1.11, sections 2.5.1 (missing data), 6.1 (labels), 7.1 (bounds).
"""

from __future__ import annotations

import contextlib
import json
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.errors import SchemaError
from gyrostab.schema import (
    SIGNAL_LONG_NAMES,
    VARIABLES,
    check_log,
    check_product,
    check_surface,
    with_axis,
)
from gyrostab.store.attributes import decode_attributes, encode_attributes, make_global_attributes
from gyrostab.store.lazy import transpose_lazy
from gyrostab.store.private import close_function, is_in_memory
from gyrostab.store.safe_names import make_names_storable, restore_names
from gyrostab.store.times import (
    decode_stamps,
    encode_grid,
    encode_stamps,
    find_time_grids,
    has_whole_microseconds,
    index_dim,
    make_time_axes,
    parse_time_grids,
    time_attributes,
)

#: Dimensions in the order of the file, and in memory; other ones keep their order at the dots.
_DISK_ORDER = ("axis", "term", "tau", ..., "time", "bnds")
_MEMORY_ORDER = ("axis", ..., "tau", "term", "bnds")
#: Labels of variables that have none.
_LONG_NAMES = {**SIGNAL_LONG_NAMES, "axis": VARIABLES["axis"]["long_name"]}
#: What the encoding of integer counts consists of, where a reader declares them.
PACKING = ("dtype", "scale_factor", "add_offset")
#: Attributes by which readers decode stored numbers; numbers in memory are decoded.
DECODING = {"_FillValue", "missing_value", "_Unsigned", "scale_factor", "add_offset"}


def find_kind(dataset: xr.Dataset) -> str:
    """Return ``"product"``, ``"surface"`` or ``"log"``, or ``"dataset"`` for anything else."""
    for kind, check in (("product", check_product), ("surface", check_surface), ("log", check_log)):
        with contextlib.suppress(SchemaError):
            check(dataset)
            return kind
    return "dataset"


def to_disk(
    dataset: xr.Dataset, verb: str, *, stamps: bool = False, nanoseconds: bool = False
) -> xr.Dataset:
    """Encode a dataset as the file will hold it; `verb` is added to its history.

    With `stamps`, a computed time axis becomes a lazy coordinate, with its rule as an attribute.
    With `nanoseconds`, times are not stored as microseconds, even if that would be exact.
    """
    if (kind := find_kind(whole := with_axis(dataset))) != "dataset":
        dataset = whole  # also of one axis that was selected
    dataset = make_names_storable(dataset)
    grids = find_time_grids(dataset)
    short = not nanoseconds and has_whole_microseconds(dataset, grids, stamps=stamps)
    divisor = 1000 if short else 1
    bounds = [
        str(variable.attrs["bounds"])
        for variable in dataset.variables.values()
        if "bounds" in variable.attrs
    ]
    variables: dict[Any, xr.Variable] = {}
    for name, variable in dataset.variables.items():
        variable = _convert_type(name, variable)
        if name in grids:
            encoded = encode_grid(grids[name], _plain_attributes(variable), divisor, stamps=stamps)
            variables[name if stamps else f"{name}_start"] = encoded
        else:
            variables[name] = _encode_variable(
                name,
                variable,
                divisor,
                is_index=name in dataset.dims,
                is_bounds=name in bounds,
            )
    coords = {
        name: variables.pop(name)
        for name in list(dataset.coords)
        if name not in bounds and name in variables
    }
    stored_set = xr.Dataset(variables, coords=xr.Coordinates(coords, indexes={}))
    if not stamps:
        stored_set = stored_set.rename_dims(
            {dim: index_dim(dim) for dim in grids if dim in stored_set.dims}
        )
    if "avar" in variables:
        ancillary = [
            name for name in ("count", "coverage", "edf", "estimator") if name in variables
        ]
        stored_set["avar"].attrs["ancillary_variables"] = " ".join(ancillary)
    stored_set.attrs = make_global_attributes(dataset, kind, verb)
    return stored_set


def _plain_attributes(variable: xr.Variable) -> dict[Any, Any]:
    """Return the attributes that do not decode stored numbers."""
    return {key: item for key, item in variable.attrs.items() if key not in DECODING}


def _encode_variable(
    name: Any, variable: xr.Variable, divisor: int, *, is_index: bool, is_bounds: bool
) -> xr.Variable:
    """Encode values, attributes and packing of a variable that is not a computed time axis."""
    stored = variable if is_index else transpose_lazy(_make_lazy(variable), _DISK_ORDER)
    label = _LONG_NAMES.get(str(name), str(name).replace("_", " "))
    attrs = encode_attributes({"long_name": label, **_plain_attributes(variable)})
    data = variable.values if is_index else stored.data
    if variable.dtype.kind == "M":
        data = encode_stamps(name, stored, divisor)
        if is_index:
            attrs = {"standard_name": "time", "axis": "T", **attrs}
        attrs |= time_attributes(divisor)
    packing = (
        {key: variable.encoding[key] for key in PACKING if key in variable.encoding}
        if "scale_factor" in variable.encoding
        else {}
    )
    return xr.Variable(stored.dims, data, {} if is_bounds else attrs, packing)


def _convert_type(name: Any, variable: xr.Variable) -> xr.Variable:
    """Convert numbers of a type that NetCDF has not; differences of times become seconds."""
    dtype: Any = variable.dtype
    if not isinstance(dtype, np.dtype) or dtype.kind not in "biufSUOTMm":
        raise SchemaError(
            f"{name!r} holds values of type {dtype}, which files cannot hold; convert it to "
            "numbers, times or texts, for instance with .astype(str)"
        )
    if dtype.kind == "m":
        seconds = variable.data / np.timedelta64(1, "s")  # NaN for NaT
        return xr.Variable(variable.dims, seconds, {**variable.attrs, "units": "s"})
    if dtype.kind == "f" and dtype.itemsize not in (4, 8):
        return variable.astype(np.float32 if dtype.itemsize < 4 else np.float64)
    return variable


def _make_lazy(variable: xr.Variable) -> xr.Variable:
    """Make a dask array of a variable that is still in another file, to copy it chunk by chunk."""
    ready = is_in_memory(variable) or variable.chunks is not None
    return variable if ready else variable.chunk("auto")


def from_disk(stored: xr.Dataset, where: str) -> xr.Dataset:
    """Decode a dataset that was opened without decoding times and without indexes.

    `where` names the file in messages.
    """
    bounds = {
        variable.attrs["bounds"]: name
        for name, variable in stored.variables.items()
        if "bounds" in variable.attrs
    }
    variables: dict[Any, xr.Variable] = {}
    grids = parse_time_grids(stored.variables, where)
    axes, close = make_time_axes(stored.sizes, grids, where), close_function(stored)
    dims: dict[Any, Any] = {index_dim(dim): dim for grid in grids.values() for dim in grid.dims}
    for name, variable in stored.variables.items():
        if name in grids:
            continue
        has_units = " since " in str(variable.attrs.get("units", ""))  # as xarray may write it
        inherits = name in bounds and not has_units
        parent = stored.variables[bounds[name]] if inherits else variable
        opened = decode_stamps(variable.copy(deep=False), parent.attrs)
        if opened.dtype.kind in "OT":
            opened = opened.astype(str)
        if name in stored.coords or name in bounds:
            opened = opened.load()
        opened.attrs = decode_attributes(dict(opened.attrs))
        for flags in {"flag_values", "flag_masks"} & opened.attrs.keys():  # Zarr holds lists
            with contextlib.suppress(OverflowError, TypeError, ValueError):  # damaged
                opened.attrs[flags] = np.array(opened.attrs[flags], opened.dtype, ndmin=1)
        opened.dims = tuple(dims.get(dim, dim) for dim in opened.dims)
        variables[name] = opened.transpose(*_MEMORY_ORDER, missing_dims="ignore")
    small_coords = xr.Coordinates(
        {
            name: variables.pop(name)
            for name in list(variables)
            if name in stored.coords or name in bounds
        }
    )
    coords, indexes = dict(small_coords.variables), dict(small_coords.xindexes)
    for name, axis in axes.items():
        coords |= axis.variables
        indexes |= axis.xindexes
        coords[grids[name].dims[0]].attrs = json.loads(
            stored.variables[name].attrs.get("axis_attributes", "{}")
        )
    dataset = xr.Dataset(
        variables, xr.Coordinates(coords, indexes=indexes), decode_attributes(dict(stored.attrs))
    )
    dataset = restore_names(dataset)
    dataset.set_close(close)
    return dataset
