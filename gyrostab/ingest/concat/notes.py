"""Notes on several files at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from gyrostab.wording import list_some

__all__ = ["absence_notes", "first_notes", "merge_notes"]

_MAX_NAMED = 5  # events of one kind that are listed one by one


def absence_notes(absent: Mapping[str, Sequence[str]]) -> list[str]:
    """Return notes on axes and channels that some files lack, by the names of these files."""
    return [
        f"{name} is not in {list_some(files)} and is missing there"
        for name, files in absent.items()
        if files
    ]


def merge_notes(notes_by_file: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Merge the notes of all files, with file names in front; equal notes appear once.

    Examples
    --------
    >>> note = "2 rows are unreadable"
    >>> merge_notes([("a.csv", [f"a.csv: {note}"]), ("b.csv", [f"b.csv: {note}"])])
    ['a.csv, b.csv: 2 rows are unreadable']
    """
    pooled: dict[str, list[str]] = {}
    for name, notes in notes_by_file:
        for note in notes:
            pooled.setdefault(note.removeprefix(f"{name}: "), []).append(name)
    return [f"{list_some(names)}: {note}" for note, names in pooled.items()]


def first_notes(notes: Sequence[str], subject: str) -> list[str]:
    """Return the first of many notes of one kind, and how many more there are."""
    more = len(notes) - _MAX_NAMED
    return [*notes[:_MAX_NAMED], *([f"{more} more {subject}"] if more > 0 else [])]
