"""Presets for the files of known programs: TOML files, recognised by headers and lines above them.

A preset has a `name`, `times` (candidates for the time column; the first that is filled is used)
and `columns`: target in the form of ``--map`` -> headers that the program writes. `above` and
`file` are patterns for a line above the header and for the file name, `needs` lists further headers
that must be present, `drops` lists columns that are not kept, and `rate` is a pattern that finds
the sampling rate [Hz] above the header.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from gyrostab.store.toml import load_toml_folder

_KEYS = {"name", "above", "file", "needs", "times", "drops", "rate", "columns"}


class PresetMatch(NamedTuple):
    """A preset that fits a file: column number -> target of ``--map``; rate [Hz] if known."""

    name: str = ""
    columns: Mapping[int, str] = MappingProxyType({})
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
    above: Sequence[str],
    is_filled: Callable[[int], bool],
) -> PresetMatch:
    """Find the preset that fits a file, with an empty name for the files of other programs.

    `headers` are full header and name without unit of each column; `is_filled` returns whether any
    of the first cells of a column is filled.
    """
    places: dict[str, int] = {}
    for place, names in reversed(list(enumerate(headers))):
        for name in reversed(names):
            places[name.strip().lower()] = place

    def held(names: Sequence[str]) -> list[int]:
        return [places[name.lower()] for name in names if name.lower() in places]

    for key, preset in _load_presets().items():
        gyro = [names for target, names in preset["columns"].items() if target.startswith("gyro_")]
        if (
            not all(map(held, [*gyro, *([name] for name in preset.get("needs", ()))]))
            or ("file" in preset and not re.search(preset["file"], path.name, re.IGNORECASE))
            or ("above" in preset and not any(re.search(preset["above"], line) for line in above))
        ):
            continue
        columns = dict.fromkeys(held(preset.get("drops", ())), "-")
        times = {at: time["unit"] for time in preset["times"] for at in held([time["column"]])}
        columns |= dict.fromkeys(times, "-")
        columns |= {at: f"time [{times[at]}]" for at in list(filter(is_filled, times))[:1]}
        for target, names in preset["columns"].items():
            columns |= dict.fromkeys(held(names)[:1], target)
        matches = (re.search(preset["rate"], line) for line in above if "rate" in preset)
        rates = [float(match[1]) for match in matches if match]
        return PresetMatch(f"{preset['name']} (preset {key})", columns, next(iter(rates), None))
    return PresetMatch()
