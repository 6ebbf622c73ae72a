"""Combine several files into one raw log: order, repeated rows, axes and channels of all."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.errors import FormatError, OptionError, TimeError
from gyrostab.ingest.columns.pieces import CHUNK_ROWS, Spool
from gyrostab.ingest.columns.stamps import CLOCK_PERIODS, NAT, find_turns, read_stamps, typical_step
from gyrostab.ingest.concat.core import absence_notes, check_kinds, merge_notes, unify_units
from gyrostab.ingest.concat.grid import group_axes, split_axes
from gyrostab.ingest.raw_rows import first_known_stamp, list_axes, stamp_span
from gyrostab.ingest.repeats import drop_repeats
from gyrostab.schema import SIGNAL_UNITS, texts
from gyrostab.store.lazy import (
    concatenate_columns,
    convert_values,
    make_dask,
    select_part,
    stack_rows,
)
from gyrostab.store.write import common_packing
from gyrostab.wording import list_some

#: Largest distance of first stamps from the zero of their clock [lengths of the shortest file].
_MAX_BEGIN = 0.1
_FIRST_ROWS = 2**12
#: Advice where units of a channel do not convert to each other.
_ADVICE = (
    'if a header is wrong, give the unit of all with --map "{0}={0} [UNIT]", otherwise drop the '
    "channel with --map {0}=-"
)


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


def continue_clocks(parts: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Continue a clock that begins again from one file to the next, with notes.

    The raw logs are in the order of their names. They stay unchanged unless each one then begins
    after the end of the one before.
    """
    continued: list[xr.Dataset] = []
    added, end, typical = 0, 0, 0.0
    for part in parts:
        first, last = stamp_span(part) if "clock_zero" in part.attrs else (0, NAT)
        if last == NAT:
            return list(parts)
        if continued and first + added < end:
            begin = first - part.attrs["clock_zero"]
            period, turns = find_turns(first + added - end, typical, first=begin)
            if not turns:
                return list(parts)
            added += turns * period
            note = (
                f"{part.attrs['source_files'][0]}: the clock begins again after "
                f"{CLOCK_PERIODS[period]} without a pause; the stamps are continued from the file "
                "before"
            )
            part = part.assign_attrs(notes=[*part.attrs["notes"], note])
        end, typical = last + added, typical_step(read_stamps(part, 0, _FIRST_ROWS))
        continued.append(_move_stamps(part, added) if added else part)
    return continued


def _move_stamps(part: xr.Dataset, added: int) -> xr.Dataset:
    """Add a time [ns] to the stamps of a raw log."""
    step = np.timedelta64(added, "ns")
    moved = convert_values(part["time"].data, lambda stamps: stamps + step, "datetime64[ns]")
    return part.assign_coords(time=(part["time"].dims, moved, part["time"].attrs))


