"""Random processes in the block means: exponentially correlated ones and walks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.diagnose.predict.candidates import (
    Candidate,
    CandidateEvidence,
    Component,
    Prospect,
    Variant,
)
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.search import Trial
from gyrostab.diagnose.statistics.mean import BlockMeanStatistic

Array = NDArray[Any]


class RandomProcess(BlockMeanStatistic):
    """A random process in the block means, which widens their scatter.

    No null record, score or evidence is its own: the flicker and random walk of the noise are free
    in the evidence of means, so that they cannot be distinguished from a random process there. It
    takes part in the model of the simulation, and in the explanation of mismatches.
    """

    name = "random_process"
    explains = ("mean", "davar", "restart", "cross_axis")
    contained_in = ()
    nuisance_alternative = "~red"
    error_shows_in = ("random_process",)
    explains_motion = True
    has_course = True
    has_size = False

    def design(self, case: Prospect) -> Iterator[Variant]:
        """Yield processes slower than half a block."""
        block = float(case.blocks.attrs["block_s"])
        for name, (time, variance) in case.prediction.wander.items():
            if time >= block / 2.0:
                yield Variant(
                    case.values, (name,), np.asarray(variance)[None], squared=True, time=time
                )

    def evidence(self, group: Sequence[Candidate], trial: Trial) -> list[CandidateEvidence]:
        """Return nothing: free flicker and random walk explain as much."""
        return []

    def is_modelled_in(self, region: Mapping[str, Any], *, together: bool) -> bool:
        """Return whether the baseline contains it: axes that wander together are in no model."""
        return not together

    def noise_shares(
        self, component: Component, axis: str, state: State, weight: Array
    ) -> tuple[Array | float, list[Array], list[Array]]:
        """Return nothing: the process is noise."""
        return 0.0, [], []
