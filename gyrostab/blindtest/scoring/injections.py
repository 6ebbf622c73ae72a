"""What salt in real recordings shows: not what is claimed, for they hold effects of their own, but what is claimed beside that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from gyrostab.blindtest.generator.catalogue import merged
from gyrostab.blindtest.scoring.proportions import share
from gyrostab.blindtest.scoring.table import CLEAR

__all__ = ["injection_differences", "injection_table"]

Row = Mapping[str, Any]


def injection_differences(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What each salted recording, and its copies turned about, are said to hold beside what the untouched copy is.

    Returns
    -------
    list of dict
        ``index``, ``recording``, ``effect``, ``strength``; ``there_before``: a name of the set of
        the effect is given to the untouched copy already; ``named``: one is given to the salted
        one; ``others``: other names that salt has brought; ``flipped`` and ``reversed``: names that
        turning the sign or the time has brought, sets merged.
    """
    groups: dict[Any, dict[str, Row]] = {}
    for row in rows:
        if row["kind"] in ("salted", "control"):
            groups.setdefault(row["index"], {})[row["copy"]] = row
    out = []
    for index, copies in sorted(groups.items()):
        if set(copies) != {"salted", "untouched", "flipped", "reversed"}:
            continue
        known = _merged(copies["untouched"])
        salted = copies["salted"]
        mine = merged(salted["effect"])
        out.append(
            {
                "index": index,
                "recording": salted["recording"],
                "effect": salted["effect"],
                "strength": salted["strength"],
                "before": sorted(_said(copies["untouched"])),
                "there_before": bool(_said(copies["untouched"]) & mine),
                "named": bool(_said(salted) & mine),
                "others": sorted(_said(salted) - mine - known),
                "flipped": sorted(_said(copies["flipped"]) - known),
                "reversed": sorted(_said(copies["reversed"]) - known),
            }
        )
    return out


def _said(row: Row) -> set[str]:
    return {name for name, _ in row["claims"]}


def _merged(row: Row) -> set[str]:
    return set().union(*(merged(name) for name in _said(row)))


def injection_table(rows: Sequence[Row]) -> pd.DataFrame:
    """Shares of salted real recordings, as `score_table` gives those of drawn ones; empty where there are none.

    Effects count whose name the untouched copy is not given already.
    """
    found = injection_differences(rows)
    if not found:
        return pd.DataFrame(columns=["quantity", "value", "low", "high", "n", "target", "state"])
    new = [one for one in found if not one["there_before"]]
    lines = [
        share(
            f"salt of {CLEAR:g} times the limit and more: named rightly",
            (one["named"] for one in new if one["strength"] >= CLEAR),
        ),
        share("salt brings another name", (bool(one["others"]) for one in found)),
        share("turning the sign brings a name", (bool(one["flipped"]) for one in found)),
        share("turning the time brings a name", (bool(one["reversed"]) for one in found)),
        share("its effect is named without salt already", (one["there_before"] for one in found)),
    ]
    return pd.DataFrame(lines)
