"""Scan a raw log in one pass: rows with a sample, unreadable cells, filled rows of channels."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Bools, Ints
from gyrostab.errors import FormatError
from gyrostab.ingest.columns.stamps import read_stamps
from gyrostab.ingest.grid.starting_period import Block
from gyrostab.ingest.uniform.core import merge_spans
from gyrostab.schema import texts
from gyrostab.store.lazy import read_slice
from gyrostab.store.threads import map_in_order

#: Rows in memory at one time.
BLOCK_ROWS = 1 << 20


@dataclass
class ScanPass:
    """Findings of one pass over a raw log."""

    row_count: int  # of the raw log
    present_bits: NDArray[np.uint8]  # one bit a row: whether any axis has a number
    absent_count: int  # rows without any number
    #: (n, 2): half-open spans of present rows in which an axis is NaN, or infinite.
    unreadable: Ints
    infinite: Ints
    constant: list[str]  # axes whose value never changes
    empty: list[str]  # axes without a number
    #: Channel on ``row`` -> number of rows with a value.
    filled_counts: dict[str, int] = field(default_factory=dict)
    repeated_count: int = 0  # rows that repeat others

    @property
    def present_count(self) -> int:
        """Number of rows with a number, including repetitions."""
        return self.row_count - self.absent_count

    def leave_out(self, rows: Ints) -> None:
        """Mark rows as repetitions, which hold no new sample."""
        bits = (128 >> rows % 8).astype(np.uint8)
        self.repeated_count += int(np.count_nonzero(self.present_bits[rows // 8] & bits))
        np.bitwise_and.at(self.present_bits, rows // 8, ~bits)

    def mask(self, begin: int, end: int) -> Bools:
        """Return which of the rows `begin` to `end` hold a sample."""
        bits = np.unpackbits(self.present_bits[begin // 8 : -(-end // 8)])
        return bits[begin % 8 : begin % 8 + end - begin].astype(bool)


def _scan_block(
    raw: xr.Dataset, name: str, channels: Sequence[str], ends: tuple[int, int]
) -> tuple[Any, ...]:
    """Return what rows hold.

    These are: presence as bits, absent rows, spans of unreadable and infinite cells, the range of
    each axis, and the filled rows of each channel.
    """
    cells = np.asarray(read_slice(raw[name].data, *ends), dtype=np.float64)
    is_nan, is_infinite = np.isnan(cells), np.isinf(cells)
    present, infinite = ~is_nan.all(axis=0), is_infinite.any(axis=0)
    finite = np.where(is_infinite, np.nan, cells) if infinite.any() else cells
    return (
        np.packbits(present),
        present.size - int(np.count_nonzero(present)),
        find_spans(is_nan.any(axis=0) & present, ends[0]),
        find_spans(infinite, ends[0]),
        np.fmin.reduce(finite, axis=1, initial=np.inf),
        np.fmax.reduce(finite, axis=1, initial=-np.inf),
        [int(np.isfinite(read_slice(raw[key].data, *ends)).sum()) for key in channels],
    )


def find_spans(bad: Any, offset: int) -> Ints:
    """Return the half-open spans in which `bad` is true, as rows from `offset` on."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]])))
    return np.asarray(edges.reshape(-1, 2) + offset, dtype=np.int64)


def scan_rows(raw: xr.Dataset, name: str) -> ScanPass:
    """Scan every cell of a raw log once; `FormatError` when no row holds a number."""
    rows = raw.sizes["row"]
    block = BLOCK_ROWS // 8 * 8
    channels = [str(key) for key, variable in raw.data_vars.items() if variable.dims == ("row",)]
    spans = ((begin, min(rows, begin + block)) for begin in range(0, max(rows, 1), block))
    blocks = map_in_order(partial(_scan_block, raw, name, channels), spans)
    bits, missing, unreadable, infinite, lows, highs, filled = zip(*blocks, strict=True)
    absent, low, high = sum(missing), np.min(lows, axis=0), np.max(highs, axis=0)
    if rows == 0 or absent == rows or not np.any(low <= high):
        raise FormatError(
            f"{', '.join(_source_names(raw))}: none of the {rows} rows holds a number for any "
            "gyro axis; check the columns, the units and --map"
        )
    ranges = list(zip(map(str, raw["axis"].values), low, high, strict=True))
    return ScanPass(
        rows,
        np.concatenate(bits),
        absent,
        merge_spans(unreadable),
        merge_spans(infinite),
        [axis for axis, least, most in ranges if least == most and rows - absent > 1],
        [axis for axis, least, most in ranges if least > most],
        dict(zip(channels, np.sum(filled, axis=0, dtype=int).tolist(), strict=True)),
    )


def stamp_blocks(raw: xr.Dataset, scanned: ScanPass, *, all_rows: bool = False) -> Iterator[Block]:
    """Yield row numbers and stamps [ns] (or `NO_STAMP`) of rows with a sample, in blocks."""

    def read_block(begin: int) -> Block:
        end = min(scanned.row_count, begin + BLOCK_ROWS)
        values = read_stamps(raw, begin, end)
        if not scanned.repeated_count and (all_rows or scanned.absent_count == 0):
            return np.arange(begin, end), values
        keep = scanned.mask(begin, end)
        return np.flatnonzero(keep) + begin, values[keep]

    return map_in_order(read_block, range(0, scanned.row_count, BLOCK_ROWS), workers=1)


def _source_names(raw: xr.Dataset) -> list[str]:
    return texts(raw, "source_files") or ["the raw log"]


def record_name(raw: xr.Dataset) -> str:
    """Return the source file of a record, or the first one and the number of the others."""
    first, *other_files = dict.fromkeys(_source_names(raw))
    if not other_files:
        return first
    return f"{first} and {len(other_files)} more file{'s' * (len(other_files) > 1)}"


def file_of(raw: xr.Dataset, row: int = 0) -> tuple[str, int]:
    """Return the source file of a row, and the number of the row in it, from 0."""
    names = _source_names(raw)
    starts = [int(start) for start in np.atleast_1d(raw.attrs.get("row_start", 0))]
    if len(starts) != len(names):
        return ", ".join(names), row
    which = max(0, bisect_right(starts, row) - 1)
    return names[which], row - starts[which]
