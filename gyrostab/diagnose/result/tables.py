"""Build the tables of `diagnosis.json` from the results of the steps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.constant_rate import constant_rates, noise_lost_by_truncation
from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.estimate.upper_limits import UpperLimit
from gyrostab.diagnose.identify.components import are_lines
from gyrostab.diagnose.identify.forward_search import MIN_P_VALUE, tail_probability
from gyrostab.diagnose.identify.identification import Identification, Identifications, Unidentified
from gyrostab.diagnose.identify.nuisance_alternatives import NUISANCE_ALTERNATIVES
from gyrostab.diagnose.predict.windows import channel_units, make_windows
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.result.attribution import active_blocks, join_blocks
from gyrostab.diagnose.result.diagnosis import effect_table
from gyrostab.diagnose.result.families import find_families, group_unrelated
from gyrostab.diagnose.result.probability import name_probability
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
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.wording import axes_text
from gyrostab.noise import LAWS
from gyrostab.physics.base import Effect
from gyrostab.simulate.model import Model
from gyrostab.units import HOUR
from gyrostab.wording import join_words

__all__ = [
    "baseline_table",
    "effect_tables",
    "identified_mismatches",
    "iso",
    "limit_tables",
    "mismatch_tables",
    "model_tables",
    "motion_mismatches",
    "recording_table",
    "rejected_tables",
    "surfaces_with_blocks",
    "unidentified_mismatches",
]

Array = NDArray[np.float64]
#: Samples of an instrument that is "much faster than the log" (`instrument = 0`): a low-pass of the
#: instrument is then resolved in the samples of the log.
FAST_INSTRUMENT_SAMPLES = 16
#: Nuisance alternative -> `view` in `diagnosis.json`.
_NUISANCE_VIEWS = {
    "~bias(t)": "mean", "~levels": "mean", "~red": "mean", "~N(t)": "davar", "~burst": "davar",
    "~S(f)": "davar", "~cov": "cross_axis", "~outliers": "distribution",
}  # fmt: skip
MAX_LINES = 4000  # bins of the line spectrum in `diagnosis.nc`: enough for a page, small on disk


def iso(blocks: xr.Dataset, seconds: float) -> str:
    """Write a time [s since the start of the record] as ISO 8601."""
    start = np.datetime64(int(blocks.attrs["start_ns"]), "ns")
    return f"{(start + np.timedelta64(round(seconds * 1e9), 'ns')).astype('datetime64[ms]')}Z"


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
    for axis in baseline["axis"].values:
        noise[str(axis)] = {}
        for term in baseline["term"].values:
            value, error = (
                float(baseline[name].sel(axis=axis, term=term))
                for name in ("coefficient", "stderr")
            )
            noise[str(axis)][str(term)] = {
                "value": value,
                "stderr": error if math.isfinite(error) else None,
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


def _mismatch(
    blocks: xr.Dataset,
    view: str,
    axes: Sequence[str],
    span: tuple[float, float],
    taus: tuple[float, float],
    p_value: float,
    statement: str,
    *,
    ratio: float | None = None,
    explained_by: Sequence[str] = (),
) -> dict[str, Any]:
    """Return a mismatch as a table, without its id; span and averaging times in s."""
    return {
        "view": view,
        "axes": list(axes),
        "start": iso(blocks, span[0]),
        "end": iso(blocks, span[1]),
        "tau_min_s": taus[0],
        "tau_max_s": taus[1],
        "ratio": ratio,
        "p_value": p_value,
        "explained_by": list(explained_by),
        "statement": statement,
    }


def mismatch_tables(
    located: xr.Dataset,
    explained: Sequence[Sequence[str]],
    identifications: Identifications,
    blocks: xr.Dataset,
    *,
    settings: Settings = DEFAULTS,
) -> list[dict[str, Any]]:
    """Return the mismatches that were located, identified or left out, each with its sentence."""
    out = _located_mismatches(located, blocks, explained)
    out += identified_mismatches(identifications, blocks, out, settings=settings)
    out += unidentified_mismatches(identifications, blocks, out)
    out += motion_mismatches(identifications.identified, blocks)
    return [{"id": number, **table} for number, table in enumerate(out, start=1)]


def _located_mismatches(
    mismatches: xr.Dataset, blocks: xr.Dataset, explained: Sequence[Sequence[str]]
) -> list[dict[str, Any]]:
    """Return the located mismatches."""
    record_s = float(blocks["end"].values[-1])
    out = []
    for number, names in enumerate(explained):
        region = {
            str(name): mismatches[name].values[number].item()
            for name in mismatches.data_vars
            if mismatches[name].dtype.kind != "M"
        }
        region["axes"] = str(region["axes"]).split()
        out.append(
            _mismatch(
                blocks,
                region["view"],
                region["axes"],
                (region["begin"], region["end"]),
                (region["tau_min_s"], region["tau_max_s"]),
                region["p_value"],
                mismatch_statement(region, record_s),
                ratio=region["ratio"],
                explained_by=names,
            )
        )
    return out


def identified_mismatches(
    identifications: Identifications,
    blocks: xr.Dataset,
    known: Sequence[Mapping[str, Any]],
    *,
    settings: Settings = DEFAULTS,
) -> list[dict[str, Any]]:
    """Return mismatches that only the identification shows.

    These are the places of named effects that explain no other mismatch. The statistic of the
    strongest component describes them.
    """
    out: list[dict[str, Any]] = []
    begin, end = blocks["begin"].values, blocks["end"].values
    for identification in identifications.identified:
        if any(
            identification.effect in region["explained_by"]
            and set(region["axes"]) & set(identification.axes)
            for region in known
        ):
            continue
        strongest = max(identification.components, key=lambda component: component.evidence_nats)
        view = strongest.statistic.view
        taus = strongest.statistic.averaging_times(strongest, blocks)
        p_value = tail_probability(
            identifications.null_best, identification.evidence_nats, settings=settings
        )
        for span in join_blocks(
            active_blocks(identification, blocks, settings=settings), begin, end
        ):
            text = named_statement(
                view,
                identification.effect,
                identification.axes,
                span_text(*span, float(end[-1])),
                p_value,
            )
            out.append(
                _mismatch(
                    blocks,
                    view,
                    identification.axes,
                    span,
                    taus,
                    p_value,
                    text,
                    explained_by=[identification.effect],
                )
            )
    return out


def unidentified_mismatches(
    identifications: Identifications, blocks: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return mismatches without an effect, where no other unexplained mismatch covers them."""
    out: list[dict[str, Any]] = []
    rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
    longest = float(blocks["end"].values[-1]) / 2.0
    for unidentified in identifications.unknown:
        view = _NUISANCE_VIEWS.get(unidentified.generic, "davar")
        if any(
            region["view"] == view
            and set(region["axes"]) & set(unidentified.axes)
            and not region["explained_by"]
            for region in known
        ):
            continue
        p_value = tail_probability(
            identifications.null_best,
            unidentified.evidence_nats,
            settings=identifications.state.settings,
        )
        nearest = unidentified.candidates
        verb = "comes" if len(nearest) == 1 else "come"
        explanation = (
            f"{join_words([plain_name(name) for name in nearest])} {verb} closest, but "
            "another form explains more"
            if nearest
            else "no known effect explains it"
        )
        description = NUISANCE_ALTERNATIVES.get(unidentified.generic, "something differs")
        begin, end, when = _find_event(unidentified, blocks)
        text = (
            f"On {axes_text(unidentified.axes)} {description}{when}; {explanation} "
            f"({chance(p_value)})."
        )
        taus = (block, longest) if view == "mean" else (1.0 / rate, block)
        out.append(_mismatch(blocks, view, unidentified.axes, (begin, end), taus, p_value, text))
    return out


