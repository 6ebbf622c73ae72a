"""Concatenate the channels of several logs, on the common grid or on their own stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import UnitError
from gyrostab.ingest.concat.grid import PlacedLog
from gyrostab.ingest.concat.lazy import PlacedArray, chunk_of, place_on_grid
from gyrostab.schema import log_channels
from gyrostab.store.lazy import concatenate_columns, take_samples
from gyrostab.time.grid import grid_index, grid_times
from gyrostab.time.stamps import to_nanoseconds

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
        check_units([(piece.source.name, piece.source.log) for piece in holders], name, advice)
        attributes = dict(holders[0].source.log[name].attrs)
        if all(piece.source.log.variables[name].dims != ("time",) for piece in holders):
            stamps, values = _own_time(holders, name, start, rate)
            variables[name] = (f"time_{name}", values, attributes)
            coordinates[f"time_{name}"] = stamps.view("datetime64[ns]")
        else:
            arrays = [_on_time(piece, name, start, rate) for piece in holders]
            variables[name] = ("time", place_on_grid([arrays], size, chunk, flat=True), attributes)
    return variables, coordinates


def check_units(logs: Sequence[tuple[str, xr.Dataset]], name: str, advice: str) -> None:
    """Refuse logs, with their file names, in which a channel has different units."""
    units = {str(log.variables[name].attrs.get("units", "1")): file for file, log in reversed(logs)}
    if len(units) > 1:
        listed = ", ".join(f"{unit!r} in {file}" for unit, file in units.items())
        raise UnitError(f"channel {name!r} has different units: {listed}; {advice}")


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


def _channel_stamps(piece: PlacedLog, name: str, start: int, rate: float) -> NDArray[np.int64]:
    """Return the stamps of a channel [ns since 1970], shifted with its log after a clock step."""
    stamps = to_nanoseconds(piece.source.log.variables[f"time_{name}"].values)
    moved = int(grid_times(start, rate, piece.first)) - piece.source.start
    return np.asarray(stamps + moved if abs(moved) > 1e9 / rate else stamps)


def _own_time(
    holders: Sequence[PlacedLog], name: str, start: int, rate: float
) -> tuple[NDArray[np.int64], Any]:
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
