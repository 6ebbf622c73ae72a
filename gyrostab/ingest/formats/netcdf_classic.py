"""Check the header of a classic NetCDF file (CDF-1, CDF-2, CDF-5) against the size of the file.

The library would allocate whatever a damaged header asks for. Here every count is compared with the
remaining bytes, so an excessive count ends in one message.

References
----------
NetCDF classic format specification, Unidata (appendix B of the NetCDF users guide).
"""

from __future__ import annotations

import math
from pathlib import Path

from gyrostab.errors import FormatError

#: nc_type -> bytes of a number.
_ITEM_BYTES = dict(enumerate((1, 1, 2, 4, 4, 8, 1, 2, 4, 8, 8), 1))
_DIMENSION, _VARIABLE, _ATTRIBUTE = 10, 11, 12
#: Bytes of the file that are read, tried in this order; the last has room for thousands of
#: variables.
_HEAD_BYTES = (2**16, 2**20, 2**24)


class _Header:
    """Bytes of a header, consumed from the front."""

    def __init__(self, path: Path, data: bytes, size: int):
        self.path, self.data, self.size, self.at = path, data, size, 4
        self.count_bytes = 8 if data[3] == 5 else 4
        self.begin_bytes = 4 if data[3] == 1 else 8

    def fail(self, problem: str) -> FormatError:
        return FormatError(
            f"{self.path.name}: the header of this NetCDF file is damaged or cut off ({problem}); "
            "copy it again"
        )

    def take(self, size: int) -> bytes:
        if size < 0 or self.at + size > len(self.data):
            raise self.fail(f"it asks for {size:,} bytes at byte {self.at:,} of {len(self.data):,}")
        part = self.data[self.at : self.at + size]
        self.at += -(-size // 4) * 4
        return part

    def number(self, size: int = 4) -> int:
        return int.from_bytes(self.take(size), "big")

    def count(self) -> int:
        return self.number(self.count_bytes)

    def name(self) -> str:
        return self.take(self.count()).decode("utf-8", "replace")

    def items(self, tag: int) -> range:
        """Return the range of the items of a list; each takes at least eight bytes."""
        kind, count = self.number(), self.count()
        if (kind, count) == (0, 0):
            return range(0)
        if kind != tag or 8 * count > len(self.data) - self.at:
            raise self.fail(
                f"it asks for a list of {count:,} items of kind {kind} at byte {self.at:,}"
            )
        return range(count)

    def skip_attributes(self) -> None:
        for _ in self.items(_ATTRIBUTE):
            self.name()
            item_bytes = self.item_bytes()
            self.take(item_bytes * self.count())

    def item_bytes(self) -> int:
        kind = self.number()
        if kind not in _ITEM_BYTES:
            raise self.fail(f"there is no type {kind}")
        return _ITEM_BYTES[kind]

    def shape(self, lengths: list[int]) -> list[int]:
        """Take the dimensions of a variable; 0 is that of the records."""
        count = self.count()
        if count > 1024:
            raise self.fail(f"it asks for a variable of {count:,} dimensions")
        places = [self.count() for _ in range(count)]
        if any(place >= len(lengths) for place in places):
            raise self.fail("a variable has a dimension that is not there")
        return [lengths[place] for place in places]

    def check(self) -> None:
        """Check the lists, and the last byte of each variable."""
        records = self.count()
        lengths: list[int] = []
        for _ in self.items(_DIMENSION):
            self.name()
            lengths.append(self.count())
        self.skip_attributes()
        places = []  # name, number of values, or 0 of records, bytes of one, first byte
        for _ in self.items(_VARIABLE):
            name, shape = self.name(), self.shape(lengths)
            self.skip_attributes()
            stride = self.item_bytes() * math.prod(shape[1:])
            self.count()  # vsize, which is wrong above 4 GiB
            places.append((name, math.prod(shape[:1]), stride, self.number(self.begin_bytes)))
        spans = [stride for _, length, stride, _ in places if length == 0]
        record = spans[0] if len(spans) == 1 else sum(-(-span // 4) * 4 for span in spans)
        streamed = records in (2**32 - 1, 2**64 - 1)  # the file size gives the number
        for name, length, stride, begin in places:
            end = begin + stride * length
            if length == 0 and records and not streamed:
                end += record * (records - 1) + stride
            if end > self.size:
                raise self.fail(f"{name!r} would end at byte {end:,} of {self.size:,}")


def check_classic_header(path: Path) -> None:
    """Refuse a classic NetCDF file whose header asks for more than the file holds.

    Files of other formats pass.
    """
    size = path.stat().st_size
    for head_bytes in _HEAD_BYTES:
        with path.open("rb") as file:
            data = file.read(min(size, head_bytes))
        if data[:3] != b"CDF" or data[3:4] not in (b"\1", b"\2", b"\5"):
            return
        try:
            _Header(path, data, size).check()
            return
        except FormatError:
            if size <= head_bytes or head_bytes == _HEAD_BYTES[-1]:
                raise
