"""Reading chunks of variables from NetCDF (HDF5) and Zarr (format 2) files.

Chunks of NetCDF files are read without the library. The library holds a lock over every read, and
keeps each chunk for as long as any handle of the file is open. Given the offsets and filters of the
chunks, several threads read them in parallel, and no file stays open.
"""

from __future__ import annotations

import errno
import json
import math
import os
import threading
import zlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.arrays import Array
from gyrostab.errors import FormatError, reading_of
from gyrostab.store.damage import is_blosc_cut
from gyrostab.store.private import library_lock

#: Variables whose layout is cached: several for each file of a long archive.
_MAX_CACHED_LAYOUTS = 2**12
#: Numbers of the filters of HDF5 that are known here.
_DEFLATE, _SHUFFLE, _FLETCHER32, _ZSTD = 1, 2, 3, 32015
_CHECKSUM_BYTES = 4


class ChunkDamage(Exception):
    """A chunk that cannot be read; the message says why."""


class ChunkCache:
    """The most recently used chunks, by opening, variable and position, within a limit of bytes.

    A chunk of more than `largest_bytes` is not stored.
    """

    def __init__(self, most_bytes: int, largest_bytes: int):
        self._max_bytes, self._max_chunk_bytes = most_bytes, largest_bytes
        self._bytes = 0
        self._chunks: OrderedDict[tuple[Any, ...], Array] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[Any, ...]) -> Array | None:
        """Return a chunk, or None when it is not stored."""
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, key: tuple[Any, ...], chunk: Array) -> None:
        """Store a chunk, and drop the least recently used ones over the limit."""
        with self._lock:
            if key in self._chunks or chunk.nbytes > self._max_chunk_bytes:
                return
            self._chunks[key] = chunk
            self._bytes += chunk.nbytes
            while self._bytes > self._max_bytes:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes


@dataclass(frozen=True, eq=False)
class _Hdf5Layout:
    """Type, filters in the order of reading, values of a chunk, and the places of the chunks.

    The place of a chunk is its first byte, its size, and a mask of the filters that were skipped.
    """

    dtype: np.dtype[Any]
    codecs: tuple[tuple[int, Any], ...]
    size: int
    places: dict[tuple[int, ...], tuple[int, int, int]]
    damage: str


@dataclass(frozen=True)
class _ZarrLayout:
    dtype: np.dtype[Any]
    codecs: tuple[Any, ...]
    size: int  # values of a chunk
    separator: str


def is_readable(path: Path, name: str) -> bool:
    """Whether `read_chunk` can read a variable.

    Every log that gyrostab wrote can be read; another program may have changed the layout.
    """
    if not path.is_dir():
        import h5py

        with library_lock(), h5py.File(path, "r") as file:
            codecs = find_hdf5_codecs(file[name].id.get_create_plist())
        return not any(isinstance(codec, _UnknownFilter) for _, codec in codecs)
    try:
        layout = json.loads((path / name / ".zarray").read_bytes())
        codecs = find_zarr_codecs(layout)
        return layout["order"] == "C" and not any(isinstance(c, _UnknownFilter) for c in codecs)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def read_chunk(path: Path, name: str, place: tuple[int, ...], *, zarr: bool, opened: str) -> Array:
    """Read one chunk as it is on disk, not scaled, in its full size.

    Parameters
    ----------
    place : tuple of int
        Number of the chunk along each dimension.
    zarr : bool
        Whether `path` is a Zarr directory.
    opened : str
        Identifier of one opening of the file; the layout is read once per opening.

    Raises
    ------
    ChunkDamage
        When the chunk is damaged or missing.
    FormatError
        When the file no longer exists, or may not be read.
    """
    if zarr:
        return _read_zarr_chunk(path / name, place, opened)
    layout = _read_hdf5_layout(path, name, opened)
    if place not in layout.places:
        if layout.damage:
            raise ChunkDamage(f"is damaged: {layout.damage}")
        raise ChunkDamage(f"is missing: {name} has no chunk {place}")
    begin, size, mask = layout.places[place]
    try:
        with path.open("rb") as file:
            # before memory is allocated: a damaged index may hold any number
            if begin + size > os.fstat(file.fileno()).st_size:
                raise ChunkDamage("is missing: the file is cut short")
            file.seek(begin)
            data = file.read(size)
    except OSError as error:
        if error.errno != errno.EIO:
            raise FormatError(
                f"{path}: cannot be opened again ({error.strerror}); has it been moved or changed?"
            ) from error
        raise ChunkDamage(f"is damaged: {error}") from error
    if len(data) < size:
        raise ChunkDamage("is missing: the file is cut short")
    codecs = [codec for number, codec in layout.codecs if not mask >> number & 1]
    return decode_chunk(data, codecs, layout.dtype, layout.size)


