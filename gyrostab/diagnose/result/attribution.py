"""Attribute each mismatch to the named effects that are needed to explain it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.diagnose.baseline.known_effects import (
    find_blocks_with_known_motion,
    remove_known_motion,
)
from gyrostab.diagnose.identify.selections import Selection, components_of
from gyrostab.diagnose.nulls.scores import NullScores, standardise
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import drop_changed_tails, find_bands, mean_columns
from gyrostab.diagnose.predict.linear_model import expected_cross, pair_rows
from gyrostab.diagnose.reduce.schema import weighted_mean
from gyrostab.diagnose.result.active_spans import active_spans
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import STATISTICS, find_statistic
from gyrostab.diagnose.statistics.base import Region
from gyrostab.diagnose.statistics.sample_counts import find_anomalous_blocks, mask_anomalous_blocks

#: Name, scores and standardised scores of each statistic.
_Scores = Sequence[tuple[str, xr.Dataset, Floats]]
#: Takes effects to leave out; returns the score that is left at a mismatch, and that of a mismatch.
ScoreLeft = Callable[[Sequence[Selection]], tuple[float, float]]


class _TimedEffect(NamedTuple):
    """An identified effect, and when it acts [s]."""

    identification: Selection
    active_spans: list[tuple[float, float]]
    moving_spans: list[tuple[float, float]]  # in which it moves the rate within blocks


def attribute_mismatches(
    located: Sequence[Region],
    identified: Sequence[Selection],
    blocks: xr.Dataset,
    after: xr.Dataset,
    null: NullScores,
    *,
    level: float,
    without: Callable[[Sequence[Selection]], xr.Dataset] | None = None,
    lines_at_rest: xr.Dataset | None = None,
) -> list[list[str]]:
    """Find the effects that explain each mismatch.

    An effect explains a mismatch when it acts on one of its axes at its time and can show in its
    statistic; what it adds to calibrated noise, at any time. If the baseline with the effects
    contains what the effect does there, two more conditions apply: the mismatch is gone with that
    baseline, or nearly so, and this effect is needed for that. A mismatch of the mean, or at a
    restart, may also lie before or after the effect, when the effect causes the difference. In
    blocks within which an effect moves the rate, power and the lowest lines exceed the noise; the
    effect explains these too.

    `after` is the baseline with the effects, and `without` returns that except for those given, at
    the sizes of the joint fit. Without it, whether an effect is needed is not tested: every effect
    at the place of a mismatch explains it. `lines_at_rest` has line spectra without the blocks in
    which an effect moves the rate.
    """
    settings = null.settings

    @cache
    def scores_without(out: tuple[Selection, ...]) -> _Scores:
        remaining = [identification for identification in identified if identification not in out]
        baseline = without(out) if without is not None and out else after
        return _statistic_scores(
            blocks, baseline, null, located, remaining, lines_at_rest=lines_at_rest
        )

    def score_left(region: Region, out: Sequence[Selection]) -> tuple[float, float]:
        return _score_left(region, scores_without(tuple(out)), null, level)

    timed_effects = [
        _TimedEffect(
            identification,
            _explained_spans(identification, blocks, settings),
            _moving_spans(identification, blocks, after, settings),
        )
        for identification in identified
    ]
    return [
        _explain_mismatch(
            region,
            timed_effects,
            blocks,
            partial(score_left, region),
            is_tested=without is not None,
            is_calibrated=after.attrs.get("source") == "calibrated",
            settings=settings,
        )
        for region in located
    ]


def _explain_mismatch(
    region: Region,
    timed_effects: Sequence[_TimedEffect],
    blocks: xr.Dataset,
    left: ScoreLeft,
    *,
    is_tested: bool,
    is_calibrated: bool,
    settings: Settings,
) -> list[str]:
    """Return the effects that explain a mismatch; `is_tested` says whether they must be needed.

    Noise that `is_calibrated` on the record contains what an effect adds on the average. Where the
    effect adds less, or nothing, the record is quieter than this noise.
    """
    score, limit = left(())
    shown = []
    for effect in timed_effects:
        components = _components_at(region, effect, blocks, settings, is_left=score >= limit)
        if components and (
            _acts_at(region, effect, blocks, settings)
            or (is_tested and _is_caused_elsewhere(region, effect, components, left))
            or (
                is_calibrated
                and score < limit
                and all(component.statistic.is_power for component in components)
            )
        ):
            shown.append((effect.identification, components))
    needed = [identification for identification, _ in shown]
    if is_tested and score < limit:
        needed = needed_effects(region, shown, left, settings=settings)
    return list(dict.fromkeys(identification.effect for identification in needed))


def _components_at(
    region: Region, effect: _TimedEffect, blocks: xr.Dataset, settings: Settings, *, is_left: bool
) -> list[Component]:
    """Return the components of an effect that can show in a mismatch, on its axes; or none.

    `is_left` says whether the mismatch is left with all effects in the baseline.
    """
    has_moved = _has_moved(region, effect, blocks)
    components = [
        component
        for component in effect.identification.components
        if component.statistic.can_explain(component, region, blocks, settings)
        and (has_moved or not component.statistic.is_in_means or region["view"] != "spectrum")
    ]
    common = set(region["axes"].split()) & set(effect.identification.axes)
    together = region["quantity"] == "slow" and len(common) > 1
    is_modelled = all(
        component.statistic.is_modelled_in(region, together=together) for component in components
    )
    return [] if not common or (is_left and is_modelled) else components


def _has_moved(region: Region, effect: _TimedEffect, blocks: xr.Dataset) -> bool:
    """Return whether an effect moves the rate within the blocks of a mismatch of their inside."""
    is_within_blocks = region["view"] in ("spectrum", "distribution") or float(
        region["tau_max_s"]
    ) < float(blocks.attrs["block_s"])
    return is_within_blocks and any(
        _overlap_seconds(region, span) > 0.0 for span in effect.moving_spans
    )


def _acts_at(region: Region, effect: _TimedEffect, blocks: xr.Dataset, settings: Settings) -> bool:
    """Return whether an effect acts at the time of a mismatch."""
    return _has_moved(region, effect, blocks) or any(
        _overlap_seconds(region, (begin, end))
        >= settings.overlap_share * min(region["end"] - region["begin"], end - begin)
        for begin, end in effect.active_spans
    )


def drop_expected(
    located: Sequence[Region],
    expected: Sequence[Selection],
    blocks: xr.Dataset,
    before: xr.Dataset,
    null: NullScores,
    *,
    level: float,
) -> list[Region]:
    """Drop the mismatches that effects of the simulation itself explain.

    They were located with the expected anomalous samples left out. Effects with such samples
    therefore explain mismatches of the sample distribution only. `before` is the baseline with
    these effects.
    """
    if not expected:
        return list(located)
    anomalous = [
        identification
        for identification in expected
        if any(
            component.statistic.is_count
            and find_anomalous_blocks(component, blocks, null.settings).any()
            for component in identification.components
        )
    ]
    others = [identification for identification in expected if identification not in anomalous]
    by_count, by_all = (
        attribute_mismatches(located, identified, blocks, before, null, level=level)
        for identified in (anomalous, others)
    )
    return [
        region
        for region, counted, named in zip(located, by_count, by_all, strict=True)
        if not (named or (counted and region["view"] == "distribution"))
    ]


def _is_caused_elsewhere(
    region: Region, effect: _TimedEffect, components: Sequence[Component], left: ScoreLeft
) -> bool:
    """Return whether a mismatch of the mean is due to what an effect does at other times.

    The constant of a record is free: a mean that is higher in one part is lower in the rest, and
    either may be the mismatch. A mean that differs after a restart may be due to an effect before.
    """
    if region["view"] not in ("mean", "restart") or not all(
        component.statistic.is_in_means for component in components
    ):
        return False
    score, limit = left((effect.identification,))
    return score >= limit


def _explained_spans(
    identification: Selection, blocks: xr.Dataset, settings: Settings
) -> list[tuple[float, float]]:
    """Return the stretches whose mismatches an effect can explain.

    A line locked to the rotation also shows in parts that rotate only a little.
    """
    if any(component.statistic.is_rotation for component in identification.components):
        return [(float(blocks["begin"].values[0]), float(blocks["end"].values[-1]))]
    return active_spans(identification, blocks, settings=settings)


def _overlap_seconds(region: Region, span: tuple[float, float]) -> float:
    return float(min(region["end"], span[1]) - max(region["begin"], span[0]))


def _moving_spans(
    identification: Selection, blocks: xr.Dataset, after: xr.Dataset, settings: Settings
) -> list[tuple[float, float]]:
    """Return the blocks [s] in which an effect moves the rate of an axis within the block."""
    axes = [str(axis) for axis in blocks["axis"].values]
    moving = find_blocks_with_known_motion(blocks, after, settings=settings)
    is_moving = np.zeros(blocks.sizes["block"], np.bool_)
    for component in (
        component
        for component in identification.components
        if component.statistic.is_in_means and component.variant.design.size
    ):
        row = axes.index(component.row[0])
        for column in mean_columns(component.variant, row):
            step = np.abs(np.diff(np.nan_to_num(column)))
            is_step = step > settings.active_share * step.max(initial=0.0)
            is_moving |= moving[row] & (np.append(is_step, False) | np.append(False, is_step))
    return [
        (float(blocks["begin"].values[block]), float(blocks["end"].values[block]))
        for block in np.flatnonzero(is_moving)
    ]


def _statistic_scores(
    blocks: xr.Dataset,
    after: xr.Dataset,
    null: NullScores,
    regions: Sequence[Region],
    identified: Sequence[Selection],
    *,
    lines_at_rest: xr.Dataset | None = None,
) -> _Scores:
    """Score the recording against a baseline with effects.

    Statistics of whole blocks leave out those with anomalous samples of `identified`, and
    statistics of their inside those in which an effect moves the rate. The line statistics use the
    lines of `lines_at_rest`, by default those of `blocks`.
    """
    out = []
    settings = null.settings
    blocks = remove_known_motion(blocks, after, settings=settings)
    after = _with_shared_lines(blocks, after, identified)
    masked = mask_anomalous_blocks(blocks, components_of(identified), settings)
    turns_left_out = drop_changed_tails(blocks, after["spectrum"].values, settings)
    lines = masked
    if lines_at_rest is not None:
        lines = masked.assign({name: lines_at_rest[name] for name in ("line_power", "line_weight")})
    for statistic in STATISTICS:
        if statistic.name not in null.statistics:
            continue
        judged = masked
        if statistic.is_count:
            judged = turns_left_out
        elif statistic.uses_line_spectra:
            judged = lines
        scores = statistic.score(statistic.prepare(judged, after, regions), after)
        if scores is not None:
            out.append(
                (statistic.name, scores, standardise(scores, null.statistics[statistic.name]))
            )
    return out


def _with_shared_lines(
    blocks: xr.Dataset, after: xr.Dataset, identified: Sequence[Selection]
) -> xr.Dataset:
    """Return the baseline with the covariance of lines that axes have in common.

    It is the mean over the record, in the bands where the line is. The lowest band is unchanged,
    because it shows what the block means have in common.
    """
    lines = [
        (component.line_index, component.row[0])
        for component in components_of(identified)
        if component.statistic.is_line
    ]
    if len(lines) < 2:
        return after
    observed, shape = (blocks[name].values for name in ("cross", "cross_shape"))
    expected = expected_cross(after, blocks)
    mean, _ = weighted_mean(observed - expected, shape, axis=1)
    cross = expected.copy()
    for place in {place for place, _ in lines}:
        frequency = float(blocks["line_frequency"].values[place])
        bands = find_bands(blocks, frequency)
        axes = {axis for line_place, axis in lines if line_place == place}
        for number, pair in enumerate(pair_rows(blocks)):
            if set(pair) <= axes:
                mine = bands[bands > 0]
                cross[number][:, mine] = expected[number][:, mine] + mean[number][mine]
    return after.assign(cross=(("pair", "block", "band"), cross))


def _score_left(
    region: Region, scores: _Scores, null: NullScores, level: float
) -> tuple[float, float]:
    """Return the largest score left at a mismatch, and the score that still makes it one.

    An error of the form of an effect may leave a share of the score of the mismatch.
    """
    largest_score, limit = 0.0, np.inf
    for name, statistic, z in scores:
        if (
            find_statistic(name).view != region["view"]
            or region["quantity"] not in statistic["quantity"].values
        ):
            continue
        rows = [
            number
            for number, axes in enumerate(statistic["axes"].values)
            if set(str(axes).split()) & set(region["axes"].split())
        ]
        inside = (statistic["begin"].values >= region["begin"] - 1e-6) & (
            statistic["end"].values <= region["end"] + 1e-6
        )
        columns = (statistic["quantity"].values == region["quantity"]) & (
            statistic["tau_min_s"].values >= 0.99 * region["tau_min_s"]
        )
        columns &= statistic["tau_min_s"].values <= 1.01 * region["tau_max_s"]
        cells = np.abs(z[np.ix_(np.array(rows, np.intp), inside, columns)])
        if np.isfinite(cells).any():
            largest_score = max(largest_score, float(np.nanmax(cells)))
            allowed = null.settings.score_error_share * abs(float(region["z"]))
            limit = min(limit, max(null.critical(name, level), allowed))
    return largest_score, limit


def needed_effects(
    region: Region,
    shown: Sequence[tuple[Selection, Sequence[Component]]],
    left: ScoreLeft,
    *,
    settings: Settings = DEFAULTS,
) -> list[Selection]:
    """Select the effects that are needed to explain a mismatch.

    An effect is needed when the mismatch returns without it. When several effects do the same,
    none is needed in this sense. Therefore each that contributes half of an equal share or more of
    what they all take off the largest score counts as needed too. An effect that contributes less
    could be larger or smaller within its error, and the mismatch would be gone all the same. An
    effect whose contribution the statistic does not contain stays, and so does the largest
    contributor.

    Those `shown` act there and together remove it, each with its components that can show in its
    statistic.
    """
    weighed = [
        identification
        for identification, components in shown
        if all(
            # a low-pass may be in the noise of the baseline already
            region["view"] in component.statistic.containing_views and not component.is_filter
            for component in components
        )
    ]
    if not weighed or len(shown) < 2:
        return [identification for identification, _ in shown]
    score_with_all = left(())[0]
    brought = left(weighed)[0] - score_with_all
    without = [left((identification,)) for identification in weighed]
    fair = settings.majority_share * brought / len(shown)
    needed = [
        number
        for number, (score, limit) in enumerate(without)
        if score >= limit or 0.0 < fair <= score - score_with_all
    ]
    if not needed and len(weighed) == len(shown):
        needed = [int(np.argmax([score for score, _ in without]))]
    dropped = [selection for number, selection in enumerate(weighed) if number not in needed]
    return [identification for identification, _ in shown if identification not in dropped]
