"""Table of scores: every figure with its interval, its target, and whether that is met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from gyrostab.blindtest.scoring.baseline_detectors import RANDOM
from gyrostab.blindtest.scoring.probability import probability_lines
from gyrostab.blindtest.scoring.proportions import Line, make_lines, median, share
from gyrostab.blindtest.scoring.score import (
    answered_rows,
    catalogue_rows,
    drawn_rows,
    first_rows,
)

Row = Mapping[str, Any]

#: Half width of a central interval of the normal law, by its probability [%].
_NORMAL_INTERVALS = {50: 0.6745, 68: 0.9945, 90: 1.6449}
#: Strength from which an effect should be detected and named.
CLEAR_STRENGTH = 1.5
#: Strength in fitted noise from which nearly every effect should be detected and named.
SURE_STRENGTH = 3.0


def score_table(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the figures of a benchmark with 95 % intervals and targets.

    Parameters
    ----------
    rows : sequence of dict
        All rows of `score_case`; counterparts are left to `counterpart_table`,
        injections and their controls to `injection_table`.

    Returns
    -------
    pandas.DataFrame
        ``quantity``, ``value``, ``low``, ``high``, ``n``, ``target`` and ``state``: ``met`` where
        the whole interval is in the target range, ``missed`` where the value is not, else ``not
        shown``; empty without a target.
    """
    rows = drawn_rows(rows)
    groups = {**_effect_groups(rows), **_driver_groups(rows), **_evidence_groups(rows)}
    return pd.DataFrame(
        [
            *make_lines("main", groups),
            *probability_lines(rows),
            *make_lines("models", groups),
            *_baseline_lines(rows),
        ]
    )


def _effect_groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group the rows of records of noise, and of effects with an undisturbed driver."""
    clear: list[Row] = [
        {**row, "clear_in_fitted_noise": _fitted_strength(row) >= CLEAR_STRENGTH}
        for row in catalogue_rows(rows, min_strength=CLEAR_STRENGTH)
    ]
    catalogue = catalogue_rows(rows)
    return {
        "null": answered_rows([row for row in rows if row["kind"] == "null"]),
        "catalogue": catalogue,
        "clear": clear,
        "clear cases": answered_rows(first_rows(clear)),
        "single": [row for row in clear if row["kind"] in ("single", "sub_threshold")],
        "sub-threshold": [row for row in clear if row["kind"] == "sub_threshold"],
        "multiple": [row for row in clear if row["kind"] in ("pair", "triple")],
        "other form": [row for row in clear if row["form_differs"]],
        "sure": [row for row in catalogue if _fitted_strength(row) >= SURE_STRENGTH],
        "sure pairs": _sure_pairs(rows),
        "out of catalogue": [
            row
            for row in rows
            if row["kind"] == "out_of_catalogue" and row["strength"] >= CLEAR_STRENGTH
        ],
    }


def _fitted_strength(row: Row) -> float:
    return float(row.get("learned_strength") or 0.0)


def _sure_pairs(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each pair of strong effects, ``named`` if both are."""
    pairs: dict[Any, list[Row]] = {}
    for row in rows:
        if row["kind"] == "pair":
            pairs.setdefault(row["index"], []).append(row)
    return [
        {**pair[0], "named": all(row["named"] for row in pair)}
        for pair in pairs.values()
        if all(_fitted_strength(row) >= SURE_STRENGTH for row in pair)
    ]


def _driver_groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {"driver lost": [], "driver distorted": []}
    for row in rows:
        if row["kind"] == "degraded_driver":
            is_lost = row["degradation"] in ("withheld", "substituted")
            groups["driver lost" if is_lost else "driver distorted"].append(row)
    return groups | {f"{name}, answered": answered_rows(part) for name, part in groups.items()}


