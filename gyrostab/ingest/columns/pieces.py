"""Growing columns of 8-byte values in pieces, packed without loss, in memory or on disk.

Files are read back with `gyrostab.store.system.read_at`, not mapped: the pages of a mapped file
count as memory of this process, and their number grows as a long log is read. Each map also holds a
file handle, so hundreds of files would need thousands of handles.
"""

from __future__ import annotations

import tempfile
import threading
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OutputError
from gyrostab.store.lazy import RowSource, Stacked, find_source, make_dask
from gyrostab.store.row_inspection import RowInspection
from gyrostab.store.system import read_at, write_at

#: Largest total size of the columns of one file that is held in memory [bytes].
SPILL_BYTES = 128 * 2**20

#: Rows of one dask chunk of a piecewise column.
CHUNK_ROWS = 2**21

#: Largest number of values of all columns of a file for which `finish` returns plain arrays.
_MAX_PLAIN_VALUES = 2**21


class Spool:
    """An unlinked temporary file, which the system removes with the last reference to it."""

    def __init__(self) -> None:
        self.file: IO[bytes] | None = None
        self.end = 0
        self._lock = threading.Lock()

    def add(self, values: NDArray[Any]) -> int:
        """Append an array and return its byte offset."""
        try:
            with self._lock:
                if self.file is None:
                    self.file = tempfile.TemporaryFile(prefix="gyrostab-", buffering=0)  # noqa: SIM115
                begin, view = self.end, values.data.cast("B")
                while view.nbytes:
                    count = write_at(self.handle, view, self.end)
                    view, self.end = view[count:], self.end + count
                return begin
        except OSError as error:
            where = tempfile.gettempdir()
            raise OutputError(
                f"{where}: the columns of a long log are kept there while it is read, and cannot "
                f"be written ({error.strerror}); "
                "make room, or name a larger place in the environment variable TMPDIR"
            ) from error

    def store(self, values: NDArray[Any]) -> PiecewiseColumn:
        """Write a column to the file and return it as a piecewise column."""
        piece = PlainPiece(np.ascontiguousarray(values).view(np.int64)).to_spool(self)
        return PiecewiseColumn(values.dtype, [piece])

    @property
    def handle(self) -> int:
        """File descriptor."""
        assert self.file is not None
        return self.file.fileno()


