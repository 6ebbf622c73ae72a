"""Arrays of numbers in MATLAB 5 files; scipy's compiled reader may crash on damaged sizes.

References
----------
MAT-File Format, The MathWorks (level 5 MAT-files: data elements, array subelements).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import FormatError

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
#: Numeric data type -> code of numpy.
_TYPES = {
    **{1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"},
    **{7: "f4", 9: "f8", 12: "i8", 13: "u8"},
}
_STRUCT, _OBJECT, _OPAQUE, _NUMERIC, _CLASSES = 2, 3, 17, range(6, 16), range(1, 18)
_DAMAGE = (KeyError, ValueError, OverflowError, RecursionError, struct.error, zlib.error)

Arrays = Iterator[tuple[str, NDArray[Any]]]


def read_arrays(path: Path, objects: list[str]) -> Arrays:
    """Yield names and arrays of numbers; descriptions of MATLAB objects are added to `objects`.

    Fields of a structure are called ``name.field``. Files of other levels are left to scipy.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or 0 in head[:4]:
            from scipy.io import loadmat

            for name, value in loadmat(path).items():
                if not name.startswith("__") and value.dtype.kind in "iuf":
                    yield name, value
            return
        order = "<" if head[126:128] == b"IM" else ">"
        try:
            for elements in _find_variables(file, order, path.stat().st_size):
                yield from elements.find_numbers("", objects)
        except _DAMAGE as error:
            problem = f"this MATLAB file is damaged or cut off ({error}); copy it again"
            raise FormatError(f"{path.name}: {problem}") from error


def _find_variables(file: BinaryIO, order: str, size: int) -> Iterator[_Elements]:
    place = _HEADER_BYTES
    while place < size:
        file.seek(place)
        kind, length = struct.unpack(order + "II", file.read(8))
        if kind not in (_MATRIX, _COMPRESSED):
            raise ValueError(f"at byte {place} there is an element of type {kind}, not an array")
        place += 8 + length
        if place > size:
            raise ValueError(f"an array ends {place - size} bytes behind the file")
        data = file.read(length)
        if kind == _COMPRESSED:
            data = zlib.decompress(data)
            kind, length = struct.unpack(order + "II", data[:8])
            if kind != _MATRIX or length > len(data) - 8:
                raise ValueError("a compressed element does not hold an array")
            data = data[8 : 8 + length]
        yield _Elements(data, order)


class _Elements:
    """The data elements within an array, in sequence."""

    def __init__(self, data: bytes | memoryview, order: str):
        self.data, self.order, self.place = memoryview(data), order, 0

    def _take_element(self) -> tuple[int, memoryview]:
        """Take type and bytes of the next element; raise an error if it is cut off."""
        word = struct.unpack_from(self.order + "I", self.data, self.place)[0]
        if word >> 16:  # a small element holds its data in the tag
            kind, length, begin, end = word & 0xFFFF, word >> 16, self.place + 4, self.place + 8
            if length > 4:
                raise ValueError(f"a small element of {length} bytes")
        else:
            kind, length = word, struct.unpack_from(self.order + "I", self.data, self.place + 4)[0]
            begin = self.place + 8
            end = begin + length + (-length % 8)
        if begin + length > len(self.data):
            raise ValueError(f"an element of {length} bytes in an array of {len(self.data)}")
        self.place = min(end, len(self.data))
        return kind, self.data[begin : begin + length]

    def _take_text(self) -> str:
        return bytes(self._take_element()[1]).decode("latin-1")

    def _take_array(self) -> NDArray[Any]:
        kind, data = self._take_element()
        return np.frombuffer(data, self.order + _TYPES[kind])

    def _take_number(self) -> int:
        numbers = self._take_array()
        if not numbers.size:
            raise ValueError("an element without its number")
        return int(numbers[0])

    def find_numbers(self, field: str, objects: list[str]) -> Arrays:
        """Yield the array that consists of these elements, or those in the fields of a structure.

        `field` is the name of a member of a structure, which carries none.
        """
        if not self.data:
            return  # an empty array within a structure
        flags = self._take_number()
        array, is_complex = flags & 0xFF, bool(flags & 0x800)
        if array not in _CLASSES:
            raise ValueError(f"there is no array of class {array}")
        if array == _OPAQUE:
            name, _, kind = (self._take_text() for _ in range(3))
            objects.append(f"a {kind} {field or name!r}")
            return
        shape = self._take_array().astype(np.int64).tolist()
        name = self._take_text() or field  # without a name: data of MATLAB objects
        if array in _NUMERIC and not is_complex and name:
            yield name, self._take_array().reshape(shape, order="F")
        elif array == _OBJECT:
            objects.append(f"an object of class {self._take_text()!r}")
        elif array == _STRUCT:
            yield from self._find_members(name, math.prod(shape), objects)

    def _find_members(self, name: str, count: int, objects: list[str]) -> Arrays:
        """Yield the arrays in the fields of a structure, or scalars of many structures as one."""
        length, names = self._take_number(), bytes(self._take_element()[1])
        if length <= 0 or len(names) % length or count * len(names) // length > len(self.data):
            raise ValueError("the names of the fields of a structure are damaged")
        parts = (names[at : at + length] for at in range(0, len(names), length))
        fields = [part.split(b"\0")[0].decode("latin-1") for part in parts]
        columns: dict[str, list[list[NDArray[Any]]]] = {field: [] for field in fields}
        for _ in range(count):
            for field in fields:
                kind, data = self._take_element()
                if kind != _MATRIX:
                    raise ValueError("a member of a structure is not an array")
                arrays = _Elements(data, self.order).find_numbers(
                    f"{name}.{field}", objects if count == 1 else []
                )
                if count == 1:
                    yield from arrays
                else:  # table2struct: one structure a row
                    columns[field].append([value for _, value in arrays])
        for field, rows in columns.items():
            if rows and all(len(row) == 1 and row[0].size == 1 for row in rows):
                yield f"{name}.{field}", np.array([row[0].item() for row in rows])
