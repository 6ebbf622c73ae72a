"""Find which effects are needed to explain a mismatch."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.known_effects import remove_known_motion
from gyrostab.diagnose.identify.identification import Selection, components_of
from gyrostab.diagnose.locate.mismatches import Region
from gyrostab.diagnose.nulls.scores import NullScores, standardise
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import drop_changed_tails
from gyrostab.diagnose.predict.linear_model import pair_rows
from gyrostab.diagnose.reduce.schema import weighted_mean
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import STATISTICS, find_statistic
from gyrostab.diagnose.statistics.sample_counts import mask_anomalous_blocks

Scores = Sequence[tuple[str, xr.Dataset, NDArray[np.float64]]]


def statistic_scores(
    blocks: xr.Dataset,
    after: xr.Dataset,
    null: NullScores,
    regions: Sequence[Region],
    identified: Sequence[Selection],
    *,
    still: xr.Dataset | None = None,
) -> Scores:
    """Score the recording against a baseline with effects.

    Statistics of whole blocks leave out those with anomalous samples of `identified`, and
    statistics of their inside those in which an effect moves the rate. The line statistics use the
    lines of `still`, by default those of `blocks`.
    """
    out = []
    settings = null.settings
    blocks = remove_known_motion(blocks, after, settings=settings)
    after = _with_shared_lines(blocks, after, identified)
    masked = mask_anomalous_blocks(blocks, components_of(identified), settings)
    turns_left_out = drop_changed_tails(blocks, after["spectrum"].values, settings)
    lines = masked
    if still is not None:
        lines = masked.assign({name: still[name] for name in ("line_power", "line_weight")})
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
        (component.place, component.row[0])
        for component in components_of(identified)
        if component.statistic.is_line and component.place >= 0
    ]
    if len(lines) < 2:
        return after
    observed, shape = (blocks[name].values for name in ("cross", "cross_shape"))
    expected = after["cross"].values if "cross" in after else np.zeros_like(observed)
    mean, _ = weighted_mean(observed - expected, shape, axis=1)
    reach = 1.0 / float(blocks.attrs["block_s"])
    cross = expected.copy()
    for place in {place for place, _ in lines}:
        frequency = float(blocks["line_frequency"].values[place])
        bands = np.flatnonzero(
            (blocks["band_low"].values <= frequency + reach)
            & (frequency - reach < blocks["band_high"].values)
        )
        axes = {axis for line_place, axis in lines if line_place == place}
        for number, pair in enumerate(pair_rows(blocks)):
            if set(pair) <= axes:
                mine = bands[bands > 0]
                cross[number][:, mine] = expected[number][:, mine] + mean[number][mine]
    return after.assign(cross=(("pair", "block", "band"), cross))


def score_left(
    region: Region, scores: Scores, null: NullScores, level: float
) -> tuple[float, float]:
    """Return the largest score left at a mismatch, and the score that still makes it one.

    An error of the form of an effect may leave a share of the score of the mismatch.
    """
    largest_score, limit = 0.0, np.inf
    for name, statistic, z in scores:
        if (
            find_statistic(name).view != region["view"]
            or str(region["what"]) not in statistic["what"].values
        ):
            continue
        rows = [
            number
            for number, axes in enumerate(statistic["axes"].values)
            if set(str(axes).split()) & set(str(region["axes"]).split())
        ]
        inside = (statistic["begin"].values >= region["begin"] - 1e-6) & (
            statistic["end"].values <= region["end"] + 1e-6
        )
        columns = (statistic["what"].values == region["what"]) & (
            statistic["tau_min_s"].values >= 0.99 * region["tau_min_s"]
        )
        columns &= statistic["tau_min_s"].values <= 1.01 * region["tau_max_s"]
        cells = np.abs(z[np.ix_(rows, inside, columns)])
        if np.isfinite(cells).any():
            largest_score = max(largest_score, float(np.nanmax(cells)))
            allowed = null.settings.score_error_share * abs(float(region["z"]))
            limit = min(limit, max(null.critical(name, level), allowed))
    return largest_score, limit


def needed_effects(
    region: Region,
    shown: Sequence[tuple[Selection, Sequence[Component]]],
    left: Callable[[Sequence[Selection]], tuple[float, float]],
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
    statistic. `left` takes effects to leave out, and returns the score that is left, and the score
    of a mismatch.
    """
    weighed = [
        identification
        for identification, components in shown
        if all(
            # a low-pass may be in the noise of the baseline already
            str(region["view"]) in component.statistic.contained_in and not component.is_filter
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
