"""PX4 logs (``.ulg``): fields by name (``gyro_rad[0]``), with the message's name if ambiguous.

Stamps are microseconds since the start of the autopilot. The messages contain no units.
"""

from __future__ import annotations

import io
from pathlib import Path

from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Table, TableColumn, TablesOfFile, library, make_reader
from gyrostab.ingest.options import ReadOptions

matches = make_matcher(rb"ULog\x01\x12\x35", ".ulg")


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


def _make_tables(path: Path, options: ReadOptions) -> TablesOfFile:
    pyulog = library("pyulog", path, extra="ulog")
    with _PaddedFile(path.open("rb", buffering=0)) as file:
        log = pyulog.ULog(file)
    tables = []
    for message in log.data_list:
        name = message.name + (f"_{message.multi_id}" if message.multi_id else "")
        fields = {field: values for field, values in message.data.items() if field != "timestamp"}
        columns = [TableColumn((name, field), values) for field, values in fields.items()]
        rows = len(next(iter(fields.values()), ()))
        stamps = message.data.get("timestamp")
        clock = None if stamps is None else TableColumn(("time",), stamps, "us")
        tables.append(Table(rows, columns, clock))
    notes = []
    if lost := [dropout.duration for dropout in log.dropouts]:
        notes.append(
            f"the logger reports that it lost data {len(lost)} times, {sum(lost)} ms in all"
        )
    if log.file_corruption:
        notes.append("the log is damaged in places; messages there are missing")
    return tables, notes


scan, read = make_reader("ulog", _make_tables)
