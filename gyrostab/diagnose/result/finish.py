"""Turn identified effects into a diagnosis: fit those whose size is not zero, write all tables."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import xarray as xr

from gyrostab.diagnose.estimate.conditioned_baseline import (
    add_outlier_power,
    expected_baseline,
    predict_baseline,
)
from gyrostab.diagnose.estimate.joint_fit import Fitted, fit_expected, fit_identifications
from gyrostab.diagnose.estimate.recalibrate import recalibrate, refer_to_kept_noise, with_noise
from gyrostab.diagnose.estimate.upper_limits import find_upper_limits
from gyrostab.diagnose.identify.components import axes_of, sum_evidence
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection, reduce_selection
from gyrostab.diagnose.nulls.scores import NullScores
from gyrostab.diagnose.predict.channel_use import unused_channels
from gyrostab.diagnose.result.attribution import attribute_mismatches
from gyrostab.diagnose.result.content import SCHEMA, check_diagnosis
from gyrostab.diagnose.result.diagnosis import Diagnosis, to_json_types
from gyrostab.diagnose.result.held_out_table import measure_held_out
from gyrostab.diagnose.result.rejections import find_rejections, find_unsupported, rejected_tables
from gyrostab.diagnose.result.surfaces import make_surfaces
from gyrostab.diagnose.result.tables import (
    baseline_table,
    effect_tables,
    mismatch_tables,
    model_tables,
    recording_table,
)
from gyrostab.diagnose.result.verdict import decide_verdict
from gyrostab.diagnose.statistics.base import Region
from gyrostab.diagnose.task import NamedBlocks, Task, lines_without_motion
from gyrostab.physics.registry import effects
from gyrostab.simulate.model import Model


class FinalFit(NamedTuple):
    """The effects with their final sizes."""

    identifications: Identifications  # with designs for the noise below
    noise: xr.Dataset  # the baseline with the noise that the effects leave
    #: Effects that the simulation lacks, and those that it already contains.
    fitted: list[Fitted]
    expected: list[Fitted]


def finish_diagnosis(
    task: Task, named: NamedBlocks, located: Sequence[Region], null: NullScores, started: float
) -> Diagnosis:
    """Fit the identified effects, measure their evidence, and attribute the mismatches."""
    blocks, baseline = named.blocks, named.baseline
    identifications, first_fit, fit = fit_supported(named.identifications, baseline)
    before = expected_baseline(fit.identifications, baseline)
    after = (
        predict_baseline(fit.identifications, fit.noise) if identifications.identified else before
    )
    mismatches = _attributed_mismatches(task, blocks, located, null, fit, after)
    unexplained = [region["id"] for region in mismatches if not region["explained_by"]]
    held = measure_held_out(blocks, baseline, identifications, first_fit)
    effects = effect_tables(fit.fitted, blocks, settings=task.settings)
    # channels that an effect could follow, or was compared with
    used = {
        name
        for candidate in fit.identifications.examination.candidates
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
        "rejected": rejected_tables(
            [
                *find_rejections(named.identifications),
                *find_unsupported(named.identifications.identified, fit.identifications.identified),
            ]
        ),
        "unused_channels": unused_channels(blocks, used),
        "channel_delays": [
            {"name": name, "delay_s": delay_s}
            for name, delay_s in blocks.attrs["channel_delays"].items()
        ],
        "held_out": held,
        "seconds": round(time.perf_counter() - started, 3),
    }
    rotation = task.log.get("rotation_rate", xr.DataArray())
    turning = str(rotation.attrs.get("rotation_axis", ""))  # axis that feels this channel
    given_model = task.simulation if isinstance(task.simulation, Model) else None
    diagnosis = Diagnosis(
        to_json_types(content),
        _make_surfaces_with_outliers(blocks, fit, before, after),
        model_tables(fit.noise, fit.fitted, given_model, blocks, turning, settings=task.settings),
    )
    check_diagnosis(diagnosis.content)
    return diagnosis


def fit_supported(
    identifications: Identifications, baseline: xr.Dataset
) -> tuple[Identifications, list[Fitted], FinalFit]:
    """Fit the effects, and drop those whose size may be zero, until none is left to drop.

    Return the remaining effects, their sizes with the noise of `baseline`, and their sizes with the
    noise that they leave.
    """
    while True:
        first_fit = fit_identifications(identifications, baseline)
        fit = refit_with_noise(identifications, baseline, first_fit)
        fits_by_identification = [
            [fitted for fitted in fit.fitted if fitted.identification is identification]
            for identification in fit.identifications.identified
        ]
        supported = keep_supported(identifications, fits_by_identification)
        if supported is identifications:
            return identifications, first_fit, fit
        identifications = supported


def refit_with_noise(
    identifications: Identifications, baseline: xr.Dataset, first_fit: list[Fitted]
) -> FinalFit:
    """Calibrate the noise with the effects of the first fit in the model, and fit them again."""
    noise = recalibrate(identifications, baseline, first_fit)
    fitted = first_fit
    if noise is not baseline:
        identifications = with_noise(identifications, noise)
        fitted = fit_identifications(identifications, noise)
    return FinalFit(
        identifications,
        noise,
        refer_to_kept_noise(fitted, noise, identifications.state.blocks),
        fit_expected(identifications, baseline),
    )


def _attributed_mismatches(
    task: Task,
    blocks: xr.Dataset,
    located: Sequence[Region],
    null: NullScores,
    fit: FinalFit,
    after: xr.Dataset,
) -> list[dict[str, Any]]:
    """Return the mismatches that were located or identified, each with what explains it."""
    identified = fit.identifications.identified

    def without(left_out: Sequence[Selection]) -> xr.Dataset:
        return predict_baseline(fit.identifications, fit.noise, left_out=left_out)

    lines = (
        lines_without_motion(task, blocks, after)
        if identified and any(region["view"] == "spectrum" for region in located)
        else None
    )
    explained = attribute_mismatches(
        located,
        identified,
        blocks,
        after,
        null,
        level=task.level / 2.0,
        without=without,
        lines_at_rest=lines,
    )
    return mismatch_tables(located, explained, fit.identifications, blocks)


def _make_surfaces_with_outliers(
    blocks: xr.Dataset, fit: FinalFit, before: xr.Dataset, after: xr.Dataset
) -> xr.Dataset:
    """Return the surfaces with the power of outliers in both simulations."""
    before = add_outlier_power(before, blocks, fit.expected)
    after = add_outlier_power(after, blocks, [*fit.expected, *fit.fitted])
    return make_surfaces(blocks, before, after)


def supported_axes(fitted: Fitted) -> tuple[str, ...]:
    """Find the axes on which a size of the effect differs from zero.

    A parameter ``name.axis`` belongs to one axis, any other to all. Without a measured size, as for
    motion with another form in every band, all axes are returned.
    """
    sizes = effects()[fitted.identification.effect].size_parameters
    measured = {
        name: estimate
        for name, estimate in fitted.parameters.items()
        if name.split(".")[0] in sizes
    }
    axes = []
    for axis in fitted.axes:
        axis_sizes = [
            estimate for name, estimate in measured.items() if name.partition(".")[2] in ("", axis)
        ]
        # zero is not in a 95 % interval; an unknown one may contain it
        if not axis_sizes or any(size.low > 0.0 or size.high < 0.0 for size in axis_sizes):
            axes.append(axis)
    return tuple(axes)


def keep_supported(
    identifications: Identifications, fits_by_identification: Sequence[Sequence[Fitted]]
) -> Identifications:
    """Keep the effects whose size differs from zero, on the axes where it does.

    What an effect gained on the other axes becomes unidentified if that exceeds its threshold:
    something is there, but the record does not show that this effect caused it. If every effect
    keeps all of its axes, `identifications` itself is returned.
    """
    identified: list[Selection] = []
    unidentified: list[Selection] = []
    for identification, fits in zip(
        identifications.identified, fits_by_identification, strict=True
    ):
        good = {axis for fitted in fits for axis in supported_axes(fitted)}
        if set(identification.axes) <= good or not fits:
            identified.append(identification)
            continue
        supported = [
            component for component in identification.components if set(component.row) <= good
        ]
        if sum_evidence(supported) > identification.threshold:
            evidence_nats = min(identification.evidence_nats, sum_evidence(supported))
            identified.append(reduce_selection(identification, supported, evidence_nats))
        else:
            supported = []
        lost = tuple(
            component for component in identification.components if component not in supported
        )
        if sum_evidence(lost) > identification.threshold:
            strongest = max(lost, key=lambda component: component.evidence_nats).statistic
            unidentified.append(
                Selection(
                    strongest.unsupported_as,
                    (),
                    axes_of(lost, identification.axes),
                    lost,
                    sum_evidence(lost),
                    identification.threshold,
                    (identification.effect,),
                )
            )
    if identified == [*identifications.identified]:
        return identifications
    return replace(
        identifications,
        identified=tuple(identified),
        unidentified=(*identifications.unidentified, *unidentified),
    )
