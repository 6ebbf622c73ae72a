"""Identify the effects that a recording shows beyond its baseline."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.baseline.quantization_grid import rounded_rates
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.evidence.sample_counts import EXPECTED, CountEvidence, has_coarse_grid
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.expected import identify_expected_effects
from gyrostab.diagnose.identify.identification import Identifications
from gyrostab.diagnose.identify.nuisance_alternatives import nuisance_alternatives
from gyrostab.diagnose.identify.selection import select_effects
from gyrostab.diagnose.nulls.scores import fit_best_evidence
from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.search import compute_evidence, evidence_by_effect
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics.candidates import effect_candidates
from gyrostab.diagnose.statistics.wording import COARSE_ANGLE_GRID
from gyrostab.physics.base import Effect
from gyrostab.progress import Stage, no_stage

Array = NDArray[np.float64]


def prepare_examination(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    nulls: Iterable[xr.Dataset],
    *,
    level: float = 0.005,
    seed: int = 0,
    known: Sequence[Effect] = (),
    progress: Stage = no_stage,
    settings: Settings = DEFAULTS,
) -> Examination:
    """Collect the candidates for a recording, and the threshold that null records give.

    Parameters
    ----------
    nulls : iterable of xarray.Dataset
        Null records, several at a time with a leading dimension ``record``.
    level : float
        Probability that noise alone gives an identification, or something unidentified.
    seed : int
        Seed of the draws for statistics that the null records do not contain.
    known : sequence of Effect
        Effects that the simulation contains but not the baseline. They are in the model before
        the selection begins.
    progress : Stage
        Callback with the number of null records done.
    """
    folds = fold_blocks(blocks)
    effects, reasons = effect_candidates(blocks, baseline["coefficient"], settings=settings)
    candidates = [*effects, *nuisance_alternatives(blocks)]
    start = initial_state(blocks, baseline, settings=settings)
    best, count_evidence = _score_null_records(
        candidates, nulls, start, folds, np.random.default_rng(seed), progress
    )
    if not count_evidence.rounded.any() and (blocks["quantization_step"] > 0.0).any():
        reasons["rate_quantization"] = (
            COARSE_ANGLE_GRID
            if has_coarse_grid(blocks).any()
            else "not identifiable: the quantization grid is that of angles, or too fine to show"
        )
    threshold = fit_best_evidence(best, settings=settings).level(level)
    return Examination(
        candidates, folds, count_evidence, threshold, start, tuple(known), best, reasons
    )


def identify_effects(examination: Examination) -> Identifications:
    """Identify the effects that a recording shows beyond its baseline.

    Effects are selected one after the other by how much better they predict held-out data.
    """
    examination = identify_expected_effects(examination)
    identified, unidentified, rejected, state = select_effects(examination)
    return Identifications(
        tuple(identified),
        tuple(unidentified),
        examination.threshold,
        examination.null_best,
        examination.reasons,
        tuple(examination.candidates),
        state,
        examination.count_evidence,
        examination.expected,
        tuple(rejected),
    )


def _score_null_records(
    candidates: Sequence[Candidate],
    nulls: Iterable[xr.Dataset],
    state: State,
    folds: xr.DataArray,
    rng: np.random.Generator,
    progress: Stage,
) -> tuple[Array, CountEvidence]:
    """Return the best evidence of any effect in each null record, sorted, and that of counts.

    The means and counts of all null records are kept. Their evidence comes last: that of counts
    needs the counts of all records, and that of means whitens every design once for all records.
    """
    at_end: list[Candidate] = []
    by_chunk: list[Candidate] = []
    for candidate in candidates:
        is_kept = candidate.statistic.is_count or candidate.statistic.null_variable == "mean"
        (at_end if is_kept else by_chunk).append(candidate)
    chunks: list[list[CandidateEvidence]] = []
    small: list[xr.Dataset] = []
    records = 0
    for chunk in nulls:
        chunks.append(compute_evidence(by_chunk, chunk, state, folds, rng=rng))
        small.append(chunk[[name for name in ("mean", *EXPECTED) if name in chunk]])
        records += chunk.sizes["record"]
        progress("naming", 0, records)
    rounded = rounded_rates(state.blocks, state.baseline, settings=state.settings)
    count_evidence = CountEvidence.gathered(small, rounded)
    data = xr.concat(small, "record", data_vars="minimal", coords="minimal", compat="override")
    last = compute_evidence(at_end, data, state, folds, count_evidence=count_evidence)
    counts = [evidence for evidence in last if evidence.candidate.statistic.is_count]
    others = [evidence for evidence in last if not evidence.candidate.statistic.is_count]
    for of_chunks in zip(*chunks, strict=True):
        evidence_nats = np.concatenate([evidence.evidence_nats for evidence in of_chunks])
        others.append(replace(of_chunks[0], evidence_nats=evidence_nats))
    sums = [evidence_by_effect(others), evidence_by_effect(counts)]
    zero = np.zeros(records)
    best = [sums[0].get(key, zero) + sums[1].get(key, zero) for key in {*sums[0], *sums[1]}]
    return np.sort(np.max(best, axis=0)), count_evidence