@lru_cache(maxsize=_MAX_CACHED_LAYOUTS)
def _read_hdf5_layout(path: Path, name: str, opened: str) -> _Hdf5Layout:
    """Read the places of the chunks, or of a damaged index as many as possible."""
    import h5py

    places: dict[tuple[int, ...], tuple[int, int, int]] = {}
    damage = ""
    with library_lock(), reading_of(path):
        try:
            file = h5py.File(path, "r")
        except OSError as error:
            raise FormatError(
                f"{path}: cannot be opened again ({error}); has it been moved or changed?"
            ) from error
        with file:
            variable = file[name]
            dtype, codecs, lengths = (
                variable.dtype,
                find_hdf5_codecs(variable.id.get_create_plist()),
                variable.chunks or (),
            )

            def note(chunk: Any) -> None:
                number = tuple(
                    at // length for at, length in zip(chunk.chunk_offset, lengths, strict=True)
                )
                places[number] = (chunk.byte_offset, chunk.size, chunk.filter_mask)

            try:
                variable.id.chunk_iter(note)
            except Exception as error:  # h5py raises errors of many kinds on a damaged index
                damage = f"the index of {name} cannot be read ({error})"
    return _Hdf5Layout(dtype, codecs, math.prod(lengths), places, damage)


def find_hdf5_codecs(plist: Any) -> tuple[tuple[int, Any], ...]:
    """Make the codecs of the filters, in the order of reading, with their numbers."""
    codecs: list[tuple[int, Any]] = []
    for number in reversed(range(plist.get_nfilters())):
        code, _, values, _ = plist.get_filter(number)
        codec: Any = _UnknownFilter(f"filter {code} of HDF5")
        if code == _SHUFFLE:
            codec = _Shuffle(values[0])
        elif code == _DEFLATE:
            codec = _Deflate(*values[:1])
        elif code == _FLETCHER32:
            codec = _Fletcher32()
        elif code == _ZSTD:
            codec = _Zstd(*values[:1])
        codecs.append((number, codec))
    return tuple(codecs)


@dataclass(frozen=True)
class _Shuffle:
    """The shuffle filter; remaining bytes, such as a checksum, stay unchanged."""

    width: int

    def encode(self, data: Array) -> bytes:
        """Bring together the bytes of each place within the numbers of an array."""
        return data.reshape(-1, 1).view(np.uint8).T.tobytes()

    def decode(self, data: Any, max_bytes: int) -> Any:
        """Restore the order of the bytes."""
        from numcodecs import Shuffle

        stored = np.frombuffer(data, np.uint8)
        shuffled_size = stored.size - stored.size % max(self.width, 1)
        ordered = Shuffle(elementsize=self.width).decode(stored[:shuffled_size])
        return (
            ordered
            if shuffled_size == stored.size
            else np.concatenate([np.frombuffer(ordered, np.uint8), stored[shuffled_size:]])
        )


class _Fletcher32:
    """The checksum at the end of a chunk."""

    def encode(self, data: Array) -> NDArray[np.uint8]:
        """Add the checksum to the bytes of an array."""
        from numcodecs import Fletcher32

        return np.frombuffer(Fletcher32().encode(data), np.uint8)

    def decode(self, data: Any, max_bytes: int) -> NDArray[np.uint8]:
        """Verify the checksum and return the bytes before it."""
        from numcodecs import Fletcher32

        try:
            return np.frombuffer(Fletcher32().decode(data), np.uint8)
        except (RuntimeError, ValueError, IndexError) as error:
            raise RuntimeError("its checksum is wrong") from error


class _Blosc:
    """Blosc, which reads beyond a cut chunk, with a check of the length."""

    def decode(self, data: Any, max_bytes: int) -> Any:
        """Check the lengths and decompress the bytes."""
        from numcodecs import blosc

        if is_blosc_cut(data[:16], len(data)):
            raise RuntimeError("it is cut short")
        _check_size(int.from_bytes(data[4:8], "little"), max_bytes)
        return blosc.decompress(data)


@dataclass(frozen=True)
class _Deflate:
    """The compression of zlib."""

    level: int = 1

    def encode(self, data: Any) -> bytes:
        """Compress the bytes."""
        return zlib.compress(data, self.level)

    def decode(self, data: Any, max_bytes: int) -> bytes:
        """Decompress the bytes, of which no more are made than one too many."""
        decoder = zlib.decompressobj()
        values = decoder.decompress(data, max_bytes + 1)
        _check_size(len(values), max_bytes)
        if not decoder.eof:
            raise RuntimeError("it is cut short")
        return values


