"""Check the structure of a MATLAB 5 file; scipy's compiled reader may crash on wrong sizes.

References
----------
MAT-File Format, The MathWorks (level 5 MAT-files: data elements, array subelements).
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from gyrostab.errors import FormatError

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
#: Numeric data type -> bytes of an item.
_ITEM_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
_TEXT_TYPES = (1, 2, 3, 4, 16, 17, 18)
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMERIC = range(6, 16)
#: Deepest nesting of arrays; MATLAB itself nests a few.
_MAX_DEPTH = 50
#: Most dimensions of a numpy array.
_MAX_DIMS = 32


class _Damage(Exception):
    """The structure of the file is damaged."""


def check_structure(path: Path) -> None:
    """Check that every data element fits into its parent, and that array sizes are consistent.

    Files that are not of level 5 pass.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or 0 in head[:4]:
            return  # level 4, or nothing that scipy takes for level 5
        order = "<" if head[126:128] == b"IM" else ">"
        try:
            _check_file(file, order, path.stat().st_size)
        except (_Damage, struct.error, zlib.error) as error:
            problem = f"this MATLAB file is damaged or cut off ({error}); copy it again"
            raise FormatError(f"{path.name}: {problem}") from error


def _check_file(file: BinaryIO, order: str, size: int) -> None:
    place = _HEADER_BYTES
    while place < size:
        file.seek(place)
        kind, length = struct.unpack(order + "II", file.read(8))
        if kind not in (_MATRIX, _COMPRESSED):
            raise _Damage(f"at byte {place} there is an element of type {kind}, not an array")
        place += 8 + length
        if place > size:
            raise _Damage(f"an array ends {place - size} bytes behind the file")
        if kind == _MATRIX:
            _Elements(file.read(length), order).check_array(0)
            continue
        data = zlib.decompress(file.read(length))
        kind, length = struct.unpack(order + "II", data[:8])
        if kind != _MATRIX or length > len(data) - 8:
            raise _Damage("a compressed element does not hold an array")
        _Elements(memoryview(data)[8 : 8 + length], order).check_array(0)


class _Elements:
    """The data elements within an array, in sequence."""

    def __init__(self, data: bytes | memoryview, order: str):
        self.data, self.order, self.place = memoryview(data), order, 0

    def take(self) -> tuple[int, memoryview]:
        """Take type and bytes of the next element; raise `_Damage` if it is cut off."""
        word = struct.unpack_from(self.order + "I", self.data, self.place)[0]
        if word >> 16:  # a small element holds its data in the tag
            kind, length, begin, end = word & 0xFFFF, word >> 16, self.place + 4, self.place + 8
            if length > 4:
                raise _Damage(f"a small element of {length} bytes")
        else:
            kind, length = word, struct.unpack_from(self.order + "I", self.data, self.place + 4)[0]
            begin = self.place + 8
            end = begin + length + (-length % 8)
        if begin + length > len(self.data):
            raise _Damage(f"an element of {length} bytes in an array of {len(self.data)}")
        self.place = min(end, len(self.data))
        return kind, self.data[begin : begin + length]

    def check_array(self, depth: int) -> None:
        """Check the array that consists of these elements."""
        if depth > _MAX_DEPTH:
            raise _Damage(f"arrays are nested more than {_MAX_DEPTH} deep")
        if not self.data:
            return  # an empty array within a cell or structure
        array, is_complex = self._take_flags()
        if array == _OPAQUE:
            return
        count = self._check_sizes()
        if self.take()[0] not in (1, 2, 16):
            raise _Damage("the name of an array is damaged")
        if array in _NUMERIC:
            for _ in range(1 + is_complex):
                self._check_numbers(count)
        elif array == _CHAR:
            if count and self.take()[0] not in _TEXT_TYPES:
                raise _Damage("a text is damaged")
        elif array in (_CELL, _STRUCT, _OBJECT, _FUNCTION):
            self._check_members(array, 1 if array == _FUNCTION else count, depth)
        elif array == _SPARSE:
            for _ in range(3 + is_complex):
                self._check_numbers(None)
        else:
            raise _Damage(f"there is no array of class {array}")

    def _take_flags(self) -> tuple[int, bool]:
        """Take the class of the array, and whether it is complex."""
        kind, flags = self.take()
        if kind != 6 or len(flags) != 8:
            raise _Damage("an array does not begin with its flags")
        word = struct.unpack_from(self.order + "I", flags)[0]
        return word & 0xFF, bool(word & 0x800)

    def _check_sizes(self) -> int:
        """Take the dimensions of the array and return the number of its items."""
        kind, sizes = self.take()
        if kind not in (5, 6) or len(sizes) % 4 or not 8 <= len(sizes) <= 4 * _MAX_DIMS:
            raise _Damage("the dimensions of an array are damaged")
        dims = struct.unpack(f"{self.order}{len(sizes) // 4}i", sizes)
        if min(dims) < 0:
            raise _Damage(f"an array has the dimensions {dims}")
        return math.prod(dims)

    def _check_numbers(self, count: int | None) -> None:
        kind, data = self.take()
        if kind not in _ITEM_BYTES or len(data) % _ITEM_BYTES[kind]:
            raise _Damage(f"numbers of type {kind} in {len(data)} bytes")
        if count is not None and len(data) != count * _ITEM_BYTES[kind]:
            raise _Damage(f"an array of {count} numbers holds {len(data) // _ITEM_BYTES[kind]}")

    def _check_members(self, array: int, count: int, depth: int) -> None:
        if array == _OBJECT:
            self.take()
        if array in (_STRUCT, _OBJECT):
            kind, data = self.take()
            length = struct.unpack_from(self.order + "i", data)[0]
            _, names = self.take()
            if kind != 5 or length <= 0 or len(names) % length:
                raise _Damage("the names of the fields of a structure are damaged")
            count *= len(names) // length
        if count > len(self.data):
            raise _Damage(f"{count} members in {len(self.data)} bytes")
        for _ in range(count):
            kind, data = self.take()
            if kind != _MATRIX:
                raise _Damage("a member of a cell array or structure is not an array")
            _Elements(data, self.order).check_array(depth + 1)
