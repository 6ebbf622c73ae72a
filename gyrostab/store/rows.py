"""Columns of foreign files, read by ranges of rows in several threads, without a lock or open file.

The libraries of NetCDF and HDF5 admit one thread at a time and keep chunks as long as the file is
open. A column here holds the places of its numbers in the file: at even distances (`EvenRows`) or
in chunks (`ChunkedRows`).
"""

from __future__ import annotations

import math
import threading
import uuid
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import DamageError
from gyrostab.store.layout import ChunkCache, ChunkDamage, has_known_filters, read_written_chunk

#: Bytes that are read at a time when other variables lie between the rows.
_STRIDED_READ_BYTES = 2**23
#: Limit of the number of chunks of a variable; the place of each takes about 200 bytes.
_MAX_CHUNKS = 2**19
#: Chunks from this size on are decoded by one thread at a time.
_LARGE_CHUNK_BYTES = 2**24
#: Small chunks of one column that were used in part: the next part of a run begins in them.
_EDGE_CACHE = ChunkCache(2**26, _LARGE_CHUNK_BYTES)
#: Chunks that several columns share. A part of a run has up to 2**24 samples (128 MiB) of all axes,
#: and all of them may be in the same chunks, for each of two workers.
_SHARED_CACHE = ChunkCache(3 * 2**27, 2**28)
_LARGE_CHUNK_LOCK = threading.Lock()


