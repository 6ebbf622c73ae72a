"""Columns of 8-byte values in pieces, packed without loss, in memory or in a temporary file.

Files are read back with `gyrostab.store.system.read_at`, not mapped: the pages of a mapped file
count as memory of this process, and their number grows as a long log is read. Each map also holds a
file handle, so hundreds of files would need thousands of handles.
"""

from __future__ import annotations

import tempfile
import threading
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OutputError
from gyrostab.store.system import read_at, write_at

__all__ = [
    "DecimalPiece",
    "EvenStampsPiece",
    "FilePiece",
    "Piece",
    "PiecewiseColumn",
    "PlainPiece",
    "Spool",
]


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
                _write_all(self.handle, values.data.cast("B"), self.end)
                begin, self.end = self.end, self.end + values.nbytes
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
        pieces = PiecewiseColumn(
            values.dtype, [PlainPiece(np.ascontiguousarray(values).view(np.int64))]
        )
        pieces.move_to(self)
        return pieces

    @property
    def handle(self) -> int:
        """File descriptor."""
        assert self.file is not None
        return self.file.fileno()


def _write_all(handle: int, view: memoryview, begin: int) -> None:
    while view.nbytes:
        count = write_at(handle, view, begin)
        view, begin = view[count:], begin + count


@dataclass(frozen=True)
class _SpooledArray:
    """An array in a spool."""

    spool: Spool
    begin: int
    size: int
    dtype: np.dtype[Any]

    def read(self, first: int, out: NDArray[Any]) -> None:
        """Read values from index `first` on into `out`."""
        wide, done = self.dtype.itemsize, 0
        view = out.data.cast("B")
        while done < view.nbytes:
            got = read_at(self.spool.handle, view[done:], self.begin + wide * first + done)
            if got < 1:
                raise OSError("the temporary file of a long log is shorter than it was")
            done += got

    def write(self, number: int, value: int) -> None:
        """Set one value."""
        write_at(
            self.spool.handle,
            np.array(value, self.dtype).tobytes(),
            self.begin + self.dtype.itemsize * number,
        )


_Values = NDArray[Any] | _SpooledArray


def _memory_bytes(kept: _Values) -> int:
    return kept.nbytes if isinstance(kept, np.ndarray) else 0


def _move_to_spool(kept: _Values, spool: Spool) -> _Values:
    return (
        _SpooledArray(spool, spool.add(kept), kept.size, kept.dtype)
        if isinstance(kept, np.ndarray) and kept.size
        else kept
    )


def _read_part(kept: _Values, first: int, size: int) -> NDArray[Any]:
    if isinstance(kept, np.ndarray):
        return kept[first : first + size]
    out = np.empty(size, kept.dtype)
    kept.read(first, out)
    return out


class Piece(Protocol):
    """Consecutive rows of a column."""

    @property
    def rows(self) -> int:
        """Number of rows."""

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece with its values moved to a spool."""

    def set_value(self, row: int, value: int) -> Piece:
        """Return the piece with the bits of one value replaced."""


@dataclass(frozen=True)
class PlainPiece:
    """Values stored as they are, by their bits."""

    words: _Values  # int64

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.words.size

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return _memory_bytes(self.words)

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        target = out.view(np.int64)
        if isinstance(self.words, np.ndarray):
            target[:] = self.words[first : first + out.size]
        else:
            self.words.read(first, target)

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece with its values moved to a spool."""
        return PlainPiece(_move_to_spool(self.words, spool))

    def set_value(self, row: int, value: int) -> Piece:
        """Return the piece with the bits of one value replaced."""
        if isinstance(self.words, np.ndarray):
            self.words[row] = value
        else:
            self.words.write(row, value)
        return self


@dataclass(frozen=True)
class DecimalPiece:
    """Decimals stored as 32-bit integers (`kernels.encoding.decimals`), converted when read."""

    counts: _Values  # int32
    tens: float
    factor: float
    offset: float

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.counts.size

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return _memory_bytes(self.counts)

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        from gyrostab.kernels.encoding.decimals import from_decimals

        from_decimals(
            _read_part(self.counts, first, out.size), self.tens, self.factor, self.offset, out
        )

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece with its values moved to a spool."""
        return DecimalPiece(_move_to_spool(self.counts, spool), self.tens, self.factor, self.offset)

    def set_value(self, row: int, value: int) -> Piece:
        """Return the piece with the bits of one value replaced."""
        return _unpack_piece(self, np.float64).set_value(row, value)


@dataclass(frozen=True)
class EvenStampsPiece:
    """Stamps stored as runs of even steps; small enough to stay in memory."""

    table: NDArray[np.int64]
    rows: int

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return self.table.nbytes

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        from gyrostab.kernels.encoding.decimals import unroll_steps

        unroll_steps(self.table, first, out.view(np.int64))

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece with its values moved to a spool."""
        return self

    def set_value(self, row: int, value: int) -> Piece:
        """Return the piece with the bits of one value replaced."""
        return _unpack_piece(self, np.int64).set_value(row, value)


