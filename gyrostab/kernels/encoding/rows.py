"""Read rows of plain text into numbers and stamps, in the form that nearly all logs have.

Cells are decimal numbers, ISO 8601 dates, or empty. Reading stops at the first row that holds
anything else, and the caller reads that row in another way. Numbers are rounded as by `float`, to
the last bit; stamps are whole nanoseconds.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from gyrostab.kernels.compiled import INNER, KERNEL

__all__ = ["BLANKS", "ISO", "NUMBER", "NUMERIC_TIME", "SKIPPED", "clean_column", "read_rows"]

#: What a column holds.
SKIPPED, NUMBER, NUMERIC_TIME, ISO = range(4)
#: Separator code of runs of blanks and tabs.
BLANKS = 32

_NAT = np.iinfo(np.int64).min
_TAB, _LINE, _RETURN, _BLANK, _QUOTE, _HASH, _PERCENT = 9, 10, 13, 32, 34, 35, 37
_PLUS, _MINUS, _POINT, _ZERO, _COLON, _T, _Z, _E, _SMALL_E, _SMALL_A, _SMALL_N = (
    43,
    45,
    46,
    48,
    58,
    84,
    90,
    69,
    101,
    97,
    110,
)
_DIGITS = 19  # that surely fit into 64 bits
_EXACT = np.uint64(1) << np.uint64(53)
_TENS = 10.0 ** np.arange(23)
_WHOLE_TENS = np.array([10**n for n in range(20)], dtype=np.uint64)
_LEAST, _MOST = -60, 40
_HALF = np.uint64(2**32 - 1)
_FULL = np.uint64(2**64 - 1)
_ZEROS, _TO_TEN, _TOPS = (
    np.uint64(0x3030303030303030),
    np.uint64(0x7676767676767676),
    np.uint64(0x8080808080808080),
)
_FIRST_PAIRS, _FIRST_SCALE, _SECOND_SCALE = (
    np.uint64(0xFF000000FF),
    np.uint64(0xF424000000064),
    np.uint64(0x271000000001),
)
_LONGEST_NS = np.uint64(2**63 - 1)


def _powers_of_five() -> NDArray[np.uint64]:
    """Compute the leading 128 bits of the powers of five from `_LEAST` to `_MOST`, in two words."""
    words = []
    for power in range(_LEAST, _MOST + 1):
        if power < 0:
            five = 5**-power
            bits = (five - 1).bit_length()
            value = 2 ** (bits + 127 if power >= -27 else 2 * bits + 128) // five + 1
        else:
            value = 5**power << 128
        value >>= value.bit_length() - 128
        words.append((value >> 64, value & (2**64 - 1)))
    return np.array(words, dtype=np.uint64)


_FIVES = _powers_of_five()


@intrinsic
def _load_byte(typing, text, at):  # type: ignore[no-untyped-def]
    """Load the byte at an address; passing arrays would cost more than the reading."""

    def load(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load(builder.inttoptr(builder.add(*arguments), ir.IntType(8).as_pointer()))

    return types.uint8(types.intp, types.intp), load


@intrinsic
def _load_eight(typing, text, at):  # type: ignore[no-untyped-def]
    """Load eight bytes from an address on, little-endian."""

    def load(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load(
            builder.inttoptr(builder.add(*arguments), ir.IntType(64).as_pointer()), align=1
        )

    return types.uint64(types.intp, types.intp), load


@intrinsic
def _zeros_behind(typing, word):  # type: ignore[no-untyped-def]
    """Count the trailing zero bits of a word; 64 for zero."""

    def count(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.IntType(1)(0))

    return types.uint64(types.uint64), count


@njit(**INNER)
def _multiply_words(a, b):  # type: ignore[no-untyped-def]
    """Multiply two words: high and low word."""
    half = np.uint64(32)
    a0, a1, b0, b1 = a & _HALF, a >> half, b & _HALF, b >> half
    low = a0 * b0
    middle = a1 * b0 + (low >> half)
    other = a0 * b1 + (middle & _HALF)
    return a1 * b1 + (middle >> half) + (other >> half), (other << half) | (low & _HALF)


@njit(**INNER)
def _nearest_double(mantissa, power):  # type: ignore[no-untyped-def]
    """Find the double nearest to ``mantissa * 10**power``, if the method of Lemire finds it.

    Lemire, Software: Practice and Experience 51 (2021).
    """
    if mantissa == np.uint64(0):
        return 0.0, True
    if power < _LEAST or power > _MOST:
        return 0.0, False
    if mantissa <= _EXACT and abs(power) < len(_TENS):
        return (mantissa / _TENS[-power], True) if power < 0 else (mantissa * _TENS[power], True)
    shifted = np.int64(0)
    while not mantissa >> np.uint64(63):
        mantissa <<= np.uint64(1)
        shifted += 1
    high, low = _multiply_words(mantissa, _FIVES[power - _LEAST, 0])
    if high & np.uint64(0x1FF) == np.uint64(0x1FF):
        more, _ = _multiply_words(mantissa, _FIVES[power - _LEAST, 1])
        low += more
        if more > low:
            high += np.uint64(1)
    if low == _FULL and power < -27:
        return 0.0, False
    top = np.int64(high >> np.uint64(63))
    shift = np.uint64(top + 9)
    kept = high >> shift
    if (
        low <= np.uint64(1)
        and -4 <= power <= 23
        and kept & np.uint64(3) == np.uint64(1)
        and kept << shift == high
    ):
        kept &= ~np.uint64(1)
    kept += kept & np.uint64(1)
    kept >>= np.uint64(1)
    return math.ldexp(np.float64(kept), ((217706 * power) >> 16) + 63 + top - shifted - 52), True


@njit(**INNER)
def _read_digits(text, at, size, mantissa):  # type: ignore[no-untyped-def]
    """Continue reading a whole number: value and end.

    Reads eight bytes at a time, because the processor cannot predict the end of a loop over digits.
    """
    while at + 8 <= size:
        bare = _load_eight(text, at) ^ _ZEROS
        other = ((bare + _TO_TEN) | bare) & _TOPS
        count = _zeros_behind(other) >> np.uint64(3)
        if count == np.uint64(0):
            return mantissa, at
        bare <<= (np.uint64(8) - count) << np.uint64(3)
        pairs = bare * np.uint64(10) + (bare >> np.uint64(8))
        high = (pairs & _FIRST_PAIRS) * _FIRST_SCALE
        value = (high + ((pairs >> np.uint64(16)) & _FIRST_PAIRS) * _SECOND_SCALE) >> np.uint64(32)
        mantissa = mantissa * _WHOLE_TENS[count] + value
        at += np.int64(count)
        if count < np.uint64(8):
            return mantissa, at
    while True:
        digit = np.uint8(_load_byte(text, at) - np.uint8(_ZERO))
        if digit > 9:
            return mantissa, at
        mantissa = mantissa * np.uint64(10) + np.uint64(digit)
        at += 1


@njit(**INNER)
def _read_decimal(text, at, size, point):  # type: ignore[no-untyped-def]
    """Read sign, digits, decimals and end; the end is negative without one, or if long."""
    negative = _load_byte(text, at) == _MINUS
    at += np.int64(negative) | np.int64(_load_byte(text, at) == _PLUS)
    first = at
    mantissa, at = _read_digits(text, at, size, np.uint64(0))
    count, decimals = at - first, np.int64(0)
    if _load_byte(text, at) == point:
        after = at + 1
        mantissa, at = _read_digits(text, after, size, mantissa)
        decimals = at - after
        count += decimals
    if count > _DIGITS:
        while (
            _load_byte(text, first) == _ZERO or _load_byte(text, first) == point
        ):  # zeros in front do not count
            count -= _load_byte(text, first) == _ZERO
            first += 1
    return (
        negative,
        mantissa,
        decimals,
        at if 0 < count <= _DIGITS or (count == 0 and decimals > 0) else np.int64(-1),
    )


@njit(**INNER)
def _read_number(text, at, size, point):  # type: ignore[no-untyped-def]
    """Read a number: value and end; the end is negative without a number."""
    negative, mantissa, decimals, end = _read_decimal(text, at, size, point)
    if end < 0:
        here = at + (_load_byte(text, at) == _MINUS)
        if (
            _load_byte(text, here) | 32 == _SMALL_N
            and _load_byte(text, here + 1) | 32 == _SMALL_A
            and _load_byte(text, here + 2) | 32 == _SMALL_N
        ):
            return np.nan, here + 3
        return 0.0, end
    power = -decimals
    if _load_byte(text, end) | 32 == _SMALL_E:
        down = _load_byte(text, end + 1) == _MINUS
        first = end + 1 + (down or _load_byte(text, end + 1) == _PLUS)
        exponent, end = _read_digits(text, first, size, np.uint64(0))
        if not 0 < end - first < 4:
            return 0.0, np.int64(-1)
        power += -np.int64(exponent) if down else np.int64(exponent)
    value, found = _nearest_double(mantissa, power)
    return -value if negative else value, end if found else np.int64(-1)


@njit(**INNER)
def _count_of_time(text, at, size, point, digits):  # type: ignore[no-untyped-def]
    """Read a numeric time as a multiple of ``10**-digits``, rounded half to even, and its end."""
    negative, mantissa, decimals, end = _read_decimal(text, at, size, point)
    if end < 0 or (digits == 0 and decimals > 0) or decimals - digits > 18:
        return np.int64(0), np.int64(-1)
    if decimals <= digits:
        scale = _WHOLE_TENS[digits - decimals]
        if mantissa > _LONGEST_NS // scale:
            return np.int64(0), np.int64(-1)
        count = np.int64(mantissa * scale)
    else:
        scale = _WHOLE_TENS[decimals - digits]
        whole, rest = mantissa // scale, mantissa % scale
        odd = whole & np.uint64(1)
        count = np.int64(whole + np.uint64(np.uint64(2) * rest + odd > scale))
    return -count if negative else count, end


@njit(**INNER)
def _read_pair(text, at):  # type: ignore[no-untyped-def]
    """Read a number of two digits; above 99 if invalid."""
    tens, ones = (
        np.uint8(_load_byte(text, at) - np.uint8(_ZERO)),
        np.uint8(_load_byte(text, at + 1) - np.uint8(_ZERO)),
    )
    return np.int64(10 * tens + ones) if tens < 10 and ones < 10 else np.int64(1000)


@njit(**INNER)
def _days_since_1970(year, month, day):  # type: ignore[no-untyped-def]
    """Count the days since 1970-01-01 (years begin in March)."""
    year -= month <= 2
    age = year - 1600
    of_year = (153 * (month - 3 if month > 2 else month + 9) + 2) // 5 + day - 1
    return 365 * age + age // 4 - age // 100 + age // 400 + of_year - 135080


@njit(**INNER)
def _read_iso_stamp(text, at, size):  # type: ignore[no-untyped-def]
    """Read ``2026-01-02T03:04:05.678Z`` (or a blank for the T, no Z): nanoseconds and end."""
    none = (np.int64(0), np.int64(-1))
    if at + 19 >= size:
        return none
    year = 100 * _read_pair(text, at) + _read_pair(text, at + 2)
    month, day, hour, minute, second = (
        _read_pair(text, at + 5), _read_pair(text, at + 8), _read_pair(text, at + 11),
        _read_pair(text, at + 14), _read_pair(text, at + 17),
    )  # fmt: skip
    if (
        _load_byte(text, at + 4) != _MINUS
        or _load_byte(text, at + 7) != _MINUS
        or _load_byte(text, at + 13) != _COLON
        or _load_byte(text, at + 16) != _COLON
    ):
        return none
    if (_load_byte(text, at + 10) != _T and _load_byte(text, at + 10) != _BLANK) or not (
        1700 <= year < 2200 and 1 <= month <= 12 and day >= 1
    ):
        return none
    short = month == 4 or month == 6 or month == 9 or month == 11
    leap = year % 4 == 0 and (year % 100 != 0 or year % 400 == 0)
    last = 28 + leap if month == 2 else 31 - short
    if day > last or hour > 23 or minute > 59 or second > 59:
        return none
    end, part = at + 19, np.uint64(0)
    if _load_byte(text, end) == _POINT:
        part, stop = _read_digits(text, end + 1, size, np.uint64(0))
        length = stop - end - 1
        if not 0 < length <= 9:
            return none
        part *= _WHOLE_TENS[9 - length]
        end = stop
    if _load_byte(text, end) == _Z:
        end += 1
    seconds = ((_days_since_1970(year, month, day) * 24 + hour) * 60 + minute) * 60 + second
    return seconds * 1_000_000_000 + np.int64(part), end


@njit(**INNER)
def _past_blanks(text, at, separator):  # type: ignore[no-untyped-def]
    while _load_byte(text, at) == _BLANK or (_load_byte(text, at) == _TAB and separator != _TAB):
        at += 1
    return at


@njit(**INNER)
def _cell_end(text, at, separator, last):  # type: ignore[no-untyped-def]
    """Find the next cell, or line, after a cell that ends at `at`; negative if malformed."""
    at = _past_blanks(text, at, separator)
    if last:
        at += _load_byte(text, at) == _RETURN
        return at + 1 if _load_byte(text, at) == _LINE else np.int64(-1)
    if separator == BLANKS:  # one was passed, or there is another cell's text here
        return (
            at
            if _load_byte(text, at) != _LINE and _load_byte(text, at) != _RETURN
            else np.int64(-1)
        )
    return at + 1 if _load_byte(text, at) == separator else np.int64(-1)


@njit(**INNER)
def _skip_cell(text, at, separator):  # type: ignore[no-untyped-def]
    """Find the end of a skipped cell; negative where quotes or comments make it uncertain."""
    while (
        _load_byte(text, at) != _LINE
        and _load_byte(text, at) != separator
        and not (separator == BLANKS and _load_byte(text, at) == _TAB)
    ):
        if _load_byte(text, at) == _QUOTE or _load_byte(text, at) == _HASH:
            return np.int64(-1)
        at += 1
    return (
        at - 1
        if at and _load_byte(text, at) == _LINE and _load_byte(text, at - 1) == _RETURN
        else at
    )


@njit(**INNER)
def _is_void(text, at, separator):  # type: ignore[no-untyped-def]
    return (
        _load_byte(text, at) == separator
        or _load_byte(text, at) == _LINE
        or _load_byte(text, at) == _RETURN
    )


@njit(**INNER)
def _read_cell(text, at, size, role, separator, point, digits):  # type: ignore[no-untyped-def]
    """Read number, stamp and end of a cell; the end is negative for other content."""
    if role == SKIPPED:
        return 0.0, np.int64(0), _skip_cell(text, at, separator)
    if _is_void(text, at, separator):
        return np.nan, np.int64(_NAT), at
    if role == NUMBER:
        value, end = _read_number(text, at, size, point)
        return value, np.int64(0), end
    stamp, end = (
        _read_iso_stamp(text, at, size)
        if role == ISO
        else _count_of_time(text, at, size, point, digits)
    )
    return 0.0, stamp, end


@njit(**INNER)
def _next_row(text, at, size):  # type: ignore[no-untyped-def]
    """Find the next line that is neither blank nor a comment."""
    while at < size:
        here = _past_blanks(text, at, np.int64(_TAB))
        if _load_byte(text, here) == _HASH or _load_byte(text, here) == _PERCENT:
            while _load_byte(text, here) != _LINE:
                here += 1
        here += _load_byte(text, here) == _RETURN
        if _load_byte(text, here) != _LINE:
            break
        at = here + 1
    return at


@njit(**KERNEL)
def _read_rows(lines, start, roles, separator, point, digits, values, stamps):  # type: ignore[no-untyped-def]
    """Run `read_rows` into `values` and `stamps`."""
    text, size, width = lines.ctypes.data, len(lines), len(roles)
    row, begin = np.int64(0), _next_row(text, np.int64(start), size)
    while begin < size and row < len(stamps):
        number, at = np.int64(0), begin
        for column in range(width):
            at = _past_blanks(text, at, separator)
            first, role = at, roles[column]
            value, stamp, at = _read_cell(text, at, size, role, separator, point, digits)
            if role == NUMBER:
                values[number, row] = value
                number += 1
            elif role != SKIPPED:
                stamps[row] = stamp
            end = at
            at = _cell_end(text, at, separator, column == width - 1) if at >= 0 else at
            if at < 0 or (separator == BLANKS and (end == first or at == end)):
                return row, begin
        begin = _next_row(text, at, size)
        row += 1
    return row, begin


def read_rows(
    text: NDArray[np.uint8],
    start: int,
    roles: NDArray[np.int64],
    *,
    separator: int,
    point: int,
    digits: int,
    rows: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64], int]:
    """Read rows up to the first with other content.

    Parameters
    ----------
    text : ndarray of uint8
        Whole lines; the last byte is the end of a line.
    start : int
        Index of the beginning of the first line to read.
    roles : ndarray of int64
        What each column holds: `SKIPPED`, `NUMBER`, `NUMERIC_TIME`, `ISO`.
    separator, point : int
        Codes of the separator (`BLANKS` for runs of them) and of the decimal point.
    digits : int
        Numeric times are rounded to this number of decimals and given as whole numbers of the last;
        with 0 they must be whole.
    rows : int
        Largest number of rows: the number of lines.

    Returns
    -------
    values : ndarray of float64, shape (numbers, n)
        One line for each column of numbers, NaN where empty.
    stamps : ndarray of int64, shape (n,)
        Numeric times, or nanoseconds since 1970 for `ISO`; the smallest integer where empty.
    stop : int
        Index of the first row with other content, or the end.
    """
    values = np.empty((int(np.count_nonzero(roles == NUMBER)), rows))
    stamps = np.empty(rows, dtype=np.int64)
    n, stop = _read_rows(text, start, roles, separator, point, digits, values, stamps)
    if 2 * n < rows:  # a short part must not keep the room of a long one
        return values[:, :n].copy(), stamps[:n].copy(), int(stop)
    return values[:, :n], stamps[:n], int(stop)


@njit(**KERNEL)
def clean_column(values, factor, offset):  # type: ignore[no-untyped-def]
    """Convert in place, ``values * factor + offset``, and set infinite values to NaN.

    Returns
    -------
    missing : int
        Values that are not finite.
    low, high : float
        Range of the others, before conversion; infinite without any.
    whole : bool
        Whether they are whole numbers.
    """
    missing, low, high, whole = np.int64(0), np.inf, -np.inf, True
    same = factor == 1.0 and offset == 0.0
    for i in range(len(values)):
        value = values[i]
        if not math.isfinite(value):
            missing += 1
            values[i] = np.nan
            continue
        low, high = min(low, value), max(high, value)
        if whole:
            whole = value == np.rint(value)
        if not same:
            values[i] = value * factor + offset
    return missing, low, high, whole
