"""Checks for content with which a library would run code, end the process or never return.

A Zarr store names the codecs of its chunks. Those that restore objects of Python can run code.

A Blosc chunk of a Zarr store states its length in bytes 12 to 16. numcodecs does not compare it
with the bytes that it is given (seen in 0.16) and reads beyond the end of a chunk that was cut
short, or whose header is damaged.

A global heap collection of an HDF5 file holds strings and references of variable length. The
library walks from object to object by their sizes, and does not notice a size with which it stays
in place (seen in HDF5 1.14 and 2.0: an object 0, the free space, of size 0).

References
----------
C-Blosc, README_CHUNK_FORMAT.rst: header of a chunk. HDF5 File Format Specification, version 3.0,
section III.E (global heap).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from gyrostab.errors import FormatError
from gyrostab.store.output.content import METADATA, UNFINISHED, read_json

#: Codecs of Zarr format 2 that only restore numbers or text; format 3 has no others.
_HARMLESS_CODECS = {
    *("blosc", "bz2", "gzip", "lz4", "lzma", "packbits", "zlib", "zstd"),
    *("astype", "bitround", "delta", "fixedscaleoffset", "quantize", "shuffle"),
    *("adler32", "crc32", "crc32c", "fletcher32", "jenkins_lookup3"),
    *("vlen-bytes", "vlen-utf8"),
}
_HEADER_BYTES = 16  # of a Blosc chunk

_SUPERBLOCK = b"\x89HDF\r\n\x1a\n"
_COLLECTION = b"GCOL\x01\0\0\0"
_OBJECT = struct.Struct("<HHIQ")  # number, references, reserved, bytes
#: Heaps are searched for in this many bytes at each end of the file: a library writes them while it
#: defines variables and attributes, before the data or after them (0.05 s an end at 2.4 GB/s).
_SEARCHED_BYTES = 128 << 20
_BLOCK_BYTES = 1 << 20
_MAX_OBJECTS = 1 << 16  # their numbers have 16 bits


def check_codecs(where: str, variables: Mapping[Any, Any]) -> None:
    """Raise `FormatError` when a variable of a Zarr store has a codec that may run code.

    The variables are those of xarray, of which no chunk has been read; `where` names the store.
    """
    for name, variable in variables.items():
        codecs = [
            codec
            for kind in ("compressors", "filters")
            for codec in variable.encoding.get(kind) or ()
        ]
        for codec in codecs:
            identifier = getattr(codec, "codec_id", None)  # None in format 3
            if identifier is not None and identifier not in _HARMLESS_CODECS:
                raise FormatError(
                    f"{where}: {name} is stored with the codec {identifier!r}, and gyrostab reads "
                    "only codecs that hold nothing but numbers or text; ask for the store with "
                    "another compressor, such as Blosc"
                )


def is_blosc_cut(header: bytes, size: int) -> bool:
    """Whether a Blosc chunk of `size` bytes is shorter than its header says.

    Examples
    --------
    >>> is_blosc_cut(bytes(12) + (100).to_bytes(4, "little"), 99)
    True
    """
    if len(header) < _HEADER_BYTES:
        return True
    return size < max(int.from_bytes(header[12:16], "little"), _HEADER_BYTES)


def check_blosc_chunks(folder: Path, *, skip: Collection[Any] = ()) -> None:
    """Check the length of every Blosc chunk of a Zarr store (about 15 us a chunk).

    Parameters
    ----------
    folder : Path
        Store of format 2 or 3.
    skip : collection of str
        Variables that the library does not read.

    Raises
    ------
    FormatError
        When a chunk is cut short.
    """
    for array in _find_blosc_arrays(folder):
        if array.name in skip:
            continue
        for path in (Path(place, name) for place, _, names in os.walk(array) for name in names):
            if path.name in METADATA or UNFINISHED.search(path.name):
                continue
            # another process may replace or remove a chunk meanwhile
            with suppress(FileNotFoundError), path.open("rb") as file:
                header = file.read(_HEADER_BYTES)
                if is_blosc_cut(header, os.fstat(file.fileno()).st_size):
                    raise FormatError(
                        f"{folder.name}: is damaged: the chunk {path.relative_to(folder)} is cut "
                        "short; copy it again"
                    )


def _find_blosc_arrays(folder: Path) -> Iterator[Path]:
    """Find the arrays whose chunks are compressed with Blosc by their own metadata or the store's.

    The library prefers the consolidated metadata of the store, which may differ if it is damaged.
    """
    consolidated = _read_consolidated(folder)
    for place, _, names in os.walk(folder):
        metadata = [consolidated.get(Path(place).relative_to(folder).as_posix())]
        metadata += [read_json(Path(place, name)) for name in {".zarray", "zarr.json"} & {*names}]
        if any(map(_uses_blosc, metadata)):
            yield Path(place)


def _read_consolidated(folder: Path) -> dict[str, Any]:
    """Return the consolidated metadata of the arrays in a store of format 2 or 3."""
    try:
        if (folder / ".zmetadata").exists():
            entries = read_json(folder / ".zmetadata")["metadata"]
            return {name.removesuffix("/.zarray"): entry for name, entry in entries.items()}
        return dict(read_json(folder / "zarr.json")["consolidated_metadata"]["metadata"])
    except (LookupError, TypeError, ValueError, AttributeError):
        return {}


def _uses_blosc(metadata: Any) -> bool:
    """Whether chunks of an array with these metadata are compressed with Blosc."""
    try:
        if "compressor" in metadata:
            return bool(metadata["compressor"]["id"] == "blosc")
        return bool(metadata["codecs"][-1]["name"] == "blosc")
    except (LookupError, TypeError):
        return False


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
