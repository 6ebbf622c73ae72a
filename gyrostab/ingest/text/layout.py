"""Find the layout of a text log from its first lines: encoding, separator, header."""

from __future__ import annotations

import csv
import re
from codecs import BOM_UTF8
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice, pairwise, takewhile, zip_longest
from pathlib import Path

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.dates import holds_date, is_time_of_day, parse_order
from gyrostab.ingest.columns.headers import VOID_CELLS, is_unit, split_header
from gyrostab.ingest.columns.stamps import is_number
from gyrostab.ingest.limits import check_columns
from gyrostab.wording import list_some

#: Separator that means any run of blanks.
BLANK = " "
#: Separators of files that may have decimal commas.
COMMA_SEPARATORS = (";", "\t")
HEAD_LINES = 200
#: Lines that are read: those that may be the header, those that follow it, and the first data rows.
MAX_LINES = 2 * HEAD_LINES + 20
#: Least number of rows for each word of a column that tells tools apart, and least share of rows
#: with another word than the row before: random words of two kinds have half.
_MIN_RECURRENCES, _MIN_CHANGING_SHARE = 4, 0.75

#: Last names of headers whose rows may end before: a separator at the end, comments of LabVIEW.
_OPTIONAL_NAMES = ("", "comment")
_HEADER_CELLS = re.compile(r"(?:[^\s\[]+(?:\[[^\[\]]*\])?(?:[ \t]+\[[^\[\]]*\])?)")
_DURATION = re.compile(r"^\s*[+-]?\d+(?:\.\d+)? (ms|s|sec|min|h|hr|d|day|days)\s*$")
_COMMENT = re.compile(r"^\s*[#%]")
#: The last three digits of a number, which a mark for thousands may precede.
_THREE_DIGITS = re.compile(r"[.,]\d{3}$")
_SWAPPED = str.maketrans(".,", ",.")
#: Where commas do not separate cells: in brackets, and before the fraction of a second if blanks
#: separate the cells.
_WITHIN_CELL = re.compile(r"\[[^\[\]]*\]|(?<=:\d\d),(?=\d+[ \t]+[^\s,])")


@dataclass(frozen=True)
class Layout:
    """Layout of a text log.

    `offset` [bytes] and `line` (from 1) give the first data row; `samples` holds the cells of the
    first few rows, without those that have too few or too many.
    """

    headers: tuple[str, ...]
    separator: str
    offset: int
    line: int
    samples: tuple[tuple[str, ...], ...]
    #: What is the decimal point of numbers: "." or ","; both where the first rows have none.
    decimal_marks: str = "."
    notes: tuple[str, ...] = ()
    above: tuple[str, ...] = ()  # lines above the header
    #: Column whose dates have their times of day in the next one; both are one column here.
    paired: int | None = None
    #: Units in a row under the header, by column.
    units: Mapping[int, str] = field(default_factory=dict)
    #: Cells of the header row, and of the units under it, as they are written; empty without them.
    header_rows: tuple[tuple[str, ...], ...] = ()

    @property
    def width(self) -> int:
        """Number of cells in a row."""
        return len(self.headers)

    def split_row(self, line: str) -> list[str]:
        """Split a data row into cells, without a comment after it."""
        width = self.width + (self.paired is not None)
        return _join_pair(_split_data(line, self.separator, width), self.paired)

    def write_point(self, cell: str) -> str:
        """Return a cell with its decimal mark as a point, and other points as commas."""
        if self.decimal_marks == ".":
            return cell
        return cell.translate(_SWAPPED) if self.decimal_marks == "," else cell.replace(",", ".")

    @cached_property
    def _header_names(self) -> set[str]:
        return _bare_names(self.header_rows[0]) if self.header_rows else set()

    def find_header_change(self, line: str) -> tuple[str, str] | None:
        """Return a cell of a later header, or of units under it, that differs, and the first one.

        None if all cells are as in the first header, or if the line is neither header nor units.
        """
        names = self._header_names
        is_likely = 2 * sum(name in line.lower() for name in names) > len(names)
        if not self.header_rows or not (is_likely or self.units):
            return None
        try:
            cells = _header_cells(line, self.separator)
        except csv.Error:
            return None
        header, *units = self.header_rows
        if is_likely and 2 * len(_bare_names(cells) & names) > len(names):
            pairs = zip_longest(cells, header, fillvalue="")
        elif units and _find_units(cells, header):
            pairs = zip_longest(cells, units[0], fillvalue="")
        else:
            return None
        return next((pair for pair in pairs if pair[0] != pair[1]), None)


def unit_of_duration(text: str) -> str | None:
    """Return the unit of a duration as MATLAB writes it, ``0.01 sec``; None for other cells."""
    match = _DURATION.match(text)
    return match.group(1) if match else None


