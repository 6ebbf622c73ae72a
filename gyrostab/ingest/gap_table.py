"""Table of gaps of a log, by sample: columns, variables, and format of times and durations."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Ints
from gyrostab.errors import SchemaError
from gyrostab.schema import GAP_CAUSES
from gyrostab.time.durations import format_measured_duration
from gyrostab.time.grid import grid_index, grid_times, time_coordinate
from gyrostab.time.stamps import format_stamp, to_nanoseconds
from gyrostab.units import HOUR

#: Largest table; in a longer one, neighbours of one cause are merged into one row.
_MAX_TABLE_ROWS = 10_000

#: Difference from one hour up to which a step of local stamps may be a change of daylight saving
#: time [1]: where many rows share one stamp, the step is known to a few stamps.
_MAX_HOUR_ERROR = 0.01

#: Columns of the table: first missing sample, first present sample after, samples missing, rows
#: concerned, cause.
COLUMNS = FIRST, END, SAMPLES, ROWS, CAUSE = range(5)

#: Causes of gaps, as numbers in the table.
MISSING, UNREADABLE, DUPLICATE, OUTSIDE_RANGE, CLOCK_STEP, RESTART = map(
    GAP_CAUSES.index,
    ("missing", "unreadable", "duplicate", "outside_range", "clock_step", "restart"),
)


def break_cause(first: float, begin: float, before: float, after: float) -> int:
    """Return the cause of a step of a clock: one that steps back restarts, or is corrected.

    It began at `first`, and `begin` was its first stamp after the last step.
    """
    elapsed = before - begin
    is_restart = after <= first + 0.1 * elapsed or 2 * (before - after) > elapsed
    return RESTART if after < before and is_restart else CLOCK_STEP


def describe_break(place: str, cause: int, before: int, after: int, samples: str) -> str:
    """Describe a restart or step of the clock between two stamps [ns since 1970].

    `samples` names what the log consists of, rows or samples.
    """
    jump = (after - before) / 1e9
    event = "time restarts" if cause == RESTART else "the clock steps"
    return (
        f"{event}{place}: from {format_stamp(before)} to {format_stamp(after)}, "
        f"{format_measured_duration(abs(jump))} {'back' if jump < 0 else 'ahead'}; "
        f"the pause is of unknown length, so the {samples} that follow come after one missing "
        f"sample{'' if jump < 0 else '; if the pause is real, raise max_gap'}"
    )


def describe_clock_change(jump: float) -> str:
    """Describe a step [s] of local stamps of about one hour as a change of daylight saving time.

    Returns "" for other steps.

    Examples
    --------
    >>> describe_clock_change(-3599.0)[:63], describe_clock_change(-3500.0)
    ('; as the stamps carry no offset from UTC, this is probably the ', '')
    """
    if abs(abs(jump) / HOUR - 1.0) > _MAX_HOUR_ERROR:
        return ""
    event, effect = (
        ("is probably the end", "the times of the rows that follow are an hour later than written")
        if jump < 0
        else ("may be the beginning", "the rows that follow come an hour too late in the log")
    )
    return (
        f"; as the stamps carry no offset from UTC, this {event} of daylight saving time: if so, "
        f"{effect}; log in UTC, or write the offset into the stamps (+02:00), or split the file "
        "at this row and run the parts separately"
    )


def sort_gaps(table: Ints) -> Ints:
    """Sort a table by sample; merge nearest neighbours of one cause in one that is too long."""
    table = sort_lines(table)
    return sort_lines(_merge_neighbours(table)) if len(table) > _MAX_TABLE_ROWS else table


def sort_lines(table: Ints) -> Ints:
    """Sort a table by sample, and the lines of a sample by cause."""
    return np.asarray(table[np.lexsort((table[:, CAUSE], table[:, FIRST]))])


def _merge_neighbours(table: Ints) -> Ints:
    """Merge lines of a sorted table."""
    parts = []
    for cause in np.unique(table[:, CAUSE]):
        part = table[table[:, CAUSE] == cause]
        room = max(1, int(_MAX_TABLE_ROWS * len(part) / len(table)))
        if len(part) > room and cause not in (CLOCK_STEP, RESTART):
            distance = part[1:, FIRST] - part[:-1, END]
            at = np.concatenate(
                [[0], np.sort(np.argsort(distance, kind="stable")[len(distance) - room + 1 :]) + 1]
            )
            ends = np.maximum.reduceat(part[:, END], at)
            sums = np.add.reduceat(part[:, [SAMPLES, ROWS]], at, axis=0)
            part = np.column_stack([part[at, FIRST], ends, sums, part[at, CAUSE]])
        parts.append(part)
    return np.concatenate(parts)


def clip_table(table: Ints, low: int, high: int) -> Ints:
    """Cut a table of gaps to the lines, or parts of lines, from sample `low` to `high`.

    Examples
    --------
    >>> clip_table(np.array([[2, 8, 6, 0, 0], [9, 9, 0, 1, 2]]), 0, 5)
    array([[2, 5, 3, 0, 0]])
    """
    first, end = np.maximum(table[:, FIRST], low), np.minimum(table[:, END], high)
    event = table[:, FIRST] == table[:, END]
    is_inside = np.where(event, (table[:, FIRST] >= low) & (table[:, FIRST] < high), end > first)
    out = table[is_inside].copy()
    cut = (end - first)[is_inside] < out[:, END] - out[:, FIRST]
    out[:, FIRST], out[:, END] = (
        np.where(event, table[:, FIRST], first)[is_inside],
        np.where(event, table[:, END], end)[is_inside],
    )
    out[cut, SAMPLES] = np.minimum(out[:, SAMPLES], out[:, END] - out[:, FIRST])[cut]
    return out


def name_lost(table: Ints, spans: Iterable[Iterable[int]], start: int, rate: float) -> Ints:
    """Change the cause of gaps that lost files leave to "unreadable".

    `spans` are first and last instant of each lost file [ns since 1970].
    """
    table = table.copy()
    for span in spans:
        low, high = grid_index(start, rate, np.asarray(list(span)))
        shared = np.minimum(table[:, END], high) - np.maximum(table[:, FIRST], low)
        length = table[:, END] - table[:, FIRST]
        belongs = (
            (table[:, CAUSE] == MISSING)
            & (shared > 0)
            & (shared >= 0.5 * np.minimum(length, high - low))
        )
        table[belongs, CAUSE] = UNREADABLE
    return table


def gap_variables(table: Ints, start: int, rate: float) -> dict[str, Any]:
    """Return the variables of a table of gaps; `start` [ns since 1970], `rate` [Hz]."""
    flags = {
        "flag_values": np.arange(len(GAP_CAUSES), dtype=np.int8),
        "flag_meanings": " ".join(GAP_CAUSES),
    }
    first, end = (
        grid_times(start, rate, table[:, column]).view("datetime64[ns]") for column in (FIRST, END)
    )
    return {
        "gap_start": ("gap", first, {"long_name": "first missing sample"}),
        "gap_end": ("gap", end, {"long_name": "first present sample after the gap"}),
        "gap_samples": ("gap", table[:, SAMPLES], {"long_name": "samples missing", "units": "1"}),
        "gap_rows": ("gap", table[:, ROWS], {"long_name": "rows concerned", "units": "1"}),
        "gap_cause": (
            "gap",
            table[:, CAUSE].astype(np.int8),
            {"long_name": "cause of the gap", **flags},
        ),
    }


def make_dataset(
    variables: dict[str, Any],
    coordinates: dict[str, Any],
    table: Ints,
    grid: tuple[int, float, int],
    attributes: dict[str, Any],
) -> xr.Dataset:
    """Make a regular log with a table of gaps; `grid` is start [ns since 1970], rate [Hz], size."""
    axes = xr.Coordinates(coordinates).merge(time_coordinate(*grid)).coords
    return xr.Dataset({**variables, **gap_variables(table, *grid[:2])}, axes, attributes)


def read_gaps(log: xr.Dataset, start: int, rate: float) -> Ints | None:
    """Read the table of gaps in grid samples (`COLUMNS`); None if it is inconsistent."""
    columns: list[Ints] = []
    for name, kind in (
        ("gap_start", "M"),
        ("gap_end", "M"),
        ("gap_samples", "iu"),
        ("gap_rows", "iu"),
        ("gap_cause", "iu"),
    ):
        variable = log.variables.get(name)
        if variable is None and name == "gap_rows":
            columns.append(np.zeros_like(columns[-1]))
            continue
        if variable is None or variable.dims != ("gap",) or variable.dtype.kind not in kind:
            return None
        values = np.asarray(variable.values)
        if kind == "M" and np.isnat(values).any():
            raise SchemaError(
                f"{name!r} holds {int(np.isnat(values).sum())} missing times (NaT); every time "
                "must be known"
            )
        if kind == "M":
            values = np.rint(grid_index(start, rate, to_nanoseconds(values)))
        columns.append(values.astype(np.int64))
    first, end, samples, _, cause = columns
    is_valid = (end >= first) & (samples >= 0) & (cause >= 0) & (cause < len(GAP_CAUSES))
    return np.stack(columns, axis=1) if is_valid.all() else None
