"""What all steps of the identification share: the record, its candidates and the threshold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.diagnose.baseline.quantization_grid import rounded_rates
from gyrostab.diagnose.evidence.sample_counts import EXPECTED, CountEvidence, has_coarse_grid
from gyrostab.diagnose.identify.components import group_components
from gyrostab.diagnose.identify.selections import Selection, condition_on_selections, form_error
from gyrostab.diagnose.nulls.scores import fit_best_evidence
from gyrostab.diagnose.predict.candidates import (
    NUISANCE_ALTERNATIVES,
    Candidate,
    CandidateEvidence,
    Component,
)
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.search import compute_evidence, evidence_by_effect
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.diagnose.statistics import STATISTICS
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.mismatch_wording import COARSE_ANGLE_GRID
from gyrostab.physics.base import Effect
from gyrostab.progress import Stage, no_stage


@dataclass(frozen=True)
class Examination:
    """A record that is examined for effects beyond those of its simulation."""

    candidates: Sequence[Candidate]  # effects and nuisance alternatives
    count_evidence: CountEvidence
    threshold: float  # evidence [nats] that noise alone exceeds with the false-alarm probability
    start: State  # with the expected effects in the model, once they are identified
    #: Effects that the simulation contains but not the baseline.
    model_effects: tuple[Effect, ...] = ()
    #: Best evidence in each null record, sorted [nats].
    null_best: Array = field(default_factory=lambda: np.empty(0))
    reasons: dict[str, str] = field(default_factory=dict)  # effect -> why it cannot show
    expected: tuple[Selection, ...] = ()  # those of the model that the record shows

    @property
    def settings(self) -> Settings:
        """Numbers that decide what is named."""
        return self.start.settings

    def state_with(
        self, selections: Sequence[Selection], *, without: Selection | None = None
    ) -> State:
        """Return the state with all selections but one in the model."""
        return condition_on_selections(self.start, selections, without)

    def compute_evidence(
        self, candidates: Sequence[Candidate], state: State
    ) -> list[CandidateEvidence]:
        """Compute the held-out evidence of candidates on the record."""
        return compute_evidence(candidates, state.blocks, state, count_evidence=self.count_evidence)

    def find_components(
        self, candidates: Sequence[Candidate], state: State
    ) -> dict[str, list[Component]]:
        """Return the components of candidates by key, the strongest first."""
        return group_components(self.compute_evidence(candidates, state), self.settings)

    def required_nats(
        self, components: Sequence[Component], selections: Iterable[Selection]
    ) -> float:
        """Return the evidence that components need in addition to the selections [nats]."""
        others = [*self.expected, *selections]
        return self.threshold + form_error(components, others, self.settings)


def prepare_examination(
    blocks: xr.Dataset,
    baseline: xr.Dataset,
    nulls: Iterable[xr.Dataset],
    *,
    level: float = 0.005,
    seed: int = 0,
    model_effects: Sequence[Effect] = (),
    progress: Stage = no_stage,
    settings: Settings = DEFAULTS,
) -> Examination:
    """Collect the candidates for a recording, and the threshold that null records give.

    The null records come several at a time, with a leading dimension ``record``. With the
    probability `level`, noise alone gives an identification, or something unidentified. `seed` is
    that of the draws for statistics that the null records do not contain. The simulation contains
    the `model_effects`, but not the baseline; they are in the model before the selection begins.
    """
    effects, reasons = effect_candidates(blocks, baseline["coefficient"], settings=settings)
    candidates = [*effects, *nuisance_alternatives(blocks)]
    start = initial_state(blocks, baseline, settings=settings)
    best, count_evidence = _score_null_records(
        candidates, nulls, start, np.random.default_rng(seed), progress
    )
    if not count_evidence.rounded.any() and (blocks["quantization_step"] > 0.0).any():
        reasons["rate_quantization"] = (
            COARSE_ANGLE_GRID
            if has_coarse_grid(blocks).any()
            else "not identifiable: the quantization grid is that of angles, or too fine to show"
        )
    threshold = fit_best_evidence(best, settings=settings).value_at(level)
    return Examination(
        candidates, count_evidence, threshold, start, tuple(model_effects), best, reasons
    )


def _score_null_records(
    candidates: Sequence[Candidate],
    nulls: Iterable[xr.Dataset],
    state: State,
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
        chunks.append(compute_evidence(by_chunk, chunk, state, rng=rng))
        small.append(chunk[["mean", *EXPECTED]])
        records += chunk.sizes["record"]
        progress("naming", 0, records)
    rounded = rounded_rates(state.blocks, state.baseline, settings=state.settings)
    count_evidence = CountEvidence.gathered(small, rounded)
    data = xr.concat(small, "record", data_vars="minimal", coords="minimal", compat="override")
    last = compute_evidence(at_end, data, state, count_evidence=count_evidence)
    for of_chunks in zip(*chunks, strict=True):
        evidence_nats = np.concatenate([evidence.evidence_nats for evidence in of_chunks])
        last.append(replace(of_chunks[0], evidence_nats=evidence_nats))
    return np.sort(np.max([*evidence_by_effect(last).values()], axis=0)), count_evidence


def nuisance_alternatives(blocks: xr.Dataset) -> list[Candidate]:
    """Build the nuisance alternatives in all statistics of the record."""
    by_name = {
        candidate.effect: candidate
        for statistic in STATISTICS
        for candidate in statistic.nuisance_alternatives(blocks)
    }
    return [by_name[name] for name in NUISANCE_ALTERNATIVES if name in by_name]
