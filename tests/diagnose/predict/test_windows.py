"""Times of jumps are searched everywhere; earth rate follows the turns of the tool."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.predict.windows import (
    power_on_times,
    predict_effect,
    select_step_times,
)
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.physics.prediction import Windows
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate
from tests.support.candidates import select_candidate
from tests.support.named import COEFFICIENT, record

_BACK = 1913.0  # s, between two values of the thinned grid


@pytest.fixture(scope="module")
def restarted():
    """An hour whose power was lost for 7 s."""
    blocks = record([]).drop_vars(
        [name for name in ("restart_begin", "restart_end") if name in record([])]
    )
    return blocks.assign(restart_begin=("restart", [_BACK - 7.0]), restart_end=("restart", [_BACK]))


def _jump_candidates(blocks):
    return select_candidate(effect_candidates(blocks, COEFFICIENT)[0], "bias_jump", "mean")


def test_a_restart_is_as_probable_as_all_other_times(restarted):
    variants = _jump_candidates(restarted).variants
    weight = np.array([variant.weight for variant in variants])
    known = np.array([variant.values["at"] == _BACK for variant in variants])
    assert known.sum() == 1
    assert weight[known].sum() == pytest.approx(weight[~known].sum())
    assert weight[~known].sum() == pytest.approx((~known).sum())


def test_each_time_has_the_probability_of_its_interval():
    variants = sorted(
        _jump_candidates(record([])).variants, key=lambda variant: variant.values["at"]
    )
    at, weight = (
        np.array(values)
        for values in zip(
            *((variant.values["at"], variant.weight) for variant in variants), strict=True
        )
    )
    np.testing.assert_allclose(
        weight[1:-1] / weight[1], (at[2:] - at[:-2]) / (at[2] - at[0]), rtol=1e-9
    )
    assert weight.mean() == pytest.approx(1.0)


@pytest.mark.parametrize("at", [1_337.0, 1_350.0, 1_359.0])
def test_a_large_jump_is_found_anywhere_in_a_long_record(at):
    block_count = 2_000
    windows = 20.0 * np.arange(block_count)
    means = np.random.default_rng(2).standard_normal(block_count) + 30.0 * np.clip(
        (windows + 20.0 - at) / 20.0, 0.0, 1.0
    )
    frame = Windows(windows, windows + 20.0, np.ones(1), 10.0, ("x",), own={"x": means})
    possible = np.unique(np.concatenate([windows[1:], windows + 10.0]))
    tried = np.array(select_step_times(possible, frame))
    assert tried.size < 350
    assert np.abs(tried - at).min() <= 5.0


def test_of_many_restarts_the_longest_are_tried(restarted):
    rng = np.random.default_rng(5)
    back = np.sort(rng.choice(np.arange(20.0, 3_580.0, 5.0), 400, replace=False))
    off = rng.uniform(5.0, 60.0, back.size)
    frame = Windows(
        20.0 * np.arange(180),
        20.0 * np.arange(1, 181),
        np.ones(1),
        10.0,
        ("x",),
        restarts=np.stack([back - off, back], axis=1),
    )
    longest = power_on_times(frame)
    assert longest.tolist() == sorted(back[np.argsort(-off)[:60]])
    tried = select_step_times(np.unique([*back, *frame.begin[1:]]), frame)
    assert len(tried) < 350
    assert set(longest) <= set(tried)


def test_two_restarts_share_their_probability(restarted):
    twice = restarted.drop_vars(["restart_begin", "restart_end"])
    twice = twice.assign(
        restart_begin=("restart", [900.0, _BACK]), restart_end=("restart", [905.0, _BACK + 7.0])
    )
    variants = _jump_candidates(twice).variants
    weight = np.array([variant.weight for variant in variants])
    known = np.array([variant.values["at"] in (905.0, _BACK + 7.0) for variant in variants])
    every = np.array([len(variant.columns) == 2 for variant in variants])
    assert known.sum() == 3
    assert every.sum() == 1  # the level changes at both
    assert weight[every].sum() == pytest.approx(weight[known & ~every].sum())
    assert weight[known].sum() == pytest.approx(weight[~known].sum())


def test_a_jump_at_a_restart_needs_less_evidence(restarted):
    middle = (restarted["begin"] + restarted["end"]) / 2.0
    moved = restarted.assign(mean=restarted["mean"] + 0.08 * (middle > _BACK))
    state = initial_state(moved, calibrate_noise(moved))
    weighed = _jump_candidates(moved)
    equal = replace(
        weighed, variants=tuple(replace(variant, weight=1.0) for variant in weighed.variants)
    )
    evidence = [compute_evidence([candidate], moved, state)[0] for candidate in (weighed, equal)]
    assert (evidence[0].evidence_nats > evidence[1].evidence_nats + 0.5).any()
    assert {variant.values["at"] for variant in evidence[0].best} == {_BACK}


def test_means_of_earth_rate_follow_the_turns_within_each_block():
    earth = {"name": "earth_rate", "latitude": 60, "inclination": 30, "azimuth": 60}
    rotation = {
        "profile": "rotation",
        "points": [[0, 90.0]],
        "sensor_rate": 50,
        "stick_slip": 0.6,
        "period": "7.3 s",
        "inclination": 30,
    }
    model = {"noise": {"N": 1e-5}, "environment": [rotation], "effect": [earth]}
    log = simulate(model, duration="20min", rate=10.0, seed=3).compute()
    blocks = reduce_log(log, block="20s")
    mean = blocks["mean"].values
    effect = make_effect(earth)
    predicted = effect.rate * predict_effect(effect, blocks, ("x", "y", "z")).mean["rate"]
    assert np.ptp(mean[:2], axis=1).min() > 0.3
    np.testing.assert_allclose(predicted, mean, atol=0.02)
    even = blocks.drop_vars("turn_mean")
    unlike = effect.rate * predict_effect(effect, even, ("x", "y", "z")).mean["rate"]
    assert np.abs(unlike - mean).max() > 0.2
