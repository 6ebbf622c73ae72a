"""What a diagnosis is worth beside the truth: one row for every true effect of a case."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gyrostab.blindtest.generator.catalogue import merged
from gyrostab.blindtest.generator.detection_limits import NATS
from gyrostab.errors import SchemaError

__all__ = ["intersection_over_union", "score_case"]

Intervals = Sequence[Sequence[str]]

#: Numbers of which only the size can be known: the sign of what several axes share is a matter of
#: convention.
_UNSIGNED = ("N",)
_LAST_DIGITS = 1e-9  # of a number


def _seconds(intervals: Intervals) -> list[tuple[float, float]]:
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
    return {claim["name"], *claim["alternatives"]}


def _gain(table: Mapping[str, Any]) -> float:
    return float((table.get("held_out_gain") or {}).get("nats") or 0.0)


def _claims(diagnosis: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every name that is claimed once, the strongest first, with all its tables: one for every axis, or every line."""
    out: dict[str, dict[str, Any]] = {}
    for table in sorted(diagnosis["effects"], key=_gain, reverse=True):
        one = out.setdefault(
            table["name"],
            {"name": table["name"], "alternatives": set(), "intervals": [], "tables": []},
        )
        one["alternatives"] |= set(table.get("alternatives", ()))
        one["intervals"] += table.get("intervals", ())
        one["tables"].append(table)
    return list(out.values())