def is_text(head: bytes) -> bool:
    """Return whether the beginning of a file is text: no zero byte, at most 2 % control codes."""
    control = sum(head.count(code) for code in (*range(0, 9), *range(14, 32)))
    return b"\0" not in head and control <= 0.02 * len(head)


def split_line(line: str, separator: str) -> list[str]:
    """Split a line into cells."""
    if separator == BLANK:
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    return [cell.strip() for cell in line.split(separator)]


def _split_data(line: str, separator: str, width: int) -> list[str]:
    """Split a data row of a table; a comment begins with # after the last cell, not within one."""
    cells = split_line(line, separator)
    if "#" not in line:
        return cells
    if len(cells) != width:
        return split_line(line.split("#")[0], separator)
    return [*cells[:-1], cells[-1].split("#")[0].strip()]


def find_layout(
    path: Path, head: bytes, *, complete: bool, limits: Mapping[str, float] | None = None
) -> Layout:
    """Find the layout of a text log in its first bytes, which may be the `complete` file.

    `FormatError` when the file is empty, is not text, has no data rows, or has more columns than
    the limit allows.
    """
    lines, notes = _decode_lines(path, head, complete=complete)
    filled = (
        index for index, line in enumerate(lines) if line.strip() and not _COMMENT.match(line)
    )
    content = list(islice(filled, MAX_LINES))
    if not content:
        raise FormatError(
            f"{path.name}: it has no data row, only {len(lines)} blank or comment lines; copy it "
            "again"
        )
    check_columns(
        path, 1 + max(lines[index].count(mark) for index in content for mark in "\t;,"), limits
    )
    header, separator, above, first = _find_header(path, lines, content)
    data = [index for index in content if index >= first]
    units = _find_units(split_line(lines[data[0]], separator), header) if header and data else {}
    header_rows = [] if header is None else [tuple(header)]
    if units:
        first = data.pop(0) + 1
        header_rows.append(tuple(split_line(lines[first - 1], separator)))
    offset = sum(len(line) for line in head.splitlines(keepends=True)[:first])
    if first == 0 and head.startswith(BOM_UTF8):
        offset = len(BOM_UTF8)
    if not data:
        raise FormatError(
            f"{path.name}: there is a header (line {content[0] + 1}) but no data row below it; "
            "copy it again"
        )
    rows, paired = _split_rows([lines[at] for at in data[:HEAD_LINES]], header, separator)
    width = _commonest_width(rows)
    if header is not None and paired is not None and len(header) > width:
        header = _join_headers(header, paired)
        units = {column - (column > paired): unit for column, unit in reversed(units.items())}
    headers = _fit_headers(header, rows, width)
    if separator == "," and width == len(headers) + 1:
        _check_seconds(path, rows[0], first + 1)
    if separator == BLANK and width != len(headers):
        notes.append(f"the header has {len(headers)} names, the rows have {width} cells")
    skipped = [index + 1 for index in content if index < above]
    if skipped:
        notes.append(
            f"skipped {len(skipped)} line{'s' * (len(skipped) > 1)} above the header (from line "
            f"{skipped[0]})"
        )
    marks = _find_decimal_marks(rows) if separator in COMMA_SEPARATORS else "."
    samples = [row for row in rows if len(row) == len(headers)]
    notes += _describe_sources(headers, samples)
    top = tuple(lines[:above]) if header is not None else ()
    return Layout(
        tuple(headers), separator, offset, first + 1, tuple(samples[:50]), marks, tuple(notes), top,
        paired, units, tuple(header_rows),
    )  # fmt: skip


def _split_rows(
    lines: Sequence[str], header: Sequence[str] | None, separator: str
) -> tuple[list[tuple[str, ...]], int | None]:
    """Split lines of data into rows, with date and time joined in one cell.

    Also return the column of the date if date and time are in two.
    """
    whole_rows = [header] if header else [split_line(line, separator) for line in lines]
    width = _commonest_width(whole_rows)
    rows = [tuple(_split_data(line, separator, width)) for line in lines]
    paired = _find_pair(rows)
    if paired is not None:
        rows = [tuple(_join_pair(list(row), paired)) for row in rows]
    return rows, paired


def _fit_headers(
    header: Sequence[str] | None, rows: Sequence[Sequence[str]], width: int
) -> list[str]:
    """Return a header for every column of the rows, which have this width; numbers without any."""
    headers = list(header) if header is not None else [str(column) for column in range(width)]
    if width == len(headers) + 1 and all(row[-1] == "" for row in rows if len(row) == width):
        headers.append("")  # every data row ends with a separator
    if width == len(headers) - 1 and headers[-1].lower() in _OPTIONAL_NAMES:
        headers.pop()
    return headers


