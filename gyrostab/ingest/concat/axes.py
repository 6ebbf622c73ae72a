"""Logs with only some axes of a recording: group them, and split a raw log by its axes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from gyrostab.errors import SchemaError
from gyrostab.schema import signal_name, texts
from gyrostab.store.lazy import select_part, stack_rows

Log = TypeVar("Log")


def group_axes(logs: Sequence[Log], axes: Iterable[Sequence[str]]) -> list[list[Log]]:
    """Group logs by their axes: logs of one group share axes, directly or through other logs.

    The groups are in the order of their first axes.

    Examples
    --------
    >>> group_axes("abcd", [["z"], ["x", "y"], ["z"], ["y"]])
    [['b', 'd'], ['a', 'c']]
    """
    groups: list[tuple[set[str], list[int]]] = []
    for number, log_axes in enumerate(axes):
        sharing_groups = [group for group in groups if group[0] & set(log_axes)]
        groups = [group for group in groups if group not in sharing_groups]
        members = sorted([number, *(member for group in sharing_groups for member in group[1])])
        groups.append((set(log_axes).union(*(group[0] for group in sharing_groups)), members))
    ordered = sorted(groups, key=lambda group: sorted(group[0]))
    return [[logs[number] for number in members] for _, members in ordered]


def split_axes(raw: xr.Dataset) -> list[xr.Dataset]:
    """Split a raw log whose groups of axes have separate stamps into one raw log for each group.

    Its attribute ``axis_rows`` lists axes, first row and row after the last of each group.
    `SchemaError` when rows were selected from the log after it was read.
    """
    groups = raw.attrs.get("axis_rows")
    if groups is None:
        return [raw]
    parts = []
    if int(groups[-1][2]) != raw.sizes["row"]:
        raise SchemaError(
            "the rows of this raw log were selected after it was read; regularise the whole, and "
            "select from the regular log"
        )
    name = signal_name(raw)
    signal, places = raw[name], [str(axis) for axis in raw["axis"].values]
    files = list(
        zip(texts(raw, "source_files"), np.atleast_1d(raw.attrs["row_start"]).tolist(), strict=True)
    )
    for number, (axes, first, end) in enumerate(groups):
        rows = [select_part(signal.data, places.index(axis), first, end) for axis in axes]
        stack = stack_rows(rows)
        data: dict[Any, Any] = {name: (("axis", "row"), stack, signal.attrs, signal.encoding)}
        for key, variable in raw.data_vars.items():
            if key != name and (variable.dims == ("row",) or number == 0):
                values = (
                    select_part(variable.data, None, first, end)
                    if variable.dims == ("row",)
                    else variable.data
                )
                data[key] = (variable.dims, values, variable.attrs, variable.encoding)
        coords = {
            str(key): raw[key].variable
            for key in raw.coords
            if str(key).startswith("time_") and number == 0
        }
        if "time" in raw.variables:
            coords["time"] = xr.Variable("row", select_part(raw["time"].data, None, first, end))
        group_files = [(file, start - first) for file, start in files if first <= start < end]
        attrs = {key: value for key, value in raw.attrs.items() if key != "axis_rows"}
        attrs |= {
            "source_files": [file for file, _ in group_files],
            "row_start": [start for _, start in group_files],
        }
        attrs |= (
            {}
            if number == 0
            else {"notes": [], "history": "", "unreadable_rows": 0, "unreadable_cells": 0}
        )
        parts.append(xr.Dataset(data, {"axis": axes, **coords}, attrs))
    return parts
