"""Build the tables of `diagnosis.json` from the results of the steps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.estimate.constant_rate import (
    constant_rates,
    fit_white_noise,
    undo_noise_loss,
)
from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.identify.components import are_lines
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection, components_of
from gyrostab.diagnose.nulls.scores import MIN_P_VALUE, fit_best_evidence
from gyrostab.diagnose.predict.candidates import NUISANCE_ALTERNATIVES
from gyrostab.diagnose.predict.windows import channel_units, make_windows
from gyrostab.diagnose.reduce.schema import format_time, read_as_measured
from gyrostab.diagnose.result.active_spans import active_spans
from gyrostab.diagnose.result.diagnosis import tabulate_effect
from gyrostab.diagnose.result.families import find_families
from gyrostab.diagnose.result.text import (
    chance,
    effect_statement,
    mismatch_statement,
    motion_statement,
    named_statement,
    plain_name,
    span_text,
    unsized_statement,
)
from gyrostab.diagnose.result.verdict import name_probability
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.base import Region
from gyrostab.diagnose.statistics.mismatch_wording import axes_text
from gyrostab.diagnose.statistics.sample_counts import mask_anomalous_blocks
from gyrostab.noise import LAWS
from gyrostab.physics.base import Effect
from gyrostab.physics.sampling import FAST_INSTRUMENT_SAMPLES, LoggerFilter
from gyrostab.simulate.model import Model
from gyrostab.wording import join_words


def recording_table(blocks: xr.Dataset) -> dict[str, Any]:
    """Describe the recording."""
    return {
        "files": [str(name) for name in blocks.attrs["source_files"]],
        "axes": [str(axis) for axis in blocks["axis"].values],
        "start": blocks.attrs["start"],
        "end": blocks.attrs["end"],
        "sampling_rate_hz": float(blocks.attrs["sampling_rate_hz"]),
        "channels": list(channel_units(blocks)),
        "missing_share": float(blocks.attrs["missing_share"]),
    }


def baseline_table(baseline: xr.Dataset, expected: Sequence[Fitted]) -> dict[str, Any]:
    """Describe the noise compared with, and the effects of the simulation that fit it."""
    noise: dict[str, Any] = {}
    is_calibrated = baseline.attrs["source"] == "calibrated"
    for axis in baseline["axis"].values:
        noise[str(axis)] = {}
        for term in baseline["term"].values:
            value, error = (
                float(baseline[name].sel(axis=axis, term=term))
                for name in ("coefficient", "stderr")
            )
            noise[str(axis)][str(term)] = {
                "value": value,
                # a ramp is not calibrated: drift is a mismatch, which effects explain
                "stderr": None
                if not math.isfinite(error) or (is_calibrated and term == "R")
                else error,
                "unit": LAWS[str(term)].label,
            }
    spans = baseline.attrs.get("calibrated_on", [])
    expected_effects = [
        {
            "name": fitted_effect.identification.effect,
            "axes": list(fitted_effect.axes),
            "statement": fitted_effect.say()
            or unsized_statement(fitted_effect.identification.effect, fitted_effect.axes),
        }
        for fitted_effect in expected
    ]
    table = {
        "source": baseline.attrs["source"],
        "noise": noise,
        "calibrated_on": [list(span) for span in spans],
    }
    return {**table, "expected": expected_effects} if expected_effects else table


def effect_tables(
    fitted: Sequence[Fitted], blocks: xr.Dataset, *, settings: Settings = DEFAULTS
) -> list[dict[str, Any]]:
    """Return the named effects, the strongest first.

    An effect with different sizes on several axes is one identification in as many tables, each
    with the evidence of the whole identification, because that passed the threshold. The standard
    error of a held-out gain is that of a log-likelihood ratio under the right model: sqrt(2 gain).
    """
    record_s = float(blocks["end"].values[-1])
    whole = [(float(blocks["begin"].values[0]), record_s)]
    out = []
    for fitted_effect, family in zip(fitted, _families_of(fitted, blocks), strict=True):
        identification = fitted_effect.identification
        components = fitted_effect.components or identification.components
        acting = replace(identification, components=components)
        when = active_spans(acting, blocks, settings=settings)
        out.append(
            {
                "name": identification.effect,
                "axes": list(fitted_effect.axes),
                "driver": ",".join(filter(None, identification.driver)) or None,
                "intervals": [
                    [format_time(blocks, low), format_time(blocks, high)] for low, high in when
                ],
                "parameters": {
                    name: asdict(estimate) for name, estimate in fitted_effect.parameters.items()
                },
                "held_out_gain": {
                    "nats": identification.evidence_nats,
                    "stderr": math.sqrt(2.0 * max(identification.evidence_nats, 0.0)),
                    "threshold": identification.threshold,
                },
                "alternatives": list(identification.alternatives),
                "probability": round(name_probability(identification, settings=settings), 3),
                "family": family,
                "statement": effect_statement(
                    _describe_fitted(fitted_effect, blocks),
                    alternatives=identification.alternatives,
                    intervals=[]
                    if when == whole
                    else [span_text(*span, record_s) for span in when],
                ),
            }
        )
    return sorted(out, key=lambda table: -table["held_out_gain"]["nats"])


def _describe_fitted(fitted_effect: Fitted, blocks: xr.Dataset) -> str:
    """Describe a fitted effect by what the record determines of it."""
    text = ""
    if fitted_effect.effect is not None:
        drivers = {
            role: name
            for role, name in fitted_effect.effect.channel_names().items()
            if f"channel_{name}" in blocks
        }
        text = fitted_effect.say(make_windows(blocks, drivers))
    return text or unsized_statement(fitted_effect.identification.effect, fitted_effect.axes)


def _families_of(fitted: Sequence[Fitted], blocks: xr.Dataset) -> list[str | None]:
    """Return the family of each effect that is a line at a frequency; None for others."""
    lines = [
        number
        for number, fitted_effect in enumerate(fitted)
        if are_lines(fitted_effect.identification.components)
        and "frequency" in fitted_effect.parameters
    ]
    families: list[str | None] = [None] * len(fitted)
    if len(lines) > 1:
        frequencies = [fitted[number].parameters["frequency"] for number in lines]
        labels = find_families(
            [frequency.value for frequency in frequencies],
            resolution=[2.0 * frequency.stderr for frequency in frequencies],
            bandwidth=0.5 * float(blocks.attrs["sampling_rate_hz"]),
        )
        for number, family in zip(lines, labels, strict=True):
            families[number] = family
    return families


def model_tables(
    baseline: xr.Dataset,
    fitted: Sequence[Fitted],
    own: Model | None,
    blocks: xr.Dataset,
    turning: str = "",
    *,
    settings: Settings = DEFAULTS,
) -> dict[str, Any]:
    """Return the tables of the model with the effects added.

    `own` is the model that was given, `turning` the axis that feels the channel ``rotation_rate``.
    """
    noise = _noise_tables(baseline)
    given_effects = list(own.effects) if own is not None else []
    given_oversampling = int(own.log.get("oversampling", 1)) if own is not None else 1
    added_effects = [
        fitted_effect.effect for fitted_effect in fitted if fitted_effect.effect is not None
    ]
    if baseline.attrs.get("source") == "calibrated":
        noise = undo_noise_loss(noise, blocks, added_effects)
    instrument = _needed_oversampling(given_oversampling, added_effects)
    if instrument > given_oversampling:
        given_effects = [
            effect.at_oversampling(given_oversampling)
            if isinstance(effect, LoggerFilter)
            else effect
            for effect in given_effects
        ]
    log = {"log": {"oversampling": instrument}} if instrument > 1 else {}
    band = own.flicker_band if own is not None else Model.flicker_band
    flicker = {"flicker_band": list(band)} if band != Model.flicker_band else {}
    ramp = {axis: terms["R"] for axis, terms in noise.items()}
    rates = constant_rates(blocks, [*given_effects, *added_effects], turning, ramp)
    tables: dict[str, Any] = {
        **log,
        "noise": {**flicker, **noise},
        "bias": {axis: float(f"{rate:.6g}") for axis, rate in rates.items()},
        "delay": dict(blocks.attrs["channel_delays"]),
        "effect": [tabulate_effect(effect) for effect in [*given_effects, *added_effects]],
    }
    components = [component for effect_fit in fitted for component in effect_fit.components]
    with_power = {  # whose noise was calibrated together with the sizes of effects
        axis
        for component in components
        if component.statistic.is_power or component.statistic.is_pairwise
        for axis in component.row
    }.intersection(baseline.attrs.get("recalibrated", ()))
    if with_power:
        clean = mask_anomalous_blocks(blocks, components, settings)
        for axis, size in fit_white_noise(tables, baseline, clean, with_power).items():
            tables["noise"][axis]["N"] = float(f"{size:.6g}")
    return tables


def _noise_tables(baseline: xr.Dataset) -> dict[str, dict[str, float]]:
    """Return the noise coefficients of each axis, rounded as the model gives them."""
    return {
        str(axis): {
            str(term): float(f"{float(baseline['coefficient'].sel(axis=axis, term=term)):.6g}")
            for term in baseline["term"].values
        }
        for axis in baseline["axis"].values
    }


def _needed_oversampling(given: int, effects: Sequence[Effect]) -> int:
    """Return the samples of the instrument in one of the log, with these effects in the model."""
    # a filter runs at the rate of the instrument
    samples = (int(getattr(effect, "instrument", 1)) for effect in effects)
    return max([given, *(number or FAST_INSTRUMENT_SAMPLES for number in samples)])


def _make_mismatch(
    blocks: xr.Dataset,
    view: str,
    axes: Sequence[str],
    span: tuple[float, float],
    taus: tuple[float, float],
    p_value: float,
    statement: str,
    *,
    explained_by: Sequence[str] = (),
) -> dict[str, Any]:
    """Return a mismatch as a table, without its id; span and averaging times in s."""
    return {
        "view": view,
        "axes": list(axes),
        "start": format_time(blocks, span[0]),
        "end": format_time(blocks, span[1]),
        "tau_min_s": taus[0],
        "tau_max_s": taus[1],
        "ratio": None,
        "p_value": p_value,
        "explained_by": list(explained_by),
        "statement": statement,
    }


def mismatch_tables(
    located: Sequence[Region],
    explained: Sequence[Sequence[str]],
    identifications: Identifications,
    blocks: xr.Dataset,
) -> list[dict[str, Any]]:
    """Return the mismatches that were located, identified or left out, each with its sentence."""
    out = _located_mismatches(located, blocks, explained)
    out += identified_mismatches(identifications, blocks, out)
    out += unidentified_mismatches(identifications, blocks, out)
    out += motion_mismatches(identifications.identified, blocks)
    return [{"id": number, **table} for number, table in enumerate(out, start=1)]


def _located_mismatches(
    mismatches: Sequence[Region], blocks: xr.Dataset, explained: Sequence[Sequence[str]]
) -> list[dict[str, Any]]:
    record_s = float(blocks["end"].values[-1])
    out = []
    for region, names in zip(mismatches, explained, strict=True):
        axes = region["axes"].split()
        span, taus = ((region["begin"], region["end"]), (region["tau_min_s"], region["tau_max_s"]))
        text = mismatch_statement(region | {"axes": axes}, record_s)
        table = _make_mismatch(blocks, region["view"], axes, span, taus, region["p_value"], text)
        out.append(table | {"ratio": region["ratio"], "explained_by": list(names)})
    return out


def identified_mismatches(
    identifications: Identifications, blocks: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return mismatches that only the identification shows.

    These are the places of named effects that explain no other mismatch. The statistic of the
    strongest component describes them.
    """
    out: list[dict[str, Any]] = []
    record_s = float(blocks["end"].values[-1])
    settings = identifications.state.settings
    null = fit_best_evidence(identifications.examination.null_best, settings=settings)
    for identification in identifications.identified:
        if any(
            identification.effect in region["explained_by"]
            and set(region["axes"]) & set(identification.axes)
            for region in known
        ):
            continue
        strongest = max(identification.components, key=lambda component: component.evidence_nats)
        view, axes, names = strongest.statistic.view, identification.axes, [identification.effect]
        taus = strongest.statistic.averaging_times(strongest, blocks)
        p_value = float(null.probability(identification.evidence_nats))
        for span in active_spans(identification, blocks, settings=settings):
            when = span_text(*span, record_s)
            text = named_statement(view, identification.effect, axes, when, p_value)
            out.append(
                _make_mismatch(blocks, view, axes, span, taus, p_value, text, explained_by=names)
            )
    return out


