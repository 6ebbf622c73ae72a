"""Compare two folders of outputs: numbers and structure strictly, text by count."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

#: Attributes that decide what a number means.
ATTRIBUTES = (
    "units",
    "scale_factor",
    "add_offset",
    "flag_values",
    "sampling_rate_hz",
    "tau_ref",
    "kind",
    "calendar",
)
#: Keys of diagnosis.json that hold prose.
PROSE = ("statement", "reason")
#: Keys that hold the time a computation took.
TIMINGS = ("seconds",)


class Text(str):
    """A difference in wording only."""


def same(a: Any, b: Any, rtol: float) -> bool:
    """Equal numbers, NaN included; within `rtol` of the largest one where it is given."""
    a, b = np.asarray(a), np.asarray(b)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    if a.dtype.kind not in "fc" or not rtol:
        return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fcmM"))
    finite = np.abs(a[np.isfinite(a)])
    return bool(
        np.allclose(a, b, rtol=rtol, atol=rtol * float(finite.max(initial=0.0)), equal_nan=True)
    )


def compare_datasets(a: xr.Dataset, b: xr.Dataset, rtol: float) -> Iterator[str]:
    """Variables, their dimensions, units and values."""
    if set(a.variables) != set(b.variables):
        yield f"variables {sorted(set(map(str, a.variables)) ^ set(map(str, b.variables)))}"
    for name in sorted(set(map(str, a.variables)) & set(map(str, b.variables))):
        first, second = a[name], b[name]
        if first.dims != second.dims or not same(first.values, second.values, rtol):
            is_prose = first.dtype.kind in "OUS" and first.shape == second.shape
            yield Text(name) if is_prose else f"{name}: values"
        if any(
            not np.array_equal(first.attrs.get(key, ""), second.attrs.get(key, ""))
            for key in ATTRIBUTES
        ):
            yield f"{name}: attributes"
        if str(first.attrs) != str(second.attrs):
            yield Text(name)


def compare_trees(a: Any, b: Any, rtol: float, path: str = "") -> Iterator[str]:
    """Plain data from JSON or TOML."""
    if isinstance(a, dict) and isinstance(b, dict):
        if a.keys() != b.keys():
            yield f"{path}: keys {sorted(a.keys() ^ b.keys())}"
        for key in (a.keys() & b.keys()) - set(TIMINGS):
            differences = compare_trees(a[key], b[key], rtol, f"{path}.{key}")
            yield from map(Text, differences) if key in PROSE else differences
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for number, (first, second) in enumerate(zip(a, b, strict=True)):
            yield from compare_trees(first, second, rtol, f"{path}[{number}]")
    elif isinstance(a, float) and isinstance(b, float):
        if not (
            a == b
            or (math.isnan(a) and math.isnan(b))
            or (rtol and math.isclose(a, b, rel_tol=rtol))
        ):
            yield f"{path}: {a} became {b}"
    elif a != b or type(a) is not type(b):
        yield f"{path}: {a!r} became {b!r}"


def open_any(path: Path) -> xr.Dataset:
    """A NetCDF file or a Zarr store as it lies on disk."""
    with xr.open_dataset(
        path, engine="zarr" if path.is_dir() else "netcdf4", decode_cf=False
    ) as data:
        return without_stamps(data.load())


def without_stamps(data: xr.Dataset) -> xr.Dataset:
    """Replace stored times that follow a rule by the first, as in logs without stamps."""
    for name in [n for n in data.coords if "sampling_grid" in data[n].attrs and data[n].ndim]:
        rule = json.loads(data[name].attrs["sampling_grid"])
        attrs = {**data[name].attrs, "sampling_rate_hz": rule["rate_hz"] / rule["stride"]}
        start = xr.Variable((), data[name].values[0], attrs)
        bare = data.drop_vars(name).rename_dims({name: f"{name}_index"})
        data = bare.assign({f"{name}_start": start})
    return data


def compare_items(a: Path, b: Path, rtol: float) -> Iterator[str]:
    """Differences between two files or stores of one name."""
    if a.suffix in (".nc", ".zarr"):
        yield from compare_datasets(open_any(a), open_any(b), rtol)
    elif a.suffix == ".json":
        yield from compare_trees(
            json.loads(a.read_text("utf-8")), json.loads(b.read_text("utf-8")), rtol
        )
    elif a.suffix == ".toml":
        yield from compare_trees(
            tomllib.loads(a.read_text("utf-8")), tomllib.loads(b.read_text("utf-8")), rtol
        )
    elif a.suffix == ".txt":
        first, second = a.read_text("utf-8").split("\n", 1), b.read_text("utf-8").split("\n", 1)
        if first[0] != second[0]:
            yield f"{first[0]} became {second[0]}"
        if first[1] != second[1]:
            yield Text("printed text")
    elif a.suffix == ".html" and a.read_bytes() != b.read_bytes():
        yield Text("page")


def items(folder: Path) -> set[str]:
    """Name the outputs of a job, without its inputs; a Zarr store counts as one output."""
    outputs = set()
    for path in folder.rglob("*"):
        relative = path.relative_to(folder)
        if relative.parts[0] == "input" or any(
            part.endswith(".zarr") for part in relative.parts[:-1]
        ):
            continue
        if path.is_file() or path.suffix == ".zarr":
            outputs.add(str(relative))
    return outputs


def compare_folders(
    reference: Path, made: Path, names: list[str], *, rtol: float
) -> tuple[list[str], int]:
    """All differences in numbers and structure, and how many there are in text alone."""
    differences, texts = [], 0
    for name in names:
        first, second = items(reference / name), items(made / name)
        differences += [f"{name}: {item} is in one of both only" for item in sorted(first ^ second)]
        for item in sorted(first & second):
            for difference in compare_items(reference / name / item, made / name / item, rtol):
                if isinstance(difference, Text):
                    texts += 1
                else:
                    differences.append(f"{name}: {item}: {difference}")
    return differences, texts