def concatenate(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Concatenate raw logs along ``row`` in the order of their first stamps, without repeated rows.

    Logs without stamps, and those whose clocks begin again at zero, are in the order given.
    `TimeError` when only some files have stamps; `UnitError` when they hold different kinds of
    signal, or a channel changes its unit.
    """
    if len(parts) == 1:
        joined = parts[0]
    else:
        split_parts = [group for part in parts for group in split_axes(part)]
        is_timed = _have_stamps(split_parts)
        check_kinds((part.attrs["source_files"][0], part.attrs.get("kind")) for part in split_parts)
        signal = next((name for name in SIGNAL_UNITS if name in split_parts[0].data_vars), None)
        ordered = [
            part.drop_vars([*names, *(f"time_{name}" for name in names)])
            for part, names in zip(split_parts, map(_slow_channels, split_parts), strict=True)
        ]
        groups = _group_by_axes(ordered)
        if is_timed:
            groups = [part for group in groups for part in _in_order(group, signal)]
        joined = _concatenate_groups(groups, signal)
        by_time = sorted(split_parts, key=first_known_stamp) if is_timed else split_parts
        apart = [part[names] for part in by_time if (names := _slow_channels(part))]
        if not is_timed and len(groups) == 1:
            order = list_some(joined.attrs["source_files"], 6)
            joined.attrs["notes"].append(f"without stamps, files follow in this order: {order}")
        joined = attach_channels(joined, apart)
    if joined.sizes["row"] < 2:
        name = joined.attrs["source_files"][0]
        raise FormatError(f"{name}: there is only one row of data; a log needs at least two")
    return joined


def _group_by_axes(parts: list[xr.Dataset]) -> list[list[xr.Dataset]]:
    """Group files by their axes if the groups cover the same time; otherwise all form one group."""
    groups = group_axes(parts, map(list_axes, parts))
    if len(groups) == 1 or not all(list_axes(group[0]) for group in groups):
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


def _slow_channels(part: xr.Dataset) -> list[str]:
    """Name the channels with a separate time coordinate."""
    return [str(name) for name, v in part.data_vars.items() if v.dims == (f"time_{name}",)]


def _have_stamps(parts: Sequence[xr.Dataset]) -> bool:
    """Return whether the files have stamps; `TimeError` if only some have."""
    timed = ["time" in part.variables for part in parts]
    if any(timed) and not all(timed):
        names = [part.attrs["source_files"][0] for part in parts]
        with_time, without = names[timed.index(True)], names[timed.index(False)]
        raise TimeError(
            f"{with_time} has time stamps and {without} has none; read them one by one, or give "
            "the latter a time column"
        )
    return all(timed)


def _in_order(parts: Sequence[xr.Dataset], signal: str | None) -> list[list[xr.Dataset]]:
    """Return the files in the order of their first stamps, without repeated rows, in groups.

    They stay in the order given if their clocks begin at zero and none repeats rows of another. The
    files of a group after the first repeat rows of earlier groups, with other axes or channels.
    """
    groups: list[list[xr.Dataset]] = []
    by_time = sorted(parts, key=first_known_stamp)
    while by_time:
        together, by_time = (by_time, []) if signal is None else drop_repeats(by_time, signal)
        groups.append(together)
    is_unchanged = {*map(id, groups[0])} == {*map(id, parts)}
    return [list(parts)] if is_unchanged and _begin_at_zero(parts) else groups


def _begin_at_zero(parts: Sequence[xr.Dataset]) -> bool:
    """Return whether the clock of each file begins near its zero, by the length of the shortest."""
    if not all("clock_zero" in part.attrs for part in parts):
        return False
    firsts, lasts = np.array(list(map(stamp_span, parts))).T
    begins = firsts - [part.attrs["clock_zero"] for part in parts]
    return bool(np.abs(begins).max() <= _MAX_BEGIN * (lasts - firsts).min())


def _concatenate_groups(groups: list[list[xr.Dataset]], signal: str | None) -> xr.Dataset:
    parts = [part for group in groups for part in group]
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
        unified = unify_units(holders, channel, _ADVICE.format(channel))
        held = iter(log[channel].data for log in unified)
        columns = [next(held) if channel in part else None for part in parts]
        units = unified[0][channel].attrs["units"]
        packing = common_packing(log[channel].encoding for log in unified)
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
        joined.attrs["axis_rows"] = _list_axis_rows(groups)
    return joined


def _list_axis_rows(groups: list[list[xr.Dataset]]) -> list[list[Any]]:
    """List the axes of each group of files, its first row, and the row after its last."""
    axis_rows: list[list[Any]] = []
    end = 0
    for group in groups:
        axes = sorted({axis for part in group for axis in list_axes(part)})
        begin, end = end, end + sum(part.sizes["row"] for part in group)
        axis_rows.append([axes, begin, end])
    return axis_rows


def _axis_column(part: xr.Dataset, signal: str, axis: str) -> Any | None:
    names = list_axes(part)
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


def attach_channels(log: xr.Dataset, sources: Sequence[xr.Dataset]) -> xr.Dataset:
    """Add the channels of other files, each on ``time_<channel>`` with its filled rows only.

    A row that several files hold, with one stamp and value, counts once.
    """
    holders: dict[str, list[tuple[str, xr.Dataset]]] = {}
    for source in sources:
        name = source.attrs["source_files"][0]
        for channel in _stamped_channels(source, name):
            if channel in log.variables:
                fix = (
                    f"rename it with --map {channel}={channel}_2 or drop it with --map {channel}=-"
                )
                raise OptionError(f"channel {channel!r} of {name} is in the log too; {fix}")
            holders.setdefault(channel, []).append((name, source))
    for channel, files in holders.items():
        unified = unify_units(files, channel, _ADVICE.format(channel))
        parts = [_filled_rows(part, channel).assign(file=n) for n, part in enumerate(unified)]
        rows = pd.concat(parts, ignore_index=True)
        if len(parts) > 1:  # a row that several files hold is that of the first
            first = rows.groupby(["stamp", "value"])["file"].transform("min")
            rows = rows[rows["file"] == first]
        rows, dim = rows.sort_values("stamp", kind="stable"), f"time_{channel}"
        units = str(unified[0][channel].attrs.get("units", "1"))
        log = log.assign_coords({dim: (dim, rows["stamp"].to_numpy())}).assign(
            {channel: (dim, rows["value"].to_numpy(), {"units": units})}
        )
    return log


def _stamped_channels(source: xr.Dataset, file: str) -> list[str]:
    """Name the channels of a file that have one value a stamp."""
    channels = [
        str(channel)
        for channel, variable in source.data_vars.items()
        if channel not in SIGNAL_UNITS
        and variable.dims in (("row",), ("time",), (_clock_of(source, str(channel)),))
    ]
    if not channels:
        raise OptionError(
            f"--channel {file}: it holds no channel with a unit; give one with --unit NAME=UNIT"
        )
    if not all(_clock_of(source, channel) in source.variables for channel in channels):
        raise OptionError(
            f"--channel {file}: it has no time column, so its rows cannot be placed; add "
            "one, or --map NAME=time"
        )
    return channels


def _clock_of(source: xr.Dataset, channel: str) -> str:
    return f"time_{channel}" if f"time_{channel}" in source.variables else "time"


def _filled_rows(source: xr.Dataset, channel: str) -> pd.DataFrame:
    stamps, values = (source[name].values for name in (_clock_of(source, channel), channel))
    is_filled = np.isfinite(values) & ~np.isnat(stamps)
    return pd.DataFrame({"stamp": stamps[is_filled], "value": values[is_filled]})


def warn_notes(log: xr.Dataset) -> None:
    """Warn with each note of a log, where the caller of the calling function is."""
    for note in texts(log, "notes"):
        warnings.warn(note, stacklevel=3)
