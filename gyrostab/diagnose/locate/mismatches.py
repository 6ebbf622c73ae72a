"""Where recording and simulation differ: axes, time and averaging time of every mismatch, and how sure it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.locate.regions import merge_regions, merge_wandering_regions
from gyrostab.diagnose.nulls.scores import NullScores, null_scores, standardise
from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.diagnose.statistics.mean import region_mean
from gyrostab.diagnose.statistics.variance_stability import scale_to_expected
from gyrostab.errors import OptionError

__all__ = ["FIELDS", "locate_mismatches", "louder"]

Array = NDArray[np.float64]
_RAISED = 2.0  # of a piece that has a part in a mismatch
_WHOLE = 0.7  # that a part of the record must show more than the whole does
_GROWN = 3.0  # standard deviations of a cell that belongs to a mismatch beside it
_MOST = 8  # mismatches of one view and row
_TOLD = 30  # mismatches of a record
_BESIDE_LINE = 3  # lines that a strong line leaks into

#: Fields of a mismatch, and their units.
FIELDS = {
    "view": None,
    "axes": None,
    "what": None,
    "begin": "s",
    "end": "s",
    "tau_min_s": "s",
    "tau_max_s": "s",
    "frequency": "Hz",
    "sign": "1",
    "z": "1",
    "ratio": "1",
    "estimate": None,
    "p_value": "1",
}


def locate_mismatches(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    nulls: Iterable[xr.Dataset] | NullScores,
    *,
    level: float = 0.01,
) -> xr.Dataset:
    """Find where a recording differs from the simulation by more than noise does.

    Every view scores its cells; a score counts in standard deviations of the null records, and its
    p-value is the share of null records in which any cell of any view does as much. From the
    largest on, cells become boxes: the span of time that explains most, and the averaging times
    beside the largest that stand out there too. What a box explains is left out of the next.

    Parameters
    ----------
    blocks : xarray.Dataset
        Of `gyrostab.diagnose.reduce.block_statistics.reduce_log`.
    baseline : xarray.Dataset
        What the simulation expects.
    nulls : iterable of xarray.Dataset, or NullScores
        Null records of `gyrostab.diagnose.nulls.records.null_records`, or what `null_scores` made
        of them.
    level : float
        Share of records of the simulation itself in which anything may be found.

    Returns
    -------
    xarray.Dataset
        By ``mismatch``, the surest first: ``statistic``, ``axes`` (parted by blanks), ``what``,
        ``begin``, ``end`` [s since the start], ``start_time``, ``end_time``, ``tau_min_s``,
        ``tau_max_s`` [s], ``frequency`` [Hz], ``sign`` (0 for a mean that wanders), ``z``,
        ``ratio`` (observed over expected; in the mean and restart views the number of standard
        deviations), ``estimate`` (see the view), ``p_value``.

    Raises
    ------
    OptionError
        When `level` is no probability below a half, or the null records are too few.

    Examples
    --------
    >>> found = locate(blocks, baseline, null_records(blocks, baseline, count=400, rng=rng))   # doctest: +SKIP
    >>> found.statistic.values, found.axes.values, found.begin.values, found.end.values               # doctest: +SKIP
    (array(['davar']), array(['x']), array([1500.]), array([1800.]))
    """
    if not 0.0 < level < 0.5:
        raise OptionError(
            f"level {level!r}: give the share of false alarms, above 0 and below 0.5, for instance 0.01"
        )
    null = nulls if isinstance(nulls, NullScores) else null_scores(baseline, nulls)
    regions: list[dict[str, Any]] = []
    for name, score in STATISTICS.items():
        if name not in null.statistics:
            continue
        find = _mean_boxes if name == "mean" else _boxes
        seen = (
            scale_to_expected(blocks, baseline, louder(regions))
            if name == "variance_stability"
            else blocks
        )
        regions += find(name, score, seen, baseline, null, level)
    return _table(merge_regions(regions)[:_TOLD], blocks, null, level)


def louder(regions: Iterable[Mapping[str, Any]]) -> list[tuple[list[str], float, float]]:
    """Axes, begin and end [s] of the boxes that say how loud the noise is: to say that it changes would tell the same again."""
    told = (
        region
        for region in regions
        if region["view"] == "davar" and region["what"] in ("avar", "level")
    )
    return [
        (str(region["axes"]).split(), float(region["begin"]), float(region["end"]))
        for region in told
    ]


def _boxes(
    name: str, score: Any, blocks: xr.Dataset, baseline: xr.Dataset, null: NullScores, level: float
) -> list[dict[str, Any]]:
    scores = score(blocks, baseline)
    z, critical = standardise(scores, null.statistics[name]), null.critical(name, level)
    found = []
    for row in range(z.shape[0]):
        left = z[row].copy()
        for _ in range(_MOST):
            region = _next_box(scores, row, left, z[row], critical)
            if region is None:
                break
            region["p_value"] = float(null.p_value(name, region["z"]))
            found.append(region)
    return found


def _mean_boxes(
    name: str, score: Any, blocks: xr.Dataset, baseline: xr.Dataset, null: NullScores, level: float
) -> list[dict[str, Any]]:
    """As `_boxes`; a step in one place pulls the mean of the record, so that each one found is taken off before the next is looked for."""
    critical, found = null.critical(name, level), []
    known = baseline["known_mean"].transpose("axis", "block").copy(deep=True)
    open_rows = set(range(blocks.sizes["axis"]))
    for _ in range(_MOST):
        now = baseline.assign(known_mean=known)
        scores = score(blocks, now)
        z = standardise(scores, null.statistics[name])
        for row in sorted(open_rows):
            region = _next_box(scores, row, z[row].copy(), z[row], critical)
            if region is None:
                open_rows.discard(row)
                continue
            region["p_value"] = float(null.p_value(name, region["z"]))
            inside = (blocks["begin"].values >= region["begin"] - 1e-9) & (
                blocks["end"].values <= region["end"] + 1e-9
            )
            region |= {
                "estimate": region_mean(blocks, now, row, inside),
                "tau_max_s": max(region["end"] - region["begin"], region["tau_min_s"]),
            }
            known.values[row] += np.where(inside, region["estimate"], 0.0)
            found.append(region)
        if not open_rows:
            break
    return merge_wandering_regions(found)


def _next_box(
    scores: xr.Dataset, row: int, left: Array, z: Array, critical: float
) -> dict[str, Any] | None:
    """Box around the largest score left, which is then taken out of `left`; None when none is above `critical`."""
    if not np.isfinite(left).any() or np.nanmax(np.abs(left)) < critical:
        return None
    window, column = np.unravel_index(np.nanargmax(np.abs(left)), left.shape)
    sign = 1.0 if left[window, column] > 0 else -1.0
    free = np.where(
        np.isfinite(left[:, column]) | np.isnan(z[:, column]), z[:, column], 0.0
    )  # what is explained counts for nothing
    begin, end, fine = _span(scores, free * sign, int(window))
    together, ratio = _stacked(scores, row, z * sign, fine, int(window))
    columns, reach = _columns(scores, together, ratio, int(column))
    region = {
        "view": scores.attrs["view"],
        "axes": str(scores["axes"].values[row]),
        "what": str(scores["what"].values[column]),
        "begin": begin,
        "end": end,
        "tau_min_s": float(scores["tau_min_s"].values[columns].min()),
        "tau_max_s": float(scores["tau_max_s"].values[columns].max()),
        "frequency": float(scores["frequency"].values[column]),
        "sign": int(sign),
        "z": float(
            sign
            * max(
                abs(left[window, column]),
                together[column] if np.isfinite(together[column]) else 0.0,
            )
        ),
        "ratio": float(ratio[column]),
        "estimate": float(scores["estimate"].values[row, window, column])
        if "estimate" in scores
        else float(ratio[column]),
    }
    overlap = (scores["begin"].values < end - 1e-9) & (scores["end"].values > begin + 1e-9)
    overlap[window] = True
    left[np.ix_(overlap, reach)] = np.nan
    return region


def _span(scores: xr.Dataset, z: Array, window: int) -> tuple[float, float, NDArray[np.int64]]:
    """Span of time around a window that explains most of a column: begin, end, and the shortest windows inside.

    Of all runs of the shortest windows it is the one with the largest sum over the root of its
    number.
    """
    first, stop = scores["first"].values, scores["stop"].values
    begin, end = scores["begin"].values, scores["end"].values
    fine = _side_by_side(first, stop, np.flatnonzero(np.isfinite(z)))
    near = 3 * (stop[window] - first[window])
    fine = fine[(stop[fine] > first[window] - near) & (first[fine] < stop[window] + near)]
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
    if best < 0.8 * z[window]:  # the pieces do not add up to what the window shows as one
        raised = inside[z[inside] > _RAISED]
        chosen = (
            inside[(inside >= raised[0]) & (inside <= raised[-1])]
            if raised.size
            else np.array([window])
        )
    elif first[window] == first.min() and stop[window] == stop.max() and best < z[window] + _WHOLE:
        chosen = inside
    return float(begin[chosen[0]]), float(end[chosen[-1]]), chosen


def _side_by_side(
    first: NDArray[np.int64], stop: NDArray[np.int64], usable: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The shortest windows, in order, of those that overlap every second one left out."""
    shortest = usable[(stop - first)[usable] == (stop - first)[usable].min()]
    chosen, until = [], -1
    for place in shortest[np.argsort(first[shortest], kind="stable")]:
        if first[place] >= until:
            chosen.append(place)
            until = stop[place]
    return np.array(chosen, dtype=np.int64)


