"""Parse text cells to numbers and stamps, with a kernel, with pyarrow, or cell by cell."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.ingest.columns.plan import Plan
from gyrostab.ingest.columns.stamps import NAT, TimeUnit, cells_to_ns, integers_to_ns
from gyrostab.ingest.options import ReadOptions
from gyrostab.ingest.text.layout import BLANK, Layout, is_number, split_line

__all__ = ["VOID_CELLS", "CellTypes", "parse_cells", "parse_fast", "parse_plain", "stamp_types"]

#: Cells without a value; other text is unreadable.
VOID_CELLS = ("", "nan", "NaN", "NAN", "-nan", "null", "NULL", "NA", "N/A", "None")
_VOID_WORDS = frozenset(word.lower() for word in VOID_CELLS)

Parsed = tuple[dict[int, NDArray[np.float64]], NDArray[np.int64] | None]


@dataclass
class CellTypes:
    """Types of the columns of one file; `stamp` is the index in `stamp_types` to try first."""

    layout: Layout
    plan: Plan
    options: ReadOptions
    stamp_types: tuple[Any, ...]
    stamp: int = 0
    sources: list[int] = field(init=False)
    gyro: frozenset[int] = field(init=False)
    time: int | None = field(init=False)
    digits: int = field(init=False)

    def __post_init__(self) -> None:
        self.sources = [column.source for column in self.plan.columns if column.role != "time"]
        self.gyro = frozenset(column.source for column in self.plan.of("gyro"))
        self.time = self.plan.time.source if self.plan.time else None
        unit = self.unit
        self.digits = (
            unit.digits if unit is not None and unit.digits is not None and unit.digits <= 9 else 0
        )

    @property
    def unit(self) -> TimeUnit | None:
        """Unit of a numeric time column, None for ISO 8601."""
        return self.plan.time.time_unit if self.plan.time else None


def parse_plain(block: bytes, start: int, rows: int, cell_types: CellTypes) -> tuple[Parsed, int]:
    """Parse up to `rows` plain rows from byte `start` on; also return where they end."""
    from gyrostab.kernels.encoding.rows import BLANKS, ISO, NUMBER, NUMERIC_TIME, SKIPPED, read_rows

    layout = cell_types.layout
    roles = np.full(layout.width, SKIPPED, dtype=np.int64)
    roles[cell_types.sources] = NUMBER
    if cell_types.time is not None:
        roles[cell_types.time] = NUMERIC_TIME if cell_types.unit else ISO
    separator = BLANKS if layout.separator == BLANK else ord(layout.separator)
    point = ord("," if layout.decimal_comma else ".")
    text = np.frombuffer(block, dtype=np.uint8)
    numbers, stamps, stop = read_rows(
        text, start, roles, separator=separator, point=point, digits=cell_types.digits, rows=rows
    )
    values = dict(zip(sorted(cell_types.sources), numbers, strict=True))
    return (values, None if cell_types.time is None else _since_epoch(stamps, cell_types)), stop


def _since_epoch(counts: NDArray[np.int64], cell_types: CellTypes) -> NDArray[np.int64]:
    """Convert counts of nanoseconds or of a non-decimal unit to stamps [ns since 1970]."""
    unit = cell_types.unit
    if unit is None:
        return counts
    if unit.digits is None or unit.ns != 10**cell_types.digits:
        return np.where(
            counts == NAT, NAT, integers_to_ns(counts, unit, cell_types.options.epoch_ns)
        )
    zero = cell_types.options.epoch_ns if unit.epoch is None else unit.epoch
    return (
        counts
        if zero == 0
        else np.where((counts != NAT) & _sum_fits(counts, zero), counts + np.int64(zero), NAT)
    )


def stamp_types(layout: Layout, plan: Plan) -> tuple[Any, ...]:
    """Return the pyarrow types to try for the time column, fastest first; all are exact.

    Whole numbers are int64. Decimals are decimal128 with digits down to a nanosecond, then with
    more digits, for texts like ``0.35000000000000003``. Without a suitable type the time column is
    parsed cell by cell.
    """
    import pyarrow as pa

    time = plan.time
    if time is None:
        return (None,)
    cells = [row[time.source] for row in layout.samples if len(row) == layout.width]
    if time.time_unit is None:
        return (pa.timestamp("ns"), pa.timestamp("ns", tz="UTC"))
    digits = time.time_unit.digits
    integer = (
        (pa.int64(),)
        if all(cell.strip().isdigit() or not is_number(cell) for cell in cells)
        else ()
    )
    if digits is None or digits > 9:
        return integer
    return (*integer, pa.decimal128(38, digits), pa.decimal128(38, digits + 11))


def parse_fast(piece: bytes, cell_types: CellTypes) -> Parsed | None:
    """Parse a block with pyarrow; None if any cell is not a number, void or expected stamp."""
    import pyarrow as pa

    if cell_types.time is not None and not cell_types.stamp_types:
        return None
    for attempt in range(cell_types.stamp, len(cell_types.stamp_types)):
        try:
            table = _read_table(piece, cell_types, cell_types.stamp_types[attempt])
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            continue
        cell_types.stamp = attempt
        values = {source: _to_floats(table.column(str(source))) for source in cell_types.sources}
        stamps = (
            None
            if cell_types.time is None
            else _table_stamps(table.column(str(cell_types.time)), cell_types)
        )
        return values, stamps
    return None


def _read_table(piece: bytes, cell_types: CellTypes, stamp_type: Any) -> Any:
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    layout = cell_types.layout
    types = {str(source): pa.float64() for source in cell_types.sources}
    if cell_types.time is not None:
        types[str(cell_types.time)] = stamp_type
    return arrow_csv.read_csv(
        pa.BufferReader(piece),
        read_options=arrow_csv.ReadOptions(
            column_names=[str(index) for index in range(layout.width)]
        ),
        parse_options=arrow_csv.ParseOptions(delimiter=layout.separator),
        convert_options=arrow_csv.ConvertOptions(
            column_types=types,
            include_columns=list(types),
            null_values=list(VOID_CELLS),
            check_utf8=False,
            decimal_point="," if layout.decimal_comma else ".",
        ),
    )


def _to_floats(column: Any) -> NDArray[np.float64]:
    parts = [chunk.to_numpy(zero_copy_only=False) for chunk in column.chunks]
    return np.concatenate(parts) if parts else np.empty(0)


def _table_stamps(column: Any, cell_types: CellTypes) -> NDArray[np.int64]:
    import pyarrow as pa

    kind = column.type
    if pa.types.is_decimal(kind):
        digits = cell_types.unit.digits  # type: ignore[union-attr]
        if kind.scale != digits:
            import pyarrow.compute as compute

            column = compute.round(column, ndigits=digits).cast(pa.decimal128(38, digits))
    parts = [_chunk_stamps(chunk, cell_types) for chunk in column.chunks]
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)


def _chunk_stamps(chunk: Any, cell_types: CellTypes) -> NDArray[np.int64]:
    import pyarrow as pa

    unit = cell_types.unit
    valid = (
        np.ones(len(chunk), dtype=bool)
        if chunk.null_count == 0
        else chunk.is_valid().to_numpy(zero_copy_only=False)
    )
    buffer = chunk.buffers()[1]
    if pa.types.is_decimal(chunk.type):
        words = np.frombuffer(buffer, dtype=np.int64)[2 * chunk.offset :][: 2 * len(chunk)].reshape(
            -1, 2
        )
        low, high = words[:, 0], words[:, 1]
        valid = valid & (high == low >> 63)
        zero = cell_types.options.epoch_ns if unit is None or unit.epoch is None else unit.epoch
        return np.where(valid & _sum_fits(low, zero), low + np.int64(zero), NAT)
    counts = np.frombuffer(buffer, dtype=np.int64)[chunk.offset :][: len(chunk)]
    if unit is not None:
        counts = integers_to_ns(counts, unit, cell_types.options.epoch_ns)
    return np.where(valid, counts, NAT)


def _sum_fits(counts: NDArray[np.int64], zero: int) -> NDArray[np.bool_]:
    limit = 2**63 - 1 - abs(zero)
    return (counts <= limit) & (counts >= -limit)


def parse_cells(
    piece: bytes, cell_types: CellTypes
) -> tuple[dict[int, NDArray[np.float64]], NDArray[np.int64] | None, int]:
    """Parse a piece of text line by line.

    Returns
    -------
    values : dict of int to ndarray
        Column number -> numbers, NaN where missing.
    stamps : ndarray of int64 or None
        Stamps [ns since 1970].
    words : int
        Channel cells that are neither a number nor void.
    """
    width = cell_types.layout.width
    rows: list[list[str] | None] = []
    for text in piece.decode("latin-1").split("\n"):
        bare = text.split("#")[0].strip("\r") if "#" in text else text.strip("\r")
        if bare.strip():
            rows.append(_split_row(bare, cell_types.layout, width))
    words = 0
    values = {}
    for source in cell_types.sources:
        numbers = np.empty(len(rows))
        for index, row in enumerate(rows):
            numbers[index] = (
                np.nan
                if row is None
                else _parse_number(row[source], comma=cell_types.layout.decimal_comma)
            )
        if source not in cell_types.gyro:
            bad = np.flatnonzero(~np.isfinite(numbers))
            cells = (rows[index] for index in bad)
            words += sum(
                1
                for row in cells
                if row is not None and row[source].strip().lower() not in _VOID_WORDS
            )
        values[source] = numbers
    return values, _cell_stamps(rows, cell_types), words


def _split_row(text: str, layout: Layout, width: int) -> list[str] | None:
    """Split a row into cells; None if there are too few or too many."""
    try:
        cells = split_line(text, layout.separator)
    except csv.Error:
        return None
    if len(cells) > width and layout.separator != BLANK and not any(cells[width:]):
        cells = cells[:width]
    return cells if len(cells) == width else None


def _parse_number(cell: str, *, comma: bool) -> float:
    try:
        value = float(cell.replace(",", ".") if comma else cell)
    except ValueError:
        return np.nan
    return np.nan if "_" in cell else value


def _cell_stamps(rows: list[list[str] | None], cell_types: CellTypes) -> NDArray[np.int64] | None:
    if cell_types.time is None:
        return None
    cells = ["" if row is None else row[cell_types.time] for row in rows]
    if cell_types.layout.decimal_comma:
        cells = [cell.replace(",", ".") for cell in cells]
    if cell_types.unit is not None:
        suffix = f" {cell_types.unit.text}"  # durations as MATLAB writes them
        cells = [cell.strip().removesuffix(suffix) for cell in cells]
    return cells_to_ns(cells, cell_types.unit, cell_types.options.epoch_ns)
