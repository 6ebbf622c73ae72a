"""Unreadable files of an archive: notes on them, and the gap that each of them leaves."""

from __future__ import annotations

import contextlib
import errno
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import xarray as xr

from gyrostab.errors import FormatError, GyrostabError
from gyrostab.ingest.options import FileSummary
from gyrostab.schema import texts
from gyrostab.time.stamps import format_stamp, to_nanoseconds

#: Largest share of unreadable files; more suggest a wrong option instead of damage.
MAX_LOST_SHARE = 0.5

#: Errors of the system that do not concern the single file.
_SYSTEM = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT, errno.EINTR)

Span = tuple[int, int]
#: Files that cannot be read, and why.
LostFiles = Mapping[Path, str]


def is_damage(path: Path, error: Exception) -> bool:
    """Return whether an error is due to one damaged or missing file.

    A wrong option, a missing unit, or a system out of disk space, memory or file handles is not.
    """
    if path.is_dir() and path.suffix.lower() != ".zarr":
        return False
    if isinstance(error, GyrostabError):
        return isinstance(error, FormatError) and not isinstance(error.__cause__, MemoryError)
    return isinstance(error, OSError) and error.errno not in _SYSTEM


def reason_of(path: Path, error: Exception) -> str:
    """Describe what is wrong with a file, in one line that begins with its name."""
    if isinstance(error, OSError) and not isinstance(error, GyrostabError):
        return f"{path.name}: cannot be read ({error.strerror or error})"
    text = " ".join(str(error).split())
    return text if path.name in text.split(": ")[0] else f"{path.name}: {text}"


def check_share(lost: LostFiles, total: int) -> None:
    """Refuse to go on when more than half of the files cannot be read."""
    if len(lost) > MAX_LOST_SHARE * total:
        advice = "that is more than damage: check the names and the reading options"
        raise FormatError(
            f"{next(iter(lost.values()))}; {len(lost)} of {total} files cannot be read, {advice}"
        )


def _name_key(path: Path) -> list[tuple[int, int, str]]:
    """Return a sort key by which run_9 comes before run_10."""
    return [
        (0, int(piece), "") if piece.isdigit() else (1, 0, piece)
        for piece in re.split(r"(\d+)", str(path))
        if piece
    ]


def find_lost_spans(
    lost: LostFiles, spans: Mapping[Path, Span], scan: Callable[[Path], FileSummary]
) -> dict[Path, Span]:
    """Find the time spans [ns since 1970] of lost files, as far as they can be determined.

    A lost file fills the gap between the files whose names come before and after its name, if these
    follow each other in time; `spans` are those of the files that were read. Otherwise the stamps
    that are still readable are used; `scan` may fail.
    """
    names = sorted([*spans, *lost], key=_name_key)
    lost_spans: dict[Path, Span] = {}
    for path in lost:
        place = names.index(path)
        previous_path = next((name for name in reversed(names[:place]) if name in spans), None)
        next_path = next((name for name in names[place:] if name in spans), None)
        between = (
            _span_between(spans, previous_path, next_path) if previous_path and next_path else None
        )
        span = between or _span_of_stamps(path, scan)
        if span:
            lost_spans[path] = span
    return lost_spans


def _span_between(spans: Mapping[Path, Span], previous_path: Path, next_path: Path) -> Span | None:
    """Return the time between two consecutive files; None if a third lies between."""
    (_, end), (start, _) = sorted([spans[previous_path], spans[next_path]])
    other_spans = [span for path, span in spans.items() if path not in (previous_path, next_path)]
    free = end < start and not any(first < start and last > end for first, last in other_spans)
    return (end, start) if free else None


def _span_of_stamps(path: Path, scan: Callable[[Path], FileSummary]) -> Span | None:
    """Return the first and last readable stamp of a damaged file."""
    with contextlib.suppress(GyrostabError, OSError, RuntimeError, ValueError):
        summary = scan(path)
        if summary.first is not None and summary.last is not None and summary.first < summary.last:
            return int(to_nanoseconds(summary.first)), int(to_nanoseconds(summary.last))
    return None


def add_lost_notes(log: xr.Dataset, lost: LostFiles, spans: Mapping[Path, Span]) -> xr.Dataset:
    """Add notes on the lost files, and their names as ``unreadable_files``."""
    if not lost:
        return log
    notes = []
    for path, reason in lost.items():
        where = "where no other file has its time, there is a gap"
        if path in spans:
            first, last = map(format_stamp, spans[path])
            where = (
                f"its time is between {first} and {last}, which is a gap unless another file "
                "covers it"
            )
        notes.append(f"{reason}; the file is left out: {where}")
    return log.assign_attrs(
        notes=[*texts(log, "notes"), *notes],
        unreadable_files=[
            *log.attrs.get("unreadable_files", []),
            *(path.name for path in lost),
        ],
    )
