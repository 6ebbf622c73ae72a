"""Which named effect accounts for which mismatch: the same view with the effects in the model, where they are in the same place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.known_effects import expect_known_motion
from gyrostab.diagnose.identify.forward_search import Identification
from gyrostab.diagnose.nulls.scores import NullScores
from gyrostab.diagnose.predict.condition import Component, find_anomalous_blocks, mean_columns
from gyrostab.diagnose.result.attribution_weights import Scores, left_of, needed, statistic_scores

__all__ = ["active_spans", "attribute_mismatches", "spans", "unexpected"]

Array = NDArray[np.float64]
#: Where an effect shows -> views of mismatches that it can explain; "model" ones are looked at
#: again with the effect in the model.
_SHOWS: dict[str, tuple[str, ...]] = {
    "mean": ("mean", "restart", "davar", "distribution", "cross_axis", "spectrum"),
    "power": ("davar", "spectrum", "distribution"),
    "cross": ("cross_axis", "davar"),
    "marks": ("distribution", "davar", "spectrum", "cross_axis"),
    "line": ("spectrum", "davar", "distribution", "cross_axis"),
    "order": ("spectrum", "davar", "mean", "distribution", "cross_axis"),
    "phase_locked": ("spectrum", "davar", "distribution", "mean"),
    "transfer": ("davar", "cross_axis", "spectrum", "mean", "distribution"),
    "wander": ("mean", "davar", "restart", "cross_axis"),
    "levels": ("mean", "restart", "davar", "distribution", "cross_axis", "spectrum"),
}
_MODELLED = (
    "mean",
    "power",
    "cross",
    "wander",
    "levels",
)  # parts that the baseline with the effects holds
_ACTS = 0.1  # of its largest, that a contribution counts as there
_STILL, _RESTS = (
    0.05,
    0.05,
)  # of the largest, that is as good as nothing, and share of the blocks that must be so
_MEETS = 0.3  # of the shorter of effect and mismatch
_MOST_SPANS = 6
_BESIDE, _SHARP = (
    3,
    0.02,
)  # lines beside a strong one, and share of its frequency, that belong to it
_BUMP, _WIDE = 0.371, 4.0
_MOVES = (
    "mean",
    "levels",
)  # parts that may move the rate within a block, which is power there and at the lowest lines
_MOVED = 0.1  # of the largest step from block to block


def active_spans(identification: Identification, blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks in which an effect does something, from its designs and from the turning of the tool; all where neither depends on time."""
    block_count = blocks.sizes["block"]
    there = np.zeros(block_count, bool)
    for component in identification.components:
        design = component.variant.design
        if component.candidate.statistic == "order":
            there |= _turning(blocks)
            continue
        if (
            component.candidate.statistic not in ("mean", "power", "cross", "wander")
            or design.size == 0
        ):
            return np.ones(block_count, bool)
        place = [number for number, size in enumerate(design.shape) if size == block_count]
        if not place:
            return np.ones(block_count, bool)
        size = np.asarray(np.moveaxis(np.asarray(design), place[0], 0).reshape(block_count, -1))
        size = np.abs(size - _rest(size) if component.candidate.statistic == "mean" else size)
        largest = np.nanmax(size, axis=0, initial=0.0)
        there |= (size > _ACTS * np.where(largest > 0, largest, np.inf)).any(axis=1)
    return there if there.any() else np.ones(block_count, bool)


def _rest(size: Array) -> Array:
    """Level of every column (block, column) at rest: zero where it stays there for a while, else its median, for the constant is free."""
    still = np.abs(size) <= _STILL * np.nanmax(np.abs(size), axis=0, initial=0.0)
    return np.where(still.mean(axis=0) >= _RESTS, 0.0, np.median(size, axis=0))


def _turning(blocks: xr.Dataset) -> NDArray[np.bool_]:
    """Blocks in which the tool turns: those that the harmonics of its turning are measured in."""
    turn = np.abs(np.nan_to_num(blocks["channel_rotation_rate"].values))
    return np.asarray(turn > _STILL * turn.max(initial=0.0))


