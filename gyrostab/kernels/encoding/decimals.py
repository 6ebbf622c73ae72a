"""Read decimal numbers from text, rounded as by `float`, to the last bit."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numba import njit

from gyrostab.arrays import Floats
from gyrostab.kernels.compiled import INNER

_PLUS, _MINUS, _ZERO, _SMALL_E = b"+-0e"
_DIGITS = 19  # that surely fit into 64 bits
_EXACT = np.uint64(1) << np.uint64(53)
_TENS = 10.0 ** np.arange(23)
_LEAST, _MOST = -60, 40


def _powers_of_ten() -> Floats:
    """Compute the powers of ten from `_LEAST` to `_MOST`, each as a sum of two doubles."""
    exact = [Fraction(10) ** power for power in range(_LEAST, _MOST + 1)]
    return np.array([(float(ten), float(ten - Fraction(float(ten)))) for ten in exact])


_POWERS = _powers_of_ten()


@njit(**INNER)
def _split_double(value):  # type: ignore[no-untyped-def]
    """Split a double into two of 26 bits, so that products of parts are exact."""
    scaled = value * (2.0**27 + 1.0)
    high = scaled - (scaled - value)
    return high, value - high


@njit(**INNER)
def _nearest_double(mantissa, power):  # type: ignore[no-untyped-def]
    """Find the double nearest to ``mantissa * 10**power``, unless it is nearly between two.

    The product of Dekker, Numerische Mathematik 18 (1971), with twice the digits of a double.
    """
    if mantissa == np.uint64(0):
        return 0.0, True
    if power < _LEAST or power > _MOST:
        return 0.0, False
    value = np.float64(mantissa)
    if mantissa <= _EXACT and abs(power) < len(_TENS):
        return (value / _TENS[-power], True) if power < 0 else (value * _TENS[power], True)
    rest = np.float64(np.int64(mantissa - np.uint64(value)))
    ten, ten_rest = _POWERS[power - _LEAST]
    product = value * ten
    (a, b), (c, d) = _split_double(value), _split_double(ten)
    low = ((a * c - product) + a * d + b * c) + b * d + (value * ten_rest + rest * ten)
    nearest = product + low
    left = low - (nearest - product)
    doubt = abs(nearest) * 2.0**-98
    is_sure = nearest + (left - doubt) == nearest and nearest + (left + doubt) == nearest
    return nearest, is_sure


@njit(**INNER)
def read_digits(text, at, mantissa):  # type: ignore[no-untyped-def]
    """Continue reading a whole number: value and end."""
    while True:
        digit = np.uint8(text[at] - np.uint8(_ZERO))
        if digit > 9:
            return mantissa, at
        mantissa = mantissa * np.uint64(10) + np.uint64(digit)
        at += 1


@njit(**INNER)
def read_decimal(text, at, point):  # type: ignore[no-untyped-def]
    """Read sign, digits, decimals and end; the end is negative without one, or if long."""
    negative = text[at] == _MINUS
    at += np.int64(negative) | np.int64(text[at] == _PLUS)
    first = at
    mantissa, at = read_digits(text, at, np.uint64(0))
    count, decimals = at - first, np.int64(0)
    if text[at] == point:
        first_decimal = at + 1
        mantissa, at = read_digits(text, first_decimal, mantissa)
        decimals = at - first_decimal
        count += decimals
    if count > _DIGITS:
        while text[first] == _ZERO or text[first] == point:  # zeros in front do not count
            count -= text[first] == _ZERO
            first += 1
    is_number = 0 < count <= _DIGITS or (count == 0 and decimals > 0)
    return negative, mantissa, decimals, at if is_number else np.int64(-1)


@njit(**INNER)
def read_number(text, at, point):  # type: ignore[no-untyped-def]
    """Read a number: value and end; the end is negative without a number."""
    negative, mantissa, decimals, end = read_decimal(text, at, point)
    if end < 0:
        return 0.0, end
    power = -decimals
    if text[end] | 32 == _SMALL_E:
        down = text[end + 1] == _MINUS
        first = end + 1 + (down or text[end + 1] == _PLUS)
        exponent, end = read_digits(text, first, np.uint64(0))
        if not 0 < end - first < 4:
            return 0.0, np.int64(-1)
        power += -np.int64(exponent) if down else np.int64(exponent)
    value, is_exact = _nearest_double(mantissa, power)
    return -value if negative else value, end if is_exact else np.int64(-1)
