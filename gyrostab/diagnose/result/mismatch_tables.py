"""Build the tables of the mismatches in `diagnosis.json`, each with its sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.diagnose.identify.examination import NUISANCE_ALTERNATIVES, Identifications
from gyrostab.diagnose.identify.identification import Selection, components_of
from gyrostab.diagnose.locate.mismatches import Region
from gyrostab.diagnose.nulls.scores import MIN_P_VALUE, fit_best_evidence
from gyrostab.diagnose.reduce.block_statistics import iso, measured
from gyrostab.diagnose.result.attribution import active_blocks, join_blocks
from gyrostab.diagnose.result.text import (
    chance,
    mismatch_statement,
    motion_statement,
    named_statement,
    plain_name,
    span_text,
)
from gyrostab.diagnose.statistics.wording import axes_text
from gyrostab.wording import join_words


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
        "start": iso(blocks, span[0]),
        "end": iso(blocks, span[1]),
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
    begin, end = blocks["begin"].values, blocks["end"].values
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
        acting = active_blocks(identification, blocks, settings=settings)
        for span in join_blocks(acting, begin, end):
            when = span_text(*span, float(end[-1]))
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
    for unidentified in identifications.unknown:
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
        verb = "comes" if len(nearest) == 1 else "come"
        explanation = (
            f"{join_words([plain_name(name) for name in nearest])} {verb} closest, but "
            "another form explains more"
            if nearest
            else "no known effect explains it"
        )
        description = NUISANCE_ALTERNATIVES.get(unidentified.effect, "something differs")
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