def spans(there: NDArray[np.bool_], begin: Array, end: Array) -> list[tuple[float, float]]:
    """Stretches of time [s] in which it is true, short pauses bridged; the whole record where it comes and goes all the time.

    Examples
    --------
    >>> t = np.arange(10.0)
    >>> spans(np.array([0, 0, 1, 1, 1, 0, 0, 0, 0, 0], bool), t, t + 1)
    [(2.0, 5.0)]
    """
    if there.mean() > 0.9:
        return [(float(begin[0]), float(end[-1]))]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int))).reshape(
        -1, 2
    )
    joined: list[list[int]] = []
    for first, stop in edges.tolist():
        if joined and first - joined[-1][1] <= max(1, there.size // 50):
            joined[-1][1] = stop
        else:
            joined.append([first, stop])
    if len(joined) > _MOST_SPANS:
        return [(float(begin[0]), float(end[-1]))]
    return [(float(begin[first]), float(end[stop - 1])) for first, stop in joined]


def attribute_mismatches(
    found: xr.Dataset,
    identified: Sequence[Identification],
    blocks: xr.Dataset,
    after: xr.Dataset,
    null: NullScores,
    *,
    level: float,
    without: Callable[[Sequence[Identification]], xr.Dataset] | None = None,
    still: xr.Dataset | None = None,
) -> list[list[str]]:
    """Effects that explain each mismatch.

    An effect explains it when it acts on one of its axes at its time and can show in its view; and
    where the baseline with the effects holds what it does there, when the mismatch is gone with
    that baseline, or nearly so, and takes this effect for it. A mismatch of the mean may also stand
    before or after what an effect does, where that is what the mean differs from. Where an effect
    moves the rate within blocks, these blocks have more power than the noise, and the lines more at
    their low end.

    Parameters
    ----------
    found : xarray.Dataset
        From `gyrostab.diagnose.locate.mismatches.locate_mismatches`.
    identified : sequence of Claim
    blocks, after : xarray.Dataset
        The recording, and the baseline with the effects.
    null : NullScores
        What was found is measured by.
    level : float
        False-alarm level.
    without : callable, optional
        Gives the baseline with the effects but for some of them, at the sizes that they have beside
        these. Without it every effect that is in the place of a mismatch is said to explain it.
    still : xarray.Dataset, optional
        Has the line spectra of the recording without the blocks in which an effect moves the rate.

    Returns
    -------
    list of list of str
        Names, for each mismatch.
    """
    regions = [
        {str(name): found[name].values[number] for name in found.data_vars}
        for number in range(found.sizes["mismatch"])
    ]
    scores = statistic_scores(blocks, after, null, regions, identified, still=still)
    known: dict[tuple[int, ...], Scores] = {(): scores}

    def left(region: Mapping[str, Any], out: Sequence[Identification]) -> tuple[float, float]:
        chosen = tuple(
            number
            for number, identification in enumerate(identified)
            if any(identification is one for one in out)
        )
        if chosen not in known and without is not None:
            rest = [
                identification
                for number, identification in enumerate(identified)
                if number not in chosen
            ]
            known[chosen] = statistic_scores(blocks, without(out), null, regions, rest, still=still)
        return left_of(region, known[chosen], null, level)

    when = [_reach(identification, blocks) for identification in identified]
    moves = [_moves(identification, blocks, after) for identification in identified]
    told = []
    for region in regions:
        score, limit = left_of(region, scores, null, level)
        shown = []
        for identification, its_time, its_moves in zip(identified, when, moves, strict=True):
            moved = _is_inside(region, blocks) and any(
                _overlap(region, span) > 0.0 for span in its_moves
            )
            components = [
                component
                for component in identification.components
                if _can_show(component, region, blocks)
            ]
            components = [
                component
                for component in components
                if moved
                or component.candidate.statistic not in _MOVES
                or region["view"] != "spectrum"
            ]
            if not components or not set(str(region["axes"]).split()) & set(identification.axes):
                continue
            if score >= limit and {
                component.candidate.statistic for component in components
            } <= _modelled(identification, region):
                continue
            if (
                moved
                or any(_meet(region, span) for span in its_time)
                or (
                    without is not None
                    and _beside(region, components, partial(left, region, (identification,)))
                )
            ):
                shown.append((identification, components))
        several = without is not None and score < limit
        kept = (
            needed(region, shown, partial(left, region))
            if several
            else [identification for identification, _ in shown]
        )
        told.append(list(dict.fromkeys(identification.effect for identification in kept)))
    return told


def unexpected(
    found: xr.Dataset,
    expected: Sequence[Identification],
    blocks: xr.Dataset,
    before: xr.Dataset,
    null: NullScores,
    *,
    level: float,
) -> xr.Dataset:
    """Mismatches without those that effects explain which the simulation has as well.

    Parameters
    ----------
    found : xarray.Dataset
        Located where odd samples that are expected were left out; so these explain what is odd and
        no more.
    expected : sequence of Claim
    blocks, before : xarray.Dataset
        The recording, and the baseline with these effects.
    null : NullScores
    level : float
    """
    odd = [
        one
        for one in expected
        if any(
            component.candidate.statistic == "marks"
            and find_anomalous_blocks(component, blocks).any()
            for component in one.components
        )
    ]
    others = [one for one in expected if one not in odd]
    by_count, by_all = (
        attribute_mismatches(found, identified, blocks, before, null, level=level)
        for identified in (odd, others)
    )
    told = [
        bool(named) or (bool(counted) and statistic == "distribution")
        for statistic, counted, named in zip(found["view"].values, by_count, by_all, strict=True)
    ]
    return found.isel(mismatch=~np.array(told, np.bool_)) if expected else found


def _beside(
    region: Mapping[str, Any],
    components: Sequence[Component],
    left: Callable[[], tuple[float, float]],
) -> bool:
    """Whether a mismatch of the mean is there for what an effect does at other times.

    The constant of a record is free: a mean that is higher in one part is one that is lower in the
    rest, and either may stand out.
    """
    if str(region["view"]) != "mean" or not {
        component.candidate.statistic for component in components
    } <= {
        "mean",
        "levels",
    }:
        return False
    score, limit = left()
    return score >= limit


def _modelled(identification: Identification, region: Mapping[str, Any]) -> set[str]:
    """Parts that must take the mismatch away; that several axes wander as one is in no model, and what wanders on them may do it."""
    held = {*_MODELLED, "line", "marks"} if region["view"] == "cross_axis" else set(_MODELLED)
    wanders = (
        str(region["what"]) == "slow"
        and len(set(str(region["axes"]).split()) & set(identification.axes)) > 1
    )
    return held - ({"wander"} if wanders else set())


def _can_show(component: Component, region: Mapping[str, Any], blocks: xr.Dataset) -> bool:
    """Whether a part of an effect can be seen where a mismatch is.

    A line explains a line at its own frequency only, and a mean of what axes share only what is
    slow.
    """
    if str(region["view"]) not in _SHOWS.get(component.candidate.statistic, ()):
        return False
    if (
        component.candidate.statistic in ("mean", "wander", "levels")
        and region["view"] == "cross_axis"
        and region["what"] != "slow"
    ):
        return False
    if component.candidate.statistic == "line" and region["view"] == "cross_axis":
        return str(region["what"]) != "slow"
    if (
        component.candidate.statistic != "line"
        or component.place < 0
        or region["view"] == "distribution"
    ):
        return True
    lines = blocks["line_frequency"].values
    mine = float(lines[component.place])
    if np.isfinite(region["frequency"]):
        return bool(
            abs(region["frequency"] - mine) <= _BESIDE * (lines[1] - lines[0]) + _SHARP * mine
        )
    tau = _BUMP / mine  # where the Allan variance of a sine is largest
    return str(region["what"]).startswith(("avar", "level", "variance")) and bool(
        region["tau_min_s"] / _WIDE <= tau <= region["tau_max_s"] * _WIDE
    )


def _reach(identification: Identification, blocks: xr.Dataset) -> list[tuple[float, float]]:
    """Stretches whose mismatches an effect can explain: a line of the turning stands out also where a part turns but little."""
    begin, end = blocks["begin"].values, blocks["end"].values
    if any(component.candidate.statistic == "order" for component in identification.components):
        return [(float(begin[0]), float(end[-1]))]
    return spans(active_spans(identification, blocks), begin, end)


def _meet(region: Mapping[str, Any], span: tuple[float, float]) -> bool:
    return _overlap(region, span) >= _MEETS * min(
        float(region["end"] - region["begin"]), span[1] - span[0]
    )


def _overlap(region: Mapping[str, Any], span: tuple[float, float]) -> float:
    return float(min(region["end"], span[1]) - max(region["begin"], span[0]))


def _is_inside(region: Mapping[str, Any], blocks: xr.Dataset) -> bool:
    """Whether a mismatch is of the inside of blocks, and not of their means."""
    return str(region["view"]) in ("spectrum", "distribution") or float(
        region["tau_max_s"]
    ) < float(blocks.attrs["block_s"])


def _moves(
    identification: Identification, blocks: xr.Dataset, after: xr.Dataset
) -> list[tuple[float, float]]:
    """Blocks [s] in which an effect moves the rate of an axis too fast for what is said of their inside."""
    axes, moving = (
        [str(axis) for axis in blocks["axis"].values],
        expect_known_motion(blocks, after),
    )
    there = np.zeros(blocks.sizes["block"], np.bool_)
    for component in (
        component
        for component in identification.components
        if component.candidate.statistic in _MOVES and component.variant.design.size
    ):
        row = axes.index(component.row[0])
        for column in mean_columns(component.variant, row):
            step = np.abs(np.diff(np.nan_to_num(column)))
            far = step > _MOVED * step.max(initial=0.0)
            there |= moving[row] & (np.append(far, False) | np.append(False, far))
    return [
        (float(blocks["begin"].values[block]), float(blocks["end"].values[block]))
        for block in np.flatnonzero(there)
    ]
