"""What all steps of the selection share: the record, the candidates, and the threshold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify.components import group_components
from gyrostab.diagnose.identify.identification import Selection, condition_on_selections, form_error
from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence, Component
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.settings import Settings
from gyrostab.physics.base import Effect

Array = NDArray[Any]


@dataclass(frozen=True)
class Examination:
    """A record that is examined for effects beyond those of its simulation."""

    candidates: Sequence[Candidate]  # effects and nuisance alternatives
    folds: xr.DataArray  # from `gyrostab.diagnose.evidence.folds.fold_blocks`
    count_evidence: CountEvidence
    threshold: float  # evidence [nats] that noise alone exceeds with the false-alarm probability
    start: State  # with the expected effects in the model, once they are identified
    known: tuple[Effect, ...] = ()  # effects that the simulation contains but not the baseline
    null_best: Array = field(default_factory=lambda: np.empty(0))  # as in `Identifications`
    reasons: dict[str, str] = field(default_factory=dict)  # effect -> why it cannot show
    expected: tuple[Selection, ...] = ()  # those of the known effects that the record shows

    @property
    def settings(self) -> Settings:
        """Numbers that decide what is named."""
        return self.start.settings

    def with_blocks(self, blocks: xr.Dataset) -> Examination:
        """Return the examination of the record with other line spectra, before any effect.

        The threshold is that of the null records so far.
        """
        return replace(self, start=replace(self.start, blocks=blocks))

    def state_with(
        self, selections: Sequence[Selection], *, without: Selection | None = None
    ) -> State:
        """Return the state with all selections but one in the model."""
        return condition_on_selections(self.start, selections, without)

    def compute_evidence(
        self, candidates: Sequence[Candidate], state: State
    ) -> list[CandidateEvidence]:
        """Compute the held-out evidence of candidates on the record."""
        return compute_evidence(
            candidates,
            state.blocks,
            state,
            self.folds,
            count_evidence=self.count_evidence,
        )

    def find_components(
        self, candidates: Sequence[Candidate], state: State
    ) -> dict[str, list[Component]]:
        """Return the components of candidates by key, the strongest first."""
        return group_components(self.compute_evidence(candidates, state), settings=self.settings)

    def required_nats(
        self, components: Sequence[Component], selections: Iterable[Selection]
    ) -> float:
        """Return the evidence that components need in addition to the selections [nats]."""
        others = [*self.expected, *selections]
        return self.threshold + form_error(components, others, settings=self.settings)
