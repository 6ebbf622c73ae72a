"""Effects leave no structure in time in the powers if they are right, and some if they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.identify import withdrawal
from gyrostab.diagnose.identify.examination import Examination, nuisance_alternatives
from gyrostab.diagnose.identify.forward_search import _select_all
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.identify.withdrawal import measure_fluctuation
from gyrostab.diagnose.predict.candidates import Candidate, Component, Variant
from gyrostab.diagnose.predict.condition import refit_powers
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.ingest.make_log import make_log
from tests.support.named import name_effects, nulls

BLOCKS, LENGTH = 120, 200


def record(factor: np.ndarray, *, seed: int = 1, gaps: bool = False) -> xr.Dataset:
    """White noise at 10 Hz on one axis, scaled by a factor in each block of 20 s."""
    rng = np.random.default_rng(seed)
    rates = rng.standard_normal((1, BLOCKS * LENGTH)) * np.repeat(factor, LENGTH)
    if gaps:
        rates[:, np.repeat(rng.random(BLOCKS * 20) < 0.3, LENGTH // 20)] = np.nan
    return reduce_log(make_log(rates, rate=10.0, unit="deg/h"), block="20s")


def fluctuation_left(blocks: xr.Dataset, *columns: np.ndarray) -> float:
    """Return the variance fluctuation with columns (block,) of added white power in the model."""
    state: State = initial_state(blocks, calibrate_noise(blocks))
    spread = [
        np.broadcast_to(column[:, None], state.expected_power.shape[1:]).astype(float)
        for column in columns
    ]
    return measure_fluctuation(
        refit_powers(state.with_columns("power", "x", spread)) if columns else state, "x"
    )


def test_noise_that_fluctuates_on_one_axis_stays_named_on_the_others(monkeypatch):
    blocks = reduce_log(
        make_log(np.random.default_rng(2).standard_normal((3, 6000)), rate=10.0, unit="deg/h")
    )
    start = initial_state(blocks, calibrate_noise(blocks))
    white = Variant({}, ("white",), np.ones((1, 1, *start.expected_power.shape[1:])), squared=True)
    candidate = Candidate("vibration_noise", find_statistic("power"), ("vibration",), (white,))
    components = tuple(
        Component(candidate, white, (axis,), nats)
        for axis, nats in (("x", 30.0), ("y", 100.0), ("z", 100.0))
    )
    selection = Selection("vibration_noise", ("vibration",), ("x", "y", "z"), components, 227.0, 8)
    monkeypatch.setattr(
        withdrawal, "measure_fluctuation", lambda state, axis: 20.0 if axis == "x" else 0.0
    )
    examination = Examination([], CountEvidence({}), 8.0, start, (), np.zeros(1), {})
    remaining, _ = withdrawal.withdraw_effects(examination, [selection], [])
    assert [item.axes for item in remaining] == [("y", "z")]
    assert remaining[0].evidence_nats == pytest.approx(198.5)  # 1.5 nats for the second axis


@pytest.mark.parametrize("gaps", [False, True])
def test_steady_noise_does_not_fluctuate(gaps: bool) -> None:
    fluctuations = [
        fluctuation_left(record(np.ones(BLOCKS), seed=seed, gaps=gaps)) for seed in range(12)
    ]
    assert max(fluctuations) < 2.0
    assert np.median(fluctuations) < 0.0


def test_bursts_fluctuate_until_they_are_in_the_model() -> None:
    burst = np.zeros(BLOCKS)
    burst[[10, 11, 12, 30, 31, 52, 53, 54, 55, 90, 91, 92]] = 0.6
    blocks = record(np.sqrt(1.0 + burst))
    assert fluctuation_left(blocks) > 8.0
    assert fluctuation_left(blocks, burst) < 2.0
    assert fluctuation_left(blocks, np.linspace(0.0, 1.0, BLOCKS)) > 8.0


def test_single_noisy_block_is_not_a_fluctuation() -> None:
    level = np.ones(BLOCKS)
    level[40] = 30.0
    assert fluctuation_left(record(level)) < 8.0


def test_masked_blocks_do_not_count() -> None:
    burst = np.ones(BLOCKS)
    burst[20:40] = 1.5
    blocks = record(burst)
    state = initial_state(blocks, calibrate_noise(blocks))
    assert measure_fluctuation(state, "x") > 8.0
    assert measure_fluctuation(replace(state, masked=(burst > 1.0)[None]), "x") < 2.0


@pytest.mark.full
def test_smooth_effect_that_stands_for_bursts_is_withdrawn() -> None:
    level = np.ones(BLOCKS)
    rng = np.random.default_rng(4)
    level[60:] = np.where(
        rng.random(60) < 0.4, 1.35, 1.0
    )  # later is noisier on average, and not at all steadily
    blocks = record(level)
    baseline, records = nulls(blocks, 40)
    identifications = name_effects(blocks, baseline, records)
    assert not identifications.identified
    assert identifications.unidentified
    steady = record(np.linspace(0.9, 1.15, BLOCKS))
    baseline, records = nulls(steady, 40)
    assert [
        identification.effect
        for identification in name_effects(steady, baseline, records).identified
    ] == ["ageing_noise"]


def test_noisy_axes_are_not_correlated() -> None:
    rng = np.random.default_rng(6)
    loud = np.ones(BLOCKS)
    loud[40:60] = 20.0
    blocks = reduce_log(
        make_log(
            rng.standard_normal((2, BLOCKS * LENGTH)) * np.repeat(loud, LENGTH),
            rate=10.0,
            unit="deg/h",
        )
    )
    state = initial_state(blocks, calibrate_noise(blocks))
    examination = Examination(nuisance_alternatives(blocks), CountEvidence({}), 7.0, state)

    (covariance,) = (
        evidence
        for evidence in examination.compute_evidence(examination.candidates, state)
        if evidence.candidate.effect == "~cov"
    )
    assert float(covariance.evidence_nats.max()) > 100.0
    chosen, _ = _select_all(examination)
    assert {selection.effect for selection in chosen} <= {"~N(t)", "~burst"}


@pytest.mark.full
def test_an_axis_that_turns_without_a_channel_has_no_jump_and_no_ageing():
    turned = [0, 300, 900, 500, 1200, 800, 1100, 950, 1190, 700, 1000, 400, 0]  # deg/h, not logged
    noise = 0.5 * np.random.default_rng(1).standard_normal((1, 3600))
    noise += np.interp(np.arange(3600) / 10.0, np.linspace(0.0, 320.0, 13), turned)
    blocks = reduce_log(make_log(noise, rate=10.0, unit="deg/h", axis=["y"]))
    identifications = name_effects(blocks, *nulls(blocks, 10))
    assert not identifications.identified
    assert "~red" in {unidentified.effect for unidentified in identifications.unidentified}
    assert {unidentified.axes for unidentified in identifications.unidentified} == {("y",)}
