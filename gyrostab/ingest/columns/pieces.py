"""Growing columns of 8-byte values, in memory as arrays or on disk in pieces.

Files are read back, not mapped: the pages of a mapped file count as memory of this process, and
their number grows as a long log is read. Each map also holds a file handle, so hundreds of files
would need thousands of handles.
"""

from __future__ import annotations

import tempfile
import threading
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import OutputError
from gyrostab.store.lazy import RowSource, make_dask

#: Largest total size of the columns of one file that is held in memory [bytes].
SPILL_BYTES = 64 * 2**20

#: Rows of one dask chunk of a piecewise column.
CHUNK_ROWS = 2**21


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
                self.file.seek(begin)
                while view.nbytes:
                    count = self.file.write(view)
                    view, self.end = view[count:], self.end + count
                return begin
        except OSError as error:
            where = tempfile.gettempdir()
            raise OutputError(
                f"{where}: the columns of a long log are kept there while it is read, and cannot "
                f"be written ({error.strerror}); "
                "make room, or name a larger place in the environment variable TMPDIR"
            ) from error

    def read_into(self, begin: int, out: NDArray[Any]) -> None:
        """Read the bytes of a contiguous array from an offset on; threads take turns."""
        assert self.file is not None
        view = out.data.cast("B")
        with self._lock:
            self.file.seek(begin)
            while view.nbytes:
                got: int = self.file.readinto(view)  # type: ignore[attr-defined]
                if not got:
                    raise OSError("the temporary file of a long log is shorter than it was")
                view = view[got:]

    def store(self, values: NDArray[Any]) -> PiecewiseColumn:
        """Write a column to the file and return it as a piecewise column."""
        bits = np.ascontiguousarray(values).view(np.int64)
        return PiecewiseColumn(values.dtype, [_move_to_spool(bits, self)])


@dataclass(frozen=True)
class SpooledPiece:
    """Rows of a column in a spool, which take no memory."""

    spool: Spool
    begin: int  # byte of the first row
    size: int

    def read_into(self, first: int, out: NDArray[np.int64]) -> None:
        """Read the values from row `first` on into `out`."""
        line = out if out.flags.c_contiguous else np.empty(out.size, np.int64)
        self.spool.read_into(self.begin + 8 * first, line)
        if line is not out:
            out[:] = line


@dataclass(frozen=True)
class EvenPiece:
    """Rows of stamps at even steps."""

    first: int
    step: int
    size: int

    def read_into(self, first: int, out: NDArray[np.int64]) -> None:
        """Read the values from row `first` on into `out`."""
        out[:] = self.first + self.step * np.arange(first, first + out.size)


#: Consecutive rows of a column, by their bits (int64).
Piece = NDArray[np.int64] | SpooledPiece | EvenPiece


def _move_to_spool(piece: Piece, spool: Spool) -> Piece:
    """Return a piece with the values that are in memory moved to a spool."""
    if not isinstance(piece, np.ndarray) or not piece.size:
        return piece
    return SpooledPiece(spool, spool.add(piece), piece.size)


def find_even(stamps: NDArray[np.datetime64]) -> NDArray[np.datetime64] | EvenPiece:
    """Return stamps as an `EvenPiece` if their steps are even, otherwise unchanged.

    Examples
    --------
    >>> find_even(np.array([5, 10, 15], dtype="datetime64[ns]"))
    EvenPiece(first=5, step=5, size=3)
    """
    bits = stamps.view(np.int64)
    steps = np.diff(bits)
    step = int(steps[0]) if steps.size else 0
    return stamps if (steps != step).any() else EvenPiece(int(bits[0]), step, bits.size)


