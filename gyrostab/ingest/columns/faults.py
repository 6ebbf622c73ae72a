"""Count the unreadable rows and cells of a file, and find codes for missing values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.plan import Column
from gyrostab.store.lazy import read_slice

if TYPE_CHECKING:
    from gyrostab.ingest.columns.raw_log import ConvertedBlock

#: Largest number of bad places that a note lists.
MAX_NAMED_PLACES = 10
#: Largest share of unreadable rows; a file with more is refused.
MAX_UNREADABLE_SHARE = 0.5

#: Rows at the beginning in which a code for missing values is searched.
_CODE_ROWS = 2**18
#: A code repeats, is farther from the other values than their range times this number, and the
#: latter have at least so many different values, unlike the states of a switch.
_MIN_CODE_REPEATS, _MIN_CODE_DISTANCE, _MIN_READINGS = 3, 3.0, 16
#: Common codes for missing values in well logs.
_COMMON_CODES = (-999.25, -9999.0)

#: Row numbers within a block -> names of the rows for messages.
Locate = Callable[[Sequence[int]], list[str]]
#: Row number within a block -> the row as it is written.
Quote = Callable[[int], str]


class _Places:
    """Number of bad places, and the names of the first ones."""

    def __init__(self) -> None:
        self.total, self.names = 0, list[str]()

    def add(self, rows: NDArray[np.int64], locate: Locate) -> None:
        self.total += len(rows)
        if room := MAX_NAMED_PLACES - len(self.names):
            self.names += locate(rows[:room].tolist())

    def describe(self) -> str:
        """Join the names: ``lines 7, 8, 9 and others``."""
        kind, names = self.names[0].split(" ")[0], self.names
        numbers = ", ".join(name.removeprefix(f"{kind} ") for name in names)
        return (
            f"{kind}{'s' * (len(names) > 1)} {numbers}{' and others' * (self.total > len(names))}"
        )


class Faults:
    """Unreadable rows and cells of the blocks of a file."""

    def __init__(self) -> None:
        self.cells = self.gyro_cells = 0  # the latter in rows that are readable otherwise
        self.rows, self.cell_rows = _Places(), _Places()
        self.missing: Counter[int] = Counter()  # missing values by column number
        self.first_row = ""

    def add(
        self, block: ConvertedBlock, first: int, locate: Locate | None, quote: Quote | None
    ) -> None:
        """Add those of a block whose first row has the number `first`."""
        locate = locate or (lambda rows: [f"row {first + row}" for row in rows])
        self.cells += block.bad_cells
        self.missing.update({source: span[0] for source, span in block.ranges.items()})
        if block.bad_rows.size:
            if quote is not None and not self.rows.total:
                self.first_row = f": {quote(int(block.bad_rows[0])):.100}"
            self.rows.add(block.bad_rows, locate)
        if block.cell_rows.size:
            self.cell_rows.add(block.cell_rows, locate)
            self.gyro_cells += block.cells

    def check(self, name: str, rows: int) -> None:
        """Refuse a file of which more than half of the rows are unreadable."""
        if self.rows.total > MAX_UNREADABLE_SHARE * rows:
            share, first = self.rows.total / rows, self.rows.names[0]
            suspects = (
                "the separator, the columns that --map names and the unit of time (stamps lie "
                "in the years 1678 to 2262)"
            )
            raise FormatError(
                f"{name}: {100 * share:.0f} % of {rows} rows are unreadable, the first is {first}"
                f"{self.first_row}; look at it, and check {suspects}"
            )

    def describe(self, rows: int, gyro: Sequence[Column]) -> list[str]:
        """Return notes on unreadable rows, and on gyro cells in other rows."""
        notes = []
        if self.rows.total:
            notes.append(f"{self.rows.total} of {rows} rows are unreadable: {self.rows.describe()}")
        empty = sum(self.missing[column.source] == rows for column in gyro)
        cells = self.gyro_cells - empty * (rows - self.rows.total)  # empty axes have a note later
        if cells:
            places = "" if empty else f": {self.cell_rows.describe()}"
            notes.append(
                f"{cells} gyro cells hold no number in rows that are readable otherwise{places}"
            )
        return notes


def describe_codes(columns: Sequence[Column], values: Mapping[int, Any]) -> list[str]:
    """Return notes on codes for missing values.

    They repeat far outside all other values, or are common codes and the only value.
    """
    notes = []
    for column in columns:
        head = np.asarray(read_slice(values[column.source], 0, _CODE_ROWS), dtype=np.float64)
        readings = head[np.isfinite(head)]
        code = _find_code(readings)
        only = code is None and len(readings) and readings.min() == readings.max()
        value = float(readings[0]) if only else code
        if value is None:
            continue
        written = (value - column.offset) / column.factor
        is_common = bool(np.isclose(written, _COMMON_CODES, rtol=1e-9).any())
        if only and not is_common:
            continue
        notes.append(
            f"{column.header!r} is {written:.10g} in {int((head == value).sum())} of the first "
            f"{len(head)} rows{'' if only else ', far outside all other values'}; "
            f"{'it is a common' if is_common else 'if that is a'} code for a missing value"
            f"{':' if is_common else ','} replace it by nan before the log is read"
        )
    return notes


def _find_code(values: NDArray[np.float64]) -> float | None:
    """Return the lowest or highest value if it repeats far outside all others; zero is a reading.

    Examples
    --------
    >>> _find_code(np.r_[np.arange(100.0), [-999.25] * 3]), _find_code(np.arange(100.0))
    (-999.25, None)
    """
    for code in (values.min(initial=np.inf), values.max(initial=-np.inf)):
        others = values[values != code]
        if code == 0 or not _MIN_CODE_REPEATS <= len(values) - len(others) < len(others):
            continue
        low, high = others.min(), others.max()
        if max(low - code, code - high) > _MIN_CODE_DISTANCE * (high - low) and (
            len(np.unique(others)) >= _MIN_READINGS
        ):
            return float(code)
    return None
