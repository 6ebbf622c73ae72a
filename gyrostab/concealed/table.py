"""Tables of many scores: every figure with its interval and its target, and how they run with the strength."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

__all__ = ["curves", "markdown", "missed", "reliability", "score_table", "wilson"]

Row = Mapping[str, Any]

#: Strength from which on an effect ought to be seen and named.
CLEAR = 1.5


def wilson(hits: int, total: int, *, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's 95 % interval of a share.

    Examples
    --------
    >>> [round(limit, 4) for limit in wilson(0, 300)]
    [0.0, 0.0126]
    """
    if total == 0:
        return 0.0, 1.0
    share, spread = hits / total, z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = z * math.sqrt(share * (1 - share) / total + spread / (4 * total)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def _median_interval(values: np.ndarray[Any, Any]) -> tuple[float, float]:
    """95 % interval of a median, by the order of the values."""
    ordered = np.sort(values)
    reach = 0.98 * math.sqrt(ordered.size)
    low, high = math.floor((ordered.size - 1) / 2 - reach), math.ceil((ordered.size - 1) / 2 + reach)
    return float(ordered[max(0, low)]), float(ordered[min(ordered.size - 1, high)])


def _share(name: str, flags: Iterable[bool], *, target: str, good: Callable[[float, float, float], bool]) -> dict[str, Any]:
    found = [bool(flag) for flag in flags]
    hits, total = sum(found), len(found)
    low, high = wilson(hits, total)
    value = hits / total if total else math.nan
    met = good(value, low, high) if total else None
    return {"quantity": name, "value": value, "low": low, "high": high, "n": total, "target": target, "met": met}


def _median(name: str, values: Iterable[float], *, target: str, good: Callable[[float], bool]) -> dict[str, Any]:
    found = np.array([value for value in values if value is not None and math.isfinite(value)], dtype=float)
    if found.size == 0:
        return {"quantity": name, "value": math.nan, "low": math.nan, "high": math.nan, "n": 0, "target": target, "met": None}
    low, high = _median_interval(found)
    middle = float(np.median(found))
    return {"quantity": name, "value": middle, "low": low, "high": high, "n": found.size, "target": target, "met": good(middle)}


def _once(rows: Sequence[Row]) -> list[Row]:
    """One row a case, where several effects give several."""
    seen: dict[Any, Row] = {}
    for i, row in enumerate(rows):
        seen.setdefault(row["index"] if row["index"] is not None else ("no number", i), row)
    return list(seen.values())


def score_table(rows: Sequence[Row]) -> pd.DataFrame:
    """The figures of a benchmark with 95 % intervals and the targets of the design.

    Parameters
    ----------
    rows : sequence of dict
        All rows of `score_case`.

    Returns
    -------
    pandas.DataFrame
        ``quantity``, ``value``, ``low``, ``high``, ``n``, ``target``, ``met`` (None where there was nothing to count).
    """
    nulls = [row for row in rows if row["kind"] in ("null", "control")]
    here = [row for row in rows if row["kind"] in ("single", "pair", "buried", "salted") and row["effect"]]
    clear = [row for row in here if row["strength"] >= CLEAR]
    seen = [row for row in clear if row["detected"]]
    strange = [row for row in rows if row["kind"] == "strange" and row["detected"]]
    cut = [row for row in rows if row["kind"] == "severed" and row["severing"] in ("withheld", "decoy")]
    bent = [row for row in rows if row["kind"] == "severed" and row["severing"] in ("lagged", "confounded") and row["detected"]]
    claimed = [row for row in here if row["set_size"]]
    covered = [flag for row in seen if row["named"] for flag in row["covered"]]
    named = [row for row in _once(clear) if row["named"] and row["oracle"] > 0]
    plain = [
        _share(
            f"seen by the {name}, at {CLEAR:g} times the limit",
            (row["naive"][name] for row in clear if name in row["naive"]),
            target="",
            good=_any,
        )
        for name in sorted({name for row in rows for name in row["naive"]})
    ]
    plain += [
        _share(f"false alarms of the {name}", (row["naive"][name] for row in nulls if name in row["naive"]), target="", good=_any)
        for name in sorted({name for row in rows for name in row["naive"]})
    ]
    table = [
        _share("false alarms: a name on a null", (bool(row["claims"]) for row in nulls), target="<= 1 %, upper bound <= 2 %", good=_alarms),
        _share("nulls with any mismatch", (row["detected"] for row in nulls), target="", good=_any),
        _share("detected at 1.5 times the limit and more", (row["detected"] for row in clear), target=">= 95 %", good=_at_least(0.95)),
        _share("named rightly, of those (sets merged)", (row["named"] for row in seen), target=">= 95 %", good=_at_least(0.95)),
        _share("named exactly, of those", (row["named_exactly"] for row in seen), target="", good=_any),
        _share("named exactly where the form differs", (row["named_exactly"] for row in seen if row["form_differs"]), target="", good=_any),
        _share("truth in the set", (row["in_set"] for row in claimed if row["strength"] >= CLEAR), target=">= 97 %", good=_at_least(0.97)),
        _median("size of the set, median", (row["set_size"] for row in claimed), target="<= 1.5", good=lambda v: v <= 1.5),
        _share("out of the catalogue: unknown", (row["unknown"] for row in strange), target=">= 90 %", good=_at_least(0.90)),
        _share("out of the catalogue: wrong name", (row["wrong"] > 0 for row in strange), target="<= 5 %", good=_at_most(0.05)),
        _share("severed: wrong name", (row["wrong"] > 0 for row in cut), target="<= 2 %", good=_at_most(0.02)),
        _share("severed: unknown, if detected", (row["unknown"] for row in cut if row["detected"]), target=">= 90 %", good=_at_least(0.90)),
        _share("late or confounded channel: wrong name", (row["wrong"] > 0 for row in bent), target="", good=_any),
        _median(
            "overlap in time (IoU), median",
            (row["iou"] for row in seen if row["iou"] is not None),
            target=">= 0.7",
            good=lambda v: v >= 0.7,
        ),
        _share("averaging times hit", (row["tau_hit"] for row in seen if row["tau_hit"] is not None), target="", good=_any),
        _share("95 % intervals that hold the truth", covered, target="90-98 %", good=lambda value, low, high: 0.90 <= value <= 0.98),
        _median("gain over the oracle's, median", (row["gain"] / row["oracle"] for row in named), target=">= 0.9", good=lambda v: v >= 0.9),
        _share(
            "buried: named rightly",
            (row["named"] for row in here if row["kind"] == "buried" and row["strength"] >= CLEAR),
            target="",
            good=_any,
        ),
        _median("seconds a case, median", (row["seconds"] for row in _once(rows)), target="", good=lambda v: True),
    ]
    return pd.DataFrame(table + plain).astype({"met": object})


def _any(value: float, low: float, high: float) -> bool:
    return True


def _alarms(value: float, low: float, high: float) -> bool:
    return value <= 0.01 and high <= 0.02


def _at_least(limit: float) -> Callable[[float, float, float], bool]:
    return lambda value, low, high: value >= limit


def _at_most(limit: float) -> Callable[[float, float, float], bool]:
    return lambda value, low, high: value <= limit


def curves(rows: Sequence[Row]) -> pd.DataFrame:
    """Completeness against strength: shares detected and named, of every effect and of all, with Wilson's intervals.

    Returns
    -------
    pandas.DataFrame
        ``effect``, ``strength``, ``n``, ``detected``, ``detected_low``, ``detected_high``, ``named``, ``named_low``, ``named_high``.
    """
    here = [row for row in rows if row["kind"] in ("single", "pair", "buried", "salted", "strange") and row["effect"]]
    out = []
    for effect in ["all", *sorted({row["effect"] for row in here})]:
        for strength in sorted({row["strength"] for row in here}):
            part = [
                row
                for row in here
                if row["strength"] == strength and (row["effect"] == effect or (effect == "all" and row["kind"] != "strange"))
            ]
            if not part:
                continue
            line: dict[str, Any] = {"effect": effect, "strength": strength, "n": len(part)}
            for key in ("detected", "named"):
                hits = sum(bool(row[key]) for row in part)
                low, high = wilson(hits, len(part))
                line |= {key: hits / len(part), f"{key}_low": low, f"{key}_high": high}
            out.append(line)
    return pd.DataFrame(out)


def reliability(rows: Sequence[Row]) -> pd.DataFrame:
    """Of all claims of a name, the share that stands for something true: ``name``, ``n``, ``right``, ``low``, ``high``."""
    said: dict[str, list[bool]] = {}
    for row in _once(rows):
        for name, right in row["claims"]:
            said.setdefault(name, []).append(right)
    out = []
    for name, flags in sorted(said.items()):
        low, high = wilson(sum(flags), len(flags))
        out.append({"name": name, "n": len(flags), "right": sum(flags) / len(flags), "low": low, "high": high})
    return pd.DataFrame(out, columns=["name", "n", "right", "low", "high"])


def missed(table: pd.DataFrame) -> list[str]:
    """Sentences on the targets that were missed, with the figures.

    Examples
    --------
    >>> missed(pd.DataFrame([{"quantity": "detected", "value": 0.8, "low": 0.7, "high": 0.9, "n": 50, "target": ">= 95 %", "met": False}]))
    ['detected: 0.8 (0.7 to 0.9, n = 50), target >= 95 %: missed']
    """
    lost = table[[met is False and bool(target) for met, target in zip(table["met"], table["target"], strict=True)]]
    return [
        "{quantity}: {value:.3g} ({low:.3g} to {high:.3g}, n = {n}), target {target}: missed".format_map(line)
        for line in lost.to_dict("records")
    ]


def markdown(table: pd.DataFrame) -> str:
    """A frame as a markdown table, numbers to three digits.

    Examples
    --------
    >>> print(markdown(pd.DataFrame({"n": [3], "share": [1 / 3]})))
    | n | share |
    |---|---|
    | 3 | 0.333 |
    """
    lines = ["| " + " | ".join(map(str, table.columns)) + " |", "|" + "---|" * len(table.columns)]
    lines += ["| " + " | ".join(_cell(value) for value in row) + " |" for row in table.itertuples(index=False)]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return format(value, ".3g") if isinstance(value, float) else str(value)