def _evidence_groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group cases, those with a right name, their parameters, and the models of diagnoses."""
    clear, cases = catalogue_rows(rows, min_strength=CLEAR_STRENGTH), first_rows(rows)
    named_cases = {row["index"] for row in rows if row.get("named")}
    incomplete = {row["index"] for row in rows if not row.get("named")}
    return {
        "cases": [{**row, "failed": bool(row.get("failed"))} for row in cases],
        "parameters": [
            {
                **row,
                **entry,
                "has_fitted_form": not row["form_differs"],
                "is_not_shared": row["effect"] != "shared_source",
                **{
                    f"within {level} %": None
                    if entry["pull"] is None
                    else abs(entry["pull"]) <= sigma
                    for level, sigma in _NORMAL_INTERVALS.items()
                },
            }
            for row in clear
            for entry in row["parameter_scores"]
        ],
        "named cases": [
            {
                **row,
                "relative": row["gain"] / row["oracle"],
                "relative_fitted": row["gain"] / row["learned"]
                if row.get("learned", 0.0) > 0
                else None,
                "enough": row["gain"] / row["oracle"] >= 0.7,
                "all_named": not row["wrong"] and row["index"] not in incomplete,
            }
            for row in first_rows(clear)
            if row["index"] in named_cases and row["oracle"] > 0 and math.isfinite(row["gain"])
        ],
        "models": [
            {
                **row,
                "runs": check["runs"],
                "nearer": check["runs"] and check["nats"] > 0.0,
            }
            for row in cases
            if (check := row.get("model_check"))
        ],
    }


def _baseline_lines(rows: Sequence[Row]) -> list[Line]:
    """Make the lines of the baseline detectors and of the cost per case."""
    nulls = [row for row in rows if row["kind"] == "null"]
    clear = catalogue_rows(rows, min_strength=CLEAR_STRENGTH)
    names = sorted({name for row in rows for name in row["baseline_detectors"]} - {RANDOM})
    lines = [
        share(
            label.format(name),
            [
                {**row, "detected": row["baseline_detectors"][name] > 0.0}
                for row in part
                if name in row["baseline_detectors"]
            ],
            "detected",
        )
        for label, part in (
            ("detected by the {}, strength 1.5 or more", clear),
            ("false alarms of the {}", nulls),
        )
        for name in names
    ]
    for rate in sorted({row["rate"] for row in rows}):
        lines.append(
            median(
                f"seconds per case at {rate:g} Hz, median",
                [row for row in first_rows(rows) if row["rate"] == rate],
                "seconds",
            )
        )
    return lines


def list_missed(table: pd.DataFrame) -> list[str]:
    """List a sentence with the figures for each missed target.

    Examples
    --------
    >>> line = {"quantity": "detected", "value": 0.8, "low": 0.7, "high": 0.9, "n": 50}
    >>> list_missed(pd.DataFrame([line | {"target": ">= 95 %", "state": "missed"}]))
    ['detected: 0.8 (0.7 to 0.9, n = 50), target >= 95 %: missed']
    """
    lost = table[table["state"] == "missed"]
    return [
        f"{line['quantity']}: {line['value']:.3g} ({line['low']:.3g} to {line['high']:.3g}, "
        f"n = {line['n']}), target {line['target']}: missed"
        for line in lost.to_dict("records")
    ]


def markdown(table: pd.DataFrame) -> str:
    """Format a frame as a Markdown table with three digits.

    Examples
    --------
    >>> print(markdown(pd.DataFrame({"n": [3], "share": [1 / 3]})))
    | n | share |
    |---|---|
    | 3 | 0.333 |
    """
    lines = ["| " + " | ".join(map(str, table.columns)) + " |", "|" + "---|" * len(table.columns)]
    lines += [
        "| " + " | ".join(_format_cell(value) for value in row) + " |"
        for row in table.itertuples(index=False)
    ]
    return "\n".join(lines)


def _format_cell(value: Any) -> str:
    if value is None or value == "" or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return format(value, ".3g") if isinstance(value, float) else str(value)
