"""Effects without a driver must be present all the time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.identify.identifiability import keep_physical
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from tests.support.candidates import find_components, winning_forms

MODEL = {"noise": {"N": 0.003}, "log": {"axes": ["x"]}}
SECOND = np.arange(24_000) / 10.0


def _simulate_wander(size: float, share: float, seed: int) -> tuple[list[Component], State]:
    """Components of a Gauss-Markov bias of 0.5 s that is present for this share of each 600 s."""
    rng = np.random.default_rng(seed)
    white = 0.003 * 60.0 * np.sqrt(10.0) * rng.standard_normal(SECOND.size)
    keep = np.exp(-0.2)
    bias = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(SECOND.size))
    blocks = reduce_log(
        make_log(white + size * bias * (share * 600.0 > SECOND % 600.0), rate=10.0, unit="deg/h")
    )
    baseline = baseline_from_model(blocks, MODEL)
    biases = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.key == "gauss_markov" and candidate.statistic.name == "power"
    ]
    state = initial_state(blocks, baseline)
    return find_components(biases, state)["gauss_markov"], state


@pytest.mark.parametrize("size", [0.12, 0.18])
@pytest.mark.parametrize(("share", "steady"), [(1.0, True), (0.5, False)])
def test_intermittent_wander_is_rejected(size: float, share: float, steady: bool) -> None:
    components, state = _simulate_wander(size / np.sqrt(share), share, seed=3)
    assert components[0].evidence_nats > 10.0
    assert bool(winning_forms(components, state)) != steady
    assert bool(keep_physical(components, state)[0]) == steady


@pytest.mark.slow
def test_chance_does_not_reject_steady_wander() -> None:
    assert all(
        not winning_forms(components, state)
        for components, state in (_simulate_wander(0.2, 1.0, seed) for seed in range(4))
    )
