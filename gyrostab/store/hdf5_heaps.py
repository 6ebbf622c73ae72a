"""Check the global heaps of an HDF5 file; the library never returns from some damaged ones.

A global heap collection holds strings and references of variable length. The library walks from
object to object by their sizes, and does not notice a size with which it stays in place (seen in
HDF5 1.14 and 2.0: an object 0, the free space, of size 0).

References
----------
HDF5 File Format Specification, version 3.0, section III.E (global heap).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gyrostab.errors import FormatError

_SUPERBLOCK = b"\x89HDF\r\n\x1a\n"
_COLLECTION = b"GCOL\x01\0\0\0"
_OBJECT = struct.Struct("<HHIQ")  # number, references, reserved, bytes
#: Heaps are searched for in this many bytes at each end of the file: a library writes them while it
#: defines variables and attributes, before the data or after them (0.05 s an end at 2.4 GB/s).
_SEARCHED_BYTES = 128 << 20
_BLOCK_BYTES = 1 << 20
_MAX_OBJECTS = 1 << 16  # their numbers have 16 bits


def check_global_heaps(path: Path) -> None:
    """Check that every global heap near the ends of a file can be walked through.

    Parameters
    ----------
    path : Path
        The file. Files that are not HDF5, or whose lengths are not of 8 bytes, pass.

    Raises
    ------
    FormatError
        When the library would not return from a heap.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if _find_size_of_lengths(file, size) != 8:
            return
        for begin in _find_collections(file, size):
            if not _is_finite(file, begin):
                problem = f"this HDF5 file is damaged (global heap at byte {begin})"
                raise FormatError(f"{path.name}: {problem}; copy it again")


def _find_size_of_lengths(file: BinaryIO, size: int) -> int:
    """Return the bytes of a length in the file; 0 without a superblock."""
    begin = 0
    while begin < size:  # after a user block of 0, 512, 1024, ... bytes
        file.seek(begin)
        head = file.read(16)
        if head.startswith(_SUPERBLOCK) and len(head) == 16:
            return head[14] if head[8] < 2 else head[10]
        begin = max(512, 2 * begin)
    return 0


def _find_collections(file: BinaryIO, size: int) -> Iterator[int]:
    """Yield the places of the collections at both ends of the file."""
    rear = max(_SEARCHED_BYTES, size - _SEARCHED_BYTES)
    for begin, stop in ((0, min(size, _SEARCHED_BYTES)), (rear, size)):
        for block in range(begin, stop, _BLOCK_BYTES):
            file.seek(block)
            # blocks overlap by all but one byte of a signature
            data = file.read(min(_BLOCK_BYTES, stop - block) + len(_COLLECTION) - 1)
            at = data.find(_COLLECTION)
            while at >= 0:
                yield block + at
                at = data.find(_COLLECTION, at + 1)


def _is_finite(file: BinaryIO, begin: int) -> bool:
    """Return whether the walk through the objects of a collection ends."""
    file.seek(begin)
    length = int.from_bytes(file.read(16)[8:], "little")
    at = 16
    for _ in range(_MAX_OBJECTS):
        if at + _OBJECT.size > length:
            return True
        file.seek(begin + at)
        head = file.read(_OBJECT.size)
        if len(head) < _OBJECT.size:
            return True  # cut off: the library says so
        number, _, _, size = _OBJECT.unpack(head)
        step = size if number == 0 else _OBJECT.size + (size + 7) // 8 * 8
        if not _OBJECT.size <= step <= length:
            return False
        at += step
    return False
