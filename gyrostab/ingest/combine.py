"""Combine several files into one raw log: order, axes and channels of all, channel files."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import FormatError, OptionError, TimeError, UnitError
from gyrostab.ingest.columns.pieces import CHUNK_ROWS, Spool
from gyrostab.ingest.concat.core import absence_notes, check_units, merge_notes
from gyrostab.ingest.concat.grid import group_axes, split_axes
from gyrostab.ingest.overlap import drop_repeats, first_known_stamp, stamp_span
from gyrostab.schema import SIGNAL_UNITS
from gyrostab.store.lazy import concatenate_columns, make_dask, select_part, stack_rows
from gyrostab.store.write import common_packing
from gyrostab.wording import list_some


def memory_bytes(part: xr.Dataset) -> int:
    """Return the size of the columns of a raw log that are in memory [bytes]; 0 for other logs."""
    return sum(variable.nbytes for variable in _columns_in_memory(part).values())


def _columns_in_memory(part: xr.Dataset) -> dict[Any, xr.Variable]:
    return {
        name: variable
        for name, variable in part.variables.items()
        if "row" in variable.dims and variable.chunks is None
    }


def move_to_disk(part: xr.Dataset, spool: Spool) -> xr.Dataset:
    """Return the raw log with its columns moved to a temporary file."""

    def moved(variable: xr.Variable) -> Any:
        stored = map(spool.store, np.atleast_2d(variable.values))
        rows = [make_dask(piece, CHUNK_ROWS) for piece in stored]
        return stack_rows(rows) if variable.ndim == 2 else rows[0]

    columns = _columns_in_memory(part).items()
    return part.assign({name: (v.dims, moved(v), v.attrs, v.encoding) for name, v in columns})


def concatenate(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Concatenate raw logs along ``row`` in the order of their first stamps, without repeated rows.

    `TimeError` when only some files have stamps; `UnitError` when they hold different kinds of
    signal, or a channel changes its unit.
    """
    if len(parts) == 1:
        joined = parts[0]
    else:
        split_parts = _in_order([group for part in parts for group in split_axes(part)])
        signal = _common_signal(split_parts)
        slow_channels = [
            [str(name) for name, v in part.data_vars.items() if v.dims == (f"time_{name}",)]
            for part in split_parts
        ]  # those with a separate time coordinate
        ordered = [
            part.drop_vars([*names, *(f"time_{name}" for name in names)])
            for part, names in zip(split_parts, slow_channels, strict=True)
        ]
        groups = _group_by_axes(ordered)
        if "time" in ordered[0].variables and signal is not None:
            groups = [drop_repeats(group, signal) for group in groups]
        joined = _concatenate_parts([part for group in groups for part in group], signal, groups)
        apart = [
            part[names] for part, names in zip(split_parts, slow_channels, strict=True) if names
        ]
        joined = with_channels(joined, apart)
    if joined.sizes["row"] < 2:
        name = joined.attrs["source_files"][0]
        raise FormatError(f"{name}: there is only one row of data; a log needs at least two")
    return joined


def _group_by_axes(parts: list[xr.Dataset]) -> list[list[xr.Dataset]]:
    """Group files by their axes if the groups cover the same time; otherwise all form one group."""
    groups = group_axes(parts, map(_axis_names, parts))
    if len(groups) == 1 or not all(_axis_names(group[0]) for group in groups):
        return [list(parts)]
    if "time" not in parts[0].variables:
        return groups
    spans = []
    for group in groups:
        first, last = zip(*map(stamp_span, group), strict=True)
        spans.append((min(first), max(last)))
    # whether a group begins after another one has ended
    is_later = any(later[0] > earlier[1] for earlier, later in pairwise(sorted(spans)))
    return [list(parts)] if is_later else groups


def _axis_names(part: xr.Dataset) -> list[str]:
    return [str(axis) for axis in part["axis"].values] if "axis" in part.coords else []