def _decode_lines(path: Path, head: bytes, *, complete: bool) -> tuple[list[str], list[str]]:
    if not head.strip():
        raise FormatError(f"{path.name}: the file is empty; copy it again")
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise FormatError(
            f"{path.name}: the file is UTF-16 text; save it as UTF-8 (iconv -f utf-16 -t utf-8)"
        )
    if b"\n" not in head and b"\r" in head.rstrip():
        raise FormatError(
            f"{path.name}: its lines end with CR alone (old Macs); convert it: tr '\\r' '\\n'"
        )
    if not is_text(
        head[:4096]
    ):  # further down, binary data such as zeros after a power loss affects single rows only
        raise FormatError(
            f"{path.name}: this is not text but binary data; if it is a known format, give the "
            "file its right suffix"
        )
    notes = []
    lines = head.splitlines()
    if not complete and len(lines) > 1:
        lines.pop()  # the last one may be cut
    try:
        text = b"\n".join(lines).decode("utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        number = error.object.count(b"\n", 0, error.start) + 1
        notes.append(
            f"line {number} is not UTF-8 ({error.object[error.start : error.start + 1]!r}); the "
            "text was read as Latin-1"
        )
        text = [line.decode("latin-1") for line in lines]
    return text, notes


def _find_decimal_marks(rows: Sequence[Sequence[str]]) -> str:
    """Find the decimal point, the mark of more numbers; both where no number has one.

    Numbers in which the mark may be that of thousands decide only if there are no others.

    Examples
    --------
    >>> _find_decimal_marks([["1", "2"]]), _find_decimal_marks([["0,5", "1.2"], ["0,6", "7,8"]])
    ('.,', ',')
    >>> _find_decimal_marks([["900,5"], ["1.101"], ["1.102"]]), _find_decimal_marks([["1.101"]])
    (',', '.')
    """
    cells = [cell for row in rows for cell in row if is_number(cell, comma=True)]
    commas, points = ([cell for cell in cells if mark in cell] for mark in ",.")
    if not commas and not points:
        return ".,"
    by_comma, by_point = (
        (sum(not _THREE_DIGITS.search(number) for number in numbers), len(numbers))
        for numbers in (commas, points)
    )
    return "," if by_comma > by_point else "."


def _find_pair(rows: Sequence[Sequence[str]]) -> int | None:
    """Return the first column of dates that is followed by a column of times of day."""
    width = _commonest_width(rows)
    full_rows = [row for row in rows if len(row) == width]
    for column in range(width - 1):
        pairs = sum(
            holds_date(row[column]) and ":" not in row[column] and is_time_of_day(row[column + 1])
            for row in full_rows
        )
        if 2 * pairs > len(full_rows):  # damaged rows are few
            return column
    return None


def _describe_sources(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a note on each column of words that alternate from row to row."""
    notes = []
    for header, *cells in zip(headers, *rows, strict=True):
        values = list(dict.fromkeys(cell.strip() for cell in cells))
        changes = sum(before.strip() != after.strip() for before, after in pairwise(cells))
        if (
            1 < len(values) <= len(cells) / _MIN_RECURRENCES
            and changes >= _MIN_CHANGING_SHARE * (len(cells) - 1)
            and not any(
                value.lower() in VOID_CELLS
                or is_number(value, comma=True)
                or holds_date(value)
                or is_time_of_day(value)
                or unit_of_duration(value)
                for value in values
            )
        ):
            notes.append(
                f"the rows alternate between {list_some(values)} in column {header!r}, as if "
                "several tools wrote to one file; they are read as one tool: if they are several, "
                "write a file for each value of that column and run each on its own"
            )
    return notes


def _check_seconds(path: Path, row: Sequence[str], line: int) -> None:
    """Refuse a row with a comma before the fraction of a second if commas separate its cells."""
    for cell, fraction in pairwise(row):
        if holds_date(cell) and re.search(r":\d\d$", cell) and fraction.isdigit():
            problem = (
                f"line {line} has one cell more than the header, because a comma precedes the "
                f"fraction of the second ({cell},{fraction}) and commas separate the cells"
            )
            raise FormatError(
                f"{path.name}: {problem}; write a point in its place, put the stamps in quotes, "
                "or separate the cells by semicolons"
            )


def _commonest_width(rows: Sequence[Sequence[str]]) -> int:
    """Return the number of cells that most rows have."""
    widths = [len(row) for row in rows]
    return max(widths, key=widths.count, default=0)


def _join_pair(cells: list[str], paired: int | None) -> list[str]:
    """Join a date and its time of day."""
    if paired is not None and len(cells) > paired + 1:
        cells[paired : paired + 2] = [" ".join(cells[paired : paired + 2])]
    return cells


def _join_headers(header: list[str], paired: int) -> list[str]:
    """Join the headers of a date and its time of day: names, then units such as YYYY-MM-DD."""
    names, units = zip(*map(split_header, header[paired : paired + 2]), strict=True)
    unit = " ".join(filter(None, units))
    joined = " ".join(names) + f" [{unit}]" * bool(unit)
    return [*header[:paired], joined, *header[paired + 2 :]]


def _guess_separator(line: str) -> str:
    bare = _WITHIN_CELL.sub("", line)
    return next((mark for mark in ("\t", ";", ",") if mark in bare), BLANK)


def _header_cells(line: str, separator: str) -> list[str]:
    return (
        [cell.strip() for cell in _HEADER_CELLS.findall(line)]
        if separator == BLANK
        else split_line(line, separator)
    )


def _bare_names(cells: Sequence[str]) -> set[str]:
    """Return the names of header cells without their units, in lower case."""
    return {split_header(cell)[0].lower() for cell in cells} - {""}


def _is_data(cells: list[str], *, comma: bool) -> bool:
    """Return whether a row is data: it has numbers or dates, and the other cells are few."""
    void = VOID_CELLS | {"inf", "-inf"}
    solid = [cell for cell in cells if cell.lower() not in void and not set(cell) <= set("*-")]
    values = [
        cell
        for cell in solid
        if is_number(cell, comma=comma) or holds_date(cell) or unit_of_duration(cell)
    ]
    return (
        bool(values)
        and 2 * len(values) >= len(solid)
        and (is_number(cells[0], comma=comma) or holds_date(cells[0]) or len(values) == len(solid))
    )


def _find_header(
    path: Path, lines: list[str], content: list[int]
) -> tuple[list[str] | None, str, int, int]:
    """Find header cells (or None), separator, and indices of header and first data line."""
    guessed = [(_guess_separator(lines[index]), lines[index]) for index in content]
    rows_of_data = (
        place
        for place, (mark, line) in enumerate(guessed)
        if _is_data(split_line(line, mark), comma=mark in COMMA_SEPARATORS)
    )
    first_row = next(rows_of_data, -1)
    for place, index in enumerate(content[:HEAD_LINES]):
        separator, line = guessed[place]
        if place == first_row:
            width = len(split_line(line, separator))
            return _commented_header(lines, index, separator, width), separator, index, index
        names = _header_cells(line, separator)
        following = guessed[place + 1 : max(place, first_row) + 21]
        rows = [(mark, _split_data(line, mark, len(names))) for mark, line in following]
        solid = [(mark, row) for mark, row in rows if _is_data(row, comma=mark in COMMA_SEPARATORS)]
        widths = {len(row) for mark, row in solid or rows if mark == separator}
        if separator != BLANK and _precedes_header(names, separator, rows):
            continue  # a line above the header, padded to the width of the table
        if _find_pair([row for _, row in solid]) is not None:
            widths |= {width - 1 for width in widths}  # one name for date and time of day
        if separator != BLANK and place + 1 == first_row and names[-1].lower() in _OPTIONAL_NAMES:
            widths |= {width + 1 for width in widths}
        if (
            not following
            or len(names) in widths
            or (separator != BLANK and len(names) + 1 in widths)
        ):
            return names, separator, index, index + 1
    problem = f"no header row or row of numbers in the first {len(lines)} lines"
    raise FormatError(
        f"{path.name}: {problem}; if this is a gyro log, put # before the lines above its header "
        "row, or delete them"
    )


def _precedes_header(
    names: Sequence[str], separator: str, rows: Sequence[tuple[str, list[str]]]
) -> bool:
    """Return whether a row above the data fills more cells than this one."""
    above = takewhile(lambda row: not _is_data(row[1], comma=row[0] in COMMA_SEPARATORS), rows)
    filled = [sum(map(bool, row)) for mark, row in above if mark == separator]
    return len(filled) < len(rows) and max(filled, default=0) > sum(map(bool, names))


def _find_units(cells: Sequence[str], header: Sequence[str]) -> dict[int, str]:
    """Return the units of a row under the header by column; empty if it is not a row of units."""
    bare = [cell.strip("[]() ") for cell in cells]
    units = {column: cell for column, cell in enumerate(bare) if is_unit(cell) or parse_order(cell)}
    is_units = len(cells) == len(header) and 2 * len(units) >= sum(map(bool, bare))
    return units if is_units and not _is_data(list(cells), comma=True) else {}


def _commented_header(lines: list[str], first: int, separator: str, width: int) -> list[str] | None:
    """Return a header after ``#`` (EuRoC, numpy.savetxt): the last comment, if its width fits."""
    last = next((line for line in reversed(lines[:first]) if line.strip()), "")
    if not _COMMENT.match(last):
        return None
    cells = _header_cells(last.strip().lstrip("#%").strip(), separator)
    return cells if len(cells) == width and not _is_data(cells, comma=False) else None
