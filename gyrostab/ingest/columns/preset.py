"""Presets for the files of known programs: TOML files, recognised by headers and lines above them.

A preset has a `name`, `times` (candidates for the time column; the first that is filled is used)
and `columns`: target in the form of ``--map`` -> headers that the program writes. `above` and
`file` are patterns for a line above the header and for the file name, `needs` lists further headers
that must be present, `drops` lists columns that are not kept, and `rate` is a pattern that finds
the sampling rate [Hz] above the header.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from gyrostab.store.toml import load_toml_folder

_KEYS = {"name", "above", "file", "needs", "times", "drops", "rate", "columns"}


@dataclass(frozen=True)
class PresetMatch:
    """A preset that fits a file: column number -> target of ``--map``; rate [Hz] if known."""

    name: str
    columns: dict[int, str] = field(default_factory=dict)
    rate: float | None = None


@cache
def _load_presets() -> dict[str, dict[str, Any]]:
    """Load the presets, by file name."""
    presets = load_toml_folder("gyrostab.ingest.columns", "presets")
    for name, preset in presets.items():
        assert set(preset) <= _KEYS, f"{name}: {set(preset) - _KEYS}"
    return presets


def find_preset(
    path: Path,
    headers: Sequence[tuple[str, str]],
    *,
    above: Sequence[str] = (),
    is_filled: Callable[[int], bool] | None = None,
) -> PresetMatch:
    """Find the preset that fits a file, with an empty name for the files of other programs.

    `headers` are full header and name without unit of each column; `is_filled` returns whether any
    of the first cells of a column is filled.
    """
    places: dict[str, int] = {}
    for place, names in reversed(list(enumerate(headers))):
        for name in reversed(names):
            places[name.strip().lower()] = place
    for key, preset in _load_presets().items():
        gyro = [names for target, names in preset["columns"].items() if target.startswith("gyro_")]
        if not all(
            any(name.lower() in places for name in names)
            for names in [*gyro, *([name] for name in preset.get("needs", ()))]
        ):
            continue
        if "file" in preset and not re.search(preset["file"], path.name, re.IGNORECASE):
            continue
        if "above" in preset and not any(re.search(preset["above"], line) for line in above):
            continue
        return _apply_preset(
            f"{preset['name']} (preset {key})",
            preset,
            places,
            above,
            is_filled or (lambda place: True),
        )
    return PresetMatch("")


def _apply_preset(
    name: str,
    preset: dict[str, Any],
    places: dict[str, int],
    above: Sequence[str],
    is_filled: Callable[[int], bool],
) -> PresetMatch:
    columns = {
        places[drop.lower()]: "-" for drop in preset.get("drops", ()) if drop.lower() in places
    }
    times = [
        (places[time["column"].lower()], time["unit"])
        for time in preset["times"]
        if time["column"].lower() in places
    ]
    filled = [(place, unit) for place, unit in times if is_filled(place)]
    columns.update(dict.fromkeys([place for place, _ in times], "-"))
    if filled:
        columns[filled[0][0]] = f"time [{filled[0][1]}]"
    for target, names in preset["columns"].items():
        held = [places[name.lower()] for name in names if name.lower() in places]
        columns.update(dict.fromkeys(held[:1], target))
    rates = [
        match[1]
        for line in above
        if "rate" in preset and (match := re.search(preset["rate"], line))
    ]
    return PresetMatch(name, columns, float(rates[0]) if rates else None)
