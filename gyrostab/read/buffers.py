"""Growing columns that move from memory to unlinked temporary files when they become large."""

from __future__ import annotations

import tempfile
import uuid
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OutputError

__all__ = ["CHUNK_ROWS", "SPILL_BYTES", "Buffers", "lazily", "park"]

#: Columns of one file together stay in memory up to this size [bytes].
SPILL_BYTES = 128 * 2**20

#: Rows of one dask chunk of a column on disk.
CHUNK_ROWS = 2**21


class Buffers:
    """Columns of 8-byte numbers that grow block by block.

    Up to `limit` bytes they are lists of arrays; beyond it each column is appended to a temporary file without a name,
    which the system removes with the last reference to it.
    """

    def __init__(self, dtypes: Mapping[Any, Any], *, limit: int = SPILL_BYTES):
        self.dtypes = {key: np.dtype(dtype) for key, dtype in dtypes.items()}
        self.limit = limit
        self.rows = 0
        self._parts: dict[Any, list[NDArray[Any]]] = {key: [] for key in dtypes}
        self._files: dict[Any, IO[bytes]] = {}

    def add(self, block: Mapping[Any, NDArray[Any]]) -> None:
        """Append one block: every column, all of one length."""
        self.rows += len(next(iter(block.values())))
        for key, values in block.items():
            self._parts[key].append(np.ascontiguousarray(values, dtype=self.dtypes[key]))
        if self._files or self.rows * sum(dtype.itemsize for dtype in self.dtypes.values()) > self.limit:
            self._spill()

    def _spill(self) -> None:
        for key, parts in self._parts.items():
            if key not in self._files:
                self._files[key] = tempfile.TemporaryFile(prefix="gyrostab-")  # noqa: SIM115
            for part in parts:
                _write(self._files[key], part)
            parts.clear()

    def finish(self) -> dict[Any, NDArray[Any]]:
        """The columns: arrays in memory, or memory maps of their files."""
        if not self._files:
            return {key: np.concatenate(parts) if parts else np.empty(0, self.dtypes[key]) for key, parts in self._parts.items()}
        columns: dict[Any, NDArray[Any]] = {}
        for key, file in self._files.items():
            _write(file)
            columns[key] = np.memmap(file, dtype=self.dtypes[key], mode="r+", shape=(self.rows,))
        return columns


def _write(file: IO[bytes], *arrays: NDArray[Any]) -> None:
    """Append arrays to a temporary file and bring it up to date."""
    try:
        for values in arrays:
            file.write(values.data)
        file.flush()
    except OSError as error:
        where = tempfile.gettempdir()
        raise OutputError(
            f"{where}: the columns of a long log are kept there while it is read, and cannot be written ({error.strerror}); "
            "make room, or name a larger place in the environment variable TMPDIR"
        ) from error


class _Mapped:
    """A memory map behind the few attributes that dask asks for; dask copies into memory whatever has a ``copy``."""

    def __init__(self, values: NDArray[Any]):
        self._values = values
        self.shape, self.dtype, self.ndim = values.shape, values.dtype, values.ndim

    def __getitem__(self, part: Any) -> NDArray[Any]:
        return np.asarray(self._values[part])


def lazily(values: NDArray[Any]) -> Any:
    """A dask array over a memory map; an array in memory is returned as it is."""
    if not isinstance(values, np.memmap):
        return values
    import dask.array

    name, meta = f"gyrostab-column-{uuid.uuid4().hex}", np.empty((0,) * values.ndim, dtype=values.dtype)
    return dask.array.from_array(_Mapped(values), chunks=CHUNK_ROWS, name=name, asarray=True, meta=meta)


def park(values: NDArray[Any]) -> Any:
    """Move an array from memory to an unlinked temporary file and wrap it as a dask array."""
    with tempfile.TemporaryFile(prefix="gyrostab-") as file:
        _write(file, np.ascontiguousarray(values).view(np.int64))
        return lazily(np.memmap(file, dtype=values.dtype, mode="r+", shape=values.shape))
