"""Lists in sentences."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["join_words", "list_some"]


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
