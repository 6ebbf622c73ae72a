"""Growing columns that move from memory to a temporary file when they become large."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.columns.pieces import FilePiece, Piece, PiecewiseColumn, PlainPiece, Spool
from gyrostab.store.lazy_slices import stack_rows, with_row_reader

__all__ = [
    "CHUNK_ROWS",
    "SPILL_BYTES",
    "Buffers",
    "as_lazy",
    "pieces_of",
    "set_rows",
    "stack_as_rows",
    "take_rows",
]

#: Largest total size of the columns of one file that is held in memory [bytes].
SPILL_BYTES = 128 * 2**20

#: Rows of one dask chunk of a piecewise column.
CHUNK_ROWS = 2**21

#: Largest number of values of all columns of a file for which `finish` returns plain arrays.
_MAX_PLAIN_VALUES = 2**21


def take_rows(column: NDArray[Any] | PiecewiseColumn, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return the values of a few rows."""
    if isinstance(column, PiecewiseColumn):
        return np.concatenate(
            [np.empty(0, column.dtype), *(column[row : row + 1] for row in rows.tolist())]
        )
    return np.asarray(column[rows])


def set_rows(column: NDArray[Any] | PiecewiseColumn, rows: NDArray[np.int64], value: int) -> None:
    """Set the values of a few rows."""
    if isinstance(column, PiecewiseColumn):
        for row in rows.tolist():
            column.set_value(row, value)
    else:
        column[rows] = value


class Buffers:
    """Columns of 8-byte numbers that grow block by block.

    Up to `limit` bytes they stay in memory; beyond it they are appended to a spool. Small columns
    in memory are returned as arrays, and the columns `rows_of` as the rows of one matrix.
    """

    def __init__(
        self, dtypes: Mapping[Any, Any], *, limit: int = SPILL_BYTES, rows_of: Sequence[Any] = ()
    ):
        self.rows_of = rows_of
        self.dtypes = {key: np.dtype(dtype) for key, dtype in dtypes.items()}
        self.limit = limit
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
            self._spill_to_disk()

    def _as_piece(self, key: Any, values: NDArray[Any]) -> Piece:
        whole = np.ascontiguousarray(values, dtype=self.dtypes[key])
        if isinstance(whole.base, np.ndarray) and whole.base.nbytes > whole.nbytes:
            whole = whole.copy()  # a view would keep its whole base in memory
        return PlainPiece(whole.view(np.int64))

    def _spill_to_disk(self) -> None:
        self._spool = spool = self._spool or Spool()
        for pieces in self._pieces.values():
            pieces[self._moved :] = [piece.to_spool(spool) for piece in pieces[self._moved :]]
        self._held, self._moved = 0, max(map(len, self._pieces.values()))

    def finish(self) -> dict[Any, NDArray[Any] | PiecewiseColumn]:
        """Return the columns: plain arrays if they are small, otherwise piecewise columns."""
        found: dict[Any, NDArray[Any] | PiecewiseColumn] = {}
        stays = any(
            isinstance(piece, FilePiece) for pieces in self._pieces.values() for piece in pieces
        )
        small = (
            not stays and self._spool is None and self.rows * len(self._pieces) <= _MAX_PLAIN_VALUES
        )
        matrix = np.empty((len(self.rows_of), self.rows if small else 0))
        for key, pieces in self._pieces.items():
            column = PiecewiseColumn(self.dtypes[key], pieces)
            pieces.clear()
            if small:
                plain = (
                    matrix[self.rows_of.index(key)]
                    if key in self.rows_of
                    else np.empty(self.rows, self.dtypes[key])
                )
                column.read_into(0, 0, plain)
                found[key] = plain
            else:
                found[key] = column
        return found


def stack_as_rows(columns: Sequence[Any]) -> Any:
    """Stack columns as the rows of one array, without a copy if they already share one matrix."""
    if not isinstance(columns[0], np.ndarray):
        stacked = stack_rows(columns)
        stacked.gyrostab_pieces = [pieces for column in columns for pieces in pieces_of(column)]
        return stacked
    whole = columns[0].base
    same = (
        whole is not None
        and whole.ndim == 2
        and len(whole) == len(columns)
        and all(column.base is whole for column in columns)
    )
    return whole if same else np.stack(columns)


def as_lazy(values: NDArray[Any] | PiecewiseColumn) -> Any:
    """Wrap a piecewise column in a dask array; return an array in memory unchanged."""
    if not isinstance(values, PiecewiseColumn):
        return values
    import dask.array

    name, meta = f"gyrostab-column-{uuid.uuid4().hex}", np.empty(0, dtype=values.dtype)
    lazy = with_row_reader(
        dask.array.from_array(values, chunks=CHUNK_ROWS, name=name, asarray=True, meta=meta),
        values.read_into,
    )
    lazy.gyrostab_pieces = [values]
    lazy.gyrostab_line = values.find_line()
    return lazy


def pieces_of(array: Any) -> list[PiecewiseColumn]:
    """Return the piecewise columns that an array of `as_lazy` or `stack_as_rows` reads."""
    return list(getattr(array, "gyrostab_pieces", ()))