@dataclass(frozen=True)
class _Zstd:
    """Zstandard."""

    level: int = 1

    def encode(self, data: Any) -> Any:
        """Compress the bytes."""
        from numcodecs import Zstd

        return Zstd(self.level).encode(data)

    def decode(self, data: Any, max_bytes: int) -> Any:
        """Check the length and decompress the bytes."""
        from numcodecs import zstd

        size = _read_zstd_size(bytes(data[:18]))
        if size is None:
            return zstd.decompress(data, np.empty(max_bytes, np.uint8))
        _check_size(size, max_bytes)
        return zstd.decompress(data)


def _read_zstd_size(header: bytes) -> int | None:
    """Read the size of the content from the header of a frame (RFC 8878, section 3.1.1.1).

    A header without it has None; then the content must have the size of the chunk.
    """
    descriptor = header[4]
    is_single_segment = descriptor >> 5 & 1
    begin = 5 + (not is_single_segment) + (0, 1, 2, 4)[descriptor & 3]
    length = (is_single_segment, 2, 4, 8)[descriptor >> 6]
    size = int.from_bytes(header[begin : begin + length], "little")
    return size + 256 * (length == 2) if length else None


def _check_size(size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise RuntimeError(f"it holds more than the {max_bytes} bytes of a chunk")


@dataclass(frozen=True)
class _UnknownFilter:
    name: str

    def decode(self, data: bytes, max_bytes: int) -> bytes:
        raise ChunkDamage(f"cannot be read: gyrostab does not support {self.name}")


def _read_zarr_chunk(folder: Path, place: Sequence[int], opened: str) -> Array:
    layout = _read_zarr_layout(folder, opened)
    name = layout.separator.join(map(str, place))
    try:
        data = (folder / name).read_bytes()
    except FileNotFoundError as error:
        if not folder.is_dir():
            raise FormatError(
                f"{folder}: no longer exists; has it been moved or removed?"
            ) from error
        raise ChunkDamage(f"is missing: no file {folder.name}/{name}") from error
    except OSError as error:
        if error.errno != errno.EIO:
            raise FormatError(f"{folder / name}: cannot be read ({error.strerror})") from error
        raise ChunkDamage(f"is damaged: {folder.name}/{name}: {error}") from error
    where = f"{folder.name}/{name}: "
    return decode_chunk(data, layout.codecs, layout.dtype, layout.size, name=where)


@lru_cache(maxsize=_MAX_CACHED_LAYOUTS)
def _read_zarr_layout(folder: Path, opened: str) -> _ZarrLayout:
    """Read codecs, type, and the separator in the names of chunks."""
    try:
        layout = json.loads((folder / ".zarray").read_bytes())
        return _ZarrLayout(
            np.dtype(layout["dtype"]),
            find_zarr_codecs(layout),
            math.prod(layout["chunks"]),
            str(layout.get("dimension_separator", ".")),
        )
    except OSError as error:
        raise FormatError(
            f"{folder}: no longer exists ({error.strerror}); has it been moved or removed?"
        ) from error
    except Exception as error:  # whatever json, numpy and numcodecs raise on damaged text
        raise FormatError(
            f"{folder / '.zarray'}: is damaged ({type(error).__name__}: {error}); copy it again"
        ) from error


def find_zarr_codecs(layout: dict[str, Any]) -> tuple[Any, ...]:
    """Make the codecs of a variable, in the order of reading."""
    known_codecs: dict[str, Any] = {
        "blosc": _Blosc, "fletcher32": _Fletcher32, "zlib": _Deflate, "zstd": _Zstd
    }  # fmt: skip
    described = [
        item for item in [layout["compressor"], *reversed(layout["filters"] or ())] if item
    ]
    return tuple(
        known_codecs[item["id"]]()
        if item["id"] in known_codecs
        else _UnknownFilter(f"codec {item['id']!r} of Zarr")
        for item in described
    )


def decode_chunk(
    data: Any, codecs: Sequence[Any], dtype: np.dtype[Any], size: int, *, name: str = ""
) -> Array:
    """Decode the bytes of a chunk to numbers, of which a whole chunk has `size`.

    No codec makes more bytes than such a chunk needs, whatever the file holds.

    Raises
    ------
    ChunkDamage
        When decoding fails; the message begins with `name`.
    """
    try:
        for number, codec in enumerate(codecs, 1):
            checksums = sum(isinstance(later, _Fletcher32) for later in codecs[number:])
            data = codec.decode(data, size * dtype.itemsize + checksums * _CHECKSUM_BYTES)
        return np.frombuffer(data, dtype)
    except ChunkDamage:
        raise
    except Exception as error:  # codecs raise errors of many kinds on damaged bytes
        raise ChunkDamage(f"is damaged: {name}{' '.join(str(error).split())}") from error
