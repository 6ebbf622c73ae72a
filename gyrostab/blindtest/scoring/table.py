"""Table of scores: every figure with its interval, its target, and whether that is met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from gyrostab.blindtest.scoring.baseline_detectors import RANDOM
from gyrostab.blindtest.scoring.probability import probability_lines
from gyrostab.blindtest.scoring.proportions import (
    Line,
    Target,
    at_least,
    at_most,
    median,
    share,
    spread,
)
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
    groups = (
        _false_alarm_lines,
        _naming_lines,
        _out_of_catalogue_lines,
        _degraded_driver_lines,
        _parameter_lines,
        probability_lines,
        _model_lines,
        _baseline_lines,
    )
    return pd.DataFrame([line for group in groups for line in group(rows)])


def _false_alarm_lines(rows: Sequence[Row]) -> list[Line]:
    nulls = answered_rows([row for row in rows if row["kind"] == "null"])
    target = Target("<= 1 %, upper bound <= 2 %", most=0.01, surely=0.02)
    return [
        share("false alarms: effect named on a null record", nulls, "identifications", target),
        share("null records with any mismatch", nulls, "detected"),
        share("failed diagnoses", first_rows(rows), lambda row: row.get("failed")),
    ]


def _naming_lines(rows: Sequence[Row]) -> list[Line]:
    clear = catalogue_rows(rows, min_strength=CLEAR_STRENGTH)
    detected = [row for row in clear if row["detected"]]
    single = [row for row in clear if row["kind"] in ("single", "sub_threshold")]
    shown = [row for row in single if (row.get("learned_strength") or 0.0) >= CLEAR_STRENGTH]
    sure = [row for row in catalogue_rows(rows) if _is_sure(row)]
    claimed = [row for row in clear if row["set_size"]]
    hidden = [row for row in clear if row["kind"] == "sub_threshold"]
    percent = at_least(0.95)
    return [
        share(
            "effects of a form that the diagnosis does not fit",
            catalogue_rows(rows),
            "form_differs",
            at_least(0.33),
        ),
        share("detected, strength 1.5 or more", clear, "detected", percent),
        share("detected, single effects", single, "detected"),
        share("detected, single effects of that strength with fitted noise", shown, "detected"),
        share(
            "detected, 3 times the limit in fitted noise or more", sure, "detected", at_least(0.97)
        ),
        share(
            "named correctly, 3 times the limit in fitted noise or more",
            sure,
            "named",
            at_least(0.92),
        ),
        share(
            "both effects of a pair named correctly, each of that strength",
            _sure_pairs(rows),
            "named",
            at_least(0.80),
        ),
        share("named correctly, of the detected (sets merged)", detected, "named", percent),
        share(
            "named correctly, single effects", [row for row in single if row["detected"]], "named"
        ),
        share(
            "named correctly, in pairs and triples",
            [row for row in detected if row["kind"] in ("pair", "triple")],
            "named",
        ),
        share("named exactly, of the detected", detected, "named_exactly"),
        share(
            "named exactly where the form differs",
            [row for row in detected if row["form_differs"]],
            "named_exactly",
        ),
        share(
            "cases with a wrong name, strength 1.5 or more",
            answered_rows(first_rows(clear)),
            "wrong",
        ),
        share("truth in the ambiguity set", claimed, "in_set", at_least(0.97)),
        median(
            "size of the ambiguity set, median",
            claimed,
            "set_size",
            Target("<= 1.5", most=1.5),
        ),
        share("sub-threshold: detected", hidden, "detected"),
        share("sub-threshold: named correctly", hidden, "named"),
    ]


def _is_sure(row: Row) -> bool:
    return bool((row.get("learned_strength") or 0.0) >= SURE_STRENGTH)


def _sure_pairs(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each pair of strong effects, ``named`` if both are."""
    pairs: dict[Any, list[Row]] = {}
    for row in rows:
        if row["kind"] == "pair":
            pairs.setdefault(row["index"], []).append(row)
    return [
        {**pair[0], "named": all(row["named"] for row in pair)}
        for pair in pairs.values()
        if all(_is_sure(row) for row in pair)
    ]


def _out_of_catalogue_lines(rows: Sequence[Row]) -> list[Line]:
    strange = [
        row
        for row in rows
        if row["kind"] == "out_of_catalogue" and row["strength"] >= CLEAR_STRENGTH
    ]
    detected = [row for row in strange if row["detected"]]
    return [
        share("out of catalogue: detected", strange, "detected"),
        share("out of catalogue: unidentified", detected, "unidentified", at_least(0.90)),
        share("out of catalogue: wrong name", detected, "wrong", at_most(0.05)),
    ]


