"""Compare detectors at equal false-alarm rates, and records with their copies without an effect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from gyrostab.arrays import Bools, Floats
from gyrostab.blindtest.generator.catalogue import merge_ambiguous
from gyrostab.blindtest.scoring.proportions import make_lines, resample
from gyrostab.blindtest.scoring.score import CATALOGUE_KINDS, answered_rows, drawn_rows, first_rows
from gyrostab.blindtest.scoring.table import CLEAR_STRENGTH

Row = Mapping[str, Any]

#: Shares of records of noise that each detector may call a detection.
FALSE_ALARM_RATES = (0.02, 0.05)
#: Kinds of cases whose detection is counted together.
_GROUPS = {
    "catalogue": CATALOGUE_KINDS,
    "out of catalogue or degraded driver": ("out_of_catalogue", "degraded_driver"),
}
#: Strength in fitted noise from which most injections should be named. Amplitudes are found to
#: 0.1 %, so that an effect drawn at this strength may be slightly weaker.
_NAMED_STRENGTH, _STRENGTH_TOLERANCE = 5.0, 1e-3


def _list_comparisons(rows: Sequence[Row]) -> list[tuple[dict[str, Any], list[Row], Floats, Bools]]:
    """List group and detector, records of noise and cases, their scores, and which are cases."""
    noise = answered_rows([row for row in rows if row["kind"] in ("null", "counterpart")])
    out = []
    for group, kinds in _GROUPS.items():
        strong = [row for row in rows if row["kind"] in kinds and row["strength"] >= CLEAR_STRENGTH]
        cases = first_rows(strong)
        if not noise or not cases:
            continue
        records = [*noise, *cases]
        is_case = np.arange(len(records)) >= len(noise)
        scores = [{"diagnosis": row["score"], **row["baseline_detectors"]} for row in records]
        for name in ("diagnosis", *cases[0]["baseline_detectors"]):
            line: dict[str, Any] = {"cases": group, "detector": name}
            out.append((line, records, np.array([row[name] for row in scores], float), is_case))
    return out


def _share_detected(scores: Floats, is_case: Bools, rate: float) -> float:
    """Compute the share of cases above the score that at most `rate` of the noise exceeds."""
    noise, cases = np.sort(scores[~is_case]), scores[is_case]
    if not noise.size or not cases.size:
        return math.nan
    threshold = noise[-1 - math.floor(rate * noise.size + 1e-9)]
    return float((cases > threshold).mean())


def _share_columns(
    records: Sequence[Row], scores: Floats, is_case: Bools, rate: float
) -> dict[str, float]:
    def share(chosen: Any) -> float:
        return _share_detected(scores[chosen], is_case[chosen], rate)

    label, (low, high) = f"at {100 * rate:g} %", resample(records, share)
    return {label: share(...), f"{label}, low": low, f"{label}, high": high}


def detection_shares(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the share of cases that each detector detects at equal rates of false alarms.

    The threshold of each detector is the score that this share of the null records and of the
    noise-only counterparts exceeds. A case counts if its strongest effect has strength 1.5 or more.
    There are ``n`` cases and ``noise`` records of noise; without the latter the table is empty. The
    95 % intervals are those of resampled records (a case and its counterpart together).
    """
    lines = []
    for line, records, scores, is_case in _list_comparisons(rows):
        line |= {"n": int(is_case.sum()), "noise": int((~is_case).sum())}
        for rate in FALSE_ALARM_RATES:
            line |= _share_columns(records, scores, is_case, rate)
        lines.append(line)
    return pd.DataFrame(lines)


def roc_curves(rows: Sequence[Row]) -> pd.DataFrame:
    """Compute the shares of cases (``detected``) and of noise (``false_alarms``) above each score.

    A line is the detector's ``own`` if the threshold is that of the detector itself, score 0.
    """
    lines = []
    for line, _, scores, is_case in _list_comparisons(rows):
        noise, cases = scores[~is_case], scores[is_case]
        thresholds = [math.inf, *np.unique(noise)[::-1], -math.inf]
        lines += [
            {
                **line,
                "false_alarms": float((noise > threshold).mean()),
                "detected": float((cases > threshold).mean()),
                "own": is_own,
            }
            for threshold, is_own in [(0.0, True), *((value, False) for value in thresholds)]
        ]
    return pd.DataFrame(lines, columns=["cases", "detector", "false_alarms", "detected", "own"])


def counterpart_table(rows: Sequence[Row]) -> pd.DataFrame:
    """Compare cases with their noise-only counterparts, in lines like those of `score_table`."""
    mine = answered_rows([row for row in rows if row["kind"] == "counterpart"])
    if not mine:
        return pd.DataFrame()
    cases = {row["index"]: row for row in drawn_rows(rows)}
    pairs: list[Row] = [
        {
            **row,
            "case": case,
            "only_with": case["detected"] and not row["detected"],
            "both": case["detected"] and row["detected"],
            "only_without": row["detected"] and not case["detected"],
        }
        for row in mine
        if (case := cases.get(row["index"]))
    ]
    names: list[Row] = [
        {"index": row["index"], "both": entry["name"] in counterpart_names}
        for row in pairs
        for counterpart_names in [{other["name"] for other in row["identifications"]}]
        for entry in row["case"]["identifications"]
    ]
    noise = answered_rows([row for row in rows if row["kind"] in ("null", "counterpart")])
    groups = {"counterparts": mine, "noise": noise, "pairs": pairs, "names": names}
    return pd.DataFrame(make_lines("counterparts", groups))


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
        names = {
            copy: {identification["name"] for identification in row["identifications"]}
            for copy, row in copies.items()
        }
        before, injected = names["untouched"], copies["injected"]
        known, mine = (
            set().union(*map(merge_ambiguous, before)),
            merge_ambiguous(injected["effect"]),
        )
        described = ("recording", "effect", "strength", "learned_strength")
        out.append(
            {
                "index": index,
                "failed": injected.get("failed", False),
                **{key: injected[key] for key in described},
                "before": sorted(before),
                "there_before": bool(before & mine),
                "named": bool(names["injected"] & mine),
                "others": sorted(names["injected"] - mine - known),
                "flipped": sorted(names["flipped"] - known),
                "reversed": sorted(names["reversed"] - known),
            }
        )
    return out


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
