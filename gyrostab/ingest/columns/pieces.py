"""Growing columns of 8-byte values, in memory as arrays or on disk in pieces.

Files are read back, not mapped: the pages of a mapped file count as memory of this process, and
their number grows as a long log is read. Each map also holds a file handle, so hundreds of files
would need thousands of handles.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.arrays import Array
from gyrostab.errors import OutputError
from gyrostab.store.lazy import RowSource, concatenate_columns

#: Largest total size of the columns of one file that is held in memory [bytes].
SPILL_BYTES = 64 * 2**20

#: Rows of one dask chunk of a column in pieces.
CHUNK_ROWS = 2**21


class Spool:
    """An unlinked temporary file, which the system removes with the last reference to it."""

    def __init__(self) -> None:
        self.end = 0
        self._lock = threading.Lock()

    @cached_property
    def _opened_file(self) -> Any:
        return tempfile.TemporaryFile(prefix="gyrostab-", buffering=0)

    def store(self, values: Array) -> SpooledPiece:
        """Append a column of 8-byte values to the file."""
        plain = np.ascontiguousarray(values)
        try:
            with self._lock:
                begin, view = self.end, plain.view(np.uint8).data
                self._opened_file.seek(begin)
                while view.nbytes:
                    count = self._opened_file.write(view)
                    view, self.end = view[count:], self.end + count
        except OSError as error:
            where = tempfile.gettempdir()
            raise OutputError(
                f"{where}: the columns of a long log are kept there while it is read, and cannot "
                f"be written ({error.strerror}); "
                "make room, or name a larger place in the environment variable TMPDIR"
            ) from error
        return SpooledPiece(self, begin, plain.shape, plain.dtype)

    def read_into(self, begin: int, out: Array) -> None:
        """Read the bytes of a contiguous array from an offset on; threads take turns."""
        view = out.view(np.uint8).data
        with self._lock:
            self._opened_file.seek(begin)
            while view.nbytes:
                got = self._opened_file.readinto(view)
                if not got:
                    raise OSError("the temporary file of a long log is shorter than it was")
                view = view[got:]


class SpooledPiece(RowSource):
    """Rows of a column in a spool, which take no memory."""

    def __init__(self, spool: Spool, begin: int, shape: tuple[int, ...], dtype: np.dtype[Any]):
        self.spool, self.begin = spool, begin  # the byte at which the values begin
        self.shape, self.dtype = shape, dtype

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read the values from `begin` on into `out`."""
        line = out if out.flags.c_contiguous else np.empty_like(out)
        self.spool.read_into(self.begin + 8 * begin, line)
        if line is not out:
            out[:] = line


class EvenPiece(RowSource):
    """Rows of stamps at even steps [ns]."""

    dtype = np.dtype("datetime64[ns]")

    def __init__(self, first: int, step: int, size: int):
        self.first, self.step, self.shape = first, step, (size,)

    def read_into(self, row: int, begin: int, out: Array) -> None:
        """Read the values from `begin` on into `out`."""
        out.view(np.int64)[:] = self.first + self.step * np.arange(begin, begin + out.size)


#: Consecutive rows of a column.
Piece = Array | SpooledPiece | EvenPiece


def find_even(stamps: NDArray[np.datetime64]) -> NDArray[np.datetime64] | EvenPiece:
    """Return stamps as an `EvenPiece` if their steps are even, otherwise unchanged.

    Examples
    --------
    >>> piece = find_even(np.array([5, 10, 15], dtype="datetime64[ns]"))
    >>> piece.first, piece.step, piece.shape
    (5, 5, (3,))
    """
    bits = stamps.view(np.int64)
    steps = np.diff(bits)
    step = int(steps[0]) if steps.size else 0
    return stamps if (steps != step).any() else EvenPiece(int(bits[0]), step, bits.size)


def find_line(pieces: Sequence[Any]) -> tuple[int, int] | None:
    """Return first value and step if pieces are stamps that are evenly spaced, otherwise None."""
    lines = [piece for piece in pieces if isinstance(piece, EvenPiece)]
    if not lines or len(lines) < len(pieces):
        return None
    first, step, row = lines[0].first, lines[0].step, 0
    for line in lines:
        if line.first != first + row * step or (line.step != step and line.shape != (1,)):
            return None
        row += line.shape[0]
    return first, step


class Buffers:
    """Columns of 8-byte numbers that grow block by block.

    Up to `SPILL_BYTES` they stay in memory; beyond it they are appended to a spool.
    """

    def __init__(self, dtypes: Mapping[Any, Any]):
        self.dtypes = {key: np.dtype(dtype) for key, dtype in dtypes.items()}
        self.rows = 0
        self._pieces: dict[Any, list[Piece]] = {key: [] for key in dtypes}
        self._spool: Spool | None = None
        self._held = 0  # bytes in memory

    def add(self, block: Mapping[Any, Array | EvenPiece]) -> None:
        """Append one block, in which all columns have the same length."""
        for key, values in block.items():
            self._pieces[key].append(
                self._as_piece(key, values) if isinstance(values, np.ndarray) else values
            )
        self.rows += next(iter(block.values())).shape[0] if block else 0
        if self._spool is None and self._held > SPILL_BYTES:
            self._spool = spool = Spool()
            for column in self._pieces.values():
                column[:] = [
                    spool.store(piece) if isinstance(piece, np.ndarray) else piece
                    for piece in column
                ]

    def _as_piece(self, key: Any, values: Array) -> Array | SpooledPiece:
        plain = np.ascontiguousarray(values, dtype=self.dtypes[key])
        if self._spool is not None:
            return self._spool.store(plain)
        if isinstance(plain.base, np.ndarray) and plain.base.nbytes > plain.nbytes:
            plain = plain.copy()  # a view would keep its whole base in memory
        self._held += plain.nbytes
        return plain

    def finish(self) -> dict[Any, Any]:
        """Return the columns: arrays if they are in memory, otherwise lazy arrays.

        Stamps at even steps stay pieces if the log is long, as these take no memory.
        """
        columns = {}
        for key in list(self._pieces):
            pieces = self._pieces.pop(key)
            is_line = self.rows > CHUNK_ROWS and find_line(pieces) is not None
            if self._spool is None and not is_line:
                pieces = [piece[:] for piece in pieces]
            columns[key] = concatenate_columns(pieces, CHUNK_ROWS)
        return columns
