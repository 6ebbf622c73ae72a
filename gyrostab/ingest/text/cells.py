"""Parse blocks of text rows: plain rows with a kernel, all others cell by cell."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.ingest.columns.dates import DAY_FIRST, YEAR_FIRST
from gyrostab.ingest.columns.headers import VOID_CELLS
from gyrostab.ingest.columns.plan import Plan
from gyrostab.ingest.columns.stamps import (
    NANOSECOND,
    NAT,
    cells_to_ns,
    integers_to_ns,
    plain_number,
)
from gyrostab.ingest.text.layout import BLANK, Layout

#: A minus sign as .NET and ICU write it in some languages, such as Norwegian and Swedish.
_MINUS_SIGN = "\N{MINUS SIGN}".encode()


class ParsedBlock(NamedTuple):
    """Rows of a block of text."""

    values: dict[int, Floats]  # column number -> numbers, NaN where missing
    stamps: Ints | None  # stamps [ns since 1970]
    words: int  # channel cells that are neither a number nor void
    block: bytes
    starts: Ints  # position of each row in the block
    lines: int  # number of lines, with comments and empty lines
    #: Rows that are headers unlike the first one: row, a cell that differs, cell of the first one.
    other_headers: list[tuple[int, str, str]]

    def name_lines(self, first: int, rows: Sequence[int]) -> list[str]:
        """Name rows by their lines; `first` is the number of the first line of the block."""
        above = (self.block.count(b"\n", 0, int(self.starts[row])) for row in rows)
        return [f"line {first + lines}" for lines in above]

    def read_line(self, row: int) -> str:
        """Return a row as it is written."""
        start = int(self.starts[row])
        return decode_line(self.block[start : self.block.index(b"\n", start)]).strip()


class BlockParser:
    """Parse the rows of one file."""

    def __init__(self, layout: Layout, plan: Plan):
        from gyrostab.kernels.encoding import rows

        self.layout, self.epoch = layout, plan.time.epoch if plan.time else 0
        self.sources = sorted(column.source for column in plan.columns if column.role != "time")
        self.channels = {column.source for column in plan.of("channel")}
        self.time = plan.time.source if plan.time else None
        self.unit = plan.time.time_unit if plan.time else None
        #: Decimals of times that the kernel reads, and unit of the whole numbers that it returns.
        self.digits, self.counted = 0, self.unit or NANOSECOND
        if self.unit is not None and (digits := self.unit.digits) is not None and digits <= 9:
            self.digits, self.counted = digits, replace(self.unit, ns=Fraction(1))
        self.order = plan.time.date_order if plan.time else YEAR_FIRST
        self.roles = np.full(layout.width, rows.SKIPPED, dtype=np.int64)
        self.roles[self.sources] = rows.NUMBER
        if self.time is not None:
            dates = {YEAR_FIRST: rows.YEAR_FIRST, DAY_FIRST: rows.DAY_FIRST}
            date = dates.get(self.order, rows.MONTH_FIRST)
            self.roles[self.time] = rows.NUMERIC_TIME if self.unit else date
        self.between = ord(" ")
        if layout.paired is not None and layout.paired == self.time:
            self.between = ord(layout.separator)
        elif layout.paired is not None:  # two cells to skip
            self.roles = np.insert(self.roles, layout.paired, rows.SKIPPED)

    def parse(self, block: bytes) -> ParsedBlock:
        """Parse whole lines; comments and empty lines do not count as rows."""
        from gyrostab.kernels.encoding.rows import BLANKS, read_rows

        text = np.frombuffer(block, dtype=np.uint8)
        lines = int(np.count_nonzero(text == 10))
        values = np.empty((len(self.sources), lines))
        counts, starts = np.empty(lines, np.int64), np.empty(lines, np.int64)
        separator = BLANKS if self.layout.separator == BLANK else ord(self.layout.separator)
        marks = self.layout.decimal_marks
        point = ord(marks if len(marks) == 1 else "," if b"," in block else ".")
        other_lines: dict[int, str] = {}
        row = at = 0
        while True:
            row, at = read_rows(
                text, at, row, self.roles, separator, point, self.digits, self.between, values,
                counts, starts,
            )  # fmt: skip
            if at == len(block):
                break
            end = block.index(b"\n", at) + 1
            if _MINUS_SIGN in block[at:end]:
                return self.parse(block.replace(_MINUS_SIGN, b"-"))
            line = decode_line(block[at:end]).strip("\r\n")
            if line.split("#")[0].strip():
                other_lines[row], starts[row] = line, at
                row += 1
            at = end
        stamps = None if self.time is None else counts[:row]
        if stamps is not None:
            stamps = integers_to_ns(stamps, self.counted, self.epoch)
        words = self._parse_cells(other_lines, values, stamps) if other_lines else 0
        columns = dict(zip(self.sources, values[:, :row], strict=True))
        parsed = ParsedBlock(columns, stamps, words, block, starts[:row], lines, [])
        rows = np.array(list(other_lines), dtype=np.int64)
        is_void = np.isnan(values[:, rows]).all(axis=0)
        if stamps is not None:
            is_void &= stamps[rows] == NAT
        for void_row in rows[is_void].tolist():
            if change := self.layout.find_header_change(parsed.read_line(void_row)):
                parsed.other_headers.append((void_row, *change))
        return parsed

    def quote_fault(self, parsed: ParsedBlock, row: int) -> str:
        """Quote the first cell of a row that cannot be read, or the row if none is filled."""
        line = parsed.read_line(row)
        faults = [source for source in self.sources if not np.isfinite(parsed.values[source][row])]
        if self.time is not None and parsed.stamps is not None and parsed.stamps[row] == NAT:
            faults.insert(0, self.time)
        cells = self._split_row(line) or []
        filled = (cells[at] for at in faults if cells and cells[at].lower() not in VOID_CELLS)
        return repr(next(filled, line))

    def _parse_cells(self, lines: dict[int, str], values: Floats, stamps: Ints | None) -> int:
        """Parse rows cell by cell into `values` and `stamps`; return the number of words."""
        rows = [self._split_row(line) for line in lines.values()]
        at, words = np.array(list(lines)), 0
        for number, source in enumerate(self.sources):
            cells = ["" if row is None else row[source] for row in rows]
            numbers = parse_numbers(cells, self.layout)
            values[number, at] = numbers
            if source in self.channels:
                bad = np.flatnonzero(~np.isfinite(numbers))
                words += sum(cells[index].strip().lower() not in VOID_CELLS for index in bad)
        if stamps is not None and self.time is not None:
            cells = ["" if row is None else row[self.time] for row in rows]
            if self.unit is not None:
                cells = [self.layout.write_point(cell) for cell in cells]
                # durations as MATLAB writes them
                cells = [cell.strip().removesuffix(f" {self.unit.text}") for cell in cells]
            stamps[at] = cells_to_ns(cells, self.unit, self.epoch, self.order)
        return words

    def _split_row(self, line: str) -> list[str] | None:
        """Split a row into cells; None if there are too few or too many."""
        width, separator = self.layout.width, self.layout.separator
        try:
            cells = self.layout.split_row(line)
        except csv.Error:
            return None
        if len(cells) > width and separator != BLANK and not any(cells[width:]):
            cells = cells[:width]
        return cells if len(cells) == width else None


def decode_line(line: bytes) -> str:
    """Decode a line as UTF-8, otherwise as Latin-1."""
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def parse_numbers(cells: Sequence[str], layout: Layout) -> Floats:
    """Convert cells to numbers, NaN where they hold none."""
    return np.array([_parse_number(cell, layout) for cell in cells])


def _parse_number(cell: str, layout: Layout) -> float:
    try:
        value = float(plain_number(layout.write_point(cell)))
    except ValueError:
        return np.nan
    return np.nan if "_" in cell else value