class Rows(Protocol):
    """Stored numbers of one column."""

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the numbers of some rows as they are stored."""


@dataclass(frozen=True)
class EvenRows:
    """Numbers at even distances in a file."""

    path: Path
    dtype: np.dtype[Any]  # with its byte order
    begin: int  # byte of row 0
    stride: int  # bytes from one row to the next

    @classmethod
    def of_array(
        cls, path: Path, dtype: np.dtype[Any], begin: int, stride: int, along: int, place: int
    ) -> EvenRows:
        """Locate one column of an array in the file.

        `begin` is its first byte, `stride` the bytes from one index of the first dimension to the
        next, `along` the dimension of the rows, and `place` the index along the other one.
        """
        across, step = (dtype.itemsize, stride) if along == 0 else (stride, dtype.itemsize)
        return cls(path, dtype, begin + place * across, step)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the numbers of some rows as they are stored."""
        out = np.empty(max(stop - start, 0), self.dtype)
        step = (
            out.size
            if self.stride == self.dtype.itemsize
            else max(_STRIDED_READ_BYTES // self.stride, 1)
        )
        with self.path.open("rb", buffering=0) as file:
            for at in range(0, out.size, max(step, 1)):
                part = out[at : at + step]
                file.seek(self.begin + (start + at) * self.stride)
                if self.stride == self.dtype.itemsize:
                    self._read_exactly(file, part.view(np.uint8).data)
                    continue
                spread = np.empty((part.size - 1) * self.stride + self.dtype.itemsize, np.uint8)
                self._read_exactly(file, spread.data)
                part[:] = np.ndarray(part.shape, self.dtype, spread, 0, (self.stride,))
        return out

    def _read_exactly(self, file: Any, view: memoryview) -> None:
        while view.nbytes:
            got = file.readinto(view)
            if not got:
                raise DamageError(f"{self.path.name}: is damaged, it is cut short; copy it again")
            view = view[got:]


@dataclass(frozen=True)
class ChunkedRows:
    """Numbers in chunks along one dimension, or one place of a second dimension."""

    #: Function of the number of the chunk along each dimension. It returns the chunk, which may be
    #: shorter at the end, or None if it was never written.
    load: Callable[[tuple[int, ...]], NDArray[Any] | None]
    #: Shape of the variable and of its chunks.
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    fill: Any  # value of samples that were never written
    #: Dimension of the rows, and index along the other one.
    along: int
    place: int
    key: tuple[str]  # identifier of one opening of the variable, common to its columns

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the numbers of some rows as they are stored."""
        out = np.empty(max(stop - start, 0), self.dtype)
        length = self.chunks[self.along]
        for number in range(start // length, -(-stop // length)) if stop > start else ():
            first = number * length
            low, high = max(start, first), min(stop, first + length)
            at: list[int] = [number]
            inside: list[Any] = [slice(low - first, high - first)]
            if len(self.shape) == 2:
                across, offset = divmod(self.place, self.chunks[1 - self.along])
                at.insert(1 - self.along, across)
                inside.insert(1 - self.along, offset)
            is_single_column = len(self.shape) == 1 or self.chunks[1 - self.along] == 1
            part = low > first or high < min(first + length, self.shape[self.along])
            chunk = self._read_chunk(tuple(at), is_single_column=is_single_column, part=part)
            out[low - start : high - start] = self.fill if chunk is None else chunk[tuple(inside)]
        return out

    def _read_chunk(
        self, at: tuple[int, ...], *, is_single_column: bool, part: bool
    ) -> NDArray[Any] | None:
        """Read a chunk; cache it if another column or a later read will use it."""
        large = math.prod(self.chunks) * self.dtype.itemsize >= _LARGE_CHUNK_BYTES
        cache, key = (
            _EDGE_CACHE if is_single_column and not large else _SHARED_CACHE,
            (*self.key, at),
        )
        chunk = cache.get(key)
        if chunk is not None:
            return chunk
        with _LARGE_CHUNK_LOCK if large else nullcontext():
            chunk = cache.get(key) if large else None
            if chunk is None:
                chunk = self.load(at)
                if chunk is not None and (part or not is_single_column):
                    cache.put(key, chunk)
        return chunk


@dataclass(frozen=True)
class LibraryRows:
    """Numbers that only a library can read, while the file is open."""

    variable: Any  # variable of the library; indexing it returns stored numbers
    #: Dimension of the rows, and index along the other one.
    along: int = 0
    place: int = 0

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the numbers of some rows as they are stored."""
        if len(self.variable.shape) == 1:
            return np.asarray(self.variable[start:stop])
        return np.asarray(
            self.variable[start:stop, self.place]
            if self.along == 0
            else self.variable[self.place, start:stop]
        )


def hdf5_rows(path: Path, variable: Any) -> Callable[[int, int], Rows] | None:
    """Find a way to read the rows of an HDF5 dataset without the library.

    Returns
    -------
    callable or None
        Function of the dimension of the rows and the index along the other one; it returns the
        column. None if only the library can read it.
    """
    import h5py

    plist = variable.id.get_create_plist()
    shape, dtype = variable.shape, variable.dtype
    if (
        plist.get_layout() == h5py.h5d.CONTIGUOUS
        and not plist.get_external_count()
        and variable.id.get_offset() is not None
    ):
        stride = dtype.itemsize * math.prod(shape[1:])
        return partial(EvenRows.of_array, path.absolute(), dtype, variable.id.get_offset(), stride)
    if plist.get_layout() != h5py.h5d.CHUNKED or not has_known_filters(plist):
        return None
    counts = [-(-size // length) for size, length in zip(shape, variable.chunks, strict=True)]
    if math.prod(counts) > _MAX_CHUNKS:
        return None  # a table of their places would be larger than the chunks
    key = uuid.uuid4().hex
    load = partial(_load_hdf5, path.absolute(), variable.name, variable.chunks, key)
    return partial(ChunkedRows, load, shape, variable.chunks, dtype, variable.fillvalue, key=(key,))


def _load_hdf5(
    path: Path, name: str, chunks: tuple[int, ...], opened: str, at: tuple[int, ...]
) -> NDArray[Any] | None:
    try:
        chunk = read_written_chunk(path, name, at, opened=opened)
        if chunk is not None and chunk.size != math.prod(chunks):
            raise ChunkDamage(f"holds {chunk.size} values in place of {math.prod(chunks)}")
    except ChunkDamage as damage:
        raise DamageError(
            f"{path.name}: is damaged, a chunk of {name.strip('/')!r} {damage}; copy it again"
        ) from damage
    return None if chunk is None else chunk.reshape(chunks)