def _degraded_driver_lines(rows: Sequence[Row]) -> list[Line]:
    degraded = [row for row in rows if row["kind"] == "degraded_driver"]
    gone, bent = (
        [row for row in degraded if (row["degradation"] in ("withheld", "substituted")) == lost]
        for lost in (True, False)
    )
    return [
        share(
            "driver withheld or substituted: wrong name",
            answered_rows(gone),
            "wrong",
            at_most(0.02),
        ),
        share(
            "driver withheld or substituted: unidentified, if detected",
            [row for row in gone if row["detected"]],
            "unidentified",
            at_least(0.90),
        ),
        share(
            "driver lagged, noisy, clipped or confounded: wrong name", answered_rows(bent), "wrong"
        ),
        share("driver lagged, noisy, clipped or confounded: named correctly", bent, "named"),
    ]


def _parameter_lines(rows: Sequence[Row]) -> list[Line]:
    clear = catalogue_rows(rows, min_strength=CLEAR_STRENGTH)
    scores: list[Row] = [{**row, **entry} for row in clear for entry in row["parameter_scores"]]
    pulls = [entry for entry in scores if entry["pull"] is not None]
    named_cases = {row["index"] for row in rows if row.get("named")}
    known: list[Row] = [
        {**row, "relative": row["gain"] / row["oracle"]}
        for row in first_rows(clear)
        if row["index"] in named_cases and row["oracle"] > 0 and math.isfinite(row["gain"])
    ]
    return [
        median(
            "overlap in time (IoU), median",
            clear,
            "iou",
            Target(">= 0.7", least=0.7),
        ),
        share(
            "averaging times overlap",
            [row for row in clear if row["tau_hit"] is not None],
            "tau_hit",
        ),
        share(
            "95 % intervals that contain the truth",
            scores,
            "covered",
            Target("92-98 %", least=0.92, most=0.98),
        ),
        share(
            "of those, form as fitted",
            [entry for entry in scores if not entry["form_differs"]],
            "covered",
        ),
        share(
            "of those, without shared_source",
            [entry for entry in scores if entry["effect"] != "shared_source"],
            "covered",
        ),
        *(
            share(
                f"errors within the {level} % interval of a normal law",
                [{**entry, "within": abs(entry["pull"]) <= sigma} for entry in pulls],
                "within",
            )
            for level, sigma in _NORMAL_INTERVALS.items()
        ),
        spread(
            "errors in standard errors, 68 % quantile",
            scores,
            "pull",
            Target("0.8-1.25", 0.8, 1.25),
        ),
        median(
            "evidence relative to the oracle, median",
            known,
            "relative",
            Target("0.9-1.2", least=0.9, most=1.2),
        ),
        median(
            "evidence relative to the oracle, all effects named correctly, median",
            [row for row in known if _all_named(row, rows)],
            "relative",
        ),
        median(
            "evidence relative to the oracle with fitted noise, median",
            [row for row in known if row.get("learned", 0.0) > 0],
            lambda row: row["gain"] / row["learned"],
            Target(">= 0.9", least=0.9),
        ),
        share("evidence at least 0.7 of the oracle", known, lambda row: row["relative"] >= 0.7),
        median(
            "held-out values inside the 95 % band, median",
            first_rows(rows),
            "coverage_after",
            Target("93-97 %", 0.93, 0.97),
        ),
    ]


def _all_named(row: Row, rows: Sequence[Row]) -> bool:
    """Test whether exactly the effects of a case were named."""
    return not row["wrong"] and all(
        other["named"] for other in rows if other["index"] == row["index"]
    )


def _model_lines(rows: Sequence[Row]) -> list[Line]:
    """Make the lines of the models that the diagnoses wrote, if they have an effect."""
    checked = [row for row in first_rows(rows) if row.get("model_check")]
    return [
        share(
            "models that can be simulated, of those with an effect",
            checked,
            lambda row: row["model_check"]["runs"],
        ),
        share(
            "simulated records nearer to the recording with the effects, without refit",
            checked,
            lambda row: row["model_check"]["runs"] and row["model_check"]["nats"] > 0.0,
            at_least(0.95),
        ),
    ]


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
