"""The latest decoded chunks, in memory that is bounded."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

from numpy.typing import NDArray

__all__ = ["ChunkCache"]


class ChunkCache:
    """Chunks by opening, variable and place, the latest of them.

    Parameters
    ----------
    most_bytes : int
        Bytes of all chunks together.
    largest_bytes : int
        A chunk that is larger is not kept.
    """

    def __init__(self, most_bytes: int, largest_bytes: int):
        self._most, self._largest = most_bytes, largest_bytes
        self._held = 0
        self._chunks: OrderedDict[tuple[Any, ...], NDArray[Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[Any, ...]) -> NDArray[Any] | None:
        """Return a chunk, or None."""
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, key: tuple[Any, ...], chunk: NDArray[Any]) -> None:
        """Keep a chunk in place of the oldest ones."""
        with self._lock:
            if key in self._chunks or chunk.nbytes > self._largest:
                return
            self._chunks[key] = chunk
            self._held += chunk.nbytes
            while self._held > self._most:
                self._held -= self._chunks.popitem(last=False)[1].nbytes
