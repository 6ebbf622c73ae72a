"""From names to a result: fit the effects, see what they are worth and what is left, and put it all together."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.conditioned_baseline import predicted
from gyrostab.diagnose.estimate.expected_effects import expected_baseline, fit_expected
from gyrostab.diagnose.estimate.joint_fit import Fitted, fit_identifications
from gyrostab.diagnose.estimate.outlier_power import add_outlier_power
from gyrostab.diagnose.estimate.recalibrate import recalibrate, with_noise
from gyrostab.diagnose.estimate.upper_limits import find_upper_limits
from gyrostab.diagnose.identify.forward_search import Identifications
from gyrostab.diagnose.identify.identification import Identification
from gyrostab.diagnose.identify.phase_locked import without_waves
from gyrostab.diagnose.identify.switching import remove_telegraph_bias
from gyrostab.diagnose.predict.channel_use import unused_channels
from gyrostab.diagnose.predict.condition import mask_anomalous_blocks
from gyrostab.diagnose.result.attribution import active_spans, attribute_mismatches
from gyrostab.diagnose.result.diagnosis import HELD_OUT, SCHEMA, Diagnosis, check_diagnosis, plain
from gyrostab.diagnose.result.held_out import forecast_from, held_out
from gyrostab.diagnose.result.size_gate import keep_supported
from gyrostab.diagnose.result.surfaces import make_surfaces
from gyrostab.diagnose.result.tables import (
    baseline_table,
    effect_tables,
    identification_tables,
    limit_tables,
    mismatch_tables,
    model_tables,
    motion_tables,
    recording_table,
    surfaces_with_blocks,
    unidentified_tables,
)
from gyrostab.diagnose.result.verdict import decide_verdict
from gyrostab.diagnose.task import Compared, Task, still_lines
from gyrostab.simulate.model import Model

__all__ = ["Fit", "finish_diagnosis", "fit_supported", "fitted_beside_their_noise", "worth"]


class Fit(NamedTuple):
    """The effects in their final numbers.

    Attributes
    ----------
    identifications : Naming
        With designs for the noise below.
    noise : xarray.Dataset
        The baseline with the noise as it is beside the effects.
    fitted, expected : list of Fitted
        Effects that the simulation lacks, and those that it has as well.
    """

    identifications: Identifications
    noise: xr.Dataset
    fitted: list[Fitted]
    expected: list[Fitted]


def finish_diagnosis(task: Task, compared: Compared, begun: float) -> Diagnosis:
    """Fit what was named, see what it is worth and what is left, and put it all into one result."""
    blocks, baseline = compared.blocks, compared.baseline
    identifications, first, fit = fit_supported(compared.identifications, baseline)
    before = expected_baseline(fit.identifications, baseline)
    after = predicted(fit.identifications, fit.noise) if identifications.identified else before
    mismatches = _mismatches(task, compared, fit, after)
    unexplained = [region["id"] for region in mismatches if not region["explained_by"]]
    held = worth(blocks, baseline, identifications, first)
    content = {
        "schema": SCHEMA,
        "recording": recording_table(blocks),
        "baseline": baseline_table(baseline, fit.expected),
        "verdict": decide_verdict(mismatches, fit.identifications.identified, unexplained, held),
        "false_alarm_level": task.level,
        "mismatches": mismatches,
        "effects": effect_tables(fit.fitted, blocks),
        "unexplained": unexplained,
        "not_found": limit_tables(find_upper_limits(fit.identifications)),
        "unused_channels": unused_channels(blocks, _used_channels(fit.identifications)),
        "held_out": {name: held[name] for name in HELD_OUT},
        "seconds": round(time.perf_counter() - begun, 3),
    }
    own = task.given if isinstance(task.given, Model) else None
    diagnosis = Diagnosis(
        plain(content),
        _surfaces(blocks, fit, before, after),
        model_tables(fit.noise, fit.fitted, own),
    )
    check_diagnosis(diagnosis.content)
    return diagnosis


def _used_channels(identifications: Identifications) -> set[str]:
    """Channels that some effect could follow, or was compared with."""
    return {name for one in identifications.candidates for name in (*one.driver, *one.witness)}


def fit_supported(
    identifications: Identifications, baseline: xr.Dataset
) -> tuple[Identifications, list[Fitted], Fit]:
    """Fit the effects until each that is left has a size away from zero.

    Returns
    -------
    identifications : Naming
        Without the effects whose size may be zero.
    first : list of Fitted
        Their numbers beside the noise of `baseline`.
    fit : Fit
        Their numbers beside the noise that they leave.
    """
    while True:
        first = fit_identifications(identifications, baseline)
        fit = fitted_beside_their_noise(identifications, baseline, first)
        numbers = [
            [one for one in fit.fitted if one.identification is identification]
            for identification in fit.identifications.identified
        ]
        kept = keep_supported(identifications, numbers)
        if kept is identifications:
            return identifications, first, fit
        identifications = kept


def fitted_beside_their_noise(
    identifications: Identifications, baseline: xr.Dataset, first: list[Fitted]
) -> Fit:
    """Calibrate the noise beside the effects as they were fitted `first`, and fit them once more to what is left."""
    noise = recalibrate(identifications, baseline, first)
    if noise is baseline:
        return Fit(identifications, baseline, first, fit_expected(identifications, baseline))
    identifications = with_noise(identifications, noise)
    return Fit(
        identifications,
        noise,
        fit_identifications(identifications, noise),
        fit_expected(identifications, baseline),
    )


def worth(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    identifications: Identifications,
    first: Sequence[Fitted],
) -> dict[str, float]:
    """What the effects gain on time that they were not fitted to, each by the views that can tell; the noise is fitted with them."""
    told, hopping = remove_telegraph_bias(identifications)
    judged, waving = without_waves(told)

    def trained(chosen: Identifications, known: NDArray[np.bool_]) -> xr.Dataset:
        own = recalibrate(chosen, baseline, first, known)
        return predicted(with_noise(chosen, own), own, known)

    components = [
        component for identification in told.identified for component in identification.components
    ]
    odd = sum(
        component.evidence_nats
        for component in components
        if component.candidate.statistic == "marks"
    )  # no other number has them
    clean = mask_anomalous_blocks(
        blocks,
        [
            *components,
            *(
                component
                for identification in told.expected
                for component in identification.components
            ),
        ],
    )
    start = partial(expected_baseline, told, baseline) if told.expected else baseline
    whole, rest = (partial(trained, one) if one.identified else start for one in (told, judged))
    later = tuple(
        identification
        for identification in judged.identified
        if _can_be_forecast(identification, blocks)
    )
    forecast = partial(trained, replace(judged, identified=later)) if later else start
    found = held_out(
        clean,
        start,
        rest,
        more_gain=odd + hopping + waving,
        shown=whole if waving else None,
        forecast=forecast,
    )
    return found if later or not told.identified else found | {"forecast_gain": np.nan}


def _can_be_forecast(identification: Identification, blocks: xr.Dataset) -> bool:
    """Return whether an effect acts both in the time that a forecast is fitted to and in the time that it predicts.

    The size of an event in the last part is not known before, and one that is over says nothing of
    later. Counts of odd samples are in neither means nor powers, which the forecast predicts.
    """
    if {component.candidate.statistic for component in identification.components} <= {"marks"}:
        return False
    acts, known = active_spans(identification, blocks), forecast_from(blocks)
    return bool(acts[known].any() and acts[~known].any())


def _mismatches(
    task: Task, compared: Compared, fit: Fit, after: xr.Dataset
) -> list[dict[str, Any]]:
    """Places beyond chance and those of what was named, each with the effects that explain it."""
    blocks, found, identified = compared.blocks, compared.found, fit.identifications.identified

    def without(left_out: Sequence[Identification]) -> xr.Dataset:
        return predicted(fit.identifications, fit.noise, left_out=left_out)

    lines = (
        still_lines(task, blocks, after)
        if identified and (found["view"] == "spectrum").any()
        else None
    )
    explained = attribute_mismatches(
        found,
        identified,
        blocks,
        after,
        compared.null,
        level=task.level / 2.0,
        without=without,
        still=lines,
    )
    mismatches = mismatch_tables(found, blocks, explained)
    mismatches += identification_tables(fit.identifications, blocks, mismatches)
    mismatches += unidentified_tables(fit.identifications, blocks, mismatches)
    return mismatches + motion_tables(identified, blocks, mismatches)


def _surfaces(blocks: xr.Dataset, fit: Fit, before: xr.Dataset, after: xr.Dataset) -> xr.Dataset:
    """The recording beside the simulation without and with the effects, odd samples in both of them as they are in the recording."""
    before = add_outlier_power(before, blocks, fit.expected)
    after = add_outlier_power(after, blocks, [*fit.expected, *fit.fitted])
    return surfaces_with_blocks(make_surfaces(blocks, before, after), blocks, before, after)
