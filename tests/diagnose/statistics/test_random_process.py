"""A random walk far beyond the calibrated one is found as such."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.identify.examination import nuisance_alternatives
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log


@pytest.mark.parametrize(
    ("excess", "is_found"), [(0.2, False), (9.0, False), (100.0, True), (3_000.0, True)]
)
def test_walk_beyond_the_grid_is_found(excess: float, is_found: bool) -> None:
    """The grid of random walks ends at 30 times the model's."""
    rng = np.random.default_rng(1)
    rate = 0.6 * rng.standard_normal((1, 18_000))
    rate += excess * 0.02 / np.sqrt(36_000.0) * rng.standard_normal(rate.shape).cumsum(axis=1)
    blocks = reduce_log(make_log(rate, rate=10.0, unit="deg/h"))
    model = {"noise": {"N": 0.003, "B": 0.004, "K": 0.02}, "log": {"axes": ["x"]}}
    state = initial_state(blocks, baseline_from_model(blocks, model))
    (walk,) = [item for item in nuisance_alternatives(blocks) if item.effect == "~red"]
    (evidence,) = compute_evidence([walk], blocks, state)
    assert (evidence.evidence_nats[0, 0] > 10.0) == is_found