def unidentified_mismatches(
    identifications: Identifications, blocks: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return mismatches without an effect, where no other unexplained mismatch covers them."""
    out: list[dict[str, Any]] = []
    rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
    longest = float(blocks["end"].values[-1]) / 2.0
    null = fit_best_evidence(
        identifications.examination.null_best, settings=identifications.state.settings
    )
    for unidentified in identifications.unidentified:
        view = unidentified.components[0].statistic.view
        if any(
            region["view"] == view
            and set(region["axes"]) & set(unidentified.axes)
            and not region["explained_by"]
            for region in known
        ):
            continue
        p_value = float(null.probability(unidentified.evidence_nats))
        nearest = unidentified.alternatives
        closest = "effect is" if len(nearest) == 1 else "effects are"
        explanation = (
            f"the closest known {closest} {join_words([plain_name(name) for name in nearest])}, "
            "but another form explains more"
            if nearest
            else "no known effect explains it"
        )
        description = NUISANCE_ALTERNATIVES[unidentified.effect]
        begin, end, when = _find_event(unidentified, blocks)
        text = (
            f"On {axes_text(unidentified.axes)} {description}{when}; {explanation} "
            f"({chance(p_value)})."
        )
        taus = (block, longest) if view == "mean" else (1.0 / rate, block)
        out.append(
            _make_mismatch(blocks, view, unidentified.axes, (begin, end), taus, p_value, text)
        )
    return out


def _find_event(unidentified: Selection, blocks: xr.Dataset) -> tuple[float, float, str]:
    """Return begin and end [s] of an unidentified event with their text, or the whole record."""
    record_s = float(blocks["end"].values[-1])
    spans = [
        (component.variant.values["begin"], component.variant.values["end"])
        for component in unidentified.components
        if "begin" in component.variant.values
    ]
    if not spans:
        return float(blocks["begin"].values[0]), record_s, ""
    begin, end = min(first for first, _ in spans), max(last for _, last in spans)
    return begin, end, f", {span_text(begin, end, record_s)}"


def motion_mismatches(identified: Sequence[Selection], blocks: xr.Dataset) -> list[dict[str, Any]]:
    """Return one mismatch for each axis with moving blocks that the comparison left out.

    It extends from the first of these blocks to the last.
    """
    if "moving" not in blocks:
        return []
    begin, end = blocks["begin"].values, blocks["end"].values
    means = read_as_measured(blocks, "mean").values
    out: list[dict[str, Any]] = []
    for row, axis in enumerate(map(str, blocks["axis"].values)):
        moving, mean = blocks["moving"].values[row], means[row]
        if not moving.any():
            continue
        first, last = float(begin[moving][0]), float(end[moving][-1])
        largest = float(np.nanmax(np.abs(mean - np.nanmedian(mean[~moving]))[moving]))
        followers = _axes_following(axis, identified)
        when = span_text(first, last, float(end[-1]))
        text = motion_statement(axis, when, largest, followers)
        taus = (
            1.0 / float(blocks.attrs["sampling_rate_hz"]),
            max((last - first) / 2.0, float(blocks.attrs["block_s"])),
        )
        out.append(_make_mismatch(blocks, "mean", [axis], (first, last), taus, MIN_P_VALUE, text))
    return out


def _axes_following(axis: str, identified: Sequence[Selection]) -> list[str]:
    """Return the axes that sense the rate of `axis` through their misalignment."""
    misaligned = [selection for selection in identified if selection.effect == "misalignment"]
    return sorted(
        {
            name
            for component in components_of(misaligned)
            if axis in (*component.variant.columns, *component.candidate.reference)
            for name in component.row
        }
    )