def _in_order(parts: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    timed = ["time" in part.variables for part in parts]
    if not any(timed):
        return list(parts)
    if not all(timed):
        names = [part.attrs["source_files"][0] for part in parts]
        with_time, without = names[timed.index(True)], names[timed.index(False)]
        raise TimeError(
            f"{with_time} has time stamps and {without} has none; read them one by one, or give "
            "the latter a time column"
        )
    return sorted(parts, key=first_known_stamp)


def _common_signal(parts: Sequence[xr.Dataset]) -> str | None:
    first = parts[0]
    for part in parts[1:]:
        if part.attrs.get("kind") != first.attrs.get("kind"):
            held, other = (f"of kind {log.attrs.get('kind')!r}" for log in (first, part))
            names = [log.attrs["source_files"][0] for log in (first, part)]
            raise UnitError(
                f"{names[0]} holds a gyro signal {held}, {names[1]} {other}; read them one by one"
            )
    return next((name for name in SIGNAL_UNITS if name in first.data_vars), None)


def _concatenate_parts(
    parts: list[xr.Dataset], signal: str | None, groups: list[list[xr.Dataset]]
) -> xr.Dataset:
    sizes = [part.sizes["row"] for part in parts]
    names = [part.attrs["source_files"][0] for part in parts]
    absent: dict[str, list[str]] = {}
    data: dict[str, Any] = {}
    coords: dict[str, Any] = {}

    def join(label: str, columns: Sequence[Any | None]) -> Any:
        """Join the columns of all parts; NaN, which takes no memory, where a part lacks it."""
        absent[label] = _files_without(
            groups, {id(part) for part, c in zip(parts, columns, strict=True) if c is not None}
        )
        blanks = (np.broadcast_to(np.nan, (size,)) for size in sizes)
        filled = [blank if c is None else c for c, blank in zip(columns, blanks, strict=True)]
        return concatenate_columns(filled, CHUNK_ROWS)

    if "time" in parts[0].variables:
        stamps = concatenate_columns([part["time"].data for part in parts], CHUNK_ROWS)
        coords["time"] = ("row", stamps)
    if signal is not None:
        axes = sorted({str(axis) for part in parts for axis in part["axis"].values})
        rows = [join(f"axis {a}", [_axis_column(part, signal, a) for part in parts]) for a in axes]
        packing = common_packing(part[signal].encoding for part in parts)
        data[signal] = (("axis", "row"), stack_rows(rows), {"units": SIGNAL_UNITS[signal]}, packing)
        coords["axis"] = np.array(axes, dtype=str)
    for channel in dict.fromkeys(
        str(name) for part in parts for name in part.data_vars if name != signal
    ):
        holders = [(part.attrs["source_files"][0], part) for part in parts if channel in part]
        advice = f"give one with --unit {channel}=UNIT or drop it with --map {channel}=-"
        check_units(holders, channel, advice)
        columns = [part[channel].data if channel in part else None for part in parts]
        units = holders[0][1][channel].attrs["units"]
        packing = common_packing(part[channel].encoding for _, part in holders)
        data[channel] = ("row", join(f"channel {channel}", columns), {"units": units}, packing)
    joined = xr.Dataset(data, coords=coords, attrs=dict(parts[0].attrs))
    joined.attrs.update(
        source_files=names,
        row_start=[int(start) for start in np.cumsum([0, *sizes[:-1]])],
        notes=[
            *merge_notes(
                (name, part.attrs["notes"]) for name, part in zip(names, parts, strict=True)
            ),
            *absence_notes(absent),
        ],
        unreadable_rows=sum(part.attrs["unreadable_rows"] for part in parts),
        unreadable_cells=sum(part.attrs["unreadable_cells"] for part in parts),
    )
    if len(groups) > 1:
        joined.attrs["axis_rows"], end = [], 0
        for group in groups:
            axes = sorted({axis for part in group for axis in _axis_names(part)})
            begin, end = end, end + sum(part.sizes["row"] for part in group)
            joined.attrs["axis_rows"].append([axes, begin, end])
    return joined


def _axis_column(part: xr.Dataset, signal: str, axis: str) -> Any | None:
    names = _axis_names(part)
    return select_part(part[signal].data, names.index(axis)) if axis in names else None


def _files_without(groups: list[list[xr.Dataset]], holders: set[int]) -> list[str]:
    """Name the files that lack something which other files of their group contain."""
    return [
        str(part.attrs["source_files"][0])
        for group in groups
        if any(id(part) in holders for part in group)
        for part in group
        if id(part) not in holders
    ]


def with_channels(log: xr.Dataset, sources: Sequence[xr.Dataset]) -> xr.Dataset:
    """Add channels of other tables of the same files, each on ``time_<channel>``."""
    return (
        attach_channels(log, sources).drop_attrs(deep=False).assign_attrs(log.attrs)
        if sources
        else log
    )


def attach_channels(log: xr.Dataset, sources: Sequence[xr.Dataset]) -> xr.Dataset:
    """Add the channels of other files, each on ``time_<channel>`` with its filled rows only."""
    pieces: dict[str, list[tuple[NDArray[Any], NDArray[Any], str]]] = {}
    files: list[str] = []
    for source in sources:
        name = source.attrs["source_files"][0]
        files.append(name)
        for channel, stamps, values, units in _read_channels(source, name):
            if channel in log.variables:
                fix = (
                    f"rename it with --map {channel}={channel}_2 or drop it with --map {channel}=-"
                )
                raise OptionError(f"channel {channel!r} of {name} is in the log too; {fix}")
            pieces.setdefault(channel, []).append((stamps, values, units))
    for channel, (stamps, values, units) in (
        (channel, zip(*parts, strict=True)) for channel, parts in pieces.items()
    ):
        if len(set(units)) > 1:
            raise UnitError(
                f"channel {channel!r} has different units in {list_some(files)}; give one with "
                f"--unit {channel}=UNIT"
            )
        order, dim = np.argsort(np.concatenate(stamps), kind="stable"), f"time_{channel}"
        log = log.assign_coords({dim: (dim, np.concatenate(stamps)[order])}).assign(
            {channel: (dim, np.concatenate(values)[order], {"units": units[0]})}
        )
    if files:
        notes = [note for source in sources for note in source.attrs.get("notes", [])]
        log = log.assign_attrs(notes=[*log.attrs.get("notes", []), *notes], channel_files=files)
    return log


def _read_channels(
    source: xr.Dataset, name: str
) -> list[tuple[str, NDArray[Any], NDArray[Any], str]]:
    channels = []
    for channel, variable in source.data_vars.items():
        dim = f"time_{channel}" if f"time_{channel}" in source.variables else "time"
        if (
            len(variable.dims) != 1
            or channel in SIGNAL_UNITS
            or str(variable.dims[0]) not in ("row", "time", dim)
        ):
            continue
        if dim not in source.variables:
            raise OptionError(
                f"--channel {name}: it has no time column, so its rows cannot be placed; add "
                "one, or --map NAME=time"
            )
        stamps, values = np.asarray(source[dim].values), np.asarray(variable.values)
        filled = np.isfinite(values) & ~np.isnat(stamps)
        channels.append(
            (str(channel), stamps[filled], values[filled], str(variable.attrs.get("units", "1")))
        )
    if not channels:
        raise OptionError(
            f"--channel {name}: it holds no channel with a unit; give one with --unit NAME=UNIT"
        )
    return channels
