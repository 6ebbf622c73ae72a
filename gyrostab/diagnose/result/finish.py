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
    naming : Naming
        With designs for the noise below.
    noise : xarray.Dataset
        The baseline with the noise as it is beside the effects.
    fitted, expected : list of Fitted
        Effects that the simulation lacks, and those that it has as well.
    """

    naming: Identifications
    noise: xr.Dataset
    fitted: list[Fitted]
    expected: list[Fitted]


def finish_diagnosis(task: Task, compared: Compared, begun: float) -> Diagnosis:
    """Fit what was named, see what it is worth and what is left, and put it all into one result."""
    reduced, baseline = compared.reduced, compared.baseline
    naming, first, fit = fit_supported(compared.naming, baseline)
    before = expected_baseline(fit.naming, baseline)
    after = predicted(fit.naming, fit.noise) if naming.claims else before
    mismatches = _mismatches(task, compared, fit, after)
    unexplained = [box["id"] for box in mismatches if not box["explained_by"]]
    held = worth(reduced, baseline, naming, first)
    content = {
        "schema": SCHEMA,
        "recording": recording_table(reduced),
        "baseline": baseline_table(baseline, fit.expected),
        "verdict": decide_verdict(mismatches, fit.naming.claims, unexplained, held),
        "false_alarm_level": task.level,
        "mismatches": mismatches,
        "effects": effect_tables(fit.fitted, reduced),
        "unexplained": unexplained,
        "not_found": limit_tables(find_upper_limits(fit.naming)),
        "unused_channels": unused_channels(reduced, _used_channels(fit.naming)),
        "held_out": {name: held[name] for name in HELD_OUT},
        "seconds": round(time.perf_counter() - begun, 3),
    }
    own = task.given if isinstance(task.given, Model) else None
    diagnosis = Diagnosis(
        plain(content),
        _surfaces(reduced, fit, before, after),
        model_tables(fit.noise, fit.fitted, own),
    )
    check_diagnosis(diagnosis.content)
    return diagnosis


def _used_channels(naming: Identifications) -> set[str]:
    """Channels that some effect could follow, or was compared with."""
    return {name for one in naming.candidates for name in (*one.driver, *one.witness)}


def fit_supported(
    naming: Identifications, baseline: xr.Dataset
) -> tuple[Identifications, list[Fitted], Fit]:
    """Fit the effects until each that is left has a size away from zero.

    Returns
    -------
    naming : Naming
        Without the effects whose size may be zero.
    first : list of Fitted
        Their numbers beside the noise of `baseline`.
    fit : Fit
        Their numbers beside the noise that they leave.
    """
    while True:
        first = fit_identifications(naming, baseline)
        fit = fitted_beside_their_noise(naming, baseline, first)
        numbers = [[one for one in fit.fitted if one.claim is claim] for claim in fit.naming.claims]
        kept = keep_supported(naming, numbers)
        if kept is naming:
            return naming, first, fit
        naming = kept


def fitted_beside_their_noise(
    naming: Identifications, baseline: xr.Dataset, first: list[Fitted]
) -> Fit:
    """Calibrate the noise beside the effects as they were fitted `first`, and fit them once more to what is left."""
    noise = recalibrate(naming, baseline, first)
    if noise is baseline:
        return Fit(naming, baseline, first, fit_expected(naming, baseline))
    naming = with_noise(naming, noise)
    return Fit(naming, noise, fit_identifications(naming, noise), fit_expected(naming, baseline))


def worth(
    reduced: xr.Dataset, baseline: xr.Dataset, naming: Identifications, first: Sequence[Fitted]
) -> dict[str, float]:
    """What the effects gain on time that they were not fitted to, each by the views that can tell; the noise is fitted with them."""
    told, hopping = remove_telegraph_bias(naming)
    judged, waving = without_waves(told)

    def trained(chosen: Identifications, known: NDArray[np.bool_]) -> xr.Dataset:
        own = recalibrate(chosen, baseline, first, known)
        return predicted(with_noise(chosen, own), own, known)

    parts = [part for claim in told.claims for part in claim.parts]
    odd = sum(
        part.gain for part in parts if part.candidate.view == "marks"
    )  # no other number has them
    clean = mask_anomalous_blocks(
        reduced, [*parts, *(part for claim in told.expected for part in claim.parts)]
    )
    start = partial(expected_baseline, told, baseline) if told.expected else baseline
    whole, rest = (partial(trained, one) if one.claims else start for one in (told, judged))
    later = tuple(claim for claim in judged.claims if _can_be_forecast(claim, reduced))
    forecast = partial(trained, replace(judged, claims=later)) if later else start
    found = held_out(
        clean,
        start,
        rest,
        more_gain=odd + hopping + waving,
        shown=whole if waving else None,
        forecast=forecast,
    )
    return found if later or not told.claims else found | {"forecast_gain": np.nan}


def _can_be_forecast(claim: Identification, reduced: xr.Dataset) -> bool:
    """Return whether an effect acts both in the time that a forecast is fitted to and in the time that it predicts.

    The size of an event in the last part is not known before, and one that is over says nothing of
    later. Counts of odd samples are in neither means nor powers, which the forecast predicts.
    """
    if {part.candidate.view for part in claim.parts} <= {"marks"}:
        return False
    acts, known = active_spans(claim, reduced), forecast_from(reduced)
    return bool(acts[known].any() and acts[~known].any())


def _mismatches(
    task: Task, compared: Compared, fit: Fit, after: xr.Dataset
) -> list[dict[str, Any]]:
    """Places beyond chance and those of what was named, each with the effects that explain it."""
    reduced, found, claims = compared.reduced, compared.found, fit.naming.claims

    def without(left_out: Sequence[Identification]) -> xr.Dataset:
        return predicted(fit.naming, fit.noise, left_out=left_out)

    lines = (
        still_lines(task, reduced, after)
        if claims and (found["view"] == "spectrum").any()
        else None
    )
    explained = attribute_mismatches(
        found,
        claims,
        reduced,
        after,
        compared.null,
        level=task.level / 2.0,
        without=without,
        still=lines,
    )
    mismatches = mismatch_tables(found, reduced, explained)
    mismatches += identification_tables(fit.naming, reduced, mismatches)
    mismatches += unidentified_tables(fit.naming, reduced, mismatches)
    return mismatches + motion_tables(claims, reduced, mismatches)


def _surfaces(reduced: xr.Dataset, fit: Fit, before: xr.Dataset, after: xr.Dataset) -> xr.Dataset:
    """The recording beside the simulation without and with the effects, odd samples in both of them as they are in the recording."""
    before = add_outlier_power(before, reduced, fit.expected)
    after = add_outlier_power(after, reduced, [*fit.expected, *fit.fitted])
    return surfaces_with_blocks(make_surfaces(reduced, before, after), reduced, before, after)
