"""A recording against its own model: random and tool-dependent effects are expected, others not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

import gyrostab
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.baseline.known_effects import find_blocks_with_known_motion
from gyrostab.diagnose.evidence.wandering import expected_processes
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.kernels.spectra.expected import interval_variance
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
SHAKE = {
    "profile": "vibration",
    "points": [[0, 0.02], [500, 0.02], [520, 6.0], [900, 6.0], [920, 0.02], [1500, 0.02]],
}
TURN = {
    "profile": "rotation",
    "points": [[0, 0.0], [300, 0.0], [330, 72.0], [800, 72.0], [830, 0.0], [1500, 0.0]],
}
JUMP = {"name": "bias_jump", "step": [1.0], "at": 700.0, "axes": ["x"]}


SPIKES = {"name": "spikes", "per_hour": 200.0, "kind": "outlier", "size": 40.0, "axes": ["x"]}
MEMORY = {"name": "gauss_markov", "rms": 0.3, "correlation_time": 100.0, "axes": ["y"]}
WALK = {"name": "vibration_random_walk", "sensitivity": 0.3, "axes": ["z"]}
HELD = {"name": "held_samples", "per_hour": 200.0, "length": 0.5}
SWAY = {"name": "real_motion", "sway": 0.5, "frequency": 0.3}
EARTH = {"name": "earth_rate", "latitude": 50.0}
SCALE = {"name": "scale_factor", "linear": 1000.0, "axes": ["z"]}


def diagnose_against_model(effects, *, environment=(), more=(), axes="xyz", seed=2):
    """Diagnose against the model without the effects in `more`."""
    model = {
        "noise": NOISE,
        "effect": [*effects, *more],
        "environment": list(environment),
        "log": {"axes": list(axes)},
    }
    log = simulate(model, duration="25min", rate=10.0, seed=seed).compute()
    return gyrostab.diagnose(log, simulation={"noise": NOISE, "effect": list(effects)}, nulls=100)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "environment", "axes"),
    [
        pytest.param([SPIKES, MEMORY, WALK], (SHAKE,), "xyz", marks=pytest.mark.full),
        pytest.param([HELD], (), "xy", marks=pytest.mark.full),
        pytest.param([SWAY], (), "xy", marks=pytest.mark.full),
        ([EARTH, SCALE], (TURN,), "yz"),
    ],
    ids=["spikes, memory, walk", "held samples", "sway", "turning"],
)
def test_effects_of_the_model_are_not_mismatches(effects, environment, axes):
    diagnosis = diagnose_against_model(effects, environment=environment, axes=axes)
    assert diagnosis.verdict == "no mismatch", (diagnosis.effects, diagnosis.content["mismatches"])


@pytest.mark.full
def test_effect_in_addition_to_expected_ones_is_identified():
    diagnosis = diagnose_against_model([SPIKES, MEMORY], more=[JUMP], axes="xy")
    assert [effect["name"] for effect in diagnosis.effects] == ["bias_jump"]
    assert (
        diagnosis.effects[0]["parameters"]["step"]["low"]
        < 1.0
        < diagnosis.effects[0]["parameters"]["step"]["high"]
    )
    (expected,) = diagnosis.content["baseline"]["expected"]  # with the size that it has here
    assert (expected["name"], expected["axes"]) == ("spikes", ["x"])
    assert "per hour" in expected["statement"], expected["statement"]
    assert "spikes" not in diagnosis.content["not_found"]


@pytest.fixture(scope="module")
def blocks():
    model = {"noise": NOISE, "log": {"axes": ["x"]}, "environment": [TURN, SHAKE]}
    return reduce_log(simulate(model, duration="25min", rate=10.0, seed=4).compute())


@pytest.mark.parametrize(("memory", "rms"), [(300.0, 0.5), (30.0, 0.5)])
def test_null_means_wander_like_the_model(blocks, memory, rms):
    """The covariance of block means is that of the double integral of the exponential memory."""
    effect = {"name": "gauss_markov", "rms": rms, "correlation_time": memory}
    baseline = baseline_from_model(blocks, {"noise": {"N": 1e-5}, "effect": [effect]})
    drawn = np.concatenate(
        [
            record["mean"].values[:, 0]
            for record in null_records(blocks, baseline, count=600, rng=np.random.default_rng(2))
        ]
    )
    a = float(blocks.attrs["block_s"]) / memory
    own, next_one = 2.0 * (a + np.expm1(-a)) / a**2, (np.expm1(-a) / a) ** 2
    assert (drawn**2).mean() == pytest.approx(rms**2 * own, rel=0.05)
    assert (drawn[:, 1:] * drawn[:, :-1]).mean() == pytest.approx(
        rms**2 * next_one, rel=0.08, abs=0.02 * rms**2
    )
    assert interval_variance(np.array([a])) == pytest.approx(own)


def test_null_means_walk_during_vibration(blocks):
    effect = {"name": "vibration_random_walk", "sensitivity": 0.3}
    baseline = baseline_from_model(blocks, {"noise": {"N": 0.003}, "effect": [effect]})
    nulls = np.concatenate(
        [
            record["mean"].values[:, 0]
            for record in null_records(blocks, baseline, count=400, rng=np.random.default_rng(3))
        ]
    )
    begin, end = blocks["begin"].values, blocks["end"].values
    still, shaken = end <= 500.0, (begin >= 520.0) & (end <= 900.0)
    span = (end[shaken][-1] - end[shaken][0]) / 3600.0
    moved = nulls[:, np.flatnonzero(shaken)[-1]] - nulls[:, np.flatnonzero(shaken)[0]]
    block = float(blocks.attrs["block_s"]) / 3600.0
    assert moved.var() == pytest.approx(
        (0.3 * 6.0) ** 2 * (span - block / 3.0), rel=0.15
    )  # K^2 t, less what the means smooth
    assert np.diff(nulls[:, still]).var() < 0.02 * moved.var()
    walk = expected_processes(baseline, "x").walk
    assert walk[shaken] == pytest.approx((0.3 * 6.0) ** 2 / 3600.0, rel=0.02)


def test_blocks_with_a_moving_known_rate_are_left_out(blocks):
    baseline = baseline_from_model(
        blocks, {"noise": NOISE, "effect": [{"name": "scale_factor", "linear": 1000.0}]}
    )
    moving = find_blocks_with_known_motion(blocks, baseline)[0]
    begin, end = blocks["begin"].values, blocks["end"].values
    ramp = ((begin < 330.0) & (end > 300.0)) | ((begin < 830.0) & (end > 800.0))
    assert moving[ramp].all()
    assert not moving[(end < 270.0) | ((begin > 360.0) & (end < 770.0)) | (begin > 860.0)].any()


@pytest.mark.parametrize(
    ("frequency", "quality"),
    [(0.3, 20.0), (1.3, 30.0), pytest.param(0.21, 60.0, marks=pytest.mark.full)],
)
def test_narrow_resonance_is_expected_with_the_leakage_of_the_taper(frequency, quality):
    """Compare with white noise through a resonator of scipy, driven far longer than its memory."""
    effect = {"name": "spectral_line", "amplitude": 1.0, "frequency": frequency, "quality": quality}
    rng = np.random.default_rng(5)
    rate, fine = 10.0, 40.0
    poles = 2.0 * np.pi * frequency * np.array([-1.0, -1.0]) / (
        2.0 * quality
    ) + 2j * np.pi * frequency * np.sqrt(1.0 - 1.0 / (4.0 * quality**2)) * np.array([1.0, -1.0])
    b, a = signal.cont2discrete(
        ([1.0, 0.0], np.real(np.poly(poles))), 1.0 / fine, method="bilinear"
    )[:2]
    values = signal.lfilter(b[0], a, rng.standard_normal(int(40_000 * fine)))[int(2000 * fine) :]
    values *= np.sqrt(0.5) / values.std()
    means = values[: values.size // 4 * 4].reshape(-1, 4).mean(axis=1)
    log = gyrostab.make_log(means[None], rate=rate, unit="deg/h")
    blocks = reduce_log(log, block="20s")
    baseline = baseline_from_model(blocks, {"noise": {"N": 1e-4}, "effect": [effect]})
    recorded, expected = (
        blocks["power"].values[0].mean(axis=0),
        baseline["spectrum"].values[0].mean(axis=0),
    )
    is_near_line = expected > 0.02 * expected.max()
    assert is_near_line.sum() >= 2
    np.testing.assert_allclose(recorded[is_near_line], expected[is_near_line], rtol=0.25)
    scatter = blocks["power"].values[0, :, is_near_line].var(axis=1) / recorded[is_near_line] ** 2
    assert (scatter / (1.0 / baseline["shape_alone"].values[0, 0, is_near_line]) > 0.4).all()
    assert (
        scatter[np.argmax(recorded[is_near_line])]
        < 2.5
        / baseline["shape_alone"].values[
            0, 0, np.flatnonzero(is_near_line)[np.argmax(recorded[is_near_line])]
        ]
    )
