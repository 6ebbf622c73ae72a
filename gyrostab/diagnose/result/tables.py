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


def iso(reduced: xr.Dataset, seconds: float) -> str:
    """Time [s since the start of the record] as ISO 8601."""
    start = np.datetime64(int(reduced.attrs["start_ns"]), "ns")
    return f"{(start + np.timedelta64(round(seconds * 1e9), 'ns')).astype('datetime64[ms]')}Z"


def recording_table(reduced: xr.Dataset) -> dict[str, Any]:
    """What the recording is."""
    channels = [
        str(name).removeprefix("channel_")
        for name in reduced.data_vars
        if str(name).startswith("channel_")
    ]
    return {
        "files": [str(name) for name in reduced.attrs["source_files"]],
        "axes": [str(axis) for axis in reduced["axis"].values],
        "start": reduced.attrs["start"],
        "end": reduced.attrs["end"],
        "sampling_rate_hz": float(reduced.attrs["sampling_rate_hz"]),
        "channels": channels,
        "missing_share": float(reduced.attrs["missing_share"]),
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
            "name": one.claim.effect,
            "axes": list(one.axes),
            "statement": one.say() or unsized_statement(one.claim.effect, one.axes),
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
    found: xr.Dataset, reduced: xr.Dataset, explained: Sequence[Sequence[str]]
) -> list[dict[str, Any]]:
    """The mismatches, each with its sentence."""
    whole = float(reduced["end"].values[-1])
    out = []
    for number, names in enumerate(explained):
        box = {
            str(name): found[name].values[number].item()
            for name in found.data_vars
            if found[name].dtype.kind != "M"
        }
        box["axes"] = str(box["axes"]).split()
        out.append(
            {
                "id": number + 1,
                "view": box["view"],
                "axes": box["axes"],
                "start": iso(reduced, box["begin"]),
                "end": iso(reduced, box["end"]),
                "tau_min_s": box["tau_min_s"],
                "tau_max_s": box["tau_max_s"],
                "ratio": box["ratio"],
                "p_value": box["p_value"],
                "explained_by": list(names),
                "statement": mismatch_statement(box, whole),
            }
        )
    return out


def chance_of_gain(best: Array, gain: float) -> float:
    """Share of null records whose largest gain is `gain` or more; by an exponential tail beyond their upper quarter."""
    start = float(np.quantile(best, 1.0 - _TAIL))
    if gain <= start:
        return float((best >= gain).mean())
    scale = max(float((best[best > start] - start).mean()), 0.1)
    return max(_TAIL * math.exp(-(gain - start) / scale), _LEAST_P)


