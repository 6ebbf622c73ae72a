"""Lists in sentences."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["join_words"]


def join_words(words: Sequence[str]) -> str:
    """Join words as in a sentence; empty without a word.

    Examples
    --------
    >>> join_words(["x"]), join_words(["x", "y", "z"])
    ('x', 'x, y and z')
    """
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