@dataclass(frozen=True)
class _SpooledArray:
    """An array in a spool, which takes no memory."""

    spool: Spool
    begin: int
    size: int
    dtype: np.dtype[Any]
    nbytes: int = 0

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        out = np.empty(rows.stop - rows.start, self.dtype)
        self.read_into(rows.start, out)
        return out

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`, which is contiguous."""
        begin, view, done = self.begin + self.dtype.itemsize * first, out.data.cast("B"), 0
        while done < view.nbytes:
            got = read_at(self.spool.handle, view[done:], begin + done)
            if got < 1:
                raise OSError("the temporary file of a long log is shorter than it was")
            done += got


class Piece:
    """Consecutive rows of a column; takes no memory unless a subclass says so."""

    rows: int

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return 0

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        raise NotImplementedError

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece with its values moved to a spool."""
        return self


@dataclass(frozen=True)
class PlainPiece(Piece):
    """Values stored as they are, by their bits (int64)."""

    values: NDArray[Any] | _SpooledArray

    @property
    def rows(self) -> int:  # type: ignore[override]
        """Number of rows."""
        return self.values.size

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return self.values.nbytes

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        bits = out.view(np.int64)
        if isinstance(self.values, _SpooledArray) and bits.flags.c_contiguous:
            self.values.read_into(first, bits)
        else:
            bits[:] = self.values[first : first + out.size]

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece with its values moved to a spool."""
        if not isinstance(self.values, np.ndarray) or not self.values.size:
            return self
        begin = spool.add(self.values)
        return replace(
            self, values=_SpooledArray(spool, begin, self.values.size, self.values.dtype)
        )


@dataclass(frozen=True)
class CountsPiece(PlainPiece):
    """Values on a grid, stored as 32-bit counts, converted when read."""

    grid: tuple[float, float]
    factor: float
    offset: float

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        from gyrostab.kernels.encoding.compact import unpack_counts

        counts = self.values[first : first + out.size]
        unpack_counts(counts, *self.grid, self.factor, self.offset, out)


@dataclass(frozen=True)
class EvenStampsPiece(Piece):
    """Stamps stored as runs of even steps; small enough to stay in memory."""

    table: NDArray[np.int64]
    rows: int

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return self.table.nbytes

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        from gyrostab.kernels.encoding.compact import unroll_steps

        unroll_steps(self.table, first, out.view(np.int64))


@dataclass(frozen=True)
class FilePiece(Piece):
    """Values that stay in their source file, from row `begin` on.

    `read` takes the first row of the file and the row after the last one, and returns converted
    values.
    """

    read: Callable[[int, int], NDArray[Any]]
    begin: int
    rows: int

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        out[:] = self.read(self.begin + first, self.begin + first + out.size).view(out.dtype)


class PiecewiseColumn(RowSource):
    """A column in pieces, as a lazy source.

    Values of single rows can be replaced: `changed` lists these rows in order, and `value` holds
    the bits of all of them.
    """

    def __init__(self, dtype: Any, pieces: Sequence[Piece]):
        self.dtype = np.dtype(dtype)
        self._pieces = [piece for piece in pieces if piece.rows]
        self._rows = np.cumsum(
            [0, *(piece.rows for piece in self._pieces)]
        ).tolist()  # first row of each piece, and the end of the last
        self.shape = (self._rows[-1],)
        self.changed, self.value = np.empty(0, np.int64), 0

    def view(self, dtype: Any) -> PiecewiseColumn:
        """Return the same bytes as another type; both share their pieces."""
        same = PiecewiseColumn(dtype, ())
        same.__dict__.update({**self.__dict__, "dtype": np.dtype(dtype)})
        return same

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return sum(piece.memory_bytes for piece in self._pieces)

    def find_line(self) -> tuple[int, int] | None:
        """Return first value and step if all values are evenly spaced, otherwise None."""
        lines = [
            (row, piece.rows, *piece.table[0, 1:].tolist())
            for row, piece in zip(self._rows, self._pieces, strict=False)
            if isinstance(piece, EvenStampsPiece) and len(piece.table) == 1
        ]
        if not lines or len(lines) < len(self._pieces) or len(self.changed):
            return None
        _, _, first, step = lines[0]
        even = all(
            start == first + row * step and (piece_step == step or rows == 1)
            for row, rows, start, piece_step in lines
        )
        return (first, step) if even else None

    def move_to(self, spool: Spool) -> None:
        """Move the pieces in memory to a file."""
        self._pieces[:] = [piece.to_spool(spool) for piece in self._pieces]

    def read_into(self, row: int, begin: int, out: NDArray[Any]) -> None:
        """Read samples of one row from `begin` on into `out`."""
        done, number = 0, bisect_right(self._rows, begin) - 1
        while done < out.size:
            first = begin + done - self._rows[number]
            part = out[done : done + self._pieces[number].rows - first]
            self._pieces[number].read_into(first, part)
            done, number = done + part.size, number + 1
        low, high = np.searchsorted(self.changed, [begin, begin + out.size])
        if high > low:
            out.view(np.int64)[self.changed[low:high] - begin] = self.value

    def take_rows(self, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Return the values of rows in ascending order, read in blocks."""
        values = np.empty(len(rows), self.dtype)
        for begin in range(0, self.shape[0], CHUNK_ROWS):
            low, high = np.searchsorted(rows, [begin, begin + CHUNK_ROWS])
            if high > low:
                first = rows[low]
                values[low:high] = self[first : rows[high - 1] + 1][rows[low:high] - first]
        return values


class Buffers:
    """Columns of 8-byte numbers that grow block by block.

    Up to `SPILL_BYTES` they stay in memory; beyond it they are appended to a spool. Small columns
    in memory are returned as arrays.
    """

    def __init__(self, dtypes: Mapping[Any, Any]):
        self.dtypes = {key: np.dtype(dtype) for key, dtype in dtypes.items()}
        self.limit = SPILL_BYTES
        self.rows = 0
        self._pieces: dict[Any, list[Piece]] = {key: [] for key in dtypes}
        self._spool: Spool | None = None
        self._held = self._moved = 0  # bytes in memory; pieces of each column that were spilled

    def add(self, block: Mapping[Any, NDArray[Any] | Piece]) -> None:
        """Append one block, in which all columns have the same length."""
        size = 0
        for key, values in block.items():
            piece = self._as_piece(key, values) if isinstance(values, np.ndarray) else values
            self._pieces[key].append(piece)
            self._held += piece.memory_bytes
            size = piece.rows
        self.rows += size
        if self._spool or self._held > self.limit:
            self._spool = spool = self._spool or Spool()
            for pieces in self._pieces.values():
                pieces[self._moved :] = [piece.to_spool(spool) for piece in pieces[self._moved :]]
            self._held, self._moved = 0, max(map(len, self._pieces.values()))

    def _as_piece(self, key: Any, values: NDArray[Any]) -> Piece:
        plain = np.ascontiguousarray(values, dtype=self.dtypes[key])
        if isinstance(plain.base, np.ndarray) and plain.base.nbytes > plain.nbytes:
            plain = plain.copy()  # a view would keep its whole base in memory
        return PlainPiece(plain.view(np.int64))

    def finish(self) -> dict[Any, NDArray[Any] | PiecewiseColumn]:
        """Return the columns: plain arrays if they are small, otherwise piecewise columns."""
        columns = {
            key: PiecewiseColumn(self.dtypes[key], pieces) for key, pieces in self._pieces.items()
        }
        stays = any(
            isinstance(piece, FilePiece) for pieces in self._pieces.values() for piece in pieces
        )
        self._pieces.clear()
        if stays or self._spool is not None or self.rows * len(columns) > _MAX_PLAIN_VALUES:
            return dict(columns)
        return {key: column[:] for key, column in columns.items()}


class InspectedRows(Stacked):
    """Columns as rows, with the inspections of their blocks, which save a second pass."""

    def __init__(self, rows: Sequence[Any], inspections: Sequence[RowInspection]):
        super().__init__(rows)
        self.inspections = tuple(inspections)


def as_lazy(values: NDArray[Any] | PiecewiseColumn) -> Any:
    """Wrap a piecewise column in a dask array; return an array in memory unchanged."""
    return make_dask(values, CHUNK_ROWS) if isinstance(values, PiecewiseColumn) else values


def pieces_of(array: Any) -> list[PiecewiseColumn]:
    """Return the piecewise columns that a lazy array reads."""
    source = find_source(array)
    if isinstance(source, PiecewiseColumn):
        return [source]
    return [] if source is None else [column for part in source.parts for column in pieces_of(part)]
