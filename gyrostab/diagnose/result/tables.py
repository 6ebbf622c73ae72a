"""The tables of `diagnosis.json` from what the steps of a diagnosis found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.estimate.upper_limits import UpperLimit
from gyrostab.diagnose.identify.forward_search import Identification, Identifications, Unidentified
from gyrostab.diagnose.predict.condition import Component
from gyrostab.diagnose.predict.nuisance import NUISANCE_ALTERNATIVES
from gyrostab.diagnose.reduce.block_statistics import measured
from gyrostab.diagnose.result.attribution import active_spans, spans
from gyrostab.diagnose.result.diagnosis import effect_table
from gyrostab.diagnose.result.text import (
    axes_text,
    chance,
    effect_statement,
    mismatch_statement,
    motion_statement,
    named_statement,
    plain_name,
    span_text,
    unsized_statement,
)
from gyrostab.noise import LAWS
from gyrostab.physics.base import Effect
from gyrostab.simulate.model import Model

__all__ = [
    "baseline_table",
    "chance_of_gain",
    "effect_tables",
    "identification_tables",
    "iso",
    "limit_tables",
    "mismatch_tables",
    "model_tables",
    "motion_tables",
    "recording_table",
    "surfaces_with_blocks",
    "unidentified_tables",
]

Array = NDArray[np.float64]
_TAIL = 0.25
_LEAST_P = 1e-12
_FAST = 16  # samples of an instrument that is much faster than the log
#: Generic -> view in which it is told.
_GENERIC_VIEW = {
    "~bias(t)": "mean", "~red": "mean", "~N(t)": "davar", "~burst": "davar", "~S(f)": "davar", "~cov": "cross_axis",
    "~outliers": "distribution",
}  # fmt: skip
#: Where an effect shows -> view in which it is told.
_PART_VIEW = {
    "mean": "mean", "wander": "mean", "levels": "mean", "power": "davar", "transfer": "davar", "cross": "cross_axis",
    "marks": "distribution", "line": "spectrum", "order": "spectrum", "phase_locked": "spectrum",
}  # fmt: skip
_BUMP = 0.371  # averaging time times frequency where the Allan variance of a sine is largest
_MOST_LINES = 4000


def iso(blocks: xr.Dataset, seconds: float) -> str:
    """Time [s since the start of the record] as ISO 8601."""
    start = np.datetime64(int(blocks.attrs["start_ns"]), "ns")
    return f"{(start + np.timedelta64(round(seconds * 1e9), 'ns')).astype('datetime64[ms]')}Z"


def recording_table(blocks: xr.Dataset) -> dict[str, Any]:
    """What the recording is."""
    channels = [
        str(name).removeprefix("channel_")
        for name in blocks.data_vars
        if str(name).startswith("channel_")
    ]
    return {
        "files": [str(name) for name in blocks.attrs["source_files"]],
        "axes": [str(axis) for axis in blocks["axis"].values],
        "start": blocks.attrs["start"],
        "end": blocks.attrs["end"],
        "sampling_rate_hz": float(blocks.attrs["sampling_rate_hz"]),
        "channels": channels,
        "missing_share": float(blocks.attrs["missing_share"]),
    }


def baseline_table(baseline: xr.Dataset, expected: Sequence[Fitted]) -> dict[str, Any]:
    """The noise that the recording is compared with, and the effects of the simulation that have the size which the recording shows."""
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
    known = [
        {
            "name": one.identification.effect,
            "axes": list(one.axes),
            "statement": one.say() or unsized_statement(one.identification.effect, one.axes),
        }
        for one in expected
    ]
    table = {
        "source": baseline.attrs["source"],
        "noise": noise,
        "calibrated_on": [list(span) for span in spans],
    }
    return {**table, "expected": known} if known else table


def mismatch_tables(
    found: xr.Dataset, blocks: xr.Dataset, explained: Sequence[Sequence[str]]
) -> list[dict[str, Any]]:
    """The mismatches, each with its sentence."""
    whole = float(blocks["end"].values[-1])
    out = []
    for number, names in enumerate(explained):
        region = {
            str(name): found[name].values[number].item()
            for name in found.data_vars
            if found[name].dtype.kind != "M"
        }
        region["axes"] = str(region["axes"]).split()
        out.append(
            {
                "id": number + 1,
                "view": region["view"],
                "axes": region["axes"],
                "start": iso(blocks, region["begin"]),
                "end": iso(blocks, region["end"]),
                "tau_min_s": region["tau_min_s"],
                "tau_max_s": region["tau_max_s"],
                "ratio": region["ratio"],
                "p_value": region["p_value"],
                "explained_by": list(names),
                "statement": mismatch_statement(region, whole),
            }
        )
    return out


def chance_of_gain(best: Array, evidence_nats: float) -> float:
    """Share of null records whose largest gain is `evidence_nats` or more; by an exponential tail beyond their upper quarter."""
    start = float(np.quantile(best, 1.0 - _TAIL))
    if evidence_nats <= start:
        return float((best >= evidence_nats).mean())
    scale = max(float((best[best > start] - start).mean()), 0.1)
    return max(_TAIL * math.exp(-(evidence_nats - start) / scale), _LEAST_P)


def identification_tables(
    identifications: Identifications, blocks: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Mismatches that only naming saw: where a named effect acts that explains none of those known, by its strongest part."""
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
        statistic = _PART_VIEW.get(strongest.candidate.statistic, "davar")
        low, high = _taus(strongest, statistic, blocks)
        p_value = chance_of_gain(identifications.null_best, identification.evidence_nats)
        for first, last in spans(active_spans(identification, blocks), begin, end):
            when = span_text(first, last, float(end[-1]))
            out.append(
                {
                    "id": len(known) + len(out) + 1,
                    "view": statistic,
                    "axes": list(identification.axes),
                    "start": iso(blocks, first),
                    "end": iso(blocks, last),
                    "tau_min_s": low,
                    "tau_max_s": high,
                    "ratio": None,
                    "p_value": p_value,
                    "explained_by": [identification.effect],
                    "statement": named_statement(
                        statistic, identification.effect, identification.axes, when, p_value
                    ),
                }
            )
    return out


