"""A jump is sudden: a gradual change is another effect, or unidentified."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.identify.components import group_components, sum_evidence
from gyrostab.diagnose.identify.effect_candidates import effect_candidates
from gyrostab.diagnose.identify.identifiability import is_physical
from gyrostab.diagnose.identify.jumps import gradual_nats, is_free_jump
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log

MODEL = {"noise": {"N": 0.003, "B": 0.004, "K": 0.02}, "log": {"axes": ["x", "y"]}}
MIDDLE = 905.0  # inside a block


@pytest.mark.parametrize(
    ("way", "size", "jump"),
    [(0.0, 0.4, True), (0.0, 4.0, True), (100.0, 0.8, False), (160.0, 4.0, False)],
)
def test_gradual_change_is_not_a_jump(way: float, size: float, jump: bool) -> None:
    second = np.arange(18_000) / 10.0
    course = np.clip((second - MIDDLE) / max(way, 1e-3) + 0.5, 0.0, 1.0)
    noise = (
        0.003 * 60.0 * np.sqrt(10.0) * np.random.default_rng(4).standard_normal((2, second.size))
    )
    blocks = reduce_log(make_log(noise + size * course * [[1.0], [-0.8]], rate=10.0, unit="deg/h"))
    baseline = baseline_from_model(blocks, MODEL)
    (jumps,) = (
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if (candidate.effect, candidate.statistic.name) == ("bias_jump", "mean")
    )
    state = initial_state(blocks, baseline)
    components = group_components(compute_evidence([jumps], blocks, state, fold_blocks(blocks)))[
        jumps.key
    ]
    assert sum_evidence(components) > 10.0
    assert abs(float(components[0].variant.values["at"]) - MIDDLE) <= 30.0
    assert all(is_free_jump(component, state) for component in components)
    assert (gradual_nats(components, state) == 0.0) == jump
    assert bool(is_physical(components, state)) == jump


def test_jump_at_a_restart_may_settle() -> None:
    """Its cause is known there, and what follows a start is often slow."""
    second = np.arange(18_000) / 10.0
    course = np.clip((second - 960.0) / 100.0, 0.0, 1.0)
    rate = 0.6 * np.random.default_rng(4).standard_normal((2, second.size)) + 0.8 * course
    rate[:, (second >= 850.0) & (second < 960.0)] = np.nan
    blocks = reduce_log(make_log(rate, rate=10.0, unit="deg/h"))
    baseline = baseline_from_model(blocks, MODEL)
    (jumps,) = (
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if (candidate.effect, candidate.statistic.name) == ("bias_jump", "mean")
    )
    state = initial_state(blocks, baseline)
    at = np.array([variant.values["at"] for variant in jumps.variants])
    components = {
        instant: Component(jumps, jumps.variants[int(np.abs(at - instant).argmin())], ("x",), 20.0)
        for instant in (960.0, 1010.0)
    }
    assert [is_free_jump(component, state) for component in components.values()] == [False, True]
    assert [gradual_nats([component], state) > 0.0 for component in components.values()] == [
        False,
        True,
    ]
