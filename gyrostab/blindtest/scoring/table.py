"""The table of many scores: every figure with its interval, its target, and whether that is met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from gyrostab.blindtest.scoring.proportions import Target, median, share, spread

__all__ = ["CLEAR", "cases", "markdown", "missed", "score_table"]

Row = Mapping[str, Any]
Line = dict[str, Any]

#: Strength from which on an effect ought to be seen and named.
CLEAR = 1.5


def cases(rows: Sequence[Row]) -> list[Row]:
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
        All rows of `score_case`; those of salted real recordings and of their copies are left to
        `salt_table`.

    Returns
    -------
    pandas.DataFrame
        ``quantity``, ``value``, ``low``, ``high``, ``n``, ``target`` and ``state``: ``met`` where
        the whole interval lies where it should, ``missed`` where the value does not, else ``not
        shown``; nothing without a target.
    """
    rows = [row for row in rows if row["kind"] not in ("salted", "control")]
    groups = (_alarms, _naming, _strangers, _severed, _numbers, _plain)
    return pd.DataFrame([line for group in groups for line in group(rows)])


def _here(rows: Sequence[Row], *, least: float = 0.0) -> list[Row]:
    """Rows of effects of the catalogue whose channel is there."""
    return [
        row
        for row in rows
        if row["kind"] in ("single", "pair", "triple", "buried")
        and row["effect"]
        and row["strength"] >= least
    ]


def _alarms(rows: Sequence[Row]) -> list[Line]:
    nulls = [row for row in rows if row["kind"] == "null"]
    target = Target("<= 1 %, upper bound <= 2 %", most=0.01, surely=0.02)
    return [
        share("false alarms: a name on a null", (bool(row["claims"]) for row in nulls), target),
        share("nulls with any mismatch", (row["detected"] for row in nulls)),
    ]


def _naming(rows: Sequence[Row]) -> list[Line]:
    clear = _here(rows, least=CLEAR)
    seen = [row for row in clear if row["detected"]]
    alone = [row for row in clear if row["kind"] in ("single", "buried")]
    shown = [row for row in alone if (row.get("learned_strength") or 0.0) >= CLEAR]
    claimed = [row for row in clear if row["set_size"]]
    percent = Target(">= 95 %", least=0.95)
    return [
        share(
            "effects whose form the fitter does not have",
            (row["form_differs"] for row in _here(rows)),
            Target(">= 33 %", least=0.33),
        ),
        share(
            "detected at 1.5 times the limit and more", (row["detected"] for row in clear), percent
        ),
        share("detected, of those that were alone", (row["detected"] for row in alone)),
        share(
            "detected, of those that were alone and are as strong in noise learned from the record",
            (row["detected"] for row in shown),
        ),
        share("named rightly, of those (sets merged)", (row["named"] for row in seen), percent),
        share(
            "named rightly, of those that were alone",
            (row["named"] for row in alone if row["detected"]),
        ),
        share(
            "named rightly, of those in pairs and triples",
            (row["named"] for row in seen if row["kind"] in ("pair", "triple")),
        ),
        share("named exactly, of those", (row["named_exactly"] for row in seen)),
        share(
            "named exactly where the form differs",
            (row["named_exactly"] for row in seen if row["form_differs"]),
        ),
        share("a wrong name beside the truth", (row["wrong"] > 0 for row in cases(clear))),
        share(
            "truth in the set", (row["in_set"] for row in claimed), Target(">= 97 %", least=0.97)
        ),
        median(
            "size of the set, median",
            (row["set_size"] for row in claimed),
            Target("<= 1.5", most=1.5),
        ),
        share("buried: detected", (row["detected"] for row in clear if row["kind"] == "buried")),
        share("buried: named rightly", (row["named"] for row in clear if row["kind"] == "buried")),
    ]


def _strangers(rows: Sequence[Row]) -> list[Line]:
    strange = [row for row in rows if row["kind"] == "strange" and row["strength"] >= CLEAR]
    seen = [row for row in strange if row["detected"]]
    return [
        share("out of the catalogue: detected", (row["detected"] for row in strange)),
        share(
            "out of the catalogue: unknown",
            (row["unknown"] for row in seen),
            Target(">= 90 %", least=0.90),
        ),
        share(
            "out of the catalogue: wrong name",
            (row["wrong"] > 0 for row in seen),
            Target("<= 5 %", most=0.05),
        ),
    ]