class PiecewiseColumn(RowSource):
    """A column in pieces, as a lazy source."""

    def __init__(self, dtype: Any, pieces: Sequence[Piece]):
        self.dtype = np.dtype(dtype)
        self._pieces = [piece for piece in pieces if piece.size]
        self._rows = np.cumsum(
            [0, *(piece.size for piece in self._pieces)]
        ).tolist()  # first row of each piece, and the end of the last
        self.shape = (self._rows[-1],)

    def find_line(self) -> tuple[int, int] | None:
        """Return first value and step if all values are evenly spaced, otherwise None."""
        lines = [piece for piece in self._pieces if isinstance(piece, EvenPiece)]
        if not lines or len(lines) < len(self._pieces):
            return None
        first, step = lines[0].first, lines[0].step
        is_even = all(
            line.first == first + row * step and (line.step == step or line.size == 1)
            for row, line in zip(self._rows, lines, strict=False)
        )
        return (first, step) if is_even else None

    def read_into(self, row: int, begin: int, out: NDArray[Any]) -> None:
        """Read samples of one row from `begin` on into `out`."""
        bits, done, number = out.view(np.int64), 0, bisect_right(self._rows, begin) - 1
        while done < out.size:
            piece, first = self._pieces[number], begin + done - self._rows[number]
            part = bits[done : done + piece.size - first]
            if isinstance(piece, np.ndarray):
                part[:] = piece[first : first + part.size]
            else:
                piece.read_into(first, part)
            done, number = done + part.size, number + 1


class Buffers:
    """Columns of 8-byte numbers that grow block by block.

    Up to `SPILL_BYTES` they stay in memory; beyond it they are appended to a spool.
    """

    def __init__(self, dtypes: Mapping[Any, Any]):
        self.dtypes = {key: np.dtype(dtype) for key, dtype in dtypes.items()}
        self.limit = SPILL_BYTES
        self.rows = 0
        self._pieces: dict[Any, list[Piece]] = {key: [] for key in dtypes}
        self._spool: Spool | None = None
        self._held = 0  # bytes in memory

    def add(self, block: Mapping[Any, NDArray[Any] | EvenPiece]) -> None:
        """Append one block, in which all columns have the same length."""
        pieces: dict[Any, Piece] = {
            key: self._as_piece(key, values) if isinstance(values, np.ndarray) else values
            for key, values in block.items()
        }
        self.rows += next(iter(pieces.values())).size if pieces else 0
        self._held += sum(
            piece.nbytes for piece in pieces.values() if isinstance(piece, np.ndarray)
        )
        for key, piece in pieces.items():
            self._pieces[key].append(
                piece if self._spool is None else _move_to_spool(piece, self._spool)
            )
        if self._spool is None and self._held > self.limit:
            self._spool = spool = Spool()
            for column in self._pieces.values():
                column[:] = [_move_to_spool(piece, spool) for piece in column]

    def _as_piece(self, key: Any, values: NDArray[Any]) -> NDArray[np.int64]:
        plain = np.ascontiguousarray(values, dtype=self.dtypes[key])
        if isinstance(plain.base, np.ndarray) and plain.base.nbytes > plain.nbytes:
            plain = plain.copy()  # a view would keep its whole base in memory
        return plain.view(np.int64)

    def finish(self) -> dict[Any, NDArray[Any] | PiecewiseColumn]:
        """Return the columns: arrays if they are in memory, otherwise piecewise columns.

        Of a long log, stamps at even steps stay a piecewise column, which takes no memory.
        """
        columns: dict[Any, NDArray[Any] | PiecewiseColumn] = {}
        for key, dtype in self.dtypes.items():
            column = PiecewiseColumn(dtype, self._pieces.pop(key))
            is_line = self.rows > CHUNK_ROWS and column.find_line() is not None
            columns[key] = column[:] if self._spool is None and not is_line else column
        return columns


def as_lazy(values: NDArray[Any] | PiecewiseColumn) -> Any:
    """Wrap a piecewise column in a dask array; return an array in memory unchanged."""
    return make_dask(values, CHUNK_ROWS) if isinstance(values, PiecewiseColumn) else values