def _numbers(claim: Mapping[str, Any], effect: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every number that truth and claim both have: ``parameter``, ``held`` (is the truth in the 95 % interval?) and ``pull`` (z)."""
    out = []
    for name, true in effect["parameters"].items():
        wanted = true.get("values") or {None: true["value"]}
        for axis, value in wanted.items():
            known = [
                _entry(table, name, axis, unless=true.get("unless", ()))
                for table in claim["tables"]
            ]
            near = [
                (_far(table, effect), entry)
                for table, entry in zip(claim["tables"], known, strict=True)
                if entry is not None
            ]
            if not near:
                continue
            found = min(near, key=lambda item: item[0])[1]
            if (
                found.get("unit") != true["unit"]
                or found.get("low") is None
                or found.get("high") is None
            ):
                continue
            turned = -1.0 if name in _UNSIGNED and (found["value"] or 0.0) < 0 else 1.0
            low, high = sorted((turned * found["low"], turned * found["high"]))
            sure = found.get("value") is not None and found.get("stderr")
            pull = (turned * found["value"] - value) / found["stderr"] if sure else None
            last = _LAST_DIGITS * abs(value)  # what is exact may differ in the last digits
            out.append(
                {"parameter": name, "held": bool(low - last <= value <= high + last), "pull": pull}
            )
    return out


def _entry(
    table: Mapping[str, Any], name: str, axis: str | None, *, unless: Sequence[str]
) -> Mapping[str, Any] | None:
    """The number of this name in a claim's table, for an axis or for all; none where others are beside it that change its meaning."""
    parameters, axes = table.get("parameters", {}), list(table.get("axes", ()))
    if {key.split(".")[0] for key in parameters} & set(unless) or (
        axis is not None and axis not in axes
    ):
        return None
    found: Mapping[str, Any] | None = parameters.get(
        f"{name}.{axis}" if axis is not None and len(axes) > 1 else name
    )
    return found


def _far(table: Mapping[str, Any], effect: Mapping[str, Any]) -> float:
    """How far a claim's table is from an effect that has a frequency: of several lines the nearest is meant."""
    true, found = (
        effect["parameters"].get("frequency"),
        table.get("parameters", {}).get("frequency"),
    )
    return (
        abs(found["value"] - true["value"])
        if true and found and found.get("value") is not None
        else 0.0
    )


def _tau_hit(diagnosis: Mapping[str, Any], name: str, effect: Mapping[str, Any]) -> bool | None:
    bands = [
        (m["tau_min_s"], m["tau_max_s"])
        for m in diagnosis["mismatches"]
        if name in m.get("explained_by", ())
    ]
    bands = [band for band in bands if band[0] is not None and band[1] is not None]
    if not bands:
        return None
    return any(low <= effect["tau_max_s"] and high >= effect["tau_min_s"] for low, high in bands)


def _check(diagnosis: Mapping[str, Any]) -> None:
    lacking = [
        key
        for key in ("verdict", "mismatches", "effects", "unexplained", "held_out")
        if key not in diagnosis
    ]
    if lacking:
        raise SchemaError(
            f"this is not a diagnosis: it has no {lacking[0]!r}; give the content of diagnosis.json"
        )


def score_case(
    diagnosis: Mapping[str, Any],
    truth: Mapping[str, Any],
    *,
    naive: Mapping[str, bool] | None = None,
) -> list[dict[str, Any]]:
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
        A row for every true effect, or one row where there is none: ``kind``, ``effect``,
        ``strength``, ``detected``, ``named`` (classes merged by the ambiguity sets),
        ``named_exactly``, ``in_set``, ``set_size``, ``wrong`` (names that stand for nothing true),
        ``unknown``, ``iou``, ``tau_hit``, ``numbers``, ``gain``, ``oracle``, ``learned`` (the
        oracle's, where noise is learned from the record), ``seconds``, ``claims`` and more. A name
        is counted once, on however many axes it is claimed.

    Raises
    ------
    SchemaError
        When the diagnosis lacks a key.
    """
    _check(diagnosis)
    accepted = set(truth["accepted"])
    claims = _claims(diagnosis)
    true = [effect["name"] for effect in truth["effects"]]
    standing = accepted.union(*(merged(name) for name in true)) if true else accepted
    wrong = [claim["name"] for claim in claims if not _names(claim) & standing]
    detected = diagnosis["verdict"] != "no mismatch" or bool(claims)
    plan = truth.get("plan") or {}
    case = {
        "index": plan.get("index"),
        "kind": plan.get("kind"),
        "recording": plan.get("recording"),
        "copy": plan.get("copy"),
        "severing": plan.get("severing"),
        "rate": truth["sampling_rate_hz"],
        "length": truth["seconds"],
        "missing": truth["missing_share"],
        "verdict": diagnosis["verdict"],
        "detected": detected,
        "wrong": len(wrong),
        "wrong_names": wrong,
        "unknown": bool(
            detected
            and not wrong
            and (diagnosis["verdict"] in ("unknown", "partly explained") or not claims)
        ),
        "claims": [(claim["name"], bool(_names(claim) & standing)) for claim in claims],
        "gain": float((diagnosis["held_out"] or {}).get("log_likelihood_gain") or 0.0),
        "oracle": float(sum(effect["expected_nats"] for effect in truth["effects"])),
        "learned": float(sum(effect.get("learned_nats", np.nan) for effect in truth["effects"])),
        "coverage_after": (diagnosis["held_out"] or {}).get("coverage95_after"),
        "seconds": float(diagnosis.get("seconds") or 0.0),
        "naive": dict(naive or {}),
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
    return [case | _row(diagnosis, claims, effect, accepted, true) for effect in truth["effects"]]


def _row(
    diagnosis: Mapping[str, Any],
    claims: Sequence[Mapping[str, Any]],
    effect: Mapping[str, Any],
    accepted: set[str],
    true: Sequence[str],
) -> dict[str, Any]:
    name = effect["name"]
    others = accepted.union(*(merged(other) for other in true if other != name)) - merged(name)
    mine = [claim for claim in claims if claim["name"] not in others]
    top = mine[0] if mine else None
    own = next((claim for claim in mine if claim["name"] in merged(name)), None)
    row: dict[str, Any] = {
        "effect": name,
        "strength": effect["strength"],
        "learned_strength": math.sqrt(effect["learned_nats"] / NATS)
        if "learned_nats" in effect
        else None,
        "size": effect["size"],
        "form_differs": effect["form_differs"],
        "named": bool(top and top["name"] in merged(name)),
        "named_exactly": bool(top and top["name"] == name),
        "in_set": None,
        "set_size": None,
        "iou": None,
        "tau_hit": None,
        "numbers": [],
    }
    if top is not None:
        row["in_set"] = name in _names(top)
        row["set_size"] = len(_names(top))
    if own is not None:
        row["numbers"] = _numbers(own, effect) if own["name"] == name else []
        row["tau_hit"] = _tau_hit(diagnosis, own["name"], effect)
        if effect["localised"] and own["intervals"]:
            row["iou"] = intersection_over_union(own["intervals"], effect["intervals"])
    return row
