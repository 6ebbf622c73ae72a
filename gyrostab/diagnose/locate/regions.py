"""Merge regions that show the same mismatch on several axes, or in several pieces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import find_statistic

#: Fields of a place where recording and simulation differ: ``statistic``, ``view``, ``axes``
#: (separated by blanks), ``what``, ``begin``, ``end`` [s since the start], ``tau_min_s``,
#: ``tau_max_s`` [s], ``frequency`` [Hz], ``sign`` (0 for a mean that wanders), ``z``, ``ratio``
#: (observed over expected; for means and restarts the number of standard deviations), ``estimate``
#: (depends on the statistic), ``p_value``.
Region = dict[str, Any]
TAU_TOLERANCE = 0.99  # ratio of averaging times that are equal but for rounding
_SEPARATE_KINDS = ("slow", "variance", "drifting")


def merge_regions(regions: Sequence[Region], *, settings: Settings = DEFAULTS) -> list[Region]:
    """Merge regions, the surest first; the surest gives the numbers.

    Regions of different axes are merged when they share most of their time. Those of the same axes
    are also merged when they are adjacent, and then span both.

    Examples
    --------
    >>> region = {"statistic": "power", "view": "davar", "axes": "x", "what": "avar",
    ...           "begin": 0.0, "end": 60.0, "tau_min_s": 0.01, "tau_max_s": 0.1,
    ...           "frequency": float("nan"), "sign": 1, "z": 9.0, "p_value": 1e-6}
    >>> on_y = region | {"axes": "y", "z": 8.0}
    >>> later = region | {"begin": 60.0, "end": 90.0, "z": 7.0}
    >>> [(merged["axes"], merged["end"]) for merged in merge_regions([region, on_y, later])]
    [('x y', 90.0)]
    """
    merged: list[Region] = []
    for region in sorted(regions, key=lambda region: (region["p_value"], -abs(region["z"]))):
        for other in merged:
            if not _are_alike(region, other, settings):
                continue
            if _common_share(region, other) > settings.majority_share or _are_adjacent(
                region, other, settings
            ):
                _extend_region(other, region, settings)
                break
        else:
            merged.append(dict(region))
    return merged


def _are_alike(region: Region, other: Region, settings: Settings) -> bool:
    """Return whether statistic, direction, and averaging times or line are the same."""
    if region["view"] != other["view"] or (
        region["sign"] != other["sign"] and region["view"] != "cross_axis"
    ):
        return False
    if region["what"] == "line" or other["what"] == "line":
        return bool(
            region["what"] == other["what"]
            and abs(region["frequency"] / other["frequency"] - 1.0) < settings.line_width_share
        )
    if _kind_of(region) != _kind_of(other):
        return False
    return bool(
        min(region["tau_max_s"], other["tau_max_s"])
        >= TAU_TOLERANCE * max(region["tau_min_s"], other["tau_min_s"])
    )


def _kind_of(region: Region) -> str:
    """Return the kind of a region; regions of different kinds are not merged."""
    kind = str(region["what"]).split(" ")[0]
    return kind if kind in _SEPARATE_KINDS else ""


def _common_share(region: Region, other: Region) -> float:
    """Return the time in common as a share of the time that both span."""
    common = min(region["end"], other["end"]) - max(region["begin"], other["begin"])
    return float(common / (max(region["end"], other["end"]) - min(region["begin"], other["begin"])))


def _are_adjacent(region: Region, other: Region, settings: Settings) -> bool:
    """Return whether two regions of the same axes are adjacent."""
    if (
        not set(region["axes"].split()) <= set(other["axes"].split())
        or not find_statistic(region["statistic"]).grows_in_time
    ):
        return False
    shorter, longer = sorted([region["end"] - region["begin"], other["end"] - other["begin"]])
    return bool(
        max(region["begin"], other["begin"]) - min(region["end"], other["end"])
        <= min(settings.gap_time_share * longer, shorter) + 1e-6
    )


def _extend_region(region: Region, other: Region, settings: Settings) -> None:
    if _common_share(region, other) <= settings.majority_share:
        region["begin"], region["end"] = (
            min(region["begin"], other["begin"]),
            max(region["end"], other["end"]),
        )
        if region["what"] != "line":
            low = min(region["tau_min_s"], other["tau_min_s"])
            high = max(region["tau_max_s"], other["tau_max_s"])
            region["tau_min_s"], region["tau_max_s"] = low, high
    names = region["axes"].split()
    region["axes"] = " ".join(
        [*names, *(name for name in other["axes"].split() if name not in names)]
    )


def merge_wandering_regions(
    regions: Sequence[Region], *, settings: Settings = DEFAULTS
) -> list[Region]:
    """Merge the regions of the mean of an axis when there are many: its mean wanders.

    The largest gives the numbers. A region is of one axis.
    """
    merged = []
    for axes in dict.fromkeys(region["axes"] for region in regions):
        mine = [region for region in regions if region["axes"] == axes]
        if len(mine) > settings.max_mean_regions:
            largest = max(mine, key=lambda region: abs(region["z"]))
            begin = min(region["begin"] for region in mine)
            end = max(region["end"] for region in mine)
            mine = [largest | {"sign": 0, "begin": begin, "end": end, "tau_max_s": end - begin}]
        merged += mine
    return merged