def identification_tables(
    naming: Identifications, reduced: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Mismatches that only naming saw: where a named effect acts that explains none of those known, by its strongest part."""
    out: list[dict[str, Any]] = []
    begin, end = reduced["begin"].values, reduced["end"].values
    for claim in naming.claims:
        if any(
            claim.effect in box["explained_by"] and set(box["axes"]) & set(claim.axes)
            for box in known
        ):
            continue
        strongest = max(claim.parts, key=lambda part: part.gain)
        view = _PART_VIEW.get(strongest.candidate.view, "davar")
        low, high = _taus(strongest, view, reduced)
        p_value = chance_of_gain(naming.null_best, claim.gain)
        for first, last in spans(active_spans(claim, reduced), begin, end):
            when = span_text(first, last, float(end[-1]))
            out.append(
                {
                    "id": len(known) + len(out) + 1,
                    "view": view,
                    "axes": list(claim.axes),
                    "start": iso(reduced, first),
                    "end": iso(reduced, last),
                    "tau_min_s": low,
                    "tau_max_s": high,
                    "ratio": None,
                    "p_value": p_value,
                    "explained_by": [claim.effect],
                    "statement": named_statement(view, claim.effect, claim.axes, when, p_value),
                }
            )
    return out


def _taus(part: Component, view: str, reduced: xr.Dataset) -> tuple[float, float]:
    """Averaging times [s] at which a part of an effect shows: those of its line, of block means, or those within a block."""
    block, whole = float(reduced.attrs["block_s"]), float(reduced["end"].values[-1])
    if part.candidate.view == "line" and part.place >= 0:
        tau = _BUMP / float(reduced["line_frequency"].values[part.place])
        return tau, tau
    if view == "mean":
        return block, whole / 2.0
    return 1.0 / float(reduced.attrs["sampling_rate_hz"]), block


def unidentified_tables(
    naming: Identifications, reduced: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Mismatches that only naming saw: what no effect explains, where no box that is left says so already."""
    out: list[dict[str, Any]] = []
    for one in naming.unknown:
        view = _GENERIC_VIEW.get(one.generic, "davar")
        told = any(
            box["view"] == view and set(box["axes"]) & set(one.axes) and not box["explained_by"]
            for box in known
        )
        if not told:
            out.append(_unknown_table(one, naming, reduced, len(known) + len(out) + 1, view))
    return out


def _unknown_table(
    one: Unidentified, naming: Identifications, reduced: xr.Dataset, number: int, view: str
) -> dict[str, Any]:
    p_value = chance_of_gain(naming.null_best, one.gain)
    near = ", ".join(plain_name(name) for name in one.candidates)
    beside = f"; what comes nearest: {near}" if near else ""
    means, what = view == "mean", NUISANCE_ALTERNATIVES.get(one.generic, "something differs")
    rate, block = float(reduced.attrs["sampling_rate_hz"]), float(reduced.attrs["block_s"])
    begin, end, when = _when(one, reduced)
    return {
        "id": number,
        "view": view,
        "axes": list(one.axes),
        "start": iso(reduced, begin),
        "end": iso(reduced, end),
        "tau_min_s": block if means else 1.0 / rate,
        "tau_max_s": float(reduced["end"].values[-1]) / 2.0 if means else block,
        "ratio": None,
        "p_value": p_value,
        "explained_by": [],
        "statement": f"On {axes_text(one.axes)} {what}{when}, and no known effect says why{beside} ({chance(p_value)}).",
    }


def _when(one: Unidentified, reduced: xr.Dataset) -> tuple[float, float, str]:
    """Begin and end of what has no name [s], with words for an event; else the whole record."""
    whole = float(reduced["end"].values[-1])
    found = [
        (part.variant.values["begin"], part.variant.values["end"])
        for part in one.parts
        if "begin" in part.variant.values
    ]
    if not found:
        return float(reduced["begin"].values[0]), whole, ""
    begin, end = min(first for first, _ in found), max(last for _, last in found)
    return begin, end, f", {span_text(begin, end, whole)}"


def motion_tables(
    claims: Sequence[Identification], reduced: xr.Dataset, known: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """One mismatch for every axis whose moving stretches were left out of the comparison, from the first of them to the last."""
    if "moving" not in reduced:
        return []
    begin, end, block = (
        reduced["begin"].values,
        reduced["end"].values,
        float(reduced.attrs["block_s"]),
    )
    out: list[dict[str, Any]] = []
    for axis, moving, mean in zip(
        map(str, reduced["axis"].values),
        reduced["moving"].values,
        measured(reduced, "mean").values,
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
                "start": iso(reduced, first),
                "end": iso(reduced, last),
                "tau_min_s": 1.0 / float(reduced.attrs["sampling_rate_hz"]),
                "tau_max_s": max((last - first) / 2.0, block),
                "ratio": None,
                "p_value": _LEAST_P,
                "explained_by": [],
                "statement": motion_statement(
                    axis, span_text(first, last, float(end[-1])), largest, _followers(axis, claims)
                ),
            }
        )
    return out


def _followers(axis: str, claims: Sequence[Identification]) -> list[str]:
    """Axes on which the rate of an axis is seen through a lean of theirs."""
    parts = [part for claim in claims if claim.effect == "misalignment" for part in claim.parts]
    return sorted(
        {
            name
            for part in parts
            if axis in (*part.variant.columns, *part.candidate.witness)
            for name in part.row
        }
    )


def effect_tables(fitted: Sequence[Fitted], reduced: xr.Dataset) -> list[dict[str, Any]]:
    """The named effects, the strongest first.

    An effect with different numbers on several axes is one claim in as many tables, each with the
    gain of the claim, which is what passed the threshold. The standard error of a held-out gain is
    the one that the logarithm of a likelihood ratio has where the model is right: the root of twice
    the gain.
    """
    begin, end = reduced["begin"].values, reduced["end"].values
    out = []
    for one in fitted:
        claim = one.claim
        when = spans(active_spans(claim, reduced), begin, end)
        whole = float(end[-1])
        out.append(
            {
                "name": claim.effect,
                "axes": list(one.axes),
                "driver": ",".join(filter(None, claim.driver)) or None,
                "intervals": [[iso(reduced, low), iso(reduced, high)] for low, high in when],
                "parameters": {name: asdict(estimate) for name, estimate in one.parameters.items()},
                "held_out_gain": {
                    "nats": claim.gain,
                    "stderr": math.sqrt(2.0 * max(claim.gain, 0.0)),
                    "threshold": claim.threshold,
                },
                "alternatives": list(claim.alternatives),
                "statement": effect_statement(
                    one.say() or unsized_statement(claim.effect, one.axes),
                    alternatives=claim.alternatives,
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
    surfaces: xr.Dataset, reduced: xr.Dataset, before: xr.Dataset, after: xr.Dataset
) -> xr.Dataset:
    """The surfaces with what else the report draws: block means, channels, and spectra of the whole record."""
    power = "degree2 hour-2 s"
    channels = {
        str(name): reduced[name] for name in reduced.data_vars if str(name).startswith("channel_")
    }
    with np.errstate(invalid="ignore"):
        cases = [reduced["power"], before["spectrum"], after["spectrum"]]
        there = np.isfinite(reduced["power"].transpose("axis", "block", "band").values)
        density = np.stack(
            [_mean_where(one.transpose("axis", "block", "band").values, there) for one in cases]
        )
        lines = reduced["line_power"].weighted(reduced["line_weight"].fillna(0.0)).mean("part")
    step = max(1, lines.sizes["line"] // _MOST_LINES)
    lines = lines.coarsen(line=step, boundary="trim").max() if step > 1 else lines
    frequency = (
        reduced["line_frequency"].coarsen(line=step, boundary="trim").mean()
        if step > 1
        else reduced["line_frequency"]
    )
    added = xr.Dataset(
        {
            "block_mean": (
                ("axis", "block"),
                reduced["mean"].transpose("axis", "block").values,
                dict(reduced["mean"].attrs),
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
            "block_begin": ("block", reduced["begin"].values, dict(reduced["begin"].attrs)),
            "block_end": ("block", reduced["end"].values, dict(reduced["end"].attrs)),
            "frequency": ("band", reduced["frequency"].values, dict(reduced["frequency"].attrs)),
            "line_frequency": ("line", frequency.values, dict(reduced["line_frequency"].attrs)),
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
