"""Turn identified effects into a diagnosis: fit them, measure their evidence, write all tables."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.conditioned_baseline import (
    add_outlier_power,
    expected_baseline,
    predict_baseline,
)
from gyrostab.diagnose.estimate.joint_fit import Fitted, fit_expected, fit_identifications
from gyrostab.diagnose.estimate.recalibrate import recalibrate, refer_to_kept_noise, with_noise
from gyrostab.diagnose.estimate.upper_limits import find_upper_limits
from gyrostab.diagnose.identify.identification import Identifications, Selection, components_of
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.channel_use import unused_channels
from gyrostab.diagnose.result.attribution import active_blocks, attribute_mismatches
from gyrostab.diagnose.result.content import SCHEMA, check_diagnosis
from gyrostab.diagnose.result.diagnosis import Diagnosis, plain
from gyrostab.diagnose.result.held_out import held_out, select_forecast_start
from gyrostab.diagnose.result.mismatch_tables import mismatch_tables
from gyrostab.diagnose.result.size_gate import keep_supported
from gyrostab.diagnose.result.surfaces import make_surfaces
from gyrostab.diagnose.result.tables import (
    baseline_table,
    effect_tables,
    model_tables,
    recording_table,
    rejected_tables,
)
from gyrostab.diagnose.result.verdict import decide_verdict
from gyrostab.diagnose.settings import Settings
from gyrostab.diagnose.statistics.sample_counts import mask_anomalous_blocks
from gyrostab.diagnose.task import Comparison, Task, lines_without_motion
from gyrostab.simulate.model import Model


class Fit(NamedTuple):
    """The effects with their final sizes."""

    identifications: Identifications  # with designs for the noise below
    noise: xr.Dataset  # the baseline with the noise that the effects leave
    #: Effects that the simulation lacks, and those that it already contains.
    fitted: list[Fitted]
    expected: list[Fitted]


def finish_diagnosis(task: Task, comparison: Comparison, started: float) -> Diagnosis:
    """Fit the identified effects, measure their evidence, and attribute the mismatches."""
    blocks, baseline = comparison.blocks, comparison.baseline
    identifications, first, fit = fit_supported(comparison.identifications, baseline)
    before = expected_baseline(fit.identifications, baseline)
    after = (
        predict_baseline(fit.identifications, fit.noise) if identifications.identified else before
    )
    mismatches = _attributed_mismatches(task, comparison, fit, after)
    unexplained = [region["id"] for region in mismatches if not region["explained_by"]]
    held = measure_evidence(blocks, baseline, identifications, first)
    effects = effect_tables(fit.fitted, blocks, settings=task.settings)
    # channels that an effect could follow, or was compared with
    used = {
        name
        for candidate in fit.identifications.candidates
        for name in (*candidate.driver, *candidate.reference)
    }
    content = {
        "schema": SCHEMA,
        "recording": recording_table(blocks),
        "baseline": baseline_table(baseline, fit.expected),
        "verdict": decide_verdict(mismatches, effects, unexplained, held, settings=task.settings),
        "false_alarm_level": task.level,
        "settings": task.settings.to_dict(),
        "mismatches": mismatches,
        "effects": effects,
        "unexplained": unexplained,
        "not_found": find_upper_limits(fit.identifications),
        "rejected": rejected_tables(fit.identifications),
        "unused_channels": unused_channels(blocks, used),
        "held_out": held,
        "seconds": round(time.perf_counter() - started, 3),
    }
    rotation = task.log.get("rotation_rate", xr.DataArray())
    turning = str(rotation.attrs.get("rotation_axis", ""))  # axis that feels this channel
    given_model = task.simulation if isinstance(task.simulation, Model) else None
    diagnosis = Diagnosis(
        plain(content),
        _make_surfaces_with_outliers(blocks, fit, before, after),
        model_tables(fit.noise, fit.fitted, given_model, blocks, turning),
    )
    check_diagnosis(diagnosis.content)
    return diagnosis


def fit_supported(
    identifications: Identifications, baseline: xr.Dataset
) -> tuple[Identifications, list[Fitted], Fit]:
    """Fit the effects, and drop those whose size may be zero, until none is left to drop.

    Returns
    -------
    identifications : Identifications
        Without the effects whose size may be zero.
    first : list of Fitted
        Sizes with the noise of `baseline`.
    fit : Fit
        Sizes with the noise that the effects leave.
    """
    while True:
        first = fit_identifications(identifications, baseline)
        fit = refit_with_noise(identifications, baseline, first)
        numbers = [
            [fitted for fitted in fit.fitted if fitted.identification is identification]
            for identification in fit.identifications.identified
        ]
        supported = keep_supported(identifications, numbers)
        if supported is identifications:
            return identifications, first, fit
        identifications = supported


def refit_with_noise(
    identifications: Identifications, baseline: xr.Dataset, first: list[Fitted]
) -> Fit:
    """Calibrate the noise with the effects of the `first` fit in the model, and fit them again."""
    noise = recalibrate(identifications, baseline, first)
    fitted = first
    if noise is not baseline:
        identifications = with_noise(identifications, noise)
        fitted = fit_identifications(identifications, noise)
    return Fit(
        identifications,
        noise,
        refer_to_kept_noise(fitted, noise, identifications.state.blocks),
        fit_expected(identifications, baseline),
    )


def measure_evidence(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    identifications: Identifications,
    first: Sequence[Fitted],
) -> dict[str, float]:
    """Measure what the effects gain on held-out data, with the noise fitted together with them.

    The likelihood of `held_out` is that of means, powers and cross-spectra. Sample counts,
    random biases and phase-locked components are in none of these: their evidence is added.
    """
    with_course, random_nats = _remove_random_biases(identifications)
    judged, phase_locked_nats = remove_phase_locked(with_course, blocks)
    identified = with_course.identified
    count_nats = sum(
        component.evidence_nats
        for component in components_of(identified)
        if component.statistic.is_count
    )
    clean = mask_anomalous_blocks(
        blocks,
        [*components_of(identified), *components_of(with_course.expected)],
        identifications.state.settings,
    )

    def train(
        chosen: Identifications, known: NDArray[np.bool_], is_left_out: Sequence[bool] = ()
    ) -> xr.Dataset:
        noise = recalibrate(chosen, baseline, first, known)
        renewed = with_noise(chosen, noise)
        left_out = tuple(compress(renewed.identified, is_left_out))
        return predict_baseline(renewed, noise, known, left_out=left_out)

    before = partial(expected_baseline, with_course, baseline)
    after = partial(train, judged) if judged.identified else before
    with_phase_locked = partial(train, with_course) if identified else before
    settings = identifications.state.settings
    known = select_forecast_start(blocks)
    begun = tuple(
        identification
        for identification in judged.identified
        if active_blocks(identification, blocks, settings=settings)[known].any()
    )
    # what is over later is not forecast, but is in the blocks that the noise is calibrated on
    is_over = [not _can_be_forecast(identification, blocks, settings) for identification in begun]
    has_forecast = not all(is_over)
    evidence = held_out(
        clean,
        before,
        after,
        more_gain=count_nats + random_nats + phase_locked_nats,
        shown=with_phase_locked if phase_locked_nats else None,
        forecast=partial(train, replace(judged, identified=begun), is_left_out=is_over)
        if has_forecast
        else before,
    )
    if not has_forecast:
        evidence["forecast_gain"] = np.nan  # no effect can be forecast
    return evidence


def _remove_random_biases(identifications: Identifications) -> tuple[Identifications, float]:
    """Drop biases that wander or switch at random, and return their evidence [nats].

    No held-out data show the course of one. Their Bayes factor is the sum of what they gain when
    every block is predicted from those before it.
    """
    random_biases = [
        identification
        for identification in identifications.identified
        if any(component.statistic.is_random_bias for component in identification.components)
    ]
    identified = tuple(
        identification
        for identification in identifications.identified
        if identification not in random_biases
    )
    return replace(identifications, identified=identified), sum(
        identification.evidence_nats for identification in random_biases
    )


def remove_phase_locked(
    identifications: Identifications, blocks: xr.Dataset
) -> tuple[Identifications, float]:
    """Drop phase-locked components and slow sines, and return their held-out evidence [nats].

    The band powers show how large such a component is, but not its phase. In them it would gain a
    small part of its evidence, and lose in every band that it leaves. Therefore its own statistic
    alone counts, and the powers of both models are without it.
    """
    identified, evidence_nats = [], 0.0
    for identification in identifications.identified:
        locked: list[Component] = []
        rest: list[Component] = []
        for component in identification.components:
            is_locked = component.statistic.is_only_in_phase(component, blocks)
            (locked if is_locked else rest).append(component)
        evidence_nats += sum(component.evidence_nats for component in locked)
        if rest:
            identified.append(
                replace(identification, components=tuple(rest)) if locked else identification
            )
    return replace(identifications, identified=tuple(identified)), evidence_nats


def _can_be_forecast(identification: Selection, blocks: xr.Dataset, settings: Settings) -> bool:
    """Return whether an effect that acts before a forecast begins can be forecast.

    The size of an event in the last part is unknown before, also where it is one of several jumps,
    and an event that is over does not affect the last part. Sample counts are in neither means nor
    powers, which are forecast.
    """
    if all(component.statistic.is_count for component in identification.components):
        return False
    acts = active_blocks(identification, blocks, settings=settings)
    known = select_forecast_start(blocks)
    has_later_step = any(
        component.is_step and (np.ptp(component.variant.design[..., known], axis=-1) == 0.0).any()
        for component in identification.components
    )
    return bool(acts[~known].any() and not has_later_step)


def _attributed_mismatches(
    task: Task, comparison: Comparison, fit: Fit, after: xr.Dataset
) -> list[dict[str, Any]]:
    """Return the mismatches that were located or identified, each with what explains it."""
    blocks = comparison.blocks
    mismatches = comparison.mismatches
    identified = fit.identifications.identified

    def without(left_out: Sequence[Selection]) -> xr.Dataset:
        return predict_baseline(fit.identifications, fit.noise, left_out=left_out)

    lines = (
        lines_without_motion(task, blocks, after)
        if identified and any(region["view"] == "spectrum" for region in mismatches)
        else None
    )
    explained = attribute_mismatches(
        mismatches,
        identified,
        blocks,
        after,
        comparison.null,
        level=task.level / 2.0,
        without=without,
        still=lines,
        settings=task.settings,
    )
    return mismatch_tables(mismatches, explained, fit.identifications, blocks)


def _make_surfaces_with_outliers(
    blocks: xr.Dataset, fit: Fit, before: xr.Dataset, after: xr.Dataset
) -> xr.Dataset:
    """Return the surfaces with the power of outliers in both simulations."""
    before = add_outlier_power(before, blocks, fit.expected)
    after = add_outlier_power(after, blocks, [*fit.expected, *fit.fitted])
    return make_surfaces(blocks, before, after)