def _stacked(
    scores: xr.Dataset, row: int, z: Array, fine: NDArray[np.int64], window: int
) -> tuple[Array, Array]:
    """Scores of every column over the span, and the ratio there; those of the window where a column has no shorter ones."""
    ratio = scores["ratio"].values[row]
    known = np.isfinite(z[fine])
    count = known.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        together = np.where(known, z[fine], 0.0).sum(axis=0) / np.sqrt(count)
        mean = np.where(known, ratio[fine], 0.0).sum(axis=0) / count
    coarse = 2 * count < fine.size
    return np.where(coarse, z[window], together), np.where(coarse, ratio[window], mean)


def _columns(
    scores: xr.Dataset, together: Array, ratio: Array, column: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns of a box, and those that it explains."""
    what, low, high = (scores[name].values for name in ("what", "tau_min_s", "tau_max_s"))
    above = np.nan_to_num(together) > _GROWN
    if what[column] == "level":  # all averaging times alike: the box has those that stand out
        seen = np.flatnonzero(above & (what == "avar"))
        return (seen if seen.size else np.array([column])), np.arange(what.size)
    lower = upper = column
    while lower > 0 and above[lower - 1] and what[lower - 1] == what[column]:
        lower -= 1
    while upper + 1 < what.size and above[upper + 1] and what[upper + 1] == what[column]:
        upper += 1
    grown = np.arange(lower, upper + 1)
    excess = np.abs(ratio - 1.0) if scores.attrs["view"] == "davar" else np.abs(together)
    region = grown[excess[grown] >= 0.25 * excess[column]]
    beside = _BESIDE_LINE if what[column] == "line" else 0
    if what[column] == "line":
        return np.array([column]), np.arange(
            max(lower - beside, 0), min(upper + beside + 1, what.size)
        )
    overlap = (low <= high[grown].max() * 1.01) & (high >= low[grown].min() * 0.99)
    return region, np.flatnonzero(overlap)


def _table(
    regions: list[dict[str, Any]], blocks: xr.Dataset, null: NullScores, level: float
) -> xr.Dataset:
    variables: dict[str, Any] = {}
    for field, units in FIELDS.items():
        kind = str if field in ("view", "axes", "what") else int if field == "sign" else float
        values = np.array([region[field] for region in regions], dtype=kind)
        variables[field] = ("mismatch", values, {"units": units} if units else {})
    start = (
        np.datetime64(int(blocks.attrs["start_ns"]), "ns")
        if "start_ns" in blocks.attrs
        else np.datetime64("1970-01-01", "ns")
    )
    for field, edge in (("start_time", "begin"), ("end_time", "end")):
        seconds = np.array([region[edge] for region in regions], dtype=float)
        variables[field] = ("mismatch", start + np.rint(seconds * 1e9).astype("timedelta64[ns]"))
    attributes = {"level": level, "null_records": null.records}
    attributes |= {f"critical_{name}": null.critical(name, level) for name in null.statistics}
    return xr.Dataset(
        variables, coords={"mismatch": np.arange(1, len(regions) + 1)}, attrs=attributes
    )
