"""Growing columns that move from memory to an unlinked temporary file when they become large.

They are read back with `os.pread`, not mapped: pages of a mapped file would count as memory of this process, more and more of them
as a long log is gone through, and every map holds a file handle of its own, of which hundreds of files would need thousands.
"""

from __future__ import annotations

import os
import tempfile
import uuid
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OutputError
from gyrostab.store.direct import stack_rows, with_fill

__all__ = ["CHUNK_ROWS", "SPILL_BYTES", "Buffers", "Spool", "Stored", "lazily", "put", "take", "together"]

#: Columns of one file together stay in memory up to this size [bytes].
SPILL_BYTES = 128 * 2**20

#: Rows of one dask chunk of a column on disk.
CHUNK_ROWS = 2**21


class Spool:
    """A temporary file without a name, which the system removes with the last reference to it."""

    def __init__(self) -> None:
        self.file: IO[bytes] | None = None
        self.end = 0

    def add(self, values: NDArray[Any]) -> int:
        """Append an array; the byte at which it begins."""
        try:
            if self.file is None:
                self.file = tempfile.TemporaryFile(prefix="gyrostab-")  # noqa: SIM115
            self.file.write(values.data)
            self.file.flush()
        except OSError as error:
            where = tempfile.gettempdir()
            raise OutputError(
                f"{where}: the columns of a long log are kept there while it is read, and cannot be written ({error.strerror}); "
                "make room, or name a larger place in the environment variable TMPDIR"
            ) from error
        begin, self.end = self.end, self.end + values.nbytes
        return begin

    def store(self, values: NDArray[Any]) -> Stored:
        """Move a column to the file."""
        whole = np.ascontiguousarray(values).view(np.int64)
        return Stored(self, values.dtype, [0, len(values)], [self.add(whole)])

    @property
    def handle(self) -> int:
        """Number of the open file."""
        assert self.file is not None
        return self.file.fileno()


class Stored:
    """A column of 8-byte values in a spool, behind the few attributes that dask asks for; dask copies whatever has a ``copy``."""

    ndim = 1

    def __init__(self, spool: Spool, dtype: Any, rows: list[int], places: list[int]):
        self.spool, self.dtype = spool, np.dtype(dtype)
        self._rows, self._places = rows, places  # the rows at which the pieces begin, and the end of the last; the bytes they begin at
        self.shape = (rows[-1],)

    def view(self, dtype: Any) -> Stored:
        """The same bytes as another type."""
        return Stored(self.spool, dtype, self._rows, self._places)

    def place(self, row: int) -> int:
        """The byte at which a row stands."""
        piece = bisect_right(self._rows, row) - 1
        return self._places[piece] + 8 * (row - self._rows[piece])

    def __getitem__(self, part: Any) -> NDArray[Any]:
        rows = range(*(part[0] if isinstance(part, tuple) else part).indices(self.shape[0]))
        out = np.empty(max(rows.stop - rows.start, 0), dtype=self.dtype)
        self.fill(0, rows.start, out)
        return out[:: rows.step]

    def fill(self, _row: int, begin: int, out: NDArray[Any]) -> None:
        """The values from row `begin` of the log on: `gyrostab.store.direct.Fill`."""
        values = out.view(np.int64)
        done = 0
        while done < len(values):
            row = begin + done
            most = self._rows[bisect_right(self._rows, row)] - row
            got = os.preadv(self.spool.handle, [values[done : done + most].data.cast("B")], self.place(row))
            if got < 8:
                raise OSError("the temporary file of a long log is shorter than it was")
            done += got // 8


def take(column: NDArray[Any] | Stored, rows: NDArray[np.int64]) -> NDArray[Any]:
    """The values of a few rows."""
    if isinstance(column, Stored):
        return np.concatenate([np.empty(0, column.dtype), *(column[row : row + 1] for row in rows.tolist())])
    return np.asarray(column[rows])


def put(column: NDArray[Any] | Stored, rows: NDArray[np.int64], value: int) -> None:
    """Change a few rows."""
    if isinstance(column, Stored):
        for row in rows.tolist():
            os.pwrite(column.spool.handle, np.int64(value).tobytes(), column.place(row))
    else:
        column[rows] = value


class Buffers:
    """Columns of 8-byte numbers that grow block by block.

    Up to `limit` bytes they are lists of arrays; beyond it they are appended to a spool. In memory, the columns `rows_of` become the
    rows of one array.
    """

    def __init__(self, dtypes: Mapping[Any, Any], *, limit: int = SPILL_BYTES, rows_of: Sequence[Any] = ()):
        self.rows_of = rows_of
        self.dtypes = {key: np.dtype(dtype) for key, dtype in dtypes.items()}
        self.limit = limit
        self.rows = 0
        self._parts: dict[Any, list[NDArray[Any]]] = {key: [] for key in dtypes}
        self._spool: Spool | None = None
        self._pieces: dict[Any, tuple[list[int], list[int]]] = {key: ([0], []) for key in dtypes}

    def add(self, block: Mapping[Any, NDArray[Any]]) -> None:
        """Append one block: every column, all of one length."""
        self.rows += len(next(iter(block.values())))
        for key, values in block.items():
            self._parts[key].append(np.ascontiguousarray(values, dtype=self.dtypes[key]))
        if self._spool or self.rows * sum(dtype.itemsize for dtype in self.dtypes.values()) > self.limit:
            self._spill()

    def _spill(self) -> None:
        self._spool = self._spool or Spool()
        for key, parts in self._parts.items():
            rows, places = self._pieces[key]
            for part in parts:
                if len(part):
                    places.append(self._spool.add(part))
                    rows.append(rows[-1] + len(part))
            parts.clear()

    def finish(self) -> dict[Any, NDArray[Any] | Stored]:
        """The columns: arrays in memory, or columns in a temporary file."""
        if self._spool is None:
            matrix = np.empty((len(self.rows_of), self.rows))
            found: dict[Any, NDArray[Any] | Stored] = {}
            for key, parts in self._parts.items():
                column = matrix[self.rows_of.index(key)] if key in self.rows_of else np.empty(self.rows, self.dtypes[key])
                if parts:
                    np.concatenate(parts, out=column)
                parts.clear()
                found[key] = column
            return found
        return {key: Stored(self._spool, self.dtypes[key], *pieces) for key, pieces in self._pieces.items()}


def together(columns: Sequence[Any]) -> Any:
    """Columns as the rows of one array, numpy if they are, without a copy if they are the rows of one already."""
    if not isinstance(columns[0], np.ndarray):
        return stack_rows(columns)
    whole = columns[0].base
    same = whole is not None and whole.ndim == 2 and len(whole) == len(columns) and all(column.base is whole for column in columns)
    return whole if same else np.stack(columns)


def lazily(values: NDArray[Any] | Stored) -> Any:
    """A dask array over a column in a temporary file; an array in memory is returned as it is."""
    if not isinstance(values, Stored):
        return values
    import dask.array

    name, meta = f"gyrostab-column-{uuid.uuid4().hex}", np.empty(0, dtype=values.dtype)
    return with_fill(dask.array.from_array(values, chunks=CHUNK_ROWS, name=name, asarray=True, meta=meta), values.fill)
