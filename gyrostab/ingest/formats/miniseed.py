"""miniSEED files: channels by code (``HJ3``), or network, station and code if ambiguous; no units.

Channels whose code is that of a rotation sensor (instrument code J: ``HJZ``, ``BJ1``) are gyro
axes, named by their orientation.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.arrays import Array, Floats
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Table, TableColumn, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions
from gyrostab.time.grid import grid_times

_HEAD = rb"\d{6}[DRQM][ \0]|MS\x03"  # versions 2 and 3
_MAX_RECORD_BYTES = 2**20  # version 2 allows longer records, which nobody writes
_ROTATION = re.compile(r"[A-Z]J([A-Z0-9])")  # band, instrument J, orientation: SEED, appendix A
_MAX_START_DIFFERENCE = 0.1  # of channels that share their stamps [samples]
_RESOLUTION_NS = 100_000  # of the stamps of records of version 2

matches = make_matcher(_HEAD, ".mseed", ".miniseed", ".msd", ".ms", ".mseed3")


@dataclass
class _Trace:
    """Unbroken segments of one channel: nominal rate [Hz], sizes, values if loaded.

    The stamps of the first and last samples [ns] give the period of each segment: the clock of a
    recorder differs from the nominal rate, and each record has a stamp.
    """

    name: tuple[str, ...]
    rate: float
    starts: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    @property
    def delays(self) -> Floats:
        """Period less the nominal one of each segment [ns], 0 if they agree to the resolution."""
        last = np.array(self.sizes) - 1
        late = np.array(self.ends) - self.starts - grid_times(0, self.rate, last)
        late = np.where(np.abs(late) <= _RESOLUTION_NS, 0, late)
        return np.asarray(late / np.maximum(last, 1), dtype=np.float64)


def _make_tables(path: Path, options: ReadOptions, *, unpack: bool) -> TablesOfFile:
    return _group_traces(_read_traces(path, unpack=unpack)), _cut_note(path)


scan, read = make_reader(
    "miniseed", partial(_make_tables, unpack=True), find_heads=partial(_make_tables, unpack=False)
)


def _cut_note(path: Path) -> list[str]:
    """Return a note if the last record of a version 2 file is cut off."""
    pymseed = library("pymseed", path, extra="miniseed")
    with path.open("rb") as file:
        head = file.read(_MAX_RECORD_BYTES)
    if not head or not re.match(_HEAD, head):
        return []
    try:
        first = next(iter(pymseed.MS3Record.from_buffer(head)), None)
    except pymseed.MiniSEEDError:
        return []
    if first is None or first.formatversion != 2 or not (cut := path.stat().st_size % first.reclen):
        return []
    return [f"cut off in its last record: {cut} bytes are left out, the complete records are read"]


def _read_traces(path: Path, *, unpack: bool) -> list[_Trace]:
    pymseed = library("pymseed", path, extra="miniseed")
    traces: dict[tuple[str, float], _Trace] = {}
    for trace in pymseed.MS3TraceList.from_file(str(path), unpack_data=unpack):
        for piece in trace:
            if (
                piece.samplecnt < 1
                or piece.samprate <= 0
                or (unpack and piece.sampletype not in ("i", "f", "d"))
            ):
                continue  # text and log records of the station
            code = pymseed.sourceid2nslc(trace.sourceid)
            channel = traces.setdefault(
                (trace.sourceid, piece.samprate), _Trace(tuple(code), piece.samprate)
            )
            channel.starts.append(int(piece.starttime))
            channel.ends.append(int(piece.endtime))
            channel.sizes.append(int(piece.samplecnt))
            if unpack:
                channel.values.append(np.array(piece.np_datasamples))
    return list(traces.values())


def _group_traces(traces: list[_Trace]) -> list[Table]:
    """Group channels of one rate and common segments into tables; the last may be shorter."""
    groups: list[list[_Trace]] = []
    for trace in traces:
        same = [group for group in groups if _in_step(group[0], trace)]
        same[0].append(trace) if same else groups.append([trace])
    tables = []
    for group in groups:
        longest = max(group, key=lambda trace: sum(trace.sizes))
        rows = sum(longest.sizes)
        columns = [
            TableColumn(
                trace.name,
                _join_values(trace.values, rows),
                target=f"gyro_{match[1].lower()}"
                if (match := _ROTATION.fullmatch(trace.name[-1]))
                else None,
            )
            for trace in group
        ]
        tables.append(Table(rows, columns, TableColumn(("time",), _trace_stamps(longest))))
    return tables


def _in_step(first: _Trace, second: _Trace) -> bool:
    apart = _MAX_START_DIFFERENCE * 1e9 / first.rate
    same = (
        first.rate == second.rate
        and first.sizes[:-1] == second.sizes[:-1]
        and len(first.sizes) == len(second.sizes)
    )
    if not same:
        return False
    sizes = np.minimum(first.sizes, second.sizes)
    starts, ends = np.array(first.starts) - second.starts, (first.delays - second.delays) * sizes
    return bool((np.abs(starts) <= apart).all() and (np.abs(starts + ends) <= apart).all())


def _join_values(pieces: list[Array], rows: int) -> Array:
    """Join the segments of a trace, with NaN up to the number of rows; empty if not loaded."""
    missing = rows - sum(map(len, pieces)) if pieces else 0
    padding = [np.full(missing, np.nan)] if missing or not pieces else []
    return np.concatenate([*pieces, *padding])


def _trace_stamps(trace: _Trace) -> Callable[[int, int], Any]:
    ends, delays = np.cumsum(trace.sizes), trace.delays

    def part(start: int, stop: int) -> NDArray[np.datetime64]:
        rows = np.arange(start, min(stop, int(ends[-1])))
        piece = np.searchsorted(ends, rows, side="right")
        index = rows - (ends - trace.sizes)[piece]
        late = np.rint(index * delays[piece]).astype(np.int64)
        stamps = np.array(trace.starts)[piece] + grid_times(0, trace.rate, index) + late
        return np.asarray(stamps.view("datetime64[ns]"))

    return part
