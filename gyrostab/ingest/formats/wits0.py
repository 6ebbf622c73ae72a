"""WITS level 0 (text): the items of each record type by their four digits, such as ``0921``.

A frame begins with ``&&`` and ends with ``!!``; each line in between is a record type, an item and
its value. Items 05 and 06 of every record are the date (YYMMDD) and the time (HHMMSS), UTC or
local. The stream contains no units: give name and unit as in ``--map "0921=temperature [degC]"``.

References
----------
Wellsite Information Transfer Specification, level 0.
"""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from pathlib import Path

from gyrostab.ingest.columns.stamps import NAT
from gyrostab.ingest.formats.recognise import make_matcher
from gyrostab.ingest.formats.tables import Messages, TablesOfFile, make_reader
from gyrostab.ingest.options import ReadOptions

_ITEM = re.compile(r"^\s*(\d\d)(\d\d)\s?(.*?)\s*$")
_LONGEST_LINE = 1000


matches = make_matcher(rb"\s*&&\s*\n\s*\d{4}")


def _read_records(path: Path, options: ReadOptions) -> TablesOfFile:
    """Return a table for each record type."""
    records: dict[str, Messages] = {}
    frame: dict[str, dict[str, str]] = {}
    with path.open(encoding="ascii", errors="replace") as file:
        while line := file.readline(_LONGEST_LINE):
            if line.startswith(("&&", "!!")):
                for record, values in frame.items():
                    stamp = _parse_stamp(values.pop("05", ""), values.pop("06", ""))
                    numbers = {record + item: _parse_number(text) for item, text in values.items()}
                    records.setdefault(record, Messages()).add(stamp, numbers)
                frame = {}
            elif item := _ITEM.match(line):
                frame.setdefault(item[1], {})[item[2]] = item[3]
    return [messages.make_table(may_be_local=True) for messages in records.values()], ()


scan, read = make_reader("wits0", _read_records)


def _parse_stamp(day: str, time: str) -> int:
    """Return the stamp of a date and a time, whole numbers that may lack leading zeros."""
    try:
        date = datetime.strptime(f"{int(day):06d}{int(time):06d}", "%y%m%d%H%M%S")
    except ValueError:
        return NAT
    return int(date.replace(tzinfo=UTC).timestamp()) * 10**9


def _parse_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
