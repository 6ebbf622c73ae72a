"""A cache of decoded chunks with a bound on its memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

from numpy.typing import NDArray

__all__ = ["ChunkCache"]


class ChunkCache:
    """The most recently used chunks, by opening, variable and position.

    Parameters
    ----------
    largest_bytes : int
        Limit of the bytes of one chunk; a larger one is not stored.
    """

    def __init__(self, most_bytes: int, largest_bytes: int):
        self._max_bytes, self._max_chunk_bytes = most_bytes, largest_bytes
        self._bytes = 0
        self._chunks: OrderedDict[tuple[Any, ...], NDArray[Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[Any, ...]) -> NDArray[Any] | None:
        """Return a chunk, or None when it is not stored."""
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, key: tuple[Any, ...], chunk: NDArray[Any]) -> None:
        """Store a chunk, and drop the least recently used ones over the limit."""
        with self._lock:
            if key in self._chunks or chunk.nbytes > self._max_chunk_bytes:
                return
            self._chunks[key] = chunk
            self._bytes += chunk.nbytes
            while self._bytes > self._max_bytes:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes
