"""Determine roles, units and factors of columns from their headers, for every format."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from gyrostab.errors import FormatError, MissingUnitError, OptionError, UnitError
from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    GYRO_PATTERNS,
    INCREMENT_PATTERN,
    KNOWN_CHANNEL_PATTERN,
    TEMPERATURE_PATTERN,
    TIME_PATTERN,
    FileColumn,
    channel_name,
    distinct_columns,
    example_unit,
    is_unit,
    is_unit_of,
    quantity_of,
    split_header,
    stored_name,
)
from gyrostab.ingest.columns.likely_channels import find_likely_channels
from gyrostab.ingest.columns.plan import (
    MAX_HEADERS,
    Column,
    Plan,
    PresetMatch,
    describe_left_out,
    find_preset,
    name_columns,
    resolve_duplicates,
)
from gyrostab.ingest.columns.plan_time import find_time
from gyrostab.ingest.limits import check_columns, describe_limit, limit_value
from gyrostab.ingest.options import ReadOptions
from gyrostab.units import INNER, known_units, parse_unit
from gyrostab.wording import list_some


def plan_columns(
    path: Path, columns: Sequence[FileColumn], options: ReadOptions, *, above: Sequence[str] = ()
) -> Plan:
    """Determine the role and unit of each column.

    `above` are the lines above the header, which may identify the program that wrote the file.
    """
    check_columns(path, len(columns), options.limits)
    headers = [column.header for column in columns]
    names = (split_header(header)[0].lower() for header in headers)
    has_axes = any(map(AXIS_PATTERN.match, names))  # named gyro_x ... already
    preset = PresetMatch() if has_axes else find_preset(path, columns, above)
    plan = Plan(path, options)
    named = resolve_duplicates(plan, name_columns(plan, columns, preset.columns))
    time = find_time(plan, named)
    data_columns = [column for column in named if column is not time]
    gyro = [column for column in data_columns if AXIS_PATTERN.match(column.low)]
    _plan_gyro(plan, gyro, columns)
    _plan_channels(plan, [column for column in data_columns if not AXIS_PATTERN.match(column.low)])
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
            f"read as axes: {list_some(preset_axes, MAX_HEADERS)}; --map overrules it"
        )
    if rate is not None:
        plan.options = replace(options, rate=rate)
    if time is None and plan.options.rate is None and not plan.problems:
        plan.refuse(
            OptionError,
            "there is no time column; give the sampling rate with --rate HZ (and --start), or "
            f"name the column: --map NAME=time. Columns: {list_some(headers, MAX_HEADERS)}",
        )
    place = {header.strip(): index for index, header in enumerate(headers)}
    plan.summaries.sort(key=lambda summary: place.get(summary.header, -1))
    order = {"time": 0, "week": 1, "gyro": 2, "channel": 3}
    plan.columns.sort(
        key=lambda column: (order[column.role], column.name if column.role == "gyro" else "")
    )
    return plan


def _plan_gyro(plan: Plan, gyro: list[FileColumn], columns: Sequence[FileColumn]) -> None:
    """Plan the gyro axes, with signal and kind (rates, increments or cumulative angles)."""
    if plan.options.channels_only:
        for column in gyro:
            plan.leave_out(column)
        left_out = [column.header for column in gyro]
        plan.notes += describe_left_out("the file is read for its channels", left_out)
        return
    if not gyro:
        if not plan.problems:
            plan.refuse(FormatError, _describe_lack(plan.path, columns))
        return
    quantities: dict[str, str] = {}
    for column in gyro:
        quantity = _plan_axis(plan, column)
        if quantity is not None:
            quantities[column.header] = quantity
    if len(set(quantities.values())) > 1:
        listed = ", ".join(f"{header!r} ({quantity})" for header, quantity in quantities.items())
        plan.refuse(
            UnitError,
            f"the gyro axes are partly rates, partly angles: {listed}; keep one kind and drop the "
            "others with --map NAME=-",
        )
    if quantities:
        plan.signal = next(iter(quantities.values()))
        first = next(column for column in gyro if column.header in quantities)
        plan.kind = _find_kind(plan, first.header, first.key, first.low)


def _plan_axis(plan: Plan, column: FileColumn) -> str | None:
    match = AXIS_PATTERN.match(column.low)
    assert match is not None
    stem, axis = match.groups()
    example, allowed = ("deg/s", ("rate", "angle")) if stem == "gyro" else ("deg", ("angle",))
    keys = [column.low, column.key, column.header, stem, "gyro"]  # "gyro" is any gyro axis
    text = plan.find_unit(column, keys, column.unit, lambda written: is_unit_of(written, allowed))

    def refuse(error: type[UnitError], problem: str) -> None:
        plan.refuse(error, problem)
        plan.add_summary(column, column.low, "gyro", text)

    if text is None:
        refuse(
            MissingUnitError,
            f"the gyro column {column.header!r} carries no unit; give it with --unit "
            f"{stem}={example} (all axes) or --unit {column.low}={example}, or write it in the "
            f"header: {column.low} [{example}]",
        )
        return None
    quantity = next((quantity for quantity in allowed if is_unit_of(text, (quantity,))), None)
    try:
        unit = parse_unit(text, quantity)
    except UnitError as error:
        problem = f"column {column.header!r}: {error}"
        if "is not known" in str(error):
            problem = (
                f"column {column.header!r}: unit {text!r} is not known; known are "
                f"{known_units('rate')}; give it with --unit {stem}={example}, or with a factor "
                f'--unit "{stem}=0.1 arcsec/s"'
            )
        refuse(UnitError, problem)
        return None
    if unit.quantity not in allowed:
        refuse(
            UnitError,
            f"column {column.header!r} has the unit {text!r}, which is a unit of {unit.quantity}, "
            f"not of {allowed[0]}; {allowed[0]} units are {known_units(allowed[0])}; give the "
            f"right one with --unit {stem}={example}, or with a factor for counts: --unit "
            f'"{stem}=0.1 {"arcsec/s" if stem == "gyro" else "arcsec"}"',
        )
        return None
    planned = column.source, column.header, "gyro", axis, INNER[unit.quantity]
    plan.add_column(column, text, Column(*planned, unit.factor, unit.offset))
    return unit.quantity


def _find_kind(plan: Plan, header: str, key: str, name: str) -> str:
    if plan.signal == "rate":
        if plan.options.kind == "angle":
            plan.refuse(
                OptionError,
                f"--kind angle, but column {header!r} is a rate; leave --kind out, or correct the "
                f'unit with --map "{key}={name} [deg]"',
            )
        return "rate"
    if plan.options.kind is None:
        plan.refuse(
            OptionError,
            f"column {header!r} is an angle of unknown kind; give --kind angle if it is the "
            "cumulative angle, --kind rate if each row is the increment since the row before",
        )
    if plan.options.kind == "angle" and name.startswith("gyro") and INCREMENT_PATTERN.search(key):
        plan.refuse(
            OptionError,
            f"--kind angle, but column {header!r} is named as an increment; give --kind rate if "
            "each row is an increment, or if it is the cumulative angle, name it so with "
            f'--map "{key}=angle_{name.removeprefix("gyro_")}"',
        )
    return "angle" if plan.options.kind == "angle" else "increment"


def _plan_channels(plan: Plan, rest: list[FileColumn]) -> None:
    """Plan the channels: those with a unit are kept, others left out with a note or refused."""
    suggested = _note_likely_channels(plan, rest)
    limits, others = plan.options.limits, len(plan.columns)  # time and gyro
    unitless: list[tuple[str, str | None]] = []  # name and quantity of channels without a unit
    left_out: dict[str, list[str]] = {"unit": [], "limit": []}
    for column in rest:
        quantity = quantity_of(column.low)
        likely = quantity or ("temperature" if TEMPERATURE_PATTERN.search(column.low) else None)
        is_known = bool(KNOWN_CHANNEL_PATTERN.match(column.low))
        name = channel_name(column)
        keys = [name, column.name, column.key, column.header]
        keys += [column.low.split("_")[0]] if quantity else []
        usable = partial(is_unit_of, quantities=(quantity,)) if quantity else is_unit
        text = plan.find_unit(column, keys, column.unit, usable)
        if column.low == "ramp" and text is None:
            text = "1"  # any scale will do
        asked = (
            column.mapped
            or plan.unit_key(keys) is not None
            or (is_known and plan.options.channels_only)
        )
        if text is None and asked:
            plan.refuse(
                MissingUnitError,
                f"column {column.header!r} carries no unit; give it with --unit "
                f'{name}={example_unit(likely)}, or drop the column with --map "{column.key}=-"',
            )
        is_full = len(plan.columns) - others >= limit_value("channels", limits)
        if text is None:
            if column.source not in suggested:
                unitless.append((name, likely))
            left_out["unit"].append(column.header)
            plan.leave_out(column)
        elif is_full and not (is_known or asked):
            left_out["limit"].append(column.header)
            plan.leave_out(column)
        else:
            _plan_channel(plan, column, name, quantity, text, is_known=is_known, asked=asked)
    advice = ""
    if unitless:
        name, likely = min(unitless, key=lambda entry: entry[1] is None)  # a known quantity first
        advice = f"keep one with a unit: --unit {shlex.quote(f'{name}={example_unit(likely)}')}"
    plan.notes += describe_left_out("they carry no unit", left_out["unit"], advice)
    needed = len(plan.columns) - others + len(left_out["limit"])
    advice = "map those that are needed (--map NAME=NAME); "
    advice += describe_limit("channels", needed, limits)
    reason = "there are more channels than a log keeps"
    plan.notes += describe_left_out(reason, left_out["limit"], advice)


def _note_likely_channels(plan: Plan, rest: list[FileColumn]) -> set[int]:
    """Note which columns may be channels that effects follow; return the columns to map."""
    options = plan.options
    if options.channels_only or options.channel:  # a file of channels may hold them
        return set()
    named: list[tuple[str, str | None]] = []
    limit = min(limit_value("channels", options.limits), len(rest))
    for column in rest[: int(limit)]:
        key = plan.unit_key((column.low, column.key, column.header))
        named.append((column.key, column.written or (options.unit[key] if key else None)))
    listed: list[str] = []
    maps: list[str] = []
    places: set[int] = set()
    for channel, likely in find_likely_channels(named).items():
        columns = [rest[column.place] for column in likely]
        if any(column.mapped for column in columns):
            continue
        headers = list_some([column.header for column in columns], MAX_HEADERS)
        unit = "" if likely[0].in_header else f" [{likely[0].unit}]"
        listed.append(f"{channel} ({headers})")
        maps.append(f'--map "{columns[0].key}={channel}{unit}"')
        places.add(columns[0].source)
    if listed:
        plan.notes.append(
            f"may be channels that effects follow: {', '.join(listed)}; name them: {' '.join(maps)}"
        )
    return places


def _plan_channel(
    plan: Plan,
    column: FileColumn,
    name: str,
    quantity: str | None,
    text: str,
    *,
    is_known: bool,
    asked: bool,
) -> None:
    factor, offset, units = 1.0, 0.0, text
    if quantity is not None:
        if is_unit_of(text, (quantity,)):
            unit = parse_unit(text, quantity)
            factor, offset, units = unit.factor, unit.offset, INNER[quantity]
        elif quantity == "number" and is_known:
            units = INNER["number"]
        elif is_known:
            message = f"column {column.header!r}: {text!r} is not a known unit of {quantity}"
            advice = (
                f"known are {known_units(quantity)}; give it with --unit "
                f"{name}={example_unit(quantity)}"
            )
            if not asked:
                plan.notes.append(f"{message}, so it is left out; {advice}")
                plan.leave_out(column)
                return
            fix = f'{advice}, or drop the column with --map "{column.key}=-"'
            plan.refuse(UnitError, f"{message}; {fix}")
    stored = stored_name(name)
    if stored != name:
        plan.notes.append(
            f"column {column.header!r} is kept as {stored!r}, as {name!r} is a variable of "
            f'gyrostab; for another name give --map "{column.key}=NAME"'
        )
    planned = column.source, column.header, "channel", stored, units
    plan.add_column(column, text, Column(*planned, factor, offset))


def _describe_lack(path: Path, columns: Sequence[FileColumn]) -> str:
    """Say that no column is a gyro axis, and how to name the likely ones."""
    headers = [column for column in distinct_columns(columns) if column.header]
    free = [c for c in headers if not TIME_PATTERN.match(c.low) and quantity_of(c.low) is None]
    candidates = (c for pattern in GYRO_PATTERNS for c in free if pattern.search(c.name))
    likely = next(candidates, next(filter(_may_be_axis, free), None))
    advice = f"If it holds channels of another log, give it as --channel {shlex.quote(path.name)}"
    if likely is not None:
        example = f'--map "{likely.key}=gyro_x"{_axis_options(likely)}'
        advice = f"Say which they are, for instance: {example}"
    return (
        "no gyro column (gyro_x, gyro_y, gyro_z or angle_x ...). Columns: "
        f"{list_some([c.name for c in headers], 100)}. {advice}{scan_advice(path)}"
    )


def _axis_options(column: FileColumn) -> str:
    """Return the options that a column needs as a gyro axis, with a blank in front."""
    if column.unit and is_unit_of(column.unit, ("rate",)):
        return ""
    if column.unit and is_unit_of(column.unit, ("angle",)):
        return f" --kind {'rate' if INCREMENT_PATTERN.search(column.name) else 'angle'}"
    low = column.header.lower()
    if INCREMENT_PATTERN.search(column.name):
        return f" --unit gyro={'rad' if 'rad' in low else 'deg'} --kind rate"
    if re.search(r"deg_?(per_?|/)?h|dph", low):
        return " --unit gyro=deg/h"
    return f" --unit gyro={'rad/s' if 'rad' in low else 'deg/s'}"


def _may_be_axis(column: FileColumn) -> bool:
    """Return whether unit and values of a column allow a gyro axis."""
    unit = column.written or "1"
    has_other_unit = is_unit(unit) and not is_unit_of(unit, ("rate", "angle", "number"))
    return not (has_other_unit or column.stamped)


def scan_advice(path: Path) -> str:
    """Return the end of a message that advises `gyrostab scan`, which leaves it out."""
    return f"; gyrostab scan {shlex.quote(path.name)} inspects each column"
