"""Wording of sentences on a mismatch: its axes and averaging times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gyrostab.units import DAY, HOUR
from gyrostab.wording import join_words

#: Why no rounding of a rate is named where the values of a counter of angles are coarse.
COARSE_ANGLE_GRID = "not identifiable: the coarse quantization grid is that of angles"


def axes_text(axes: Sequence[str]) -> str:
    """Return ``"axis x"`` or ``"axes x and y"``."""
    if not axes:
        return "the record"
    return f"ax{'i' if len(axes) == 1 else 'e'}s {join_words(axes)}"


def length_text(seconds: float) -> str:
    """Write a duration with the unit that suits it."""
    for size, name in ((DAY, "d"), (HOUR, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}"
    return f"{seconds:.3g} s" if seconds >= 0.1 else f"{seconds * 1e3:.3g} ms"


def capitalise_axes(axes: Sequence[str]) -> str:
    """Write axes as the beginning of a sentence."""
    text = axes_text(axes)
    return text[0].upper() + text[1:]


def is_higher(region: Mapping[str, Any]) -> bool:
    """Return whether the recording exceeds the expectation."""
    return bool(region.get("sign", 1) >= 0)


def taus_text(region: Mapping[str, Any]) -> str:
    """Write the averaging times of a mismatch."""
    low, high = length_text(region["tau_min_s"]), length_text(region["tau_max_s"])
    if region["tau_max_s"] > 1.01 * region["tau_min_s"]:
        return f"averaging times of {low} to {high}"
    return f"an averaging time of {low}"
