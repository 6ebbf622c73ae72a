"""Check the header of a classic NetCDF file (CDF-1, CDF-2, CDF-5) against the size of the file.

The library would allocate whatever a damaged header asks for. Here every count is compared with the
remaining bytes, so an excessive count ends in one message.

References
----------
NetCDF classic format specification, Unidata (appendix B of the NetCDF users guide).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gyrostab.errors import FormatError

#: nc_type -> numpy type, big-endian.
_TYPE_CODES = ("i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8")
_TYPES = dict(enumerate(_TYPE_CODES, 1))
_DIMENSION, _VARIABLE, _ATTRIBUTE = 10, 11, 12
#: Bytes of the file that are read, tried in this order; the last has room for thousands of
#: variables.
_HEAD_BYTES = (2**16, 2**20, 2**24)


@dataclass(frozen=True)
class ClassicVariable:
    """Location of a variable's numbers: type, shape, first byte, stride of the first dimension."""

    name: str
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    begin: int
    stride: int


class _Header:
    """Bytes of a header, consumed from the front."""

    def __init__(self, path: Path, data: bytes, wide_count: bool, wide_begin: bool):
        self.path, self.data, self.at = path, data, 4
        self.count_bytes, self.begin_bytes = (8 if wide else 4 for wide in (wide_count, wide_begin))

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
            kind, count = self.number(), self.count()
            self.take(self.dtype(kind).itemsize * count)

    def dtype(self, kind: int) -> np.dtype[np.generic]:
        if kind not in _TYPES:
            raise self.fail(f"there is no type {kind}")
        return np.dtype(_TYPES[kind])


def read_classic_header(path: Path) -> dict[str, ClassicVariable] | None:
    """Read the locations of the variables of a classic NetCDF file; None for other formats.

    `FormatError` when the header asks for more than the file holds.
    """
    size = path.stat().st_size
    for head_bytes in _HEAD_BYTES:
        with path.open("rb") as file:
            data = file.read(min(size, head_bytes))
        if data[:3] != b"CDF" or data[3:4] not in (b"\1", b"\2", b"\5"):
            return None
        try:
            return _read_header(_Header(path, data, data[3] == 5, data[3] in (2, 5)), size)
        except FormatError:
            if size <= head_bytes or head_bytes == _HEAD_BYTES[-1]:
                raise
    return None


def _read_header(header: _Header, size: int) -> dict[str, ClassicVariable]:
    records = header.count()
    lengths = []
    for _ in header.items(_DIMENSION):
        header.name()
        lengths.append(header.count())
    header.skip_attributes()
    stored = []
    for _ in header.items(_VARIABLE):
        name = header.name()
        shape = _take_shape(header, lengths)
        header.skip_attributes()
        dtype = header.dtype(header.number())
        header.count()  # vsize, which is wrong above 4 GiB
        stride = dtype.itemsize * math.prod(shape[1:])
        begin = header.number(header.begin_bytes)
        stored.append(ClassicVariable(name, dtype, shape, begin, stride))
    return _place_records(header, size, records, stored)


def _take_shape(header: _Header, lengths: list[int]) -> tuple[int, ...]:
    """Take the dimensions of a variable; 0 is that of the records."""
    count = header.count()
    if count > 1024:
        raise header.fail(f"it asks for a variable of {count:,} dimensions")
    places = [header.count() for _ in range(count)]
    if any(place >= len(lengths) for place in places):
        raise header.fail("a variable has a dimension that is not there")
    return tuple(lengths[place] for place in places)


def _place_records(
    header: _Header, size: int, records: int, stored: list[ClassicVariable]
) -> dict[str, ClassicVariable]:
    """Find number and stride of records, and check the last byte of each variable."""
    in_records = [variable for variable in stored if variable.shape[:1] == (0,)]
    spans = [variable.stride for variable in in_records]
    stride = spans[0] if len(spans) == 1 else sum(-(-span // 4) * 4 for span in spans)
    if spans and records in (2**32 - 1, 2**64 - 1):
        # written as a stream: the file size gives the number
        first = min(variable.begin for variable in in_records)
        records = max(size - first, 0) // max(stride, 1)
    variables = {}
    for variable in stored:
        end = variable.begin + variable.stride * math.prod(variable.shape[:1])
        if variable.shape[:1] == (0,):
            end += stride * (records - 1) + variable.stride if records else 0
            shape = (records, *variable.shape[1:])
            variable = replace(variable, shape=shape, stride=stride)
        if end > size:
            raise header.fail(f"{variable.name!r} would end at byte {end:,} of {size:,}")
        variables[variable.name] = variable
    return variables
