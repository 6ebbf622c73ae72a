"""Determine roles, units and factors of columns from their headers, for every format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from gyrostab.errors import OptionError
from gyrostab.ingest.columns.headers import AXIS_PATTERN, FileColumn, split_header
from gyrostab.ingest.columns.plan import (
    MAX_HEADERS,
    Plan,
    name_columns,
    resolve_duplicates,
)
from gyrostab.ingest.columns.plan_roles import plan_channels, plan_gyro
from gyrostab.ingest.columns.plan_time import find_time
from gyrostab.ingest.columns.preset import PresetMatch, find_preset
from gyrostab.ingest.limits import check_columns
from gyrostab.ingest.options import ReadOptions
from gyrostab.wording import list_some


def plan_columns(
    path: Path,
    columns: Sequence[FileColumn],
    options: ReadOptions,
    *,
    rising: Callable[[int], bool] | None = None,
    above: Sequence[str] = (),
    is_filled: Callable[[int], bool] = lambda source: True,
    word_in: Callable[[int], str] = lambda source: "",
) -> Plan:
    """Determine the role and unit of each column.

    `rising` returns whether the first values of a column rise, which decides between candidates for
    the time column; `above` are the lines above the header, which may identify the program that
    wrote the file; `is_filled` returns whether any of the first cells of a column is filled, and
    `word_in` the first of them that holds no number, or nothing.
    """
    check_columns(path, len(columns), options.limits)
    headers = [column.header for column in columns]
    split = [(header, split_header(header)[0]) for header in headers]
    preset = PresetMatch()
    if not any(AXIS_PATTERN.match(name.lower()) for _, name in split):  # named gyro_x ... already
        preset = find_preset(path, split, above=above, is_filled=is_filled)
    plan = Plan(path, options, rising, word_in)
    named = resolve_duplicates(plan, name_columns(plan, columns, preset.columns))
    time = find_time(plan, named)
    data_columns = [column for column in named if column is not time]
    gyro = [column for column in data_columns if AXIS_PATTERN.match(column.low)]
    plan_gyro(plan, gyro, columns)
    plan_channels(plan, [column for column in data_columns if not AXIS_PATTERN.match(column.low)])
    rate = preset.rate if time is None and options.rate is None else None
    if preset.name:
        source_note = f", and {rate:g} Hz by the lines above the header" if rate else ""
        plan.notes.insert(
            0, f"read as a file of {preset.name}{source_note}; --map, --unit and --rate overrule it"
        )
    elif preset_axes := [
        f"{c.header} is {c.name}" for c in named if c.preset and AXIS_PATTERN.match(c.low)
    ]:
        plan.notes.append(
            f"taken for axes: {list_some(preset_axes, MAX_HEADERS)}; --map overrules it"
        )
    if rate is not None:
        plan.options = replace(options, rate=rate)
    if time is None and plan.options.rate is None and not plan.problems:
        plan.refuse(
            OptionError,
            "there is no time column; give the sampling rate with --rate HZ (and --start), or "
            f"name the column: --map NAME=time. Columns: {list_some(headers, MAX_HEADERS)}",
        )
    plan.add_notes(columns)
    order = {"time": 0, "gyro": 1, "channel": 2}
    plan.columns.sort(
        key=lambda column: (order[column.role], column.name if column.role == "gyro" else "")
    )
    return plan
