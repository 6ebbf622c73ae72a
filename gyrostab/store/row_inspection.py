"""Inspection of a block of rows: rows with samples, cells without a number, filled channels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyrostab.kernels.grid.stamps import scan_cells

_NO_SPANS = np.empty((0, 2), dtype=np.int64)


class RowInspection(NamedTuple):
    """Result of the inspection of some rows."""

    #: Number of rows, and of rows without any number.
    rows: int
    absent: int
    bits: NDArray[np.uint8]  # one bit per row: whether some axis has a number
    #: (n, 2): half-open spans of present rows in which an axis is NaN or infinite.
    unreadable: NDArray[np.int64]
    infinite: NDArray[np.int64]
    #: (n_axes,): range of the finite values.
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    filled: dict[str, int]  # number of rows with a number, by channel


def inspect_rows(
    cells: NDArray[np.float64], channels: Mapping[str, NDArray[Any]], begin: int
) -> RowInspection:
    """Inspect every cell of a block once.

    Parameters
    ----------
    cells : ndarray, shape (n_axes, n)
        Values by axis and row.
    begin : int
        Row of the log at which the block begins.
    """
    present = np.empty(cells.shape[1], dtype=bool)
    absent, holes, infinities, low, high = scan_cells(
        np.ascontiguousarray(cells, dtype=np.float64), present
    )
    unreadable = find_spans(np.isnan(cells).any(axis=0) & present, begin) if holes else _NO_SPANS
    infinite = find_spans(np.isinf(cells).any(axis=0), begin) if infinities else _NO_SPANS
    filled = {name: int(np.isfinite(values).sum()) for name, values in channels.items()}
    return RowInspection(
        present.size, absent, np.packbits(present), unreadable, infinite, low, high, filled
    )


def find_spans(bad: Any, offset: int) -> NDArray[np.int64]:
    """Return the half-open spans in which `bad` is true, as rows from `offset` on."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]])))
    return np.asarray(edges.reshape(-1, 2) + offset, dtype=np.int64)
