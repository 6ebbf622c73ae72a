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
from dataclasses import replace
from pathlib import Path
from typing import Any

from gyrostab.ingest.columns.headers import is_time_unit
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Table, TableColumn, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions

#: Held while the settings of the process are changed.
_LOCK = threading.Lock()

matches = make_matcher(rb"(?s).{4}V1\.00RECORD", ".dlis")  # label of a storage unit


def _read_frames(path: Path, options: ReadOptions) -> TablesOfFile:
    """Return a table for each frame of each logical file."""
    dlis = library("dlisio.dlis", path, extra="dlis")
    with _process_settings(path), dlis.load(str(path)) as files:
        frames = [frame for logical in files for frame in logical.frames]
        tables = (_make_table(frame) for frame in frames)
        return [table for table in tables if table is not None], ()


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


def _make_table(frame: Any) -> Table | None:
    """Return the channels with one value a row; None if there are none."""
    channels = [c for c in frame.channels if c and list(c.dimension) == [1]]
    if not channels:
        return None
    values = frame.curves()
    columns = [
        TableColumn((frame.name, channel.name), values[channel.name], channel.units)
        for channel in channels
    ]
    kind = str(frame.index_type or "").upper()
    is_timed = (
        "TIME" in kind and channels[0].name == frame.index and is_time_unit(columns[0].unit or "")
    )
    if is_timed:
        return Table(len(values), columns[1:], replace(columns[0], name=("time",)))
    return Table(len(values), columns)


scan, read = make_reader("dlis", _read_frames)
