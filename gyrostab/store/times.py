"""Times in files: computed time axes as a first stamp and a rule, and stored stamps by CF.

References
----------
CF conventions 1.11, section 4.4 (time).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Ints
from gyrostab.errors import FormatError, SchemaError
from gyrostab.store.damage import check_blosc_chunks
from gyrostab.store.lazy import RowSource, make_dask
from gyrostab.time.grid import GridTransform, TimeGridIndex, period_ns
from gyrostab.time.stamps import to_nanoseconds

#: Attribute with the rule of a computed time axis, on the variable that holds its first stamp.
GRID = "sampling_grid"
#: Stamps that are computed together.
_STAMPS_CHUNK = 2**20
_EPOCH = "1970-01-01T00:00:00"
#: Units of stored stamps, by their length [ns].
_UNITS = {1: f"nanoseconds since {_EPOCH}", 1000: f"microseconds since {_EPOCH}"}
_STEPS = {units: step for step, units in _UNITS.items()}


def time_attributes(divisor: int) -> dict[str, str]:
    """Return the attributes of stamps in units of `divisor` nanoseconds, 1 or 1000."""
    return {
        "units": _UNITS[divisor],
        "calendar": "proleptic_gregorian",
        "units_metadata": "leap_seconds: unknown",
    }


def index_dim(dim: Any) -> str:
    """Name a dimension with computed stamps in the file; CF reserves ``time`` for stored ones."""
    return f"{dim}_index"


def find_time_grids(dataset: xr.Dataset) -> dict[Any, GridTransform]:
    """Find the rules of the computed time axes."""
    grids = {
        name: index.transform
        for name, index in dataset.xindexes.items()
        if isinstance(index, TimeGridIndex)
    }
    conflicts = [
        needed_name
        for name in grids
        for needed_name in (f"{name}_start", index_dim(name))
        if needed_name in dataset.variables
    ]
    if conflicts:
        raise SchemaError(
            f"the name {conflicts[0]!r} is needed for the time axis; rename that variable"
        )
    return grids


def encode_grid(
    grid: GridTransform, attrs: dict[Any, Any], divisor: int, *, stamps: bool
) -> xr.Variable:
    """Encode a computed time axis with its exact rule as an attribute.

    With `stamps` it is a lazy CF coordinate, otherwise the first stamp alone.
    """
    (dim,) = grid.dims
    attributes: dict[str, Any]
    if stamps:
        data = make_dask(_GridStamps(grid, divisor), min(max(grid.size, 1), _STAMPS_CHUNK))
        attributes = {"long_name": "time", "standard_name": "time"}
        attributes |= {"axis": "T"} if dim == "time" else {}
    else:
        data = grid.stamps_at(0) // divisor
        attributes = {
            "long_name": f"time of the first sample on the dimension {index_dim(dim)}",
            "comment": "sample n (from 0) is at this time + n / sampling_rate_hz; "
            f"{GRID} is the exact rule: "
            "start_ns + round((first + stride * n) * 1e9 / rate_hz) nanoseconds since 1970",
            "sampling_rate_hz": grid.rate / grid.samples.step,
        }
    rule = {
        "dim": dim,
        "start_ns": grid.start,
        "rate_hz": grid.rate,
        "first": grid.samples.start,
        "stride": grid.samples.step,
        "size": grid.size,
    }
    attributes[GRID] = json.dumps(rule)
    if attrs:
        attributes["axis_attributes"] = json.dumps(dict(attrs), default=str)
    return xr.Variable(grid.dims[: data.ndim], data, {**attributes, **time_attributes(divisor)})


class _GridStamps(RowSource):
    """Stamps of a computed time axis, in whole units of `divisor` nanoseconds since 1970."""

    def __init__(self, grid: GridTransform, divisor: int):
        self.grid, self.divisor = grid, divisor
        self.shape, self.dtype = (grid.size,), np.dtype(np.int64)

    def read_into(self, row: int, begin: int, out: Array) -> None:
        stamps = self.grid.stamps_at(np.arange(begin, begin + out.size))
        np.floor_divide(stamps, self.divisor, out=out)


def has_whole_microseconds(
    dataset: xr.Dataset, grids: Mapping[Any, GridTransform], *, stamps: bool = False
) -> bool:
    """Whether microseconds represent every time exactly; fewer programs read nanoseconds."""
    for name, variable in dataset.variables.items():
        if name in grids:
            grid = grids[name]
            nanoseconds, fraction = period_ns(grid.rate)
            if grid.stamps_at(0) % 1000 or (
                stamps and (fraction or nanoseconds * grid.samples.step % 1000)
            ):
                return False
        elif variable.dtype.kind == "M" and np.any(to_nanoseconds(variable.values) % 1000):
            return False
    return True


def encode_stamps(name: Any, variable: xr.Variable, divisor: int) -> Ints:
    """Encode times as integer microseconds or nanoseconds since 1970."""
    stamps = variable.values
    if np.isnat(stamps).any():
        raise SchemaError(
            f"{name!r} holds {int(np.isnat(stamps).sum())} missing times (NaT); "
            "every time must be known"
        )
    return to_nanoseconds(stamps) // divisor


def parse_time_grids(
    variables: Mapping[Any, xr.Variable], where: object
) -> dict[str, GridTransform]:
    """Parse the rules of the computed time axes that a file declares, by name of the variable."""
    declared = {
        str(name): variable.attrs[GRID]
        for name, variable in variables.items()
        if GRID in variable.attrs
    }
    try:
        return {name: _parse_grid(text) for name, text in declared.items()}
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            f"{where}: the rule of its time axis, attribute {GRID!r}, is damaged ({error}); "
            "copy it again"
        ) from error


def _parse_grid(text: Any) -> GridTransform:
    """Parse the rule of a time axis; `ValueError` when `to_disk` did not write it."""
    rule = json.loads(text)
    kinds = {
        "dim": str,
        "size": int,
        "start_ns": int,
        "first": int,
        "stride": int,
        "rate_hz": int | float,
    }
    wrong = [
        name
        for name, kind in kinds.items()
        if not isinstance(rule, dict) or not isinstance(rule.get(name), kind)
    ]
    if wrong:
        raise ValueError(f"no {' and no '.join(wrong)}")
    start, rate, size = rule["start_ns"], rule["rate_hz"], rule["size"]
    first, stride = rule["first"], rule["stride"]
    if not (0 < rate < math.inf and size >= 0 and stride > 0):
        raise ValueError(f"{text}")
    ends = (first + stride * n for n in (0, max(size, 1) - 1))
    if any(abs(start + n * 1e9 / rate) >= 2.0**63 for n in ends):
        raise ValueError("it leaves the years 1678 to 2262")
    return GridTransform(start, rate, range(first, first + stride * size, stride), rule["dim"])


def make_time_axes(
    sizes: Mapping[Any, int], grids: Mapping[str, GridTransform], where: str
) -> dict[str, xr.Coordinates]:
    """Make the coordinates of the computed time axes, by name of the declaring variable."""
    axes = {}
    for name, grid in grids.items():
        (dim,) = grid.dims
        size = sizes.get(index_dim(dim), sizes.get(dim, 0))
        if size != grid.size:
            raise FormatError(
                f"{where}: has {size} samples on {index_dim(dim)!r}, but was written with "
                f"{grid.size}: some other program has cut it, and its times are lost; "
                "cut it in Python with gyrostab.open_log(...).isel or .sel, "
                "and write it with gyrostab.to_netcdf"
            )
        axes[name] = xr.Coordinates.from_xindex(TimeGridIndex(grid))
    return axes


def replace_stamps(stored: xr.Dataset, where: object) -> xr.Dataset:
    """Replace stored stamps by the rule that they follow.

    A rule that another program has left unchanged with other stamps is dropped: `stored` then has
    an ordinary time coordinate.
    """
    for name, grid in parse_time_grids(stored.variables, where).items():
        stamps = stored.variables[name]
        if not stamps.ndim:
            continue
        if _has_stamps_of(grid, stamps, Path(str(where)) / name):
            start = xr.Variable((), 0, stamps.attrs)
            stored = stored.drop_vars(name).assign({f"{name}_start": start})
        else:
            other_attrs = {key: value for key, value in stamps.attrs.items() if key != GRID}
            changed = xr.Variable(stamps.dims, stamps.data, other_attrs, stamps.encoding)
            stored = stored.drop_vars(name).assign_coords(
                xr.Coordinates({name: changed}, indexes={})
            )
    return stored


def _has_stamps_of(grid: GridTransform, stamps: xr.Variable, folder: Path) -> bool:
    """Whether stamps on disk agree in number and at both ends with a rule, or are damaged.

    `folder` holds the chunks of the stamps of a Zarr store.
    """
    if stamps.shape != (grid.size,):
        return False
    try:
        check_blosc_chunks(folder)
        ends = np.unique([0, grid.size - 1]) if grid.size else np.empty(0, np.int64)
        written = to_nanoseconds(decode_stamps(stamps[ends]).values)
        return np.array_equal(written, grid.stamps_at(ends))
    except Exception:  # damaged stamps, for which the libraries raise errors of many kinds
        return True


def decode_stamps(variable: xr.Variable, attrs: dict[Any, Any] | None = None) -> xr.Variable:
    """Decode times to datetime64[ns], by the units in `attrs` or else of the variable.

    A variable without units of time is returned unchanged.
    """
    attrs = variable.attrs if attrs is None else attrs
    if " since " not in str(attrs.get("units", "")):
        return variable
    step = _STEPS.get(attrs["units"])
    if step and variable.dtype.kind == "i":  # as `to_disk` writes them; xarray is slower
        other_attrs = {
            key: value for key, value in variable.attrs.items() if key not in ("units", "calendar")
        }
        return xr.Variable(
            variable.dims,
            (np.asarray(variable.values, dtype=np.int64) * step).view("datetime64[ns]"),
            other_attrs,
        )
    timed = variable.copy(deep=False)
    timed.attrs = {
        **variable.attrs,
        "units": attrs["units"],
        "calendar": attrs.get("calendar", "standard"),
    }
    decoded = xr.decode_cf(xr.Dataset({"stamps": timed})).variables["stamps"].load()
    return decoded.copy(data=to_nanoseconds(decoded.values).view("datetime64[ns]"))
