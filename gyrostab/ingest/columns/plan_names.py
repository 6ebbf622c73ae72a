"""Name the columns of a file by ``--map`` and presets, and resolve duplicate names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gyrostab.errors import FormatError
from gyrostab.ingest.columns.headers import (
    AXIS_PATTERN,
    Header,
    distinct_columns,
    free_name,
    is_contract_name,
    split_header,
)
from gyrostab.ingest.columns.plan_draft import PlanDraft, list_names

__all__ = ["name_columns", "resolve_duplicates"]


def name_columns(
    draft: PlanDraft,
    headers: Sequence[str],
    units: Mapping[int, str],
    calendars: Mapping[int, str],
    stamped: frozenset[int],
    presets: Mapping[int, str],
) -> list[Header]:
    """Name the columns by ``--map``, then by the preset, and drop those that either drops."""
    wanted = {key.strip().lower(): key for key in draft.options.map}
    targets = {split_header(target)[0].lower() for target in draft.options.map.values()}
    named: list[Header] = []
    for column in distinct_columns(headers):
        source = column.source
        column.stored, column.calendar = units.get(source), calendars.get(source)
        column.stamped = source in stamped
        texts = (column.key.lower(), column.header.lower(), column.low)
        key = next((wanted[text] for text in texts if text in wanted), None)
        if key is not None:
            draft.used_map.add(key)
            target, target_unit = split_header(draft.options.map[key])
            if target in ("", "-"):
                continue
            column.name, column.unit, column.mapped = target, target_unit or column.unit, True
        elif source in presets:
            target, target_unit = split_header(presets[source])
            if target == "-" or _is_taken(target.lower(), targets):
                draft.leave_out(column)
                continue
            column.name, column.preset = target, True
            if target_unit is not None:  # overruled by --unit, overrules a header without a unit
                column.unit, column.stored = None, target_unit
        if column.name:
            named.append(column)
    return named


def resolve_duplicates(draft: PlanDraft, named: list[Header]) -> list[Header]:
    """Give columns of one name different names; an axis must be one column."""
    groups: dict[str, list[Header]] = {}
    for column in named:
        groups.setdefault(column.low if is_contract_name(column.low) else column.name, []).append(
            column
        )
    taken, dropped = set(groups), set[int]()
    renamed: list[str] = []
    for name, same in groups.items():
        asked = [column for column in same if column.mapped]
        if len(same) == 1 or (name == "time" and len(asked) < 2):
            continue
        if len(asked) > 1 or (AXIS_PATTERN.match(name) and not asked):
            headers = ", ".join(repr(column.header) for column in same[:5])
            fix = f'drop the others, for instance --map "{(asked or same)[1].key}=-"'
            draft.problems.append(
                FormatError(
                    f"{draft.path.name}: {len(same)} columns are called {name!r} ({headers}); {fix}"
                )
            )
        elif AXIS_PATTERN.match(name):
            others = [column for column in same if not column.mapped]
            dropped.update(column.source for column in others)
            draft.notes.append(
                f"left out, as --map names another column {name}: "
                f"{list_names([column.header for column in others])}"
            )
        else:
            for number, column in enumerate(
                sorted(same, key=lambda column: not column.mapped)[1:], 2
            ):
                column.name = free_name(f"{column.name}_", taken, number)
                taken.add(column.name)
                renamed.append(f"{column.header!r} is {column.name!r}")
    if renamed:
        more = f" and {len(renamed) - 5} more" if len(renamed) > 5 else ""
        draft.notes.append(f"columns of one name are renamed: {', '.join(renamed[:5])}{more}")
    return [column for column in named if column.source not in dropped]


def _is_taken(target: str, asked: set[str]) -> bool:
    """Return whether --map names a column for this target, or for any axis if it is an axis."""
    return target in asked or (
        bool(AXIS_PATTERN.match(target)) and any(AXIS_PATTERN.match(name) for name in asked)
    )
