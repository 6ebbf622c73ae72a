"""Lists and numbers in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence


def join_words(words: Sequence[str]) -> str:
    """Join words as in a sentence; empty without a word.

    Examples
    --------
    >>> join_words(["x"]), join_words(["x", "y", "z"])
    ('x', 'x, y and z')
    """
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def list_some(words: Sequence[str], most: int = 3) -> str:
    """List the first words, without empty ones, and say how many more there are.

    Examples
    --------
    >>> list_some(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    more = len(words) - most
    return ", ".join(filter(None, words[:most])) + (f" and {more} more" if more > 0 else "")


def format_share(share: float) -> str:
    """Format a share in percent; only none and all are written as 0 % and 100 %.

    Examples
    --------
    >>> [format_share(share) for share in (0.0, 0.002, 0.37, 0.996, 1.0)]
    ['0 %', '< 1 %', '37 %', '> 99 %', '100 %']
    """
    if 0.0 < share < 0.01:
        return "< 1 %"
    return "> 99 %" if 0.99 < share < 1.0 else f"{100.0 * share:.0f} %"


def format_rounded(value: float, digits: int = 2) -> str:
    """Format a number to some digits; a large one is written out, without an exponent.

    Examples
    --------
    >>> format_rounded(123.4), format_rounded(0.0123), format_rounded(1.2e-7)
    ('120', '0.012', '1.2e-07')
    >>> format_rounded(1920.4, 3)
    '1920'
    """
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text else text


def format_value(value: float, error: float | None = None) -> str:
    """Format a value to the second digit of its error; to four digits without an error.

    Examples
    --------
    >>> format_value(0.71696402, 0.00027), format_value(40.2, 5.1), format_value(0.71696402)
    ('0.71696', '40.2', '0.717')
    """
    return f"{value:.{value_digits(value, error)}g}"


def value_digits(value: float | None, error: float | None) -> int:
    """Return the number of digits that show a value to the second digit of its error; or 4.

    Examples
    --------
    >>> value_digits(0.71696402, 0.00027), value_digits(0.71696402, None)
    (5, 4)
    """
    if not (value and error and math.isfinite(value) and math.isfinite(error)):
        return 4
    beyond = math.floor(math.log10(abs(value))) - math.floor(math.log10(abs(error)))
    return min(max(beyond + 2, 2), 15)
