"""What a diagnosis is worth beside the truth: one row for every true effect of a case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gyrostab.concealed.catalogue import merged
from gyrostab.errors import SchemaError

__all__ = ["intersection_over_union", "score_case"]

Intervals = Sequence[Sequence[str]]


def _seconds(intervals: Intervals) -> list[tuple[float, float]]:
    spans = sorted(
        tuple(float(np.datetime64(stamp.removesuffix("Z"), "ns").astype(np.int64)) * 1e-9 for stamp in pair) for pair in intervals
    )
    joined: list[tuple[float, float]] = []
    for begin, end in spans:
        if joined and begin <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((begin, end))
    return joined


def intersection_over_union(found: Intervals, true: Intervals) -> float:
    """Time that both have, over time that either has; intervals are pairs of ISO 8601.

    Examples
    --------
    >>> intersection_over_union([["2026-01-01T00:00:00", "2026-01-01T00:00:10"]], [["2026-01-01T00:00:05Z", "2026-01-01T00:00:15Z"]])
    0.3333333333333333
    """
    a, b = _seconds(found), _seconds(true)
    both = sum(max(0.0, min(x[1], y[1]) - max(x[0], y[0])) for x in a for y in b)
    either = sum(end - begin for begin, end in (*a, *b)) - both
    return both / either if either > 0 else 0.0


def _names(claim: Mapping[str, Any]) -> set[str]:
    return {claim["name"], *claim.get("alternatives", ())}


def _gain(claim: Mapping[str, Any]) -> float:
    return float((claim.get("held_out_gain") or {}).get("nats") or 0.0)


def _covered(claim: Mapping[str, Any], effect: Mapping[str, Any]) -> list[bool]:
    """Whether the interval of every parameter that both know, in the same unit and on the same axes, holds the true value."""
    out = []
    for name, true in effect["parameters"].items():
        found = claim.get("parameters", {}).get(name)
        if found is None or found.get("unit") != true["unit"] or found.get("low") is None or found.get("high") is None:
            continue
        if true.get("axis") is not None and list(claim.get("axes", ())) != [true["axis"]]:
            continue
        out.append(bool(found["low"] <= true["value"] <= found["high"]))
    return out


def _tau_hit(diagnosis: Mapping[str, Any], name: str, effect: Mapping[str, Any]) -> bool | None:
    bands = [(m["tau_min_s"], m["tau_max_s"]) for m in diagnosis["mismatches"] if name in m.get("explained_by", ())]
    bands = [band for band in bands if band[0] is not None and band[1] is not None]
    if not bands:
        return None
    return any(low <= effect["tau_max_s"] and high >= effect["tau_min_s"] for low, high in bands)


def _check(diagnosis: Mapping[str, Any]) -> None:
    lacking = [key for key in ("verdict", "mismatches", "effects", "unexplained", "held_out") if key not in diagnosis]
    if lacking:
        raise SchemaError(f"this is not a diagnosis: it has no {lacking[0]!r}; give the content of diagnosis.json")


def score_case(diagnosis: Mapping[str, Any], truth: Mapping[str, Any], *, naive: Mapping[str, bool] | None = None) -> list[dict[str, Any]]:
    """Compare a diagnosis with the truth.

    Parameters
    ----------
    diagnosis : mapping
        Content of ``diagnosis.json``.
    truth : mapping
        From `make_case`, or opened with `open_truth`.
    naive : mapping, optional
        What plain detectors said: name to whether they saw something.

    Returns
    -------
    list of dict
        A row for every true effect, or one row where there is none: ``kind``, ``effect``, ``strength``, ``detected``, ``named`` (classes
        merged by the ambiguity sets), ``named_exactly``, ``in_set``, ``set_size``, ``wrong`` (claims that stand for nothing true),
        ``unknown``, ``iou``, ``tau_hit``, ``covered``, ``gain``, ``oracle``, ``seconds``, ``claims`` and more.

    Raises
    ------
    SchemaError
        When the diagnosis lacks a key.
    """
    _check(diagnosis)
    accepted = set(truth["accepted"])
    claims = sorted(diagnosis["effects"], key=_gain, reverse=True)
    true = [effect["name"] for effect in truth["effects"]]
    standing = accepted.union(*(merged(name) for name in true)) if true else accepted
    wrong = [claim["name"] for claim in claims if not _names(claim) & standing]
    detected = diagnosis["verdict"] != "no mismatch" or bool(claims)
    plan = truth.get("plan") or {}
    case = {
        "index": plan.get("index"),
        "kind": plan.get("kind"),
        "severing": plan.get("severing"),
        "rate": truth["sampling_rate_hz"],
        "length": truth["seconds"],
        "missing": truth["missing_share"],
        "verdict": diagnosis["verdict"],
        "detected": detected,
        "wrong": len(wrong),
        "wrong_names": wrong,
        "unknown": bool(detected and not wrong and (diagnosis["verdict"] in ("unknown", "partly explained") or not claims)),
        "claims": [(claim["name"], bool(_names(claim) & standing)) for claim in claims],
        "gain": float((diagnosis["held_out"] or {}).get("log_likelihood_gain") or 0.0),
        "oracle": float(sum(effect["expected_nats"] for effect in truth["effects"])),
        "coverage_after": (diagnosis["held_out"] or {}).get("coverage95_after"),
        "seconds": float(diagnosis.get("seconds") or 0.0),
        "naive": dict(naive or {}),
    }
    if not true:
        return [case | {"effect": None, "strength": 0.0, "size": 0.0, "form_differs": None}]
    return [case | _row(diagnosis, claims, effect, accepted, true) for effect in truth["effects"]]


def _row(
    diagnosis: Mapping[str, Any], claims: Sequence[Mapping[str, Any]], effect: Mapping[str, Any], accepted: set[str], true: Sequence[str]
) -> dict[str, Any]:
    name = effect["name"]
    others = accepted.union(*(merged(other) for other in true if other != name)) - merged(name)
    mine = [claim for claim in claims if claim["name"] not in others]
    top = mine[0] if mine else None
    row: dict[str, Any] = {
        "effect": name,
        "strength": effect["strength"],
        "size": effect["size"],
        "form_differs": effect["form_differs"],
        "named": bool(top and top["name"] in merged(name)),
        "named_exactly": bool(top and top["name"] == name),
        "in_set": None,
        "set_size": None,
        "iou": None,
        "tau_hit": None,
        "covered": [],
    }
    if top is not None:
        row["in_set"] = name in _names(top)
        row["set_size"] = len(_names(top))
    if top is not None and row["named"]:
        row["covered"] = _covered(top, effect)
        row["tau_hit"] = _tau_hit(diagnosis, top["name"], effect)
        if effect["localised"] and top.get("intervals"):
            row["iou"] = intersection_over_union(top["intervals"], effect["intervals"])
    return row
