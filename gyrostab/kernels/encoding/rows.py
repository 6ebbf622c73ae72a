"""Read rows of plain text into numbers and stamps, in the form that nearly all logs have.

Cells are decimal numbers, dates of ten characters with the time, empty, or words for missing
values, quoted or not. Reading stops at the first row that holds anything else, and the caller reads
that row in another way. Numbers are rounded as by `float`, to the last bit; stamps are whole
nanoseconds.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types

from gyrostab.kernels.compiled import INNER, KERNEL
from gyrostab.kernels.encoding.decimals import read_decimal, read_digits, read_number

#: What a column holds.
SKIPPED, NUMBER, NUMERIC_TIME, YEAR_FIRST, DAY_FIRST, MONTH_FIRST = range(6)
#: Separator code of runs of blanks and tabs.
BLANKS = 32

_NAT = np.iinfo(np.int64).min
_TAB, _LINE, _RETURN, _BLANK, _QUOTE, _HASH, _PERCENT = b'\t\n\r "#%'
_PLUS, _MINUS, _POINT, _ZERO, _COLON, _T, _Z, _SMALL_N, _SLASH, _COMMA = b"+-.0:TZn/,"
# words for missing values, in lower case
_NAN, _NA, _N_A, _NULL, _NONE = (
    int.from_bytes(word, "big") for word in (b"nan", b"na", b"n/a", b"null", b"none")
)
_WHOLE_TENS = np.array([10**n for n in range(20)], dtype=np.uint64)
_LONGEST_NS = np.uint64(2**63 - 1)


@njit(types.CPointer(types.uint8)(types.CPointer(types.uint8)), **KERNEL)
def _as_pointer(text):  # type: ignore[no-untyped-def]
    """Convert ``array.ctypes`` to a pointer; passing arrays would cost more than the reading."""
    return text


@njit(**INNER)
def _count_of_time(text, at, point, digits):  # type: ignore[no-untyped-def]
    """Read a numeric time as a multiple of ``10**-digits``, rounded half to even, and its end."""
    negative, mantissa, decimals, end = read_decimal(text, at, point)
    if end < 0 or (digits == 0 and decimals > 0) or decimals - digits > 18:
        return np.int64(0), np.int64(-1)
    if decimals <= digits:
        scale = _WHOLE_TENS[digits - decimals]
        if mantissa > _LONGEST_NS // scale:
            return np.int64(0), np.int64(-1)
        count = np.int64(mantissa * scale)
    else:
        scale = _WHOLE_TENS[decimals - digits]
        quotient, remainder = mantissa // scale, mantissa % scale
        odd = quotient & np.uint64(1)
        count = np.int64(quotient + np.uint64(np.uint64(2) * remainder + odd > scale))
    return -count if negative else count, end


@njit(**INNER)
def _read_pair(text, at):  # type: ignore[no-untyped-def]
    """Read a number of two digits; above 99 if invalid."""
    tens = np.uint8(text[at] - np.uint8(_ZERO))
    ones = np.uint8(text[at + 1] - np.uint8(_ZERO))
    return np.int64(10 * tens + ones) if tens < 10 and ones < 10 else np.int64(1000)


@njit(**INNER)
def _days_since_1970(year, month, day):  # type: ignore[no-untyped-def]
    """Count the days since 1970-01-01 (years begin in March)."""
    year -= month <= 2
    age = year - 1600
    of_year = (153 * (month - 3 if month > 2 else month + 9) + 2) // 5 + day - 1
    return 365 * age + age // 4 - age // 100 + age // 400 + of_year - 135080


@njit(**INNER)
def _read_zone(text, at):  # type: ignore[no-untyped-def]
    """Read ``Z``, ``+01``, ``-05:30``, ``+0530`` or nothing: minutes and end, negative if wrong."""
    if text[at] == _Z:
        return np.int64(0), at + 1
    if text[at] != _PLUS and text[at] != _MINUS:
        return np.int64(0), at
    west, hours, minutes = text[at] == _MINUS, _read_pair(text, at + 1), np.int64(0)
    end = at + 3
    if hours < 24 and (text[end] == _COLON or np.uint8(text[end] - np.uint8(_ZERO)) < 10):
        end += text[end] == _COLON
        minutes = _read_pair(text, end)
        end += 2
    if hours > 23 or minutes > 59:
        return np.int64(0), np.int64(-1)
    minutes += 60 * hours
    return -minutes if west else minutes, end


@njit(**INNER)
def _read_date_stamp(text, at, size, order, mark_of_part, between):  # type: ignore[no-untyped-def]
    """Read ``2026-01-02T03:04:05.678Z`` or a like form: nanoseconds and end.

    Date and time are separated by T, a blank or `between`; points or slashes may take the place of
    the first two dashes, `mark_of_part` that of the point, and other zones that of the Z.
    """
    none = (np.int64(0), np.int64(-1))
    if at + 19 >= size:  # for the caller
        return none
    year_at, month_at, day_at, mark_at = at, at + 5, at + 8, at + 4
    if order != YEAR_FIRST:
        year_at, mark_at = at + 6, at + 2
        month_at, day_at = (at + 3, at) if order == DAY_FIRST else (at, at + 3)
    year = 100 * _read_pair(text, year_at) + _read_pair(text, year_at + 2)
    month, day, hour, minute = (
        _read_pair(text, month_at), _read_pair(text, day_at), _read_pair(text, at + 11),
        _read_pair(text, at + 14),
    )  # fmt: skip
    has_seconds = text[at + 16] == _COLON
    second = _read_pair(text, at + 17) if has_seconds else np.int64(0)
    mark, middle = text[mark_at], text[at + 10]
    if (
        (mark != _MINUS and mark != _SLASH and mark != _POINT)
        or text[mark_at + 3] != mark
        or (middle != _T and middle != _BLANK and middle != between)
        or text[at + 13] != _COLON
        or not (1700 <= year < 2200 and 1 <= month <= 12 and day >= 1)
    ):
        return none
    short = month == 4 or month == 6 or month == 9 or month == 11
    leap = year % 4 == 0 and (year % 100 != 0 or year % 400 == 0)
    last = 28 + leap if month == 2 else 31 - short
    if day > last or hour > 23 or minute > 59 or second > 59:
        return none
    end, part = at + (19 if has_seconds else 16), np.uint64(0)
    if has_seconds and (text[end] == _POINT or text[end] == mark_of_part):
        part, stop = read_digits(text, end + 1, np.uint64(0))
        length = stop - end - 1
        if not 0 < length <= 9:
            return none
        part *= _WHOLE_TENS[9 - length]
        end = stop
    minutes, end = _read_zone(text, end)
    if end < 0:
        return none
    minute -= minutes
    seconds = ((_days_since_1970(year, month, day) * 24 + hour) * 60 + minute) * 60 + second
    return seconds * 1_000_000_000 + np.int64(part), end


@njit(**INNER)
def _past_blanks(text, at, separator):  # type: ignore[no-untyped-def]
    while text[at] == _BLANK or (text[at] == _TAB and separator != _TAB):
        at += 1
    return at


@njit(**INNER)
def _cell_end(text, at, separator, last):  # type: ignore[no-untyped-def]
    """Find the next cell, or line, after a cell that ends at `at`; negative if malformed."""
    at = _past_blanks(text, at, separator)
    if last:
        at += text[at] == _RETURN
        return at + 1 if text[at] == _LINE else np.int64(-1)
    if separator == BLANKS:  # one was passed, or there is another cell's text here
        return at if text[at] != _LINE and text[at] != _RETURN else np.int64(-1)
    return at + 1 if text[at] == separator else np.int64(-1)


@njit(**INNER)
def _skip_cell(text, at, separator, quoted):  # type: ignore[no-untyped-def]
    """Find the end of a skipped cell; negative where quotes or comments make it uncertain."""
    if quoted:
        at += 1
        while text[at] != _QUOTE:
            if text[at] == _LINE or text[at] == _HASH:
                return np.int64(-1)
            at += 1
        return at + 1 if text[at + 1] != _QUOTE else np.int64(-1)
    while (
        text[at] != _LINE
        and text[at] != separator
        and not (separator == BLANKS and text[at] == _TAB)
    ):
        if text[at] == _QUOTE or text[at] == _HASH:
            return np.int64(-1)
        at += 1
    return at - 1 if at and text[at] == _LINE and text[at - 1] == _RETURN else at


@njit(**INNER)
def _is_end(code, separator):  # type: ignore[no-untyped-def]
    return code in (separator, _LINE, _RETURN, _QUOTE)


@njit(**INNER)
def _past_void(text, at, separator):  # type: ignore[no-untyped-def]
    """Find the end of an empty cell, or of a word for a missing value; negative for others."""
    first = at + np.int64(text[at] == _MINUS)
    if _is_end(text[at], separator):
        return at
    if text[first] | 32 != _SMALL_N:
        return np.int64(-1)
    word, end = np.int64(0), first
    while end < first + 4 and text[end] > _BLANK and not _is_end(text[end], separator):
        word = word << 8 | np.int64(text[end] | 32)
        end += 1
    is_void = word == _NAN or (first == at and (word in (_NA, _N_A, _NULL, _NONE)))
    return end if is_void else np.int64(-1)


@njit(**INNER)
def _read_cell(text, at, size, role, separator, point, digits, between, may_quote):  # type: ignore[no-untyped-def]
    """Read number, stamp and end of a cell; the end is negative for other content."""
    quoted = False
    if role == SKIPPED:
        quoted = may_quote and text[at] == _QUOTE
        return 0.0, np.int64(0), _skip_cell(text, at, separator, quoted)
    value, stamp, end = np.nan, np.int64(_NAT), np.int64(-1)
    first = at + np.int64(text[at] == _MINUS)
    if np.uint8(text[first] - np.uint8(_ZERO)) > 9:  # most cells begin with a digit
        if may_quote and text[at] == _QUOTE:
            quoted, at = True, _past_blanks(text, at + 1, separator)
        end = _past_void(text, at, separator)
    if end < 0:
        if role == NUMBER:
            value, end = read_number(text, at, point)
        elif role == NUMERIC_TIME:
            stamp, end = _count_of_time(text, at, point, digits)
        else:
            mark = _COMMA if quoted or separator != _COMMA else _POINT
            stamp, end = _read_date_stamp(text, at, size, role, mark, between)
    if quoted and end >= 0:
        end = _past_blanks(text, end, separator)
        end = end + 1 if text[end] == _QUOTE else np.int64(-1)
    return value, stamp, end


@njit(**INNER)
def _next_row(text, at, size):  # type: ignore[no-untyped-def]
    """Find the next line that is neither blank nor a comment."""
    while at < size:
        cursor = _past_blanks(text, at, np.int64(_TAB))
        if text[cursor] == _HASH or text[cursor] == _PERCENT:
            while text[cursor] != _LINE:
                cursor += 1
        cursor += text[cursor] == _RETURN
        if text[cursor] != _LINE:
            break
        at = cursor + 1
    return at


@njit(**KERNEL)
def read_rows(lines, at, row, roles, separator, point, digits, between, values, stamps, starts):  # type: ignore[no-untyped-def]
    """Read rows up to the first with other content, which is for the caller to read.

    Parameters
    ----------
    lines : uint8 (bytes,)
        Whole lines; the last byte is the end of a line.
    at, row : int
        Index of the beginning of the first line to read, and the number of its row.
    roles : int64 (width,)
        What each column holds: `SKIPPED`, `NUMBER`, `NUMERIC_TIME`, or dates: `YEAR_FIRST`,
        `DAY_FIRST`, `MONTH_FIRST`.
    separator, point : int
        Codes of the separator (`BLANKS` for runs of them) and of the decimal point.
    digits : int
        Numeric times are rounded to this number of decimals and given as whole numbers of the last;
        with 0 they must be whole.
    between : int
        Code that may separate date and time of day, in addition to T and blank: the separator, if
        each has a cell; they count as one column.
    values : float64 (numbers, n)
        Overwritten: one line for each column of numbers, NaN where empty. `n` is the number of
        lines or more.
    stamps : int64 (n,)
        Overwritten: numeric times, or nanoseconds since 1970 of dates; the smallest integer where
        empty.
    starts : int64 (n,)
        Overwritten: index of the beginning of each row.

    Returns
    -------
    row : int
        Number of the first row that was not read.
    at : int
        Index of its beginning, or the end of the lines.
    """
    text, size, width = _as_pointer(lines.ctypes), len(lines), len(roles)
    begin = _next_row(text, np.int64(at), size)
    while begin < size:
        number, at = np.int64(0), begin
        for column in range(width):
            cell = at
            first, role = _past_blanks(text, at, separator), roles[column]
            may_quote = cell == first and separator != BLANKS
            value, stamp, at = _read_cell(
                text, first, size, role, separator, point, digits, between, may_quote
            )
            if role == NUMBER:
                values[number, row] = value
                number += 1
            elif role != SKIPPED:
                stamps[row] = stamp
            end = at
            at = _cell_end(text, at, separator, column == width - 1) if at >= 0 else at
            if at < 0 or (separator == BLANKS and (end == first or at == end)):
                return row, begin
        starts[row] = begin
        row, begin = row + 1, _next_row(text, at, size)
    return row, begin
