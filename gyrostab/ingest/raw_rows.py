"""Axes and stamps of a raw log, read in blocks of rows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.ingest.columns.stamps import NAT, read_stamps

#: Rows of a raw log that are read at one time.
BLOCK_ROWS = 2**20


def list_axes(part: xr.Dataset) -> list[str]:
    """Return the names of the axes of a raw log; empty if it holds channels only."""
    return [str(axis) for axis in part["axis"].values] if "axis" in part.coords else []


def _stamp_blocks(part: xr.Dataset) -> Iterator[tuple[int, Ints]]:
    """Yield the stamps of a raw log [ns since 1970] in blocks, with the first row of each."""
    for begin in range(0, part.sizes["row"], BLOCK_ROWS):
        yield begin, read_stamps(part, begin, begin + BLOCK_ROWS)


def first_known_stamp(part: xr.Dataset) -> int:
    """Return the first stamp of a raw log [ns since 1970]; the largest integer without any."""
    known = (stamps[stamps != NAT] for _, stamps in _stamp_blocks(part))
    return next((int(stamps[0]) for stamps in known if stamps.size), int(np.iinfo(np.int64).max))


def stamp_span(part: xr.Dataset) -> tuple[int, int]:
    """Return the first and the latest stamp of a raw log [ns since 1970]."""
    latest = max((int(stamps.max()) for _, stamps in _stamp_blocks(part)), default=NAT)
    return first_known_stamp(part), latest  # NAT is the smallest integer


def find_first_row(part: xr.Dataset, first: int) -> int:
    """Return the row from which all stamps are `first` or later."""
    early = (
        (begin, np.flatnonzero((stamps < first) & (stamps != NAT)))
        for begin, stamps in _stamp_blocks(part)
    )
    return max((begin + int(rows[-1]) + 1 for begin, rows in early if rows.size), default=0)


def count_rows_until(part: xr.Dataset, last: int) -> int:
    """Return the number of rows before the first stamp later than `last`."""
    late = ((begin, np.flatnonzero(stamps > last)) for begin, stamps in _stamp_blocks(part))
    return next((begin + int(rows[0]) for begin, rows in late if rows.size), part.sizes["row"])
