"""Encode datasets by the CF conventions, and decode them.

This concerns the order of dimensions, exact times, unit strings and attributes.

References
----------
CF conventions 1.11, sections 2.5.1 (missing data), 3.1 (units), 4.4 (time), 6.1 (labels), 7.1
(bounds); ACDD 1.3.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError, SchemaError
from gyrostab.kernels.allan.variances import VARIANCES
from gyrostab.schema import (
    SIGNAL_LONG_NAMES,
    VARIABLES,
    check_log,
    check_product,
    check_surface,
    texts,
)
from gyrostab.store.blosc_chunks import check_blosc_chunks
from gyrostab.store.lazy import RowSource, make_dask, transpose_lazy
from gyrostab.store.private import close_function, is_in_memory
from gyrostab.store.safe_names import (
    is_storable,
    make_name_storable,
    make_names_storable,
    restore_names,
)
from gyrostab.time.clock import time_of_day
from gyrostab.time.grid import TimeGridIndex, grid_times, period_ns, time_coordinate
from gyrostab.time.stamps import to_nanoseconds
from gyrostab.units import ON_DISK, on_disk

__all__ = [
    "GRID",
    "PACKING",
    "decode_stamps",
    "find_kind",
    "from_disk",
    "index_dim",
    "parse_time_grids",
    "replace_stamps",
    "to_disk",
]

CONVENTIONS = "CF-1.11, ACDD-1.3"
TITLES = {
    "product": "Dynamic Allan variance of a gyro log, "
    "with the noise coefficients Q, N, B, K and R of every window",
    "surface": "Dynamic Allan variance of a gyro log",
    "log": "Gyro log on a uniform time axis",
    "dataset": "Gyro stability data",
}
#: Dimensions in the order of the file; those not named keep their place between `tau` and `time`.
_ORDER = ("axis", "term", "tau")
#: Attribute with the rule of a computed time axis, on the variable that holds its first stamp.
GRID = "sampling_grid"
#: Stamps that are computed together.
_STAMPS_CHUNK = 2**20
_EPOCH = "1970-01-01T00:00:00"
_CALENDAR = {"calendar": "proleptic_gregorian", "units_metadata": "leap_seconds: none"}
#: Labels of variables that have none.
_LONG_NAMES = {**SIGNAL_LONG_NAMES, "axis": VARIABLES["axis"]["long_name"]}
#: What the encoding of integer counts consists of, where a reader declares them.
PACKING = ("dtype", "scale_factor", "add_offset")
_JSON_NAMES = "json_attributes"

# Names that UDUNITS reads as intended. An integer power may follow; UDUNITS misreads a fractional
# one without an error, so none passes.
_SAFE_UNIT_NAMES = (
    "degree_Celsius|standard_free_fall|degree|hour|microradian|radian|"
    "s|m|K|V|W|Pa|T|uT|Hz|kg|percent"
)
_SAFE_UNIT = re.compile(
    rf"(?:{_SAFE_UNIT_NAMES})(?:-?[1-9])?(?: (?:{_SAFE_UNIT_NAMES})(?:-?[1-9])?)*"
)


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
    kind = find_kind(dataset)
    dataset = make_names_storable(dataset)
    grids = _find_time_grids(dataset)
    short = not nanoseconds and _has_whole_microseconds(dataset, grids, stamps=stamps)
    divisor = 1000 if short else 1
    since = {
        "units": f"{'microseconds' if divisor == 1000 else 'nanoseconds'} since {_EPOCH}",
        **_CALENDAR,
    }
    bounds = [
        str(variable.attrs["bounds"])
        for variable in dataset.variables.values()
        if "bounds" in variable.attrs
    ]
    variables: dict[Any, xr.Variable] = {}
    for name, variable in dataset.variables.items():
        if name in grids:
            encode = _encode_all_stamps if stamps else _encode_first_stamp
            variables[name if stamps else f"{name}_start"] = encode(
                grids[name], variable.attrs, divisor, since
            )
            continue
        stored = (
            transpose_lazy(_make_lazy(variable), _disk_order(variable.dims))
            if name not in dataset.dims
            else variable
        )
        label = _LONG_NAMES.get(str(name), str(name).replace("_", " "))
        attrs = _encode_attributes({"long_name": label, **variable.attrs})
        data = stored.data if name not in dataset.dims else None
        if variable.dtype.kind == "M":
            data = _encode_stamps(name, stored, divisor)
            if name in dataset.dims:
                attrs = {"standard_name": "time", "axis": "T", **attrs}
            if name not in bounds:
                attrs |= since
        elif data is None:
            data = variable.values
        packing = (
            {key: variable.encoding[key] for key in PACKING if key in variable.encoding}
            if "scale_factor" in variable.encoding
            else {}
        )
        variables[name] = xr.Variable(stored.dims, data, {} if name in bounds else attrs, packing)
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
    stored_set.attrs = _make_global_attributes(dataset, kind, verb)
    return stored_set


def _disk_order(dims: tuple[Any, ...]) -> list[Any]:
    last = [dim for dim in ("time", "bnds") if dim in dims]
    return (
        [dim for dim in _ORDER if dim in dims]
        + [dim for dim in dims if dim not in (*_ORDER, *last)]
        + last
    )


def _make_lazy(variable: xr.Variable) -> xr.Variable:
    """Make a dask array of a variable that is still in another file, to copy it chunk by chunk."""
    ready = is_in_memory(variable) or variable.chunks is not None
    return variable if ready else variable.chunk("auto")


def _find_time_grids(dataset: xr.Dataset) -> dict[Any, Any]:
    """Find the rules of the computed time axes."""
    grids = {
        name: index.transform
        for name, index in dataset.xindexes.items()
        if isinstance(index, TimeGridIndex)
    }
    taken = [
        other
        for name in grids
        for other in (f"{name}_start", index_dim(name))
        if other in dataset.variables
    ]
    if taken:
        raise SchemaError(
            f"the name {taken[0]!r} is needed for the time axis; rename that variable"
        )
    return grids


def index_dim(dim: Any) -> str:
    """Name a dimension with computed stamps in the file; CF reserves ``time`` for stored ones."""
    return f"{dim}_index"


def _encode_first_stamp(
    grid: Any, attrs: dict[Any, Any], divisor: int, since: dict[str, Any]
) -> xr.Variable:
    """Encode a computed time axis: its first stamp, with rate and exact rule as attributes."""
    (dim,) = grid.dims
    first = int(grid_times(grid.start, grid.rate, grid.first))
    attributes = {
        "long_name": f"time of the first sample on the dimension {index_dim(dim)}",
        "comment": "sample n (from 0) is at this time + n / sampling_rate_hz; "
        f"{GRID} is the exact rule: "
        "start_ns + round((first + stride * n) * 1e9 / rate_hz) nanoseconds since 1970",
        "sampling_rate_hz": grid.rate / grid.stride,
    }
    return xr.Variable(
        (), np.int64(first // divisor), {**attributes, **_encode_rule(grid, attrs), **since}
    )


def _encode_all_stamps(
    grid: Any, attrs: dict[Any, Any], divisor: int, since: dict[str, Any]
) -> xr.Variable:
    """Encode a computed time axis as a lazy CF coordinate, with its exact rule as an attribute."""
    (dim,) = grid.dims
    attributes = {"long_name": "time", "standard_name": "time"}
    attributes |= {"axis": "T"} if dim == "time" else {}
    stamps = make_dask(_GridStamps(grid, divisor), min(max(grid.size, 1), _STAMPS_CHUNK))
    return xr.Variable((dim,), stamps, {**attributes, **_encode_rule(grid, attrs), **since})


def _encode_rule(grid: Any, attrs: dict[Any, Any]) -> dict[str, str]:
    (dim,) = grid.dims
    rule = {
        "dim": dim,
        "start_ns": grid.start,
        "rate_hz": grid.rate,
        "first": grid.first,
        "stride": grid.stride,
        "size": grid.size,
    }
    return {
        GRID: json.dumps(rule),
        **({"axis_attributes": json.dumps(dict(attrs), default=str)} if attrs else {}),
    }


class _GridStamps(RowSource):
    """Stamps of a computed time axis, in whole units of `divisor` nanoseconds since 1970."""

    def __init__(self, grid: Any, divisor: int):
        self.grid, self.divisor = grid, divisor
        self.shape, self.dtype = (grid.size,), np.dtype(np.int64)

    def read_into(self, row: int, begin: int, out: NDArray[Any]) -> None:
        """Compute the stamps of the samples from `begin` on."""
        grid = self.grid
        samples = grid.first + grid.stride * np.arange(begin, begin + out.size)
        np.floor_divide(grid_times(grid.start, grid.rate, samples), self.divisor, out=out)


def _has_whole_microseconds(
    dataset: xr.Dataset, grids: dict[Any, Any], *, stamps: bool = False
) -> bool:
    """Whether microseconds represent every time exactly; fewer programs read nanoseconds."""
    for name, variable in dataset.variables.items():
        if name in grids:
            grid = grids[name]
            whole, fraction = period_ns(grid.rate)
            if int(grid_times(grid.start, grid.rate, grid.first)) % 1000 or (
                stamps and (fraction or whole * grid.stride % 1000)
            ):
                return False
        elif variable.dtype.kind == "M" and np.any(to_nanoseconds(variable.values) % 1000):
            return False
    return True


def _encode_stamps(name: Any, variable: xr.Variable, divisor: int) -> NDArray[np.int64]:
    """Encode times as integer microseconds or nanoseconds since 1970."""
    stamps = variable.values
    if np.isnat(stamps).any():
        raise SchemaError(
            f"{name!r} holds {int(np.isnat(stamps).sum())} missing times (NaT); "
            "every time must be known"
        )
    return to_nanoseconds(stamps) // divisor


def _encode_attributes(attrs: dict[str, Any]) -> dict[str, Any]:
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
        if isinstance(value, np.generic):
            attrs[name] = value = value.item()
        if isinstance(value, str) or (
            isinstance(value, int | float) and not isinstance(value, bool)
        ):
            continue
        if not isinstance(value, np.ndarray):
            # in ASCII: Octave cannot list a file with other characters in a global attribute
            attrs[name] = json.dumps(value, default=str)
            coded.append(name)
    if coded:
        attrs[_JSON_NAMES] = " ".join(coded)
    return attrs


def _make_global_attributes(dataset: xr.Dataset, kind: str, verb: str) -> dict[str, Any]:
    now = time_of_day()
    try:
        version = metadata.version("gyrostab")
    except metadata.PackageNotFoundError:
        version = "unknown"
    given = dict(dataset.attrs)
    history = given.get("history", "")
    lines = [history] if isinstance(history, str) else [str(line) for line in history]
    given["history"] = "\n".join(
        [*filter(None, lines), f"{now} gyrostab {version}: {verb}, {kind}"]
    )
    variance = VARIANCES.get(str(given.get("variance")), VARIANCES["avar"]).text
    titles = {name: text.replace("Allan", variance) for name, text in TITLES.items()}
    if given.get("title") in (None, *titles.values()):  # also a title of an earlier stage
        given["title"] = titles[kind]
    names = texts(dataset, "source_files")
    source = "gyro log: " + ", ".join(names) if names else "gyro log"
    given.setdefault("source", source.encode("ascii", "backslashreplace").decode())
    given |= {
        "Conventions": CONVENTIONS,
        "date_created": now,
        "gyrostab_version": version,
        "gyrostab_content": kind,
    }
    given.setdefault(
        "references",
        "IEEE Std 952; Wang et al., Sensors 16 (2016) 2081 "
        "(dynamic Allan variance of gyros with missing data)",
    )
    times = dataset.get("time")
    if times is not None and times.dtype.kind == "M" and times.size:
        for end, position in (("start", 0), ("end", -1)):
            # one dimension when the axis is computed
            stamp = np.asarray(times[position].values).ravel()[0]
            given[f"time_coverage_{end}"] = f"{stamp.astype('datetime64[us]')}Z"
    return _encode_attributes(given)


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
    grids = parse_time_grids(stored, where)
    axes, close = _make_time_axes(stored, grids, where), close_function(stored)
    dims: dict[Any, Any] = {index_dim(rule["dim"]): rule["dim"] for rule in grids.values()}
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
        opened.attrs = _decode_attributes(dict(opened.attrs))
        opened.dims = tuple(dims.get(dim, dim) for dim in opened.dims)
        variables[name] = opened.transpose(*_memory_order(opened.dims))
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
        coords[grids[name]["dim"]].attrs = json.loads(
            stored.variables[name].attrs.get("axis_attributes", "{}")
        )
    dataset = xr.Dataset(
        variables,
        xr.Coordinates(coords, indexes=indexes),
        _decode_attributes(dict(stored.attrs)),
    )
    dataset = restore_names(dataset)
    dataset.set_close(close)
    return dataset


def _memory_order(dims: tuple[Any, ...]) -> list[Any]:
    last = [dim for dim in ("tau", "term", "bnds") if dim in dims]
    return (
        sorted((dim for dim in dims if dim not in last), key=lambda dim: bool(dim != "axis")) + last
    )


def decode_stamps(variable: xr.Variable, attrs: dict[Any, Any] | None = None) -> xr.Variable:
    """Decode times to datetime64[ns], by the units in `attrs` or else of the variable.

    A variable without units of time is returned unchanged.
    """
    attrs = variable.attrs if attrs is None else attrs
    if " since " not in str(attrs.get("units", "")):
        return variable
    step = {f"microseconds since {_EPOCH}": 1000, f"nanoseconds since {_EPOCH}": 1}.get(
        attrs["units"]
    )
    if step and variable.dtype.kind == "i":  # as `to_disk` writes them; xarray is slower
        rest = {
            key: value for key, value in variable.attrs.items() if key not in ("units", "calendar")
        }
        return xr.Variable(
            variable.dims,
            (np.asarray(variable.values, dtype=np.int64) * step).view("datetime64[ns]"),
            rest,
        )
    timed = variable.copy(deep=False)
    timed.attrs = {
        **variable.attrs,
        "units": attrs["units"],
        "calendar": attrs.get("calendar", "standard"),
    }
    decoded = xr.decode_cf(xr.Dataset({"stamps": timed})).variables["stamps"].load()
    return decoded.astype("datetime64[ns]")


def replace_stamps(stored: xr.Dataset, where: object) -> xr.Dataset:
    """Replace stored stamps by the rule that they follow.

    A rule that another program has left unchanged with other stamps is dropped: `stored` then has
    an ordinary time coordinate.
    """
    for name, rule in parse_time_grids(stored, where).items():
        stamps = stored.variables[name]
        if not stamps.ndim:
            continue
        if _has_stamps_of(rule, stamps, Path(str(where)) / name):
            start = xr.Variable((), 0, stamps.attrs)
            stored = stored.drop_vars(name).assign({f"{name}_start": start})
        else:
            rest = {key: value for key, value in stamps.attrs.items() if key != GRID}
            changed = xr.Variable(stamps.dims, stamps.data, rest, stamps.encoding)
            stored = stored.drop_vars(name).assign_coords(
                xr.Coordinates({name: changed}, indexes={})
            )
    return stored


def _has_stamps_of(rule: dict[str, Any], stamps: xr.Variable, folder: Path) -> bool:
    """Whether stamps on disk agree in number and at both ends with a rule, or are damaged.

    `folder` holds the chunks of the stamps of a Zarr store.
    """
    if stamps.shape != (rule["size"],):
        return False
    ends = np.unique([0, max(rule["size"] - 1, 0)])[: rule["size"]]
    samples = rule["first"] + rule["stride"] * ends
    try:
        check_blosc_chunks(folder)
        found = to_nanoseconds(decode_stamps(stamps[ends], stamps.attrs).values)
    except Exception:  # damaged stamps, for which the libraries raise errors of many kinds
        return True
    return np.array_equal(found, grid_times(rule["start_ns"], rule["rate_hz"], samples))


def parse_time_grids(stored: xr.Dataset, where: object) -> dict[str, dict[str, Any]]:
    """Parse the rules of the computed time axes that a file declares, by name of the variable."""
    declared = {
        str(name): variable.attrs[GRID]
        for name, variable in stored.variables.items()
        if GRID in variable.attrs
    }
    try:
        return {name: _parse_grid(text) for name, text in declared.items()}
    except (TypeError, ValueError) as error:
        raise FormatError(
            f"{where}: the rule of its time axis, attribute {GRID!r}, is damaged ({error}); "
            "copy it again"
        ) from error


def _parse_grid(text: Any) -> dict[str, Any]:
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
    first, last = (rule["first"] + rule["stride"] * n for n in (0, max(rule["size"], 1) - 1))
    spans = (
        (rule["start_ns"] + n * 1e9 / rule["rate_hz"] for n in (first, last))
        if rule["rate_hz"] > 0
        else ()
    )
    if not (
        rule["rate_hz"] > 0
        and math.isfinite(rule["rate_hz"])
        and rule["size"] >= 0
        and rule["stride"] != 0
    ):
        raise ValueError(f"{text}")
    if any(abs(stamp) >= 2.0**63 for stamp in spans):
        raise ValueError("it leaves the years 1678 to 2262")
    return dict(rule)


def _make_time_axes(
    stored: xr.Dataset, grids: dict[str, dict[str, Any]], where: str
) -> dict[str, xr.Coordinates]:
    """Make the coordinates of the computed time axes, by name of the declaring variable."""
    axes = {}
    for name, rule in grids.items():
        dim = rule["dim"]
        size = stored.sizes.get(index_dim(dim), stored.sizes.get(dim, 0))
        if size != rule["size"]:
            raise FormatError(
                f"{where}: has {size} samples on {index_dim(dim)!r}, but was written with "
                f"{rule['size']}: some other program has cut it, and its times are lost; "
                "cut it in Python with gyrostab.open_log(...).isel or .sel, "
                "and write it with gyrostab.to_netcdf"
            )
        axes[name] = time_coordinate(
            rule["start_ns"],
            rule["rate_hz"],
            size,
            name=dim,
            first=rule["first"],
            stride=rule["stride"],
        )
    return axes


def _decode_attributes(attrs: dict[str, Any]) -> dict[str, Any]:
    for name in set(str(attrs.pop(_JSON_NAMES, "")).split()) & set(attrs):
        attrs[name] = json.loads(attrs[name])
    for name, value in attrs.items():
        attrs[name] = value.item() if isinstance(value, np.generic) else value
    if "since" in str(attrs.get("units", "")):
        del attrs["units"]
    for name in ("calendar", "units_metadata", "ancillary_variables"):
        attrs.pop(name, None)
    if "source_units" in attrs:
        attrs["units"] = attrs.pop("source_units")
    inner = {stored: units for units, stored in ON_DISK.items()}
    if "units" in attrs:
        attrs["units"] = inner.get(attrs["units"], attrs["units"])
    return attrs
