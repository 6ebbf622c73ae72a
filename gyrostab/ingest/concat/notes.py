"""What is said of several files at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

__all__ = ["first_notes", "merge_notes", "name_some"]

_MAX_NAMED = 5  # of many events of one kind, so many are told one by one


def name_some(names: Sequence[str], most: int = 3) -> str:
    """Name a few of several files.

    Examples
    --------
    >>> some(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def merge_notes(said: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """The notes of all files, each with the file's name in front; what several files say alike is said once.

    Examples
    --------
    >>> together([("a.csv", ["a.csv: 2 rows are unreadable"]), ("b.csv", ["b.csv: 2 rows are unreadable"])])
    ['a.csv, b.csv: 2 rows are unreadable']
    """
    pooled: dict[str, list[str]] = {}
    for name, notes in said:
        for note in notes:
            pooled.setdefault(note.removeprefix(f"{name}: "), []).append(name)
    return [f"{name_some(names)}: {note}" for note, names in pooled.items()]


def first_notes(notes: Sequence[str], what: str) -> list[str]:
    """The first of many notes of one kind, and how many more there are."""
    more = len(notes) - _MAX_NAMED
    return [*notes[:_MAX_NAMED], *([f"{more} more {what}"] if more > 0 else [])]