def _find_event(unidentified: Unidentified, blocks: xr.Dataset) -> tuple[float, float, str]:
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


def motion_mismatches(
    identified: Sequence[Identification], blocks: xr.Dataset
) -> list[dict[str, Any]]:
    """Return one mismatch for each axis with moving blocks that the comparison left out.

    It extends from the first of these blocks to the last.
    """
    if "moving" not in blocks:
        return []
    begin, end = blocks["begin"].values, blocks["end"].values
    means = measured(blocks, "mean").values
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
        out.append(_mismatch(blocks, "mean", [axis], (first, last), taus, MIN_P_VALUE, text))
    return out


def _axes_following(axis: str, identified: Sequence[Identification]) -> list[str]:
    """Return the axes that sense the rate of `axis` through their misalignment."""
    components = [
        component
        for identification in identified
        if identification.effect == "misalignment"
        for component in identification.components
    ]
    return sorted(
        {
            name
            for component in components
            if axis in (*component.variant.columns, *component.candidate.reference)
            for name in component.row
        }
    )


def effect_tables(
    fitted: Sequence[Fitted], blocks: xr.Dataset, *, settings: Settings = DEFAULTS
) -> list[dict[str, Any]]:
    """Return the named effects, the strongest first.

    An effect with different sizes on several axes is one identification in as many tables, each
    with the evidence of the whole identification, because that passed the threshold. The standard
    error of a held-out gain is that of a log-likelihood ratio under the right model: sqrt(2 gain).
    """
    begin, end = blocks["begin"].values, blocks["end"].values
    out = []
    for fitted_effect, family in zip(fitted, _families_of(fitted, blocks), strict=True):
        identification = fitted_effect.identification
        components = fitted_effect.components or identification.components
        acting = active_blocks(
            replace(identification, components=components), blocks, settings=settings
        )
        when = join_blocks(acting, begin, end)
        record_s = float(end[-1])
        out.append(
            {
                "name": identification.effect,
                "axes": list(fitted_effect.axes),
                "driver": ",".join(filter(None, identification.driver)) or None,
                "intervals": [[iso(blocks, low), iso(blocks, high)] for low, high in when],
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
                    if when == [(float(begin[0]), record_s)]
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
        frequencies = [fitted[number].parameters["frequency"].value for number in lines]
        labels = find_families(
            frequencies,
            resolution=float(np.diff(blocks["line_frequency"].values[:2])[0]),
            bandwidth=0.5 * float(blocks.attrs["sampling_rate_hz"]),
        )
        for number, family in zip(lines, group_unrelated(labels), strict=True):
            families[number] = family
    return families


def limit_tables(limits: Mapping[str, UpperLimit]) -> dict[str, Any]:
    """Return the upper limit of each effect that was not found, and why it was not."""
    return {
        name: {"upper_limit": limit.upper_limit, "unit": limit.unit, "reason": limit.reason}
        for name, limit in limits.items()
    }


def rejected_tables(identifications: Identifications) -> list[dict[str, Any]]:
    """Return what beats each effect that was examined and not named, the closest first."""
    named = {identification.effect for identification in identifications.identified}
    return [
        {
            "name": rejection.effect,
            "axes": list(rejection.axes),
            "beaten_by": rejection.beaten_by,
            "nats": rejection.nats,
        }
        for rejection in sorted(
            identifications.rejected, key=lambda rejection: (rejection.nats, rejection.effect)
        )
        if rejection.effect not in named
    ]


def model_tables(
    baseline: xr.Dataset,
    fitted: Sequence[Fitted],
    own: Model | None,
    blocks: xr.Dataset,
    turning: str = "",
) -> dict[str, Any]:
    """Return the tables of the model with the effects added.

    Parameters
    ----------
    own : Model or None
        The model that was given.
    turning : str
        Axis that feels the channel ``rotation_rate``, if any.
    """
    noise = {
        str(axis): {
            str(term): float(f"{float(baseline['coefficient'].sel(axis=axis, term=term)):.6g}")
            for term in baseline["term"].values
        }
        for axis in baseline["axis"].values
    }
    given_effects = list(own.effects) if own is not None else []
    added_effects = [
        fitted_effect.effect for fitted_effect in fitted if fitted_effect.effect is not None
    ]
    if baseline.attrs.get("source") == "calibrated":
        rate = float(blocks.attrs["sampling_rate_hz"])
        for axis, variance in noise_lost_by_truncation(blocks, added_effects).items():
            square = max(noise[axis]["N"] ** 2 + variance / (HOUR * rate), 0.0)
            noise[axis]["N"] = float(f"{math.sqrt(square):.6g}")
    instrument = max(
        [
            int(own.log.get("oversampling", 1)) if own is not None else 1,
            *map(_instrument_samples, added_effects),
        ]
    )
    log = {"log": {"oversampling": instrument}} if instrument > 1 else {}
    rates = constant_rates(blocks, [*given_effects, *added_effects], turning)
    return {
        **log,
        "noise": noise,
        "bias": {axis: float(f"{rate:.6g}") for axis, rate in rates.items()},
        "effect": [effect_table(effect) for effect in [*given_effects, *added_effects]],
    }


def _instrument_samples(effect: Effect) -> int:
    """Return the instrument samples per log sample that an effect needs.

    A filter runs at the rate of the instrument.
    """
    return int(getattr(effect, "instrument", 1)) or FAST_INSTRUMENT_SAMPLES


def surfaces_with_blocks(
    surfaces: xr.Dataset, blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset
) -> xr.Dataset:
    """Add block means, channels and spectra of the whole record to the surfaces, for the report."""
    power = "degree2 hour-2 s"
    channels = {
        str(name): blocks[name] for name in blocks.data_vars if str(name).startswith("channel_")
    }
    with np.errstate(invalid="ignore"):
        cases = [blocks["power"], before["spectrum"], after["spectrum"]]
        has_data = np.isfinite(blocks["power"].values)
        density = np.stack([_average_where(case.values, has_data) for case in cases])
        lines = blocks["line_power"].weighted(blocks["line_weight"].fillna(0.0)).mean("part")
    step = max(1, lines.sizes["line"] // MAX_LINES)
    lines = lines.coarsen(line=step, boundary="trim").max() if step > 1 else lines
    frequency = (
        blocks["line_frequency"].coarsen(line=step, boundary="trim").mean()
        if step > 1
        else blocks["line_frequency"]
    )
    added = xr.Dataset(
        {
            "block_mean": (("axis", "block"), blocks["mean"].values, dict(blocks["mean"].attrs)),
            "density": (
                ("case", "axis", "band"),
                density,
                {"units": power, "long_name": "two-sided power density of the record"},
            ),
            "line_density": (
                ("axis", "line"),
                lines.values,
                {
                    "units": power,
                    "long_name": "two-sided power density of the recording at full resolution",
                },
            ),
            **{
                name: ("block", values.values, dict(values.attrs))
                for name, values in channels.items()
            },
        },
        coords={
            "block_begin": ("block", blocks["begin"].values, dict(blocks["begin"].attrs)),
            "block_end": ("block", blocks["end"].values, dict(blocks["end"].attrs)),
            "frequency": ("band", blocks["frequency"].values, dict(blocks["frequency"].attrs)),
            "line_frequency": ("line", frequency.values, dict(blocks["line_frequency"].attrs)),
        },
    )
    return surfaces.merge(added, compat="no_conflicts", join="exact")


def _average_where(values: Array, has_data: NDArray[np.bool_]) -> Array:
    count = has_data.sum(axis=1)
    return np.asarray(
        np.divide(
            np.where(has_data, values, 0.0).sum(axis=1),
            count,
            out=np.full(count.shape, np.nan),
            where=count > 0,
        )
    )
