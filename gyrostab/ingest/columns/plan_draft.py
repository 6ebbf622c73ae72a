"""A plan while it is being made: columns, notes, problems and the options that were used."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gyrostab.errors import GyrostabError
from gyrostab.ingest.columns.headers import (
    Header,
    example_unit,
)
from gyrostab.ingest.columns.stamps import TimeUnit
from gyrostab.ingest.limits import describe_limit
from gyrostab.ingest.options import ColumnSummary, ReadOptions

__all__ = ["Column", "PlanDraft", "by_lower_name", "list_names"]


@dataclass(frozen=True)
class Column:
    """A column to read, as ``value * factor + offset`` in `units`; stamps by `time_unit`."""

    source: int
    header: str
    role: str  # "time", "gyro" or "channel"
    name: str  # "time", the axis, or the channel
    quantity: str
    units: str
    factor: float = 1.0
    offset: float = 0.0
    time_unit: TimeUnit | None = None


class PlanDraft:
    """Columns, notes and problems of a plan while it is being made."""

    def __init__(self, path: Path, options: ReadOptions, rising: Callable[[int], bool]):
        self.path, self.options, self.rising = path, options, rising
        self.columns: list[Column] = []
        self.summaries: list[ColumnSummary] = []
        self.notes: list[str] = []
        self.problems: list[GyrostabError] = []
        self.left_out: list[str] = []
        self.surplus: list[str] = []
        self.kept_channels = 0
        self.unitless: list[tuple[str, str | None, str]] = []  # name, quantity, header
        self.used_map: set[str] = set()
        self.used_units: set[str] = set()

    def find_unit(
        self,
        column: Header,
        keys: list[str],
        written: str | None,
        usable: Callable[[str], bool],
        *,
        prefer_given: bool = False,
    ) -> str | None:
        """Return the unit of a column: from its header if usable, otherwise from the user."""
        given = by_lower_name(self.options.unit)
        key = next((given[low] for low in map(str.lower, keys) if low in given), None)
        if key is None:
            return written or column.stored
        self.used_units.add(key)
        text = self.options.unit[key]
        if written is None or prefer_given or written == text:
            return text
        if not usable(written):
            self.notes.append(
                f"column {column.header!r} says [{written}], which is not a usable unit; it is "
                f"read by --unit {key}={text}"
            )
            return text
        note = (
            f"column {column.header!r} says [{written}], so --unit {key}={text} is not "
            "applied to it"
        )
        self.notes.append(
            f'{note}; to overrule the header give --map "{column.key}={column.low} [{text}]"'
        )
        return written

    def leave_out(self, column: Header) -> None:
        """Add the summary of a column that is left out."""
        self.add_summary(column, column.name, "left out", None, column.unit or column.stored)

    def add_summary(
        self, column: Header, name: str, role: str, quantity: str | None, unit: str | None
    ) -> None:
        """Add the summary of a column."""
        self.summaries.append(ColumnSummary(column.header, name, role, quantity, unit, column.key))

    def add_notes(self, headers: Sequence[str]) -> None:
        """Add notes on columns that were left out, and sort the summaries as in the file."""
        if self.unitless:
            name, quantity, _ = min(
                self.unitless, key=lambda entry: entry[1] is None
            )  # a known quantity first
            advice = (
                f"keep one with a unit: --unit {shlex.quote(f'{name}={example_unit(quantity)}')}"
            )
            self.notes.append(
                "left out, as they carry no unit: "
                f"{list_names([header for _, _, header in self.unitless])} ({advice})"
            )
        if self.surplus:
            needed = self.kept_channels + len(self.surplus)
            advice = (
                "map those that are needed (--map NAME=NAME); "
                f"{describe_limit('channels', needed, self.options.limits)}"
            )
            self.notes.append(
                "left out, as there are more channels than a log keeps: "
                f"{list_names(self.surplus, 5)} ({advice})"
            )
        if self.left_out:
            self.notes.append(
                f"left out, as the file is read for its channels: {list_names(self.left_out)}"
            )
        place = {header.strip(): index for index, header in enumerate(headers)}
        self.summaries.sort(key=lambda summary: place.get(summary.header, -1))


def by_lower_name(names: Mapping[str, str]) -> dict[str, str]:
    """Return lower-case name -> name."""
    return {name.lower(): name for name in names}


def list_names(names: Sequence[str], most: int = 30) -> str:
    """Join the first names of a list, and say how many more there are."""
    shown = ", ".join(name for name in names[:most] if name)
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")
