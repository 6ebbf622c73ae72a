"""Concatenate many regular logs to one lazy regular log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array, Floats, Ints
from gyrostab.errors import TimeError, UnitError
from gyrostab.ingest.concat.grid import PlacedLog, SourceLog, group_axes, merge_gaps, source_of
from gyrostab.ingest.concat.lazy import PlacedArray, chunk_of, place_on_grid
from gyrostab.ingest.concat.place import place_logs
from gyrostab.ingest.gap_table import make_dataset, name_lost
from gyrostab.ingest.limits import describe_limit, is_absurd_grid
from gyrostab.schema import SIGNAL_UNITS, check_log, log_channels, signal_name, texts
from gyrostab.store.lazy import concatenate_columns, convert_values, take_samples
from gyrostab.store.private import close_function
from gyrostab.store.write import common_packing
from gyrostab.time.durations import duration_seconds
from gyrostab.time.grid import grid_index, grid_times
from gyrostab.time.stamps import extend_history, format_stamp, to_nanoseconds
from gyrostab.units import find_conversion
from gyrostab.wording import list_some

#: Smallest share of a log without an axis of other logs that is noted; recorders are started one
#: after the other.
_NOTED_SHARE = 0.01

#: Largest relative difference of the rates of two logger clocks, or of one clock over temperature;
#: more is a different sampling rate.
RATE_TOLERANCE = 1e-4


def concatenate_logs(
    logs: Sequence[xr.Dataset],
    paths: Sequence[str | Path],
    *,
    max_gap: str | float = "10D",
    lost: Sequence[tuple[int, int]] = (),
    limits: Mapping[str, float] | None = None,
) -> xr.Dataset:
    """Concatenate regular logs along time, lazily.

    Parameters
    ----------
    logs : sequence of xarray.Dataset
        Regular logs, in any order, overlapping or with gaps between them: ``rate(axis, time)``
        [degree hour-1] or ``angle(axis, time)`` [degree], channels, tables of gaps.
    max_gap : str or float
        A longer pause is taken as a step of the clock, and the next log follows after one missing
        sample; a number is in seconds.
    lost : sequence of (int, int)
        First and last instant [ns since 1970] of files that cannot be read; gaps there have the
        cause "unreadable".
    limits : mapping of str to float, optional
        Limits of `gyrostab.ingest.limits` with other values; ``grid_samples`` bounds the samples of
        an axis.

    Returns
    -------
    xarray.Dataset
        One regular log on the grid of the first: each sample of another log takes the nearest
        sample of the grid. Where logs overlap, the earlier one counts unless it is NaN. Logs with
        other axes over the same time are put side by side. Axes and channels that a log lacks are
        NaN there. The table of gaps lists the gaps of the logs and those between them. The signal
        is one dask task for each chunk.

    Raises
    ------
    TimeError
        When the sampling rates differ by more than 100 parts per million, or the common grid is
        much longer than the logs together.
    UnitError
        When the logs have different kinds of signal, or units of a channel do not convert.

    Examples
    --------
    >>> from gyrostab.ingest.make_log import make_log
    >>> starts = ["2026-01-01T00:00:00", "2026-01-01T00:00:06"]
    >>> first, second = (
    ...     make_log(np.full(4, float(n)), rate=1.0, unit="deg/h", start=start)
    ...     for n, start in enumerate(starts)
    ... )
    >>> concatenate_logs([second, first], ["b.nc", "a.nc"]).rate.values
    array([[ 0.,  0.,  0.,  0., nan, nan,  1.,  1.,  1.,  1.]])
    """
    if len(logs) == 1:
        return logs[0]
    for log in logs:
        check_log(log)
    sources = sorted(
        (source_of(log, Path(path).name) for log, path in zip(logs, paths, strict=True)),
        key=lambda source: source.start,
    )
    check_kinds((source.name, signal_name(source.log)) for source in sources)
    _check_rates(sources)
    pieces, notes = place_logs(sources, max_gap=duration_seconds(max_gap, "max_gap"))
    rate = sources[0].rate
    start = int(grid_times(sources[0].start, rate, -pieces[0].first))
    size = max(piece.end for piece in pieces)
    _check_grid(pieces, size, limits)
    name = signal_name(sources[0].log)
    chunk = chunk_of([source.log[name].data for source in sources])
    axes = sorted({axis for source in sources for axis in source.axes})
    arrays = [
        [
            (piece.source.log.variables[name].data, piece.source.axes.index(axis), piece.runs)
            for piece in pieces
            if axis in piece.source.axes
        ]
        for axis in axes
    ]
    signal = xr.Variable(
        ("axis", "time"),
        place_on_grid(arrays, size, chunk),
        {**sources[0].log[name].attrs, "units": SIGNAL_UNITS[name]},
    )
    signal.encoding = common_packing(source.log[name].encoding for source in sources)
    channels, stamps = concatenate_channels(pieces, start, rate, size, chunk)
    joined = make_dataset(
        {name: signal, **channels},
        {"axis": np.array(axes, dtype=str), **stamps},
        name_lost(merge_gaps(pieces), lost, start, rate),
        (start, rate, size),
        _common_attributes(sources, size, [*notes, *_describe_absent(sources, axes)]),
    )
    # keeps no other reference to the logs
    joined.set_close(partial(_close_files, list(filter(None, map(close_function, logs)))))
    return joined


def _check_grid(pieces: Sequence[PlacedLog], size: int, limits: Mapping[str, float] | None) -> None:
    """Refuse a common grid that has far more samples than the logs."""
    if not is_absurd_grid(size, sum(piece.source.size for piece in pieces), limits):
        return
    ordered = sorted(pieces, key=lambda piece: piece.first)
    widest = max(
        range(1, len(ordered)), key=lambda place: ordered[place].first - ordered[place - 1].end
    )
    earlier, later = (ordered[place].source for place in (widest - 1, widest))
    raise TimeError(
        f"{earlier.name} ends at {format_stamp(earlier.end)} and {later.name} begins at "
        f"{format_stamp(later.start)}: the grid of "
        f"{earlier.rate:.10g} Hz would have {size:.4g} samples. Correct the time of one of them, "
        "or give a shorter --max-gap to take the "
        "pause for a clock step. If the pause is real: "
        f"{describe_limit('grid_samples', size, limits)}"
    )


def _close_files(files: Sequence[Callable[[], None]]) -> None:
    for close in files:
        close()


def check_kinds(kinds: Iterable[tuple[str, str | None]]) -> None:
    """Refuse files, given by name, whose kind of signal differs from that of the first."""
    (name, kind), *others = kinds
    for other_name, other_kind in others:
        if other_kind != kind:
            raise UnitError(
                f"{name} holds a gyro signal of kind {kind!r}, {other_name} of kind "
                f"{other_kind!r}; run them one by one"
            )


def _check_rates(sources: Sequence[SourceLog]) -> None:
    """Refuse logs whose sampling rate differs from that of the first."""
    first = sources[0]
    for source in sources[1:]:
        if abs(source.rate / first.rate - 1) > RATE_TOLERANCE:
            raise TimeError(
                f"{first.name} is a log of {first.rate:.10g} Hz and {source.name} one of "
                f"{source.rate:.10g} Hz; one log has one sampling "
                "rate: run them one by one, or ingest their source files together"
            )


def _describe_absent(sources: Sequence[SourceLog], axes: Sequence[str]) -> list[str]:
    """Return notes on axes and channels that some logs lack, unless those hold other axes."""
    groups = group_axes(sources, [source.axes for source in sources])
    holders = {f"axis {axis}": [s for s in sources if axis in s.axes] for axis in axes}
    for channel in dict.fromkeys(name for source in sources for name in log_channels(source.log)):
        holders[f"channel {channel}"] = [source for source in sources if channel in source.log]
    return absence_notes({name: _logs_without(groups, logs) for name, logs in holders.items()})


def _logs_without(groups: Sequence[Sequence[SourceLog]], holders: Sequence[SourceLog]) -> list[str]:
    """Name the logs that lack something, except logs of other axes at the same time."""
    if not holders:
        return []
    first, last = min(holder.start for holder in holders), max(holder.end for holder in holders)
    names = []
    for group in groups:
        is_same = any(source in holders for source in group)
        for source in group:
            absent = max(first - source.start, 0) + max(source.end - last, 0)
            if source not in holders and (
                is_same or absent > _NOTED_SHARE * (source.end - source.start)
            ):
                names.append(source.name)
    return names


def _common_attributes(
    sources: Sequence[SourceLog], size: int, notes: Sequence[str]
) -> dict[str, Any]:
    first = sources[0].log.attrs
    common = {
        key: value
        for key, value in first.items()
        if all(
            type(other := source.log.attrs.get(key)) is type(value) and np.all(other == value)
            for source in sources
        )
    }
    files, notes_of_logs = (
        [texts(source.log, name) for source in sources] for name in ("source_files", "notes")
    )
    labels = [
        names[0] if len(names) == 1 else source.name
        for names, source in zip(files, sources, strict=True)
    ]
    done = (
        f"gyrostab.read_log: {len(sources)} regular logs on {size} samples at "
        f"{sources[0].rate:.10g} Hz"
    )
    collected = {
        key: list(dict.fromkeys(text for source in sources for text in texts(source.log, key)))
        for key in ("unreadable_files", "rate_changes")
    }
    return {
        **common,
        "kind": signal_name(sources[0].log),
        "sampling_rate_hz": sources[0].rate,
        "source_files": list(dict.fromkeys(name for names in files for name in names)),
        "history": extend_history(sources[0].log, done),
        "notes": [*merge_notes(zip(labels, notes_of_logs, strict=True)), *notes],
        **{key: values for key, values in collected.items() if values},
    }


def absence_notes(absent: Mapping[str, Sequence[str]]) -> list[str]:
    """Return notes on axes and channels that some files lack, by the names of these files."""
    return [
        f"{name} is not in {list_some(files)} and is missing there"
        for name, files in absent.items()
        if files
    ]


def merge_notes(notes_by_file: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Merge the notes of all files, with file names in front; equal notes appear once.

    Examples
    --------
    >>> note = "2 rows are unreadable"
    >>> merge_notes([("a.csv", [f"a.csv: {note}"]), ("b.csv", [f"b.csv: {note}"])])
    ['a.csv, b.csv: 2 rows are unreadable']
    """
    pooled: dict[str, list[str]] = {}
    for name, notes in notes_by_file:
        for note in notes:
            pooled.setdefault(note.removeprefix(f"{name}: "), []).append(name)
    return [f"{list_some(names)}: {note}" for note, names in pooled.items()]