def _severed(rows: Sequence[Row]) -> list[Line]:
    gone = [
        row for row in rows if row["kind"] == "severed" and row["severing"] in ("withheld", "decoy")
    ]
    bent = [
        row
        for row in rows
        if row["kind"] == "severed" and row["severing"] not in ("withheld", "decoy")
    ]
    return [
        share(
            "channel withheld or replaced: wrong name",
            (row["wrong"] > 0 for row in gone),
            Target("<= 2 %", most=0.02),
        ),
        share(
            "channel withheld or replaced: unknown, if detected",
            (row["unknown"] for row in gone if row["detected"]),
            Target(">= 90 %", least=0.90),
        ),
        share(
            "channel late, noisy, clipped or confounded: wrong name",
            (row["wrong"] > 0 for row in bent),
        ),
        share(
            "channel late, noisy, clipped or confounded: named rightly",
            (row["named"] for row in bent),
        ),
    ]


def _numbers(rows: Sequence[Row]) -> list[Line]:
    clear = _here(rows, least=CLEAR)
    found = [(row, number) for row in clear for number in row["numbers"]]
    coverage = Target("90-98 %", least=0.90, most=0.98)
    gains = [
        (row["gain"] / row["oracle"], _all_named(row, rows))
        for row in cases(clear)
        if row["named"] and _known_gain(row)
    ]
    learned = [
        row["gain"] / row["learned"]
        for row in cases(clear)
        if row["named"] and _known_gain(row) and row.get("learned", 0.0) > 0
    ]
    others = [number["held"] for row, number in found if row["effect"] != "shared_source"]
    return [
        median(
            "overlap in time (IoU), median",
            (row["iou"] for row in clear),
            Target(">= 0.7", least=0.7),
        ),
        share(
            "averaging times hit", (row["tau_hit"] for row in clear if row["tau_hit"] is not None)
        ),
        share(
            "95 % intervals that hold the truth", (number["held"] for _, number in found), coverage
        ),
        share(
            "of those, where the form is the fitter's",
            (number["held"] for row, number in found if not row["form_differs"]),
        ),
        share("of those, without the shared source", others),
        spread(
            "errors in units of their standard error, two thirds",
            (number["pull"] for _, number in found),
            Target("0.8-1.25", 0.8, 1.25),
        ),
        median(
            "gain over the oracle's, median",
            (gain for gain, _ in gains),
            Target("0.9-1.2", least=0.9, most=1.2),
        ),
        median(
            "gain over the oracle's where all was named rightly, median",
            (gain for gain, whole in gains if whole),
        ),
        median(
            "gain over that of the truth where noise is learned from the record, median", learned
        ),
        share("gain of 0.7 of the oracle's or more", (gain >= 0.7 for gain, _ in gains)),
        median(
            "share of predicted cells inside the 95 % band, median",
            (row["coverage_after"] for row in cases(rows)),
            Target("93-97 %", 0.93, 0.97),
        ),
    ]


def _known_gain(row: Row) -> bool:
    return bool(row["oracle"] > 0 and math.isfinite(row["gain"]))


def _all_named(row: Row, rows: Sequence[Row]) -> bool:
    """Whether every effect of a case was named rightly, and nothing else was."""
    return not row["wrong"] and all(
        other["named"] for other in rows if other["index"] == row["index"]
    )


def _plain(rows: Sequence[Row]) -> list[Line]:
    """The naive detectors, and what a case costs."""
    nulls, clear = [row for row in rows if row["kind"] == "null"], _here(rows, least=CLEAR)
    names = sorted({name for row in rows for name in row["naive"]})
    lines = [
        share(f"{told} by the {name}", (row["naive"][name] for row in part if name in row["naive"]))
        for told, part in (
            ("effects at 1.5 times the limit and more seen", clear),
            ("false alarms", nulls),
        )
        for name in names
    ]
    for rate in sorted({row["rate"] for row in rows}):
        lines.append(
            median(
                f"seconds a case of {rate:g} Hz, median",
                (row["seconds"] for row in cases(rows) if row["rate"] == rate),
            )
        )
    return lines


def missed(table: pd.DataFrame) -> list[str]:
    """Sentences on the targets that were missed, with the figures.

    Examples
    --------
    >>> line = {"quantity": "detected", "value": 0.8, "low": 0.7, "high": 0.9, "n": 50, "target": ">= 95 %", "state": "missed"}
    >>> missed(pd.DataFrame([line]))
    ['detected: 0.8 (0.7 to 0.9, n = 50), target >= 95 %: missed']
    """
    lost = table[table["state"] == "missed"]
    return [
        "{quantity}: {value:.3g} ({low:.3g} to {high:.3g}, n = {n}), target {target}: missed".format_map(
            line
        )
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
    lines += [
        "| " + " | ".join(_cell(value) for value in row) + " |"
        for row in table.itertuples(index=False)
    ]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None or value == "" or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return format(value, ".3g") if isinstance(value, float) else str(value)
