"""Score injections by the difference to the untouched recording, which has unknown effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from gyrostab.blindtest.generator.catalogue import merge_ambiguous
from gyrostab.blindtest.scoring.proportions import make_lines
from gyrostab.blindtest.scoring.score import answered_rows
from gyrostab.blindtest.scoring.table import CLEAR_STRENGTH

Row = Mapping[str, Any]

#: Strength in fitted noise from which most injections should be named. Amplitudes are found to
#: 0.1 %, so that an effect drawn at this strength may be slightly weaker.
_NAMED_STRENGTH, _STRENGTH_TOLERANCE = 5.0, 1e-3


def injection_differences(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Compare the names found in the injected and reversed copies with those of the untouched one.

    ``before`` are the names in the untouched copy, and ``there_before`` whether the effect's
    ambiguity set is among them; ``named`` is whether it is named in the injected copy, ``others``
    are other names added by the injection, and ``flipped`` and ``reversed`` names added by
    reversing sign or time, sets merged. Injections with a control whose diagnosis failed are left
    out.
    """
    groups: dict[Any, dict[str, Row]] = {}
    for row in rows:
        if row["kind"] == "injected" or (row["kind"] == "control" and not row.get("failed")):
            groups.setdefault(row["index"], {})[row["copy"]] = row
    out = []
    for index, copies in sorted(groups.items()):
        if set(copies) != {"injected", "untouched", "flipped", "reversed"}:
            continue
        untouched_names = _merged_names(copies["untouched"])
        injected = copies["injected"]
        mine = merge_ambiguous(injected["effect"])
        out.append(
            {
                "index": index,
                "recording": injected["recording"],
                "effect": injected["effect"],
                "failed": injected.get("failed", False),
                "strength": injected["strength"],
                "learned_strength": injected["learned_strength"],
                "before": sorted(_names_given(copies["untouched"])),
                "there_before": bool(_names_given(copies["untouched"]) & mine),
                "named": bool(_names_given(injected) & mine),
                "others": sorted(_names_given(injected) - mine - untouched_names),
                "flipped": sorted(_names_given(copies["flipped"]) - untouched_names),
                "reversed": sorted(_names_given(copies["reversed"]) - untouched_names),
            }
        )
    return out


def _names_given(row: Row) -> set[str]:
    return {identification["name"] for identification in row["identifications"]}


def _merged_names(row: Row) -> set[str]:
    return set().union(*(merge_ambiguous(name) for name in _names_given(row)))


def injection_table(rows: Sequence[Row]) -> pd.DataFrame:
    """Tabulate injections like `score_table`; empty without injections.

    An effect counts as named only where the untouched copy does not have its name already.
    """
    differences = injection_differences(rows)
    if not differences:
        return pd.DataFrame(columns=["quantity", "value", "low", "high", "n", "target", "state"])
    least = _NAMED_STRENGTH * (1.0 - _STRENGTH_TOLERANCE)
    new = [
        {
            **line,
            "is_clear": line["strength"] >= CLEAR_STRENGTH,
            "is_strong": (line["learned_strength"] or 0.0) >= least,
        }
        for line in differences
        if not line["there_before"]
    ]
    groups: dict[str, Sequence[Row]] = {
        "all": differences,
        "answered": answered_rows(differences),
        "new": new,
    }
    return pd.DataFrame(make_lines("injections", groups))
