"""Score a diagnosis against the truth: one row for every true effect of a case."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gyrostab.blindtest.generator.catalogue import merge_ambiguous
from gyrostab.blindtest.generator.detection_limits import NATS

Intervals = Sequence[Sequence[str]]

#: Kinds of cases with catalogue effects and an undisturbed driver.
CATALOGUE_KINDS = ("single", "pair", "triple", "sub_threshold")
#: Parameters with an arbitrary sign: that of a source which several axes share is a convention.
_UNSIGNED = ("N",)
_RELATIVE_TOLERANCE = 1e-9


def _merge_intervals(intervals: Intervals) -> list[tuple[float, float]]:
    spans = sorted(
        tuple(
            float(np.datetime64(stamp.removesuffix("Z"), "ns").astype(np.int64)) * 1e-9
            for stamp in pair
        )
        for pair in intervals
    )
    joined: list[tuple[float, float]] = []
    for begin, end in spans:
        if joined and begin <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((begin, end))
    return joined


def intersection_over_union(diagnosed: Intervals, true: Intervals) -> float:
    """Compute the overlap in time of two lists of ISO 8601 intervals (IoU)."""
    a, b = _merge_intervals(diagnosed), _merge_intervals(true)
    overlap = sum(max(0.0, min(x[1], y[1]) - max(x[0], y[0])) for x in a for y in b)
    either = sum(end - begin for begin, end in (*a, *b)) - overlap
    return overlap / either if either > 0 else 0.0


def _ambiguity_set(identification: Mapping[str, Any]) -> set[str]:
    return {identification["name"], *identification["alternatives"]}


def _evidence_nats(table: Mapping[str, Any]) -> float:
    return float((table.get("held_out_gain") or {}).get("nats") or 0.0)


def _collect_identifications(diagnosis: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Collect the tables of each identified name (one per axis or line), strongest name first."""
    out: dict[str, dict[str, Any]] = {}
    for table in sorted(diagnosis["effects"], key=_evidence_nats, reverse=True):
        identification = out.setdefault(
            table["name"],
            {"name": table["name"], "alternatives": set(), "intervals": [], "tables": []},
        )
        identification["alternatives"] |= set(table.get("alternatives", ()))
        identification["intervals"] += table.get("intervals", ())
        identification["tables"].append(table)
    return list(out.values())


