"""DLIS well logs (RP66 V1): channels by their mnemonics, with their units.

An index of the kind TIME is the time. Frames may have separate rates; channels with several values
a row are left out.

References
----------
American Petroleum Institute, Recommended Practice 66, version 1.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xarray as xr

from gyrostab.ingest.columns.headers import is_time_unit
from gyrostab.ingest.formats.recognise import begins_like
from gyrostab.ingest.formats.tables import (
    Table,
    library,
    plain_names,
    read_tables,
    scan_tables,
    sliced,
)
from gyrostab.ingest.options import FileSummary, ReadOptions

__all__ = ["matches", "read", "scan"]

#: Held while the settings of the process are changed.
_LOCK = threading.Lock()


def matches(path: Path) -> bool:
    """Return whether the file has the label of a DLIS storage unit, or such a suffix."""
    return begins_like(path, rb"(?s).{4}V1\.00RECORD", ".dlis")


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise frames, channels and stamps; reads the whole file."""
    return scan_tables(path, "dlis", _read_frames(path), options)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a DLIS file; see `gyrostab.ingest.read_log`."""
    return read_tables(path, _read_frames(path), options)


def _read_frames(path: Path) -> list[Table]:
    """Return a table for each frame of each logical file."""
    dlis = library("dlisio.dlis", path, extra="dlis")
    with _process_settings(path), dlis.load(str(path)) as files:
        frames = [
            (
                frame,
                [
                    channel
                    for channel in frame.channels
                    if channel and list(channel.dimension) == [1]
                ],
            )
            for logical in files
            for frame in logical.frames
        ]
        names = iter(
            plain_names(
                [(frame.name, channel.name) for frame, channels in frames for channel in channels]
            )
        )
        return [
            _make_table(frame, channels, [next(names) for _ in channels])
            for frame, channels in frames
            if channels
        ]


@contextlib.contextmanager
def _process_settings(path: Path) -> Iterator[None]:
    """Set encodings and level of messages, which dlisio has once a process, and restore them."""
    common = library("dlisio.common", path, extra="dlis")
    logger = logging.getLogger("dlisio")
    with _LOCK:
        encodings, level = common.get_encodings(), logger.level
        common.set_encodings(["utf-8", "latin1"])
        logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            common.set_encodings(encodings)
            logger.setLevel(level)


def _make_table(frame: Any, channels: list[Any], names: list[str]) -> Table:
    values = frame.curves()
    units = [str(channel.units or "").strip() or None for channel in channels]
    columns = [sliced(values[channel.name]) for channel in channels]
    kind = str(frame.index_type or "").upper()
    timed = "TIME" in kind and channels[0].name == frame.index and is_time_unit(units[0] or "")
    first = 1 if timed else 0
    return Table(
        len(values),
        tuple(names[first:]),
        tuple(units[first:]),
        tuple(columns[first:]),
        columns[0] if timed else None,
        units[0] if timed else None,
    )