def _taus(component: Component, statistic: str, blocks: xr.Dataset) -> tuple[float, float]:
    """Averaging times [s] at which a part of an effect shows: those of its line, of block means, or those within a block."""
    block, whole = float(blocks.attrs["block_s"]), float(blocks["end"].values[-1])
    if component.candidate.statistic == "line" and component.place >= 0:
        tau = _BUMP / float(blocks["line_frequency"].values[component.place])
        return tau, tau
    if statistic == "mean":
        return block, whole / 2.0
    return 1.0 / float(blocks.attrs["sampling_rate_hz"]), block


def unidentified_tables(
    identifications: Identifications, blocks: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Mismatches that only naming saw: what no effect explains, where no box that is left says so already."""
    out: list[dict[str, Any]] = []
    for one in identifications.unknown:
        statistic = _GENERIC_VIEW.get(one.generic, "davar")
        told = any(
            region["view"] == statistic
            and set(region["axes"]) & set(one.axes)
            and not region["explained_by"]
            for region in known
        )
        if not told:
            out.append(
                _unknown_table(one, identifications, blocks, len(known) + len(out) + 1, statistic)
            )
    return out


def _unknown_table(
    one: Unidentified,
    identifications: Identifications,
    blocks: xr.Dataset,
    number: int,
    statistic: str,
) -> dict[str, Any]:
    p_value = chance_of_gain(identifications.null_best, one.evidence_nats)
    near = ", ".join(plain_name(name) for name in one.candidates)
    beside = f"; what comes nearest: {near}" if near else ""
    means, what = statistic == "mean", NUISANCE_ALTERNATIVES.get(one.generic, "something differs")
    rate, block = float(blocks.attrs["sampling_rate_hz"]), float(blocks.attrs["block_s"])
    begin, end, when = _when(one, blocks)
    return {
        "id": number,
        "view": statistic,
        "axes": list(one.axes),
        "start": iso(blocks, begin),
        "end": iso(blocks, end),
        "tau_min_s": block if means else 1.0 / rate,
        "tau_max_s": float(blocks["end"].values[-1]) / 2.0 if means else block,
        "ratio": None,
        "p_value": p_value,
        "explained_by": [],
        "statement": f"On {axes_text(one.axes)} {what}{when}, and no known effect says why{beside} ({chance(p_value)}).",
    }


def _when(one: Unidentified, blocks: xr.Dataset) -> tuple[float, float, str]:
    """Begin and end of what has no name [s], with words for an event; else the whole record."""
    whole = float(blocks["end"].values[-1])
    found = [
        (component.variant.values["begin"], component.variant.values["end"])
        for component in one.components
        if "begin" in component.variant.values
    ]
    if not found:
        return float(blocks["begin"].values[0]), whole, ""
    begin, end = min(first for first, _ in found), max(last for _, last in found)
    return begin, end, f", {span_text(begin, end, whole)}"


def motion_tables(
    identified: Sequence[Identification], blocks: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """One mismatch for every axis whose moving stretches were left out of the comparison, from the first of them to the last."""
    if "moving" not in blocks:
        return []
    begin, end, block = (
        blocks["begin"].values,
        blocks["end"].values,
        float(blocks.attrs["block_s"]),
    )
    out: list[dict[str, Any]] = []
    for axis, moving, mean in zip(
        map(str, blocks["axis"].values),
        blocks["moving"].values,
        measured(blocks, "mean").values,
        strict=True,
    ):
        if not moving.any():
            continue
        first, last = (float(edge) for edge in (begin[moving][0], end[moving][-1]))
        largest = float(np.nanmax(np.abs(mean - np.nanmedian(mean[~moving]))[moving]))
        out.append(
            {
                "id": len(known) + len(out) + 1,
                "view": "mean",
                "axes": [axis],
                "start": iso(blocks, first),
                "end": iso(blocks, last),
                "tau_min_s": 1.0 / float(blocks.attrs["sampling_rate_hz"]),
                "tau_max_s": max((last - first) / 2.0, block),
                "ratio": None,
                "p_value": _LEAST_P,
                "explained_by": [],
                "statement": motion_statement(
                    axis,
                    span_text(first, last, float(end[-1])),
                    largest,
                    _followers(axis, identified),
                ),
            }
        )
    return out


def _followers(axis: str, identified: Sequence[Identification]) -> list[str]:
    """Axes on which the rate of an axis is seen through a lean of theirs."""
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
            if axis in (*component.variant.columns, *component.candidate.witness)
            for name in component.row
        }
    )


def effect_tables(fitted: Sequence[Fitted], blocks: xr.Dataset) -> list[dict[str, Any]]:
    """The named effects, the strongest first.

    An effect with different numbers on several axes is one claim in as many tables, each with the
    gain of the claim, which is what passed the threshold. The standard error of a held-out gain is
    the one that the logarithm of a likelihood ratio has where the model is right: the root of twice
    the gain.
    """
    begin, end = blocks["begin"].values, blocks["end"].values
    out = []
    for one in fitted:
        identification = one.identification
        when = spans(active_spans(identification, blocks), begin, end)
        whole = float(end[-1])
        out.append(
            {
                "name": identification.effect,
                "axes": list(one.axes),
                "driver": ",".join(filter(None, identification.driver)) or None,
                "intervals": [[iso(blocks, low), iso(blocks, high)] for low, high in when],
                "parameters": {name: asdict(estimate) for name, estimate in one.parameters.items()},
                "held_out_gain": {
                    "nats": identification.evidence_nats,
                    "stderr": math.sqrt(2.0 * max(identification.evidence_nats, 0.0)),
                    "threshold": identification.threshold,
                },
                "alternatives": list(identification.alternatives),
                "statement": effect_statement(
                    one.say() or unsized_statement(identification.effect, one.axes),
                    alternatives=identification.alternatives,
                    intervals=[]
                    if when == [(float(begin[0]), whole)]
                    else [span_text(*span, whole) for span in when],
                ),
            }
        )
    return sorted(out, key=lambda table: -table["held_out_gain"]["nats"])


def limit_tables(found: Mapping[str, UpperLimit]) -> dict[str, Any]:
    """How large what was not found may be, and why it was not."""
    return {
        name: {"upper_limit": one.upper_limit, "unit": one.unit, "reason": one.reason}
        for name, one in found.items()
    }


def model_tables(
    baseline: xr.Dataset, fitted: Sequence[Fitted], own: Model | None
) -> dict[str, Any]:
    """The simulation with the effects added, as the tables of a model; `own` is the model that was given."""
    noise = {
        str(axis): {
            str(term): float(f"{float(baseline['coefficient'].sel(axis=axis, term=term)):.6g}")
            for term in baseline["term"].values
        }
        for axis in baseline["axis"].values
    }
    before = list(own.effects) if own is not None else []
    found = [one.effect for one in fitted if one.effect is not None]
    instrument = max(
        [int(own.log.get("oversampling", 1)) if own is not None else 1, *map(_instrument, found)]
    )
    log = {"log": {"oversampling": instrument}} if instrument > 1 else {}
    return {**log, "noise": noise, "effect": [effect_table(effect) for effect in [*before, *found]]}


def _instrument(effect: Effect) -> int:
    """Samples of the instrument in one of the log that an effect needs: a filter works at the rate of the instrument."""
    return int(getattr(effect, "instrument", 1)) or _FAST


def surfaces_with_blocks(
    surfaces: xr.Dataset, blocks: xr.Dataset, before: xr.Dataset, after: xr.Dataset
) -> xr.Dataset:
    """The surfaces with what else the report draws: block means, channels, and spectra of the whole record."""
    power = "degree2 hour-2 s"
    channels = {
        str(name): blocks[name] for name in blocks.data_vars if str(name).startswith("channel_")
    }
    with np.errstate(invalid="ignore"):
        cases = [blocks["power"], before["spectrum"], after["spectrum"]]
        there = np.isfinite(blocks["power"].transpose("axis", "block", "band").values)
        density = np.stack(
            [_mean_where(one.transpose("axis", "block", "band").values, there) for one in cases]
        )
        lines = blocks["line_power"].weighted(blocks["line_weight"].fillna(0.0)).mean("part")
    step = max(1, lines.sizes["line"] // _MOST_LINES)
    lines = lines.coarsen(line=step, boundary="trim").max() if step > 1 else lines
    frequency = (
        blocks["line_frequency"].coarsen(line=step, boundary="trim").mean()
        if step > 1
        else blocks["line_frequency"]
    )
    added = xr.Dataset(
        {
            "block_mean": (
                ("axis", "block"),
                blocks["mean"].transpose("axis", "block").values,
                dict(blocks["mean"].attrs),
            ),
            "density": (
                ("case", "axis", "band"),
                density,
                {"units": power, "long_name": "two-sided power density of the record"},
            ),
            "line_density": (
                ("axis", "line"),
                lines.transpose("axis", "line").values,
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


def _mean_where(values: Array, there: NDArray[np.bool_]) -> Array:
    count = there.sum(axis=1)
    return np.asarray(
        np.divide(
            np.where(there, values, 0.0).sum(axis=1),
            count,
            out=np.full(count.shape, np.nan),
            where=count > 0,
        )
    )
