"""PX4 logs (``.ulg``): fields by name (``gyro_rad[0]``), with the message's name if ambiguous.

Stamps are microseconds since the start of the autopilot. The messages contain no units.
"""

from __future__ import annotations

import io
from pathlib import Path

import xarray as xr

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

MAGIC = b"ULog\x01\x12\x35"


def matches(path: Path) -> bool:
    """Return whether the file begins like a PX4 log or has such a suffix."""
    return begins_like(path, MAGIC, ".ulg")


def scan(path: Path, options: ReadOptions) -> FileSummary:
    """Summarise messages, fields and stamps; reads the whole file."""
    tables, notes = _make_tables(path)
    return scan_tables(path, "ulog", tables, options, notes)


def read(path: Path, options: ReadOptions) -> xr.Dataset:
    """Return the raw log of a PX4 log; see `gyrostab.ingest.read_log`."""
    tables, notes = _make_tables(path)
    return read_tables(path, tables, options, notes=notes)


class _PaddedFile(io.BufferedReader):
    """A file in which reading beyond the end moves the position as if there were more.

    pyulog returns by the declared size of an unknown message to look for the next one, without
    testing whether the file was shorter, and then reads the same bytes again for ever.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            self.seek(size - len(data), io.SEEK_CUR)
        return data


def _make_tables(path: Path) -> tuple[list[Table], list[str]]:
    pyulog = library("pyulog", path, extra="ulog")
    with _PaddedFile(path.open("rb", buffering=0)) as file:
        log = pyulog.ULog(file)
    messages = []
    for message in log.data_list:
        name = message.name + (f"_{message.multi_id}" if message.multi_id else "")
        fields = [(field, values) for field, values in message.data.items() if field != "timestamp"]
        messages.append((name, message.data.get("timestamp"), fields))
    names = iter(
        plain_names([(name, field) for name, _, fields in messages for field, _ in fields])
    )
    tables = []
    for _, stamps, fields in messages:
        columns = tuple(sliced(values) for _, values in fields)
        clock = None if stamps is None else sliced(stamps)
        tables.append(
            Table(
                len(fields[0][1]) if fields else 0,
                tuple(next(names) for _ in fields),
                (None,) * len(fields),
                columns,
                clock,
                "us",
            )
        )
    lost = [dropout.duration for dropout in log.dropouts]
    notes = (
        [f"the logger reports that it lost data {len(lost)} times, {sum(lost)} ms in all"]
        if lost
        else []
    )
    return tables, [
        *notes,
        *(
            ["the log is damaged in places; messages there are missing"]
            if log.file_corruption
            else []
        ),
    ]
