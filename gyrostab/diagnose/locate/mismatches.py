"""Locate the mismatches: their axes, times and averaging times, and their probability."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.nulls.scores import NullScores, standardise
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import STATISTICS, Statistic, find_statistic
from gyrostab.diagnose.statistics.base import Region
from gyrostab.diagnose.statistics.mean import region_mean
from gyrostab.kernels.spectra.line_levels import LEAK_LINES

#: Ratios of averaging times that are equal but for rounding.
MIN_TAU_RATIO, MAX_TAU_RATIO = 0.99, 1.01
#: On either side of a window, in which the time of its region is sought [lengths of the window].
_REACH_WINDOWS = 3
_SEPARATE_KINDS = ("slow", "variance", "drifting")
# Limits of the table; the rows left out are the least certain.
MAX_PER_ROW = 8  # mismatches of one statistic and row
MAX_MISMATCHES = 30  # of a record


def locate_mismatches(
    blocks: xr.Dataset, baseline: xr.Dataset, null: NullScores, *, level: float = 0.01
) -> list[Region]:
    """Locate where a recording differs from the simulation by more than noise does.

    Every statistic scores its cells, in standard deviations of the null records. The p-value of a
    score is the share of null records in which any cell of any statistic reaches it. From the
    largest score on, cells become regions: the time that explains most, and the neighbouring
    averaging times that exceed noise there. What a region explains is left out of the next. A
    recording without missing physics has any mismatch with the probability `level`. The surest
    region is the first.

    Examples
    --------
    >>> null = null_scores(baseline, null_records(blocks, baseline, rng=rng))  # doctest: +SKIP
    >>> found = locate_mismatches(blocks, baseline, null)  # doctest: +SKIP
    >>> [(region["axes"], region["begin"], region["end"]) for region in found]  # doctest: +SKIP
    [('x', 1500.0, 1800.0)]
    """
    regions: list[Region] = []
    for statistic in STATISTICS:
        if statistic.name in null.statistics:
            prepared = statistic.prepare(blocks, baseline, regions)
            regions += _locate_regions(statistic, prepared, baseline, null, level)
    return merge_regions(regions, settings=null.settings)[:MAX_MISMATCHES]


def _locate_regions(
    statistic: Statistic, blocks: xr.Dataset, baseline: xr.Dataset, null: NullScores, level: float
) -> list[Region]:
    """Locate the regions of one statistic, row by row.

    A step at one place shifts the mean of the whole record: each region of the mean is located with
    the ones before it removed.
    """
    first = statistic.score(blocks, baseline)
    if first is None:
        return []
    z = standardise(first, null.statistics[statistic.name])
    regions = []
    for row in range(z.shape[0]):
        remaining_baseline, scores, row_z = baseline, first, z[row]
        remaining = row_z.copy()
        for _ in range(MAX_PER_ROW):
            region = _take_region(statistic, scores, row, remaining, row_z, null, level)
            if region is None:
                break
            regions.append(region)
            if statistic.is_linear_in_means:
                remaining_baseline = _without_region(region, blocks, remaining_baseline, row)
                rescored = statistic.score(blocks, remaining_baseline)
                if rescored is None:
                    break
                scores = rescored
                row_z = standardise(scores, null.statistics[statistic.name])[row]
                remaining = row_z.copy()
    return (
        merge_wandering_regions(regions, settings=null.settings)
        if statistic.is_linear_in_means
        else regions
    )


def _without_region(
    region: Region, blocks: xr.Dataset, baseline: xr.Dataset, row: int
) -> xr.Dataset:
    """Complete a region of the mean, and return the baseline with its mean in it."""
    inside = (blocks["begin"].values >= region["begin"] - 1e-9) & (
        blocks["end"].values <= region["end"] + 1e-9
    )
    region |= {
        "estimate": region_mean(blocks, baseline, row, inside),
        "tau_max_s": max(region["end"] - region["begin"], region["tau_min_s"]),
    }
    known_mean = baseline["known_mean"].copy(deep=True)
    known_mean.values[row] += np.where(inside, region["estimate"], 0.0)
    return baseline.assign(known_mean=known_mean)


def _take_region(
    statistic: Statistic,
    scores: xr.Dataset,
    row: int,
    remaining: Floats,
    z: Floats,
    null: NullScores,
    level: float,
) -> Region | None:
    """Return the region around the largest score left, or None; remove it from `remaining`."""
    critical = null.critical(statistic.name, level)
    if not np.isfinite(remaining).any() or np.nanmax(np.abs(remaining)) < critical:
        return None
    window, column = np.unravel_index(np.nanargmax(np.abs(remaining)), remaining.shape)
    sign = 1.0 if remaining[window, column] > 0 else -1.0
    # explained windows do not count
    free = np.where(np.isfinite(remaining[:, column]) | np.isnan(z[:, column]), z[:, column], 0.0)
    begin, end, fine = _find_span(scores, free * sign, int(window), null.settings)
    combined, ratio = _combine_windows(scores, row, z * sign, fine, int(window))
    largest = abs(remaining[window, column])
    if np.isfinite(combined[column]):
        largest = max(largest, combined[column])
    columns, reach = _find_columns(statistic, scores, combined, ratio, int(column), null.settings)
    region: Region = {
        "statistic": statistic.name,
        "view": statistic.view,
        "axes": str(scores["axes"].values[row]),
        "quantity": str(scores["quantity"].values[column]),
        "begin": begin,
        "end": end,
        "tau_min_s": float(scores["tau_min_s"].values[columns].min()),
        "tau_max_s": float(scores["tau_max_s"].values[columns].max()),
        "frequency": float(scores["frequency"].values[column]),
        "sign": int(sign),
        "z": float(sign * largest),
        # null records have the largest of cells
        "p_value": float(null.p_value(statistic.name, remaining[window, column])),
        "ratio": float(ratio[column]),
        "estimate": float(ratio[column]),
    }
    if "estimate" in scores:
        region["estimate"] = float(scores["estimate"].values[row, window, column])
    overlap = (scores["begin"].values < end - 1e-9) & (scores["end"].values > begin + 1e-9)
    overlap[window] = True
    remaining[np.ix_(overlap, reach)] = np.nan
    return region


def _find_span(
    scores: xr.Dataset, z: Floats, window: int, settings: Settings
) -> tuple[float, float, Ints]:
    """Return begin and end of the time about a window that explains most of a column.

    It is the run of the shortest windows with the largest sum divided by the root of their number.
    The third result is these windows.
    """
    first, stop = scores["first"].values, scores["stop"].values
    begin, end = scores["begin"].values, scores["end"].values
    fine = _disjoint_windows(first, stop, np.flatnonzero(np.isfinite(z)))
    reach = _REACH_WINDOWS * (stop[window] - first[window])
    fine = fine[(stop[fine] > first[window] - reach) & (first[fine] < stop[window] + reach)]
    total = np.concatenate([[0.0], np.cumsum(z[fine])])
    best, low, high = -np.inf, 0, fine.size
    for count in range(1, fine.size + 1):
        sums = (total[count:] - total[:-count]) / np.sqrt(count)
        sums[
            (stop[fine[count - 1 :]] <= first[window])
            | (first[fine[: fine.size - count + 1]] >= stop[window])
        ] = -np.inf
        place = int(np.argmax(sums))
        if sums[place] > best:
            best, low, high = float(sums[place]), place, place + count
    chosen = fine[low:high]
    inside = fine[(first[fine] >= first[window]) & (stop[fine] <= stop[window])]
    if best < settings.window_sum_share * z[window]:  # they do not add up to the whole window
        raised = inside[z[inside] > settings.visible_sigma]
        chosen = (
            inside[(inside >= raised[0]) & (inside <= raised[-1])]
            if raised.size
            else np.array([window])
        )
    elif (
        first[window] == first.min()
        and stop[window] == stop.max()
        and best < z[window] + settings.whole_record_sigma
    ):
        chosen = inside
    return float(begin[chosen[0]]), float(end[chosen[-1]]), chosen


def _disjoint_windows(first: Ints, stop: Ints, usable: Ints) -> Ints:
    """Return the shortest windows in order, without those that overlap the one before."""
    shortest = usable[(stop - first)[usable] == (stop - first)[usable].min()]
    chosen, until = [], -1
    for place in shortest[np.argsort(first[shortest], kind="stable")]:
        if first[place] >= until:
            chosen.append(place)
            until = stop[place]
    return np.array(chosen, dtype=np.int64)


def _combine_windows(
    scores: xr.Dataset, row: int, z: Floats, fine: Ints, window: int
) -> tuple[Floats, Floats]:
    """Return scores and ratios of every column over the span.

    A column without short windows has those of the window itself.
    """
    ratio = scores["ratio"].values[row]
    present = np.isfinite(z[fine])
    count = present.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        combined = np.where(present, z[fine], 0.0).sum(axis=0) / np.sqrt(count)
        mean = np.where(present, ratio[fine], 0.0).sum(axis=0) / count
    coarse = 2 * count < fine.size
    return np.where(coarse, z[window], combined), np.where(coarse, ratio[window], mean)


def _find_columns(
    statistic: Statistic,
    scores: xr.Dataset,
    combined: Floats,
    ratio: Floats,
    column: int,
    settings: Settings,
) -> tuple[Ints, Ints]:
    """Return the columns of a region, and those that it explains."""
    kinds, low, high = (scores[name].values for name in ("quantity", "tau_min_s", "tau_max_s"))
    above = np.nan_to_num(combined) > settings.clear_sigma
    if kinds[column] == "level":  # of all averaging times: the region has those above the noise
        avar_columns = np.flatnonzero(above & (kinds == "avar"))
        return (avar_columns if avar_columns.size else np.array([column])), np.arange(kinds.size)
    lower = upper = column
    while lower > 0 and above[lower - 1] and kinds[lower - 1] == kinds[column]:
        lower -= 1
    while upper + 1 < kinds.size and above[upper + 1] and kinds[upper + 1] == kinds[column]:
        upper += 1
    grown = np.arange(lower, upper + 1)
    excess = np.abs(ratio - 1.0) if statistic.is_ratio else np.abs(combined)
    region = grown[excess[grown] >= settings.majority_share**2 * excess[column]]
    if kinds[column] == "line":
        first, last = max(lower - LEAK_LINES, 0), min(upper + LEAK_LINES + 1, kinds.size)
        return np.array([column]), np.arange(first, last)
    overlap = (low <= high[grown].max() * MAX_TAU_RATIO) & (
        high >= low[grown].min() * MIN_TAU_RATIO
    )
    return region, np.flatnonzero(overlap)


def merge_regions(regions: Sequence[Region], *, settings: Settings = DEFAULTS) -> list[Region]:
    """Merge regions, the surest first; the surest gives the numbers.

    Regions of different axes are merged when they share most of their time. Those of the same axes
    are also merged when they are adjacent, and then span both.

    Examples
    --------
    >>> region = {"statistic": "power", "view": "davar", "axes": "x", "quantity": "avar",
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
            merged.append(region.copy())
    return merged


def _are_alike(region: Region, other: Region, settings: Settings) -> bool:
    """Return whether statistic, direction, and averaging times or line are the same."""
    if region["view"] != other["view"] or (
        region["sign"] != other["sign"] and region["view"] != "cross_axis"
    ):
        return False
    if region["quantity"] == "line" or other["quantity"] == "line":
        return bool(
            region["quantity"] == other["quantity"]
            and abs(region["frequency"] / other["frequency"] - 1.0) < settings.line_width_share
        )
    if _kind_of(region) != _kind_of(other):
        return False
    return bool(
        min(region["tau_max_s"], other["tau_max_s"])
        >= MIN_TAU_RATIO * max(region["tau_min_s"], other["tau_min_s"])
    )


def _kind_of(region: Region) -> str:
    """Return the kind of a region; regions of different kinds are not merged."""
    kind = region["quantity"].split(" ")[0]
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
        if region["quantity"] != "line":
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