# stamps of two copies of a value differ by the rounding of each to its own grid
_SAME_STAMP_PERIODS = 0.75


def concatenate_channels(
    pieces: Sequence[PlacedLog], start: int, rate: float, size: int, chunk: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Concatenate the channels of logs that are placed on one grid.

    Returns variables, NaN where a log lacks them, and the coordinates ``time_<channel>`` of
    channels with separate stamps.
    """
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    for name in dict.fromkeys(name for piece in pieces for name in log_channels(piece.source.log)):
        holders = [piece for piece in pieces if name in piece.source.log]
        advice = f"ingest one of them again with --unit {name}=UNIT or --map {name}=-"
        logs = unify_units(
            [(piece.source.name, piece.source.log) for piece in holders], name, advice
        )
        holders = [
            replace(piece, source=replace(piece.source, log=log))
            for piece, log in zip(holders, logs, strict=True)
        ]
        attributes = dict(holders[0].source.log[name].attrs)
        if all(piece.source.log.variables[name].dims != ("time",) for piece in holders):
            stamps, values = _own_time(holders, name, start, rate)
            variables[name] = (f"time_{name}", values, attributes)
            coordinates[f"time_{name}"] = stamps.view("datetime64[ns]")
        else:
            arrays = [_on_time(piece, name, start, rate) for piece in holders]
            variables[name] = ("time", place_on_grid([arrays], size, chunk, flat=True), attributes)
    return variables, coordinates


def unify_units(logs: Sequence[tuple[str, xr.Dataset]], name: str, advice: str) -> list[xr.Dataset]:
    """Return logs, given with their file names, with a channel in the unit that the first one has.

    `UnitError` if units do not convert.
    """
    units = {str(log.variables[name].attrs.get("units", "1")): file for file, log in reversed(logs)}
    target = str(logs[0][1].variables[name].attrs.get("units", "1"))
    conversions = {unit: find_conversion(unit, target) for unit in units}
    if None in conversions.values():
        listed = ", ".join(f"{unit!r} in {file}" for unit, file in units.items())
        raise UnitError(f"channel {name!r} has different units: {listed}; {advice}")
    unified = []
    for _, log in logs:
        variable = log.variables[name]
        factor, offset = conversions[str(variable.attrs.get("units", "1"))] or (1.0, 0.0)
        if (factor, offset) != (1.0, 0.0):
            convert = partial(_scale_values, factor=factor, offset=offset)
            data = convert_values(variable.data, convert, np.float64)
            log = log.assign({name: (variable.dims, data, variable.attrs | {"units": target})})
        unified.append(log)
    return unified


def _scale_values(values: Array, factor: float, offset: float) -> Floats:
    return np.asarray(values * factor + offset, dtype=np.float64)


def _on_time(piece: PlacedLog, name: str, start: int, rate: float) -> PlacedArray:
    """Return a channel on the time of its log, with separate stamps at the nearest samples."""
    channel = piece.source.log[name]
    if channel.dims == ("time",):
        return channel.data, None, piece.runs
    stamps = _channel_stamps(piece, name, start, rate)
    samples = np.rint(grid_index(start, rate, stamps)).astype(np.int64)
    inside = np.flatnonzero((samples >= piece.first) & (samples < piece.end))[::-1]
    samples, places = np.unique(samples[inside], return_index=True)  # the last value of a sample
    return channel.data, None, np.stack([samples, inside[places], np.ones_like(places)], axis=1)


def _channel_stamps(piece: PlacedLog, name: str, start: int, rate: float) -> Ints:
    """Return the stamps of a channel [ns since 1970], shifted with its log after a clock step."""
    stamps = to_nanoseconds(piece.source.log.variables[f"time_{name}"].values)
    moved = int(grid_times(start, rate, piece.first)) - piece.source.start
    return np.asarray(stamps + moved if abs(moved) > 1e9 / rate else stamps)


def _own_time(holders: Sequence[PlacedLog], name: str, start: int, rate: float) -> tuple[Ints, Any]:
    """Return stamps and values in order of time; duplicates are taken from the earlier log."""
    tolerance = int(_SAME_STAMP_PERIODS * 1e9 / rate)
    arrays = [piece.source.log.variables[name].data for piece in holders]
    by_log = [_channel_stamps(piece, name, start, rate) for piece in holders]
    number = np.repeat(np.arange(len(holders)), list(map(len, by_log)))
    stamps = np.concatenate(by_log)
    places = np.argsort(stamps, kind="stable")
    stamps, number = stamps[places], number[places]
    is_copy = np.zeros(len(stamps), dtype=bool)
    for apart in range(1, len(holders)):
        earlier, later = number[:-apart], number[apart:]
        is_close = (stamps[apart:] - stamps[:-apart] <= tolerance) & (earlier != later)
        if not is_close.any():
            break
        is_copy[apart:] |= is_close & (later > earlier)
        is_copy[:-apart] |= is_close & (earlier > later)
    chunk = chunk_of(arrays)
    values = take_samples(concatenate_columns(arrays, chunk), places[~is_copy], chunk)
    return stamps[~is_copy], values
