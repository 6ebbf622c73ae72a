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
from gyrostab.blindtest.scoring.score import CATALOGUE_KINDS, drawn_rows, first_rows

Row = Mapping[str, Any]

#: Half width of a central interval of the normal law, by its probability [%].
_NORMAL_INTERVALS = {50: 0.6745, 68: 0.9945, 90: 1.6449}
#: Strength from which an effect should be detected and named.
CLEAR_STRENGTH = 1.5
#: Strength in fitted noise from which nearly every effect should be detected and named.
SURE_STRENGTH = 3.0


def score_table(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the figures of a benchmark with 95 % intervals and targets from its rows.

    Counterparts are left to `counterpart_table`, injections and their controls to
    `injection_table`. The ``state`` is ``met`` where the whole interval is in the target range,
    ``missed`` where the value is not, else ``not shown``; it is empty without a target.
    """
    levels = _make_levels(drawn_rows(rows))
    return pd.DataFrame(
        [
            *make_lines("main", levels),
            *probability_lines(rows),
            *make_lines("models", levels),
            *_baseline_lines(levels),
        ]
    )


def _make_levels(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Make the rows of effects, cases and parameters, with the flags that ``figures.csv`` reads."""
    effects: list[Row] = [{**row, **_flag_effect(row)} for row in rows]
    clear, named, incomplete, unsure = (
        {row["index"] for row in effects if bool(row[flag]) is value}
        for flag, value in (("clear", True), ("named", True), ("named", False), ("sure", False))
    )
    cases: list[Row] = [
        {
            **row,
            **_rate_evidence(row),
            "has_clear": row["index"] in clear,
            "has_name": row["index"] in named,
            "all_named": row["index"] not in incomplete,
            "nothing_else": not row["wrong"],
            "sure_pair": row["kind"] == "pair" and row["index"] not in unsure,
        }
        for row in first_rows(effects)
    ]
    parameters: list[Row] = [
        {
            **row,
            **entry,
            "has_fitted_form": not row["form_differs"],
            "is_not_shared": row["effect"] != "shared_source",
            **{
                f"within {level} %": None if entry["pull"] is None else abs(entry["pull"]) <= sigma
                for level, sigma in _NORMAL_INTERVALS.items()
            },
        }
        for row in effects
        if row["clear"]
        for entry in row["parameter_scores"]
    ]
    return {"effects": effects, "cases": cases, "parameters": parameters}


def _flag_effect(row: Row) -> dict[str, bool]:
    kind, fitted = row["kind"], float(row.get("learned_strength") or 0.0)
    is_strong = row["strength"] >= CLEAR_STRENGTH
    in_catalogue = kind in CATALOGUE_KINDS and bool(row["effect"])
    is_lost = row["degradation"] in ("withheld", "substituted")
    return {
        "failed": bool(row.get("failed")),
        "answered": not row.get("failed"),
        "named": bool(row.get("named")),
        "confidently_wrong": any(
            not entry["right"] and (entry["probability"] or 0.0) >= 0.5
            for entry in row["identifications"]
        ),
        "null": kind == "null",
        "catalogue": in_catalogue,
        "clear": in_catalogue and is_strong,
        "clear_in_fitted_noise": fitted >= CLEAR_STRENGTH,
        "sure": in_catalogue and fitted >= SURE_STRENGTH,
        "single": kind in ("single", "sub_threshold"),
        "sub_threshold": kind == "sub_threshold",
        "multiple": kind in ("pair", "triple"),
        "out_of_catalogue": kind == "out_of_catalogue" and is_strong,
        "driver_lost": kind == "degraded_driver" and is_lost,
        "driver_distorted": kind == "degraded_driver" and not is_lost,
    }


def _rate_evidence(row: Row) -> dict[str, Any]:
    """Compare the evidence of a case with the oracle's, and its model with others; None without."""
    check, learned = row.get("model_check"), row.get("learned", 0.0)
    is_known = row["oracle"] > 0 and math.isfinite(row["gain"])
    return {
        "relative": row["gain"] / row["oracle"] if is_known else None,
        "relative_fitted": row["gain"] / learned if is_known and learned > 0 else None,
        "enough": row["gain"] / row["oracle"] >= 0.7 if is_known else None,
        "runs": check["runs"] if check else None,
        "nearer": check["runs"] and check["nats"] > 0.0 if check else None,
    }


def _baseline_lines(levels: Mapping[str, Sequence[Row]]) -> list[Line]:
    """Make the lines of the baseline detectors and of the cost per case."""
    rows = levels["effects"]
    names = sorted({name for row in rows for name in row["baseline_detectors"]} - {RANDOM})
    lines = [
        share(
            label.format(name),
            [
                {"index": row["index"], "detected": row["baseline_detectors"][name] > 0.0}
                for row in rows
                if row[flag] and name in row["baseline_detectors"]
            ],
            "detected",
        )
        for label, flag in (
            ("detected by the {}, strength 1.5 or more", "clear"),
            ("false alarms of the {}", "null"),
        )
        for name in names
    ]
    for rate in sorted({row["rate"] for row in rows}):
        mine = [row for row in levels["cases"] if row["rate"] == rate]
        lines.append(median(f"seconds per case at {rate:g} Hz, median", mine, "seconds"))
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
