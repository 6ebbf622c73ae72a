"""How detection and naming run with the strength and from effect to effect, and what a name is worth that is given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from gyrostab.blindtest.scoring.proportions import wilson
from gyrostab.blindtest.scoring.table import CLEAR, cases

__all__ = ["by_effect", "curves", "reliability"]

Row = Mapping[str, Any]


def curves(rows: Sequence[Row]) -> pd.DataFrame:
    """Completeness against strength: shares detected and named, of every effect and of all, with Wilson's intervals.

    Of an effect of no catalogue it is right to say that it is unknown, so this counts there in the
    place of a name.

    Returns
    -------
    pandas.DataFrame
        ``effect``, ``strength``, ``n``, ``detected``, ``detected_low``, ``detected_high``,
        ``named``, ``named_low``, ``named_high``.
    """
    here = [
        row
        for row in rows
        if row["kind"] in ("single", "pair", "triple", "buried", "strange") and row["effect"]
    ]
    out = []
    for effect in ["all", *sorted({row["effect"] for row in here})]:
        for strength in sorted({row["strength"] for row in here}):
            part = [
                row
                for row in here
                if row["strength"] == strength
                and (row["effect"] == effect or (effect == "all" and row["kind"] != "strange"))
            ]
            if not part:
                continue
            line: dict[str, Any] = {"effect": effect, "strength": strength, "n": len(part)}
            for key in ("detected", "named"):
                hits = sum(
                    bool(row["unknown" if key == "named" and row["kind"] == "strange" else key])
                    for row in part
                )
                low, high = wilson(hits, len(part))
                line |= {key: hits / len(part), f"{key}_low": low, f"{key}_high": high}
            out.append(line)
    return pd.DataFrame(out)


def reliability(rows: Sequence[Row]) -> pd.DataFrame:
    """Of all claims of a name, the share that stands for something true: ``name``, ``n``, ``right``, ``low``, ``high``."""
    said: dict[str, list[bool]] = {}
    for row in cases([row for row in rows if row["kind"] not in ("salted", "control")]):
        for name, right in row["claims"]:
            said.setdefault(name, []).append(right)
    out = []
    for name, flags in sorted(said.items()):
        low, high = wilson(sum(flags), len(flags))
        out.append(
            {
                "name": name,
                "n": len(flags),
                "right": sum(flags) / len(flags),
                "low": low,
                "high": high,
            }
        )
    return pd.DataFrame(out, columns=["name", "n", "right", "low", "high"])


def by_effect(rows: Sequence[Row]) -> pd.DataFrame:
    """Completeness and reliability of every effect of the catalogue.

    Returns
    -------
    pandas.DataFrame
        ``effect``; ``n`` at 1.5 times the limit and more, and of these the shares ``detected``,
        ``named`` (sets merged) and ``exactly``; ``claims`` of this name in all cases and the share
        of them that is ``right``; ``numbers`` of it that could be compared and the share ``held``
        of their 95 % intervals that hold the truth. None where there is nothing to count.
    """
    claims = {line["name"]: line for line in reliability(rows).to_dict("records")}
    here = [
        row
        for row in rows
        if row["kind"] in ("single", "pair", "triple", "buried") and row["effect"]
    ]
    out = []
    for effect in sorted({row["effect"] for row in here} | set(claims)):
        clear = [row for row in here if row["effect"] == effect and row["strength"] >= CLEAR]
        numbers = [number["held"] for row in clear for number in row["numbers"]]
        out.append(
            {
                "effect": effect,
                "n": len(clear),
                **{key: _mean([row[mark] for row in clear]) for key, mark in _MARKS.items()},
                "claims": claims.get(effect, {}).get("n", 0),
                "right": claims.get(effect, {}).get("right"),
                "numbers": len(numbers),
                "held": _mean(numbers),
            }
        )
    return pd.DataFrame(
        out, columns=["effect", "n", *_MARKS, "claims", "right", "numbers", "held"], dtype=object
    )


_MARKS = {"detected": "detected", "named": "named", "exactly": "named_exactly"}


def _mean(flags: Sequence[bool]) -> float | None:
    return sum(map(bool, flags)) / len(flags) if flags else None
