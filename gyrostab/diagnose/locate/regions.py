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
_KINDS = ("slow", "variance", "drifting")
_STEPS = 3  # boxes of one mean, beyond which it is said to wander


def merge_regions(regions: Sequence[Region]) -> list[Region]:
    """Join boxes, the surest first; the surest of those that are joined gives its numbers.

    Boxes of different axes are one when they share most of their time; those of the same axes also
    when they lie side by side, and their joint box then spans both.

    Parameters
    ----------
    regions : sequence of dict
        With the fields of `gyrostab.diagnose.locate.mismatches.FIELDS`.

    Examples
    --------
    >>> region = {"view": "davar", "axes": "x", "what": "avar", "begin": 0.0, "end": 60.0, "tau_min_s": 0.01, "tau_max_s": 0.1,
    ...        "frequency": float("nan"), "sign": 1, "z": 9.0, "p_value": 1e-6}
    >>> [(one["axes"], one["end"]) for one in merged([region, region | {"axes": "y", "z": 8.0}, region | {"begin": 60.0, "end": 90.0, "z": 7.0}])]
    [('x y', 90.0)]
    """
    kept: list[Region] = []
    for region in sorted(regions, key=lambda one: (one["p_value"], -abs(one["z"]))):
        for other in kept:
            if not _alike(region, other):
                continue
            if _shared(region, other) > _LIKE or _touching(region, other):
                _join(other, region)
                break
        else:
            kept.append(dict(region))
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


def _kind(region: Region) -> str:
    """What is never one mismatch: inside of blocks and from one to the next, a level and its scatter, lines that stand and that move."""
    kind = str(region["what"]).split(" ")[0]
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


def _join(region: Region, other: Region) -> None:
    if _shared(region, other) <= _LIKE:
        region["begin"], region["end"] = (
            min(region["begin"], other["begin"]),
            max(region["end"], other["end"]),
        )
        if region["what"] != "line":
            low, high = (
                min(region["tau_min_s"], other["tau_min_s"]),
                max(region["tau_max_s"], other["tau_max_s"]),
            )
            region["tau_min_s"], region["tau_max_s"] = low, high
    names = region["axes"].split()
    region["axes"] = " ".join(
        [*names, *(name for name in other["axes"].split() if name not in names)]
    )


def merge_wandering_regions(regions: Sequence[Region]) -> list[Region]:
    """Boxes of the mean, those of an axis as one when there are many: its mean wanders, and the largest gives the numbers.

    Parameters
    ----------
    regions : sequence of dict
        Boxes of the mean view, one axis each.
    """
    found = []
    for axes in dict.fromkeys(region["axes"] for region in regions):
        mine = [region for region in regions if region["axes"] == axes]
        if len(mine) > _STEPS:
            largest = max(mine, key=lambda region: abs(region["z"]))
            begin, end = (
                min(region["begin"] for region in mine),
                max(region["end"] for region in mine),
            )
            mine = [largest | {"sign": 0, "begin": begin, "end": end, "tau_max_s": end - begin}]
        found += mine
    return found
