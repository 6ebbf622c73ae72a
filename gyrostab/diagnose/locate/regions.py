"""One mismatch of boxes that show the same: on several axes, in pieces, or as a mean that wanders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["merge_regions", "merge_wandering_regions"]

Region = dict[str, Any]
_LIKE = 0.5  # share of the time of both that two boxes have in common when they are one
# of the longer of two boxes, which may lie between them when they are one, if it is no longer than
# the shorter
_NEAR = 0.25
_LINE = 0.02  # share of the frequency by which one line may wander
_KINDS = ("slow", "restless", "glide")
_STEPS = 3  # boxes of one mean, beyond which it is said to wander


def merge_regions(boxes: Sequence[Region]) -> list[Region]:
    """Join boxes, the surest first; the surest of those that are joined gives its numbers.

    Boxes of different axes are one when they share most of their time; those of the same axes also
    when they lie side by side, and their joint box then spans both.

    Parameters
    ----------
    boxes : sequence of dict
        With the fields of `gyrostab.diagnose.locate.mismatches.FIELDS`.

    Examples
    --------
    >>> box = {"view": "davar", "axes": "x", "what": "avar", "begin": 0.0, "end": 60.0, "tau_min_s": 0.01, "tau_max_s": 0.1,
    ...        "frequency": float("nan"), "sign": 1, "z": 9.0, "p_value": 1e-6}
    >>> [(one["axes"], one["end"]) for one in merged([box, box | {"axes": "y", "z": 8.0}, box | {"begin": 60.0, "end": 90.0, "z": 7.0}])]
    [('x y', 90.0)]
    """
    kept: list[Region] = []
    for box in sorted(boxes, key=lambda one: (one["p_value"], -abs(one["z"]))):
        for other in kept:
            if not _alike(box, other):
                continue
            if _shared(box, other) > _LIKE or _touching(box, other):
                _join(other, box)
                break
        else:
            kept.append(dict(box))
    return kept


def _alike(one: Region, other: Region) -> bool:
    """The same view, direction, and averaging times or line."""
    if one["view"] != other["view"] or (
        one["sign"] != other["sign"] and one["view"] != "cross_axis"
    ):
        return False
    if one["what"] == "line" or other["what"] == "line":
        return bool(
            one["what"] == other["what"]
            and abs(one["frequency"] / other["frequency"] - 1.0) < _LINE
        )
    if _kind(one) != _kind(other):
        return False
    return bool(
        min(one["tau_max_s"], other["tau_max_s"])
        >= 0.99 * max(one["tau_min_s"], other["tau_min_s"])
    )


def _kind(box: Region) -> str:
    """What is never one mismatch: inside of blocks and from one to the next, a level and its scatter, lines that stand and that move."""
    kind = str(box["what"]).split(" ")[0]
    return kind if kind in _KINDS else ""


def _shared(one: Region, other: Region) -> float:
    common = min(one["end"], other["end"]) - max(one["begin"], other["begin"])
    return float(common / (max(one["end"], other["end"]) - min(one["begin"], other["begin"])))


def _touching(one: Region, other: Region) -> bool:
    """Pieces of the same axes that lie side by side."""
    if not set(one["axes"].split()) <= set(other["axes"].split()) or one["view"] in (
        "mean",
        "restart",
    ):
        return False
    shorter, longer = sorted([one["end"] - one["begin"], other["end"] - other["begin"]])
    return bool(
        max(one["begin"], other["begin"]) - min(one["end"], other["end"])
        <= min(_NEAR * longer, shorter) + 1e-6
    )


def _join(box: Region, other: Region) -> None:
    if _shared(box, other) <= _LIKE:
        box["begin"], box["end"] = min(box["begin"], other["begin"]), max(box["end"], other["end"])
        if box["what"] != "line":
            low, high = (
                min(box["tau_min_s"], other["tau_min_s"]),
                max(box["tau_max_s"], other["tau_max_s"]),
            )
            box["tau_min_s"], box["tau_max_s"] = low, high
    names = box["axes"].split()
    box["axes"] = " ".join([*names, *(name for name in other["axes"].split() if name not in names)])


def merge_wandering_regions(boxes: Sequence[Region]) -> list[Region]:
    """Boxes of the mean, those of an axis as one when there are many: its mean wanders, and the largest gives the numbers.

    Parameters
    ----------
    boxes : sequence of dict
        Boxes of the mean view, one axis each.
    """
    found = []
    for axes in dict.fromkeys(box["axes"] for box in boxes):
        mine = [box for box in boxes if box["axes"] == axes]
        if len(mine) > _STEPS:
            largest = max(mine, key=lambda box: abs(box["z"]))
            begin, end = min(box["begin"] for box in mine), max(box["end"] for box in mine)
            mine = [largest | {"sign": 0, "begin": begin, "end": end, "tau_max_s": end - begin}]
        found += mine
    return found