def _score_parameters(
    identification: Mapping[str, Any], effect: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Score the parameters in both truth and identification.

    Each is ``covered`` if the truth is in its 95 % interval; its ``pull`` is the error over the
    standard error.
    """
    out = []
    for name, true in effect["parameters"].items():
        true_values = true.get("values") or {None: true["value"]}
        for axis, value in true_values.items():
            entries = [
                _find_parameter(table, name, axis, unless=true.get("unless", ()))
                for table in identification["tables"]
            ]
            matches = [
                (_frequency_distance(table, effect), entry)
                for table, entry in zip(identification["tables"], entries, strict=True)
                if entry is not None
            ]
            if not matches:
                continue
            estimate = min(matches, key=lambda item: item[0])[1]
            if (
                estimate.get("unit") != true["unit"]
                or estimate.get("low") is None
                or estimate.get("high") is None
            ):
                continue
            turned = -1.0 if name in _UNSIGNED and (estimate["value"] or 0.0) < 0 else 1.0
            low, high = sorted((turned * estimate["low"], turned * estimate["high"]))
            sure = estimate.get("value") is not None and estimate.get("stderr")
            pull = (turned * estimate["value"] - value) / estimate["stderr"] if sure else None
            last = _RELATIVE_TOLERANCE * abs(value)  # exact values may differ by rounding
            out.append(
                {
                    "parameter": name,
                    "covered": bool(low - last <= value <= high + last),
                    "pull": pull,
                }
            )
    return out


def _find_parameter(
    table: Mapping[str, Any], name: str, axis: str | None, *, unless: Sequence[str]
) -> Mapping[str, Any] | None:
    """Find a parameter in a table of an identification; None where `unless` changes its meaning."""
    parameters, axes = table.get("parameters", {}), list(table.get("axes", ()))
    if {key.split(".")[0] for key in parameters} & set(unless) or (
        axis is not None and axis not in axes
    ):
        return None
    entry: Mapping[str, Any] | None = parameters.get(
        f"{name}.{axis}" if axis is not None and len(axes) > 1 else name
    )
    return entry


def _frequency_distance(table: Mapping[str, Any], effect: Mapping[str, Any]) -> float:
    """Compute the distance in frequency between table and effect, to match the nearest line."""
    true, estimate = (
        effect["parameters"].get("frequency"),
        table.get("parameters", {}).get("frequency"),
    )
    return (
        abs(estimate["value"] - true["value"])
        if true and estimate and estimate.get("value") is not None
        else 0.0
    )


def _tau_hit(diagnosis: Mapping[str, Any], name: str, effect: Mapping[str, Any]) -> bool | None:
    bands = [
        (m["tau_min_s"], m["tau_max_s"])
        for m in diagnosis["mismatches"]
        if name in m.get("explained_by", ()) and None not in (m["tau_min_s"], m["tau_max_s"])
    ]
    if not bands:
        return None
    return any(low <= effect["tau_max_s"] and high >= effect["tau_min_s"] for low, high in bands)


def drawn_rows(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Keep the rows of drawn cases: no counterparts, injections and controls."""
    return [row for row in rows if row["kind"] not in ("counterpart", "injected", "control")]


def answered_rows(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Keep the rows whose diagnosis did not fail: only these show that a name is absent."""
    return [row for row in rows if not row.get("failed")]


def catalogue_rows(
    rows: Sequence[Mapping[str, Any]], *, min_strength: float = 0.0
) -> list[Mapping[str, Any]]:
    """Keep the rows of catalogue effects with an undisturbed driver."""
    return [
        row
        for row in rows
        if row["kind"] in CATALOGUE_KINDS and row["effect"] and row["strength"] >= min_strength
    ]


def first_rows(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Keep one row per case, and per copy of a case or of a real recording."""
    rows_by_case: dict[Any, Mapping[str, Any]] = {}
    for row in rows:
        rows_by_case.setdefault((row["index"], row.get("copy")), row)
    return list(rows_by_case.values())


def detection_score(diagnosis: Mapping[str, Any]) -> float:
    """Compute how far a diagnosis is above its threshold of detection, or below it [nats].

    This is the largest of: the evidence of each named effect, less its threshold; the logarithm of
    the false-alarm level over the p-value of each mismatch; and what each effect that noise
    explains lacks, with a negative sign.
    """
    level = diagnosis.get("false_alarm_level") or 0.01
    gains = [effect.get("held_out_gain") or {} for effect in diagnosis["effects"]]
    margins = [
        gain["nats"] - gain["threshold"]
        for gain in gains
        if gain.get("nats") is not None and gain.get("threshold") is not None
    ]
    margins += [
        math.log(level / max(mismatch["p_value"], 1e-300))
        for mismatch in diagnosis["mismatches"]
        if mismatch.get("p_value") is not None
    ]
    margins += [
        -rejection["nats"]
        for rejection in diagnosis.get("rejected", ())
        if rejection["beaten_by"] == "noise" and rejection["nats"] is not None
    ]
    return max(margins, default=-math.inf)


def score_case(
    diagnosis: Mapping[str, Any],
    truth: Mapping[str, Any],
    *,
    baseline_scores: Mapping[str, float] | None = None,
) -> list[dict[str, Any]]:
    """Compare the content of ``diagnosis.json`` with the truth.

    `baseline_scores` are those of other detectors by name, above 0 for a detection. Return a row
    for every true effect, or one row without an effect, with among others: ``score`` (of
    `detection_score`), ``named`` (ambiguity sets merged; a name counts for one effect), ``wrong``
    (number of names without a true effect), ``learned`` (the oracle's evidence with fitted noise),
    and ``identifications``. A name counts once, on however many axes it is identified: with its
    ``probability``, whether it is ``right`` (counts for a true effect), and whether it is a true
    name itself (``exact``).
    """
    accepted = set(truth["accepted"])
    identifications = _collect_identifications(diagnosis)
    true = [effect["name"] for effect in truth["effects"]]
    matches = _match_names(identifications, true)
    right = accepted.union(match["name"] for match in matches if match is not None)
    wrong = [entry for entry in identifications if entry["name"] not in right]
    detected = diagnosis["verdict"] != "no mismatch" or bool(identifications)
    plan = truth["plan"]
    case = {
        "index": plan["index"],
        "kind": plan["kind"],
        "recording": plan.get("recording"),
        "copy": plan.get("copy"),
        "degradation": plan.get("degradation"),
        "rate": truth["sampling_rate_hz"],
        "length": truth["seconds"],
        "missing": truth["missing_share"],
        "verdict": diagnosis["verdict"],
        "detected": detected,
        "score": detection_score(diagnosis),
        "wrong": len(wrong),
        "wrong_names": [entry["name"] for entry in wrong],
        "unidentified": bool(
            detected
            and not wrong
            and (
                diagnosis["verdict"] in ("unknown", "partly explained")
                or all(entry["name"] in accepted for entry in identifications)
            )
        ),
        "identifications": [
            {
                "name": identification["name"],
                "probability": identification["tables"][0].get("probability"),
                "right": identification["name"] in right,
                "exact": identification["name"] in accepted.union(true),
            }
            for identification in identifications
        ],
        "gain": float((diagnosis["held_out"] or {}).get("log_likelihood_gain") or 0.0),
        "oracle": float(sum(effect["expected_nats"] for effect in truth["effects"])),
        "learned": float(sum(effect.get("learned_nats", np.nan) for effect in truth["effects"])),
        "coverage_after": (diagnosis["held_out"] or {}).get("coverage95_after"),
        "model_check": diagnosis.get("model_check"),
        "seconds": float(diagnosis.get("seconds") or 0.0),
        "baseline_detectors": dict(baseline_scores or {}),
    }
    if not true:
        return [
            case
            | {
                "effect": None,
                "strength": 0.0,
                "learned_strength": None,
                "size": 0.0,
                "form_differs": None,
            }
        ]
    return [
        case | _score_effect(diagnosis, identifications, effect, match, wrong)
        for effect, match in zip(truth["effects"], matches, strict=True)
    ]


def _match_names(
    identifications: Sequence[dict[str, Any]], true: Sequence[str]
) -> list[dict[str, Any] | None]:
    """Match each true effect to at most one identification, and each of these to one effect.

    Exact names come first, then as many names of the ambiguity sets as possible, the strongest.
    """
    from scipy.optimize import linear_sum_assignment

    matches: list[dict[str, Any] | None] = [None] * len(true)
    weights = np.array(
        [
            [
                100.0 * (entry["name"] == name)
                + 10.0 * (entry["name"] in merge_ambiguous(name))
                - place / len(identifications)
                for place, entry in enumerate(identifications)
            ]
            for name in true
        ]
    ).reshape(len(true), len(identifications))
    for effect, place in zip(*linear_sum_assignment(weights, maximize=True), strict=True):
        if weights[effect, place] > 0.0:
            matches[effect] = identifications[int(place)]
    return matches


def _score_effect(
    diagnosis: Mapping[str, Any],
    identifications: Sequence[Mapping[str, Any]],
    effect: Mapping[str, Any],
    match: Mapping[str, Any] | None,
    wrong: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Score a true effect by its match; a wrong name that is stronger comes in its place."""
    name = effect["name"]
    top = next((entry for entry in identifications if entry is match or entry in wrong), None)
    named = match if match is top else None
    row: dict[str, Any] = {
        "effect": name,
        "strength": effect["strength"],
        "learned_strength": math.sqrt(effect["learned_nats"] / NATS)
        if "learned_nats" in effect
        else None,
        "size": effect["size"],
        "form_differs": effect["form_differs"],
        "named": named is not None,
        "named_exactly": named is not None and named["name"] == name,
        "in_set": name in _ambiguity_set(top) if top else None,
        "set_size": len(_ambiguity_set(top)) if top else None,
        "iou": None,
        "tau_hit": None,
        "parameter_scores": [],
    }
    if match is not None:
        row["parameter_scores"] = _score_parameters(match, effect) if match["name"] == name else []
        row["tau_hit"] = _tau_hit(diagnosis, match["name"], effect)
        if effect["localised"] and match["intervals"]:
            row["iou"] = intersection_over_union(match["intervals"], effect["intervals"])
    return row
