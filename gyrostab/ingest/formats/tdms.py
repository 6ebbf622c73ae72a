"""TDMS files (LabVIEW): channels by name, or group and name (``imu.wx``) if ambiguous, with units.

Stamps come from the waveform properties of channels, otherwise from a channel of dates in the same
group.
"""

from __future__ import annotations

import re
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gyrostab.arrays import Array
from gyrostab.errors import FormatError
from gyrostab.ingest.columns.stamps import NAT
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Table, TableColumn, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions
from gyrostab.time.stamps import to_nanoseconds

#: LabVIEW counts from 1904, and writes 1904 if it has no clock.
_FIRST_DATE = np.datetime64("1950-01-01", "us")
#: Bytes before the metadata of a segment, flag of its byte order, and largest metadata that are
#: searched.
_LEAD_BYTES, _BIG_ENDIAN, _MAX_METADATA_BYTES = 28, 0x40, 2**24
#: Paths of channels, and start times (of type 0x44) after them, in the metadata of a segment.
_STARTS = re.compile(
    rb"(?s)(?P<channel>/'[^\0-\x1f]*'/'[^\0-\x1f]*')"
    rb"|wf_start_time(?:D\0\0\0|\0\0\0D)(?P<start>.{16})"
)

matches = make_matcher(b"TDSm", ".tdms")


@contextmanager
def _open_tables(path: Path, options: ReadOptions) -> Iterator[TablesOfFile]:
    """Group channels of one length and clock into tables; without a clock, of one group."""
    nptdms = library("nptdms", path, extra="tdms")
    with nptdms.TdmsFile.open(str(path)) as file:
        groups: dict[Any, list[Any]] = {}
        for group in file.groups():
            for channel in group.channels():
                if len(channel):
                    clock = _waveform_clock(path, channel) or channel.group_name
                    groups.setdefault((len(channel), clock), []).append(channel)
        yield [_make_table(path, channels) for channels in groups.values()], _describe_starts(path)


scan, read = make_reader("tdms", _open_tables)


def _describe_starts(path: Path) -> list[str]:
    """Return a note if a channel begins again in a later segment, as the library merges them."""
    starts = defaultdict[bytes, set[bytes]](set)
    with path.open("rb") as file:
        while len(lead := file.read(_LEAD_BYTES)) == _LEAD_BYTES and lead.startswith(b"TDSm"):
            size, metadata = struct.unpack(">QQ" if lead[4] & _BIG_ENDIAN else "<QQ", lead[12:])
            begin, channel = file.tell(), b""
            for part in _STARTS.finditer(file.read(min(metadata, size, _MAX_METADATA_BYTES))):
                channel = part["channel"] or channel
                starts[channel].update([part["start"]] if part["start"] else [])
            # a segment that was not finished has the largest 64-bit number for its size
            file.seek(min(begin + size, path.stat().st_size))
    if all(len(times) < 2 for times in starts.values()):
        return []
    return [
        "segments of one channel begin at different times (wf_start_time); the last is used for "
        "all rows, so earlier rows have late stamps and pauses are lost; write a file for each"
        " start"
    ]


def _waveform_clock(path: Path, channel: Any) -> tuple[float, Any] | None:
    """Return interval [s] and start of a waveform, None without waveform properties."""
    properties = channel.properties
    step = float(properties.get("wf_increment") or 0.0)
    start = properties.get("wf_start_time")
    if step <= 0.0:
        return None
    start = None if start is None else np.datetime64(start, "us")
    if start is not None and start < _FIRST_DATE:
        start = None
    began = 0 if start is None else int(to_nanoseconds(np.array(start), far_as_nat=True))
    if began == NAT:
        raise FormatError(
            f"{path.name}: channel {channel.name!r} begins at {start}, which is after the "
            "year 2262; correct wf_start_time"
        )
    offset = float(properties.get("wf_start_offset") or 0.0)
    if not (step < np.inf and abs(offset) * 1e9 + abs(began) < np.iinfo(np.int64).max):
        raise FormatError(
            f"{path.name}: channel {channel.name!r} has wf_increment {step} and wf_start_offset "
            f"{offset}; correct them"
        )
    first = round(offset * 1e9)
    return step, first if start is None else np.datetime64(began + first, "ns")


def _make_table(path: Path, channels: list[Any]) -> Table:
    columns = [
        TableColumn(
            (channel.group_name, channel.name), channel, channel.properties.get("unit_string")
        )
        for channel in channels
    ]
    clock = _waveform_clock(path, channels[0])
    if clock is not None:
        unit = None if isinstance(clock[1], np.datetime64) else "ns"
        stamps = TableColumn(("time",), _waveform_stamps(*clock), unit)
        return Table(len(channels[0]), columns, stamps)
    kinds = [np.dtype(channel.dtype).kind for channel in channels]
    if "M" not in kinds:
        return Table(len(channels[0]), columns)
    dates = columns.pop(kinds.index("M"))
    return Table(len(channels[0]), columns, TableColumn(("time",), dates.values))


def _waveform_stamps(step: float, start: Any) -> Callable[[int, int], Any]:
    def part(begin: int, stop: int) -> Array:
        since = np.rint(np.arange(begin, stop) * (step * 1e9)).astype(np.int64)
        stamps: Array = start + (
            since.view("timedelta64[ns]") if isinstance(start, np.datetime64) else since
        )
        return stamps

    return part