@dataclass(frozen=True)
class FilePiece:
    """Values that stay in their source file and are read and converted on each access.

    Attributes
    ----------
    read : callable
        First row of the file, row after the last one -> converted values.
    begin, rows : int
        First row of the file, and number of rows.
    changes : dict
        Row of the piece -> bits of the value that replaces the stored one.
    """

    read: Callable[[int, int], NDArray[Any]]
    begin: int
    rows: int
    changes: dict[int, int] = field(default_factory=dict)

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return 0

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Read the values from row `first` on into `out`."""
        out[:] = self.read(self.begin + first, self.begin + first + out.size).view(out.dtype)
        for row, value in self.changes.items():
            if first <= row < first + out.size:
                out.view(np.int64)[row - first] = value

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece, which takes no memory."""
        return self

    def set_value(self, row: int, value: int) -> Piece:
        """Return the piece with the bits of one value replaced."""
        self.changes[row] = value
        return self


@dataclass(frozen=True)
class NaNPiece:
    """Rows without a value; they take no memory."""

    rows: int
    memory_bytes: int = 0

    def read_into(self, first: int, out: NDArray[Any]) -> None:
        """Fill `out` with NaN."""
        out[:] = np.nan

    def to_spool(self, spool: Spool) -> Piece:
        """Return the piece, which takes no memory."""
        return self

    def set_value(self, row: int, value: int) -> Piece:
        """Return the piece with the bits of one value replaced."""
        return _unpack_piece(self, np.float64).set_value(row, value)


def _unpack_piece(piece: Piece, dtype: Any) -> PlainPiece:
    values = np.empty(piece.rows, dtype)
    piece.read_into(0, values)
    return PlainPiece(values.view(np.int64))


class PiecewiseColumn:
    """A column with the few attributes that dask needs; no ``copy``, which dask would call."""

    ndim = 1

    def __init__(self, dtype: Any, pieces: Sequence[Piece]):
        self.dtype = np.dtype(dtype)
        self._pieces = [piece for piece in pieces if piece.rows]
        self._rows = np.cumsum(
            [0, *(piece.rows for piece in self._pieces)]
        ).tolist()  # first row of each piece, and the end of the last
        self.shape = (self._rows[-1],)

    def view(self, dtype: Any) -> PiecewiseColumn:
        """Return the same bytes as another type; both share their pieces."""
        same = PiecewiseColumn(dtype, ())
        same._pieces, same._rows, same.shape = self._pieces, self._rows, self.shape
        return same

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory."""
        return sum(piece.memory_bytes for piece in self._pieces)

    def find_line(self) -> tuple[int, int] | None:
        """Return first value and step if all values are evenly spaced, otherwise None."""
        if not self._pieces or not all(
            isinstance(piece, EvenStampsPiece) and len(piece.table) == 1 for piece in self._pieces
        ):
            return None
        _, first, step = (int(number) for number in self._pieces[0].table[0])  # type: ignore[attr-defined]
        for row, piece in zip(self._rows, self._pieces, strict=False):
            _, start, own = (int(number) for number in piece.table[0])  # type: ignore[attr-defined]
            if start != first + row * step or (own != step and piece.rows > 1):
                return None
        return first, step

    def move_to(self, spool: Spool) -> None:
        """Move the pieces in memory to a file."""
        self._pieces[:] = [piece.to_spool(spool) for piece in self._pieces]

    def __getitem__(self, part: Any) -> NDArray[Any]:
        rows = range(*(part[0] if isinstance(part, tuple) else part).indices(self.shape[0]))
        out = np.empty(max(rows.stop - rows.start, 0), dtype=self.dtype)
        self.read_into(0, rows.start, out)
        return out[:: rows.step]

    def read_into(self, _row: int, begin: int, out: NDArray[Any]) -> None:
        """Read the values from row `begin` of the log on into `out`."""
        done, number = 0, bisect_right(self._rows, begin) - 1
        while done < out.size:
            first = begin + done - self._rows[number]
            part = out[done : done + self._pieces[number].rows - first]
            self._pieces[number].read_into(first, part)
            done, number = done + part.size, number + 1

    def set_value(self, row: int, value: int) -> None:
        """Replace the bits of a value."""
        number = bisect_right(self._rows, row) - 1
        self._pieces[number] = self._pieces[number].set_value(row - self._rows[number], value)
