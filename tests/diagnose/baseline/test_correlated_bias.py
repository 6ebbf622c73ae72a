"""Evidence of an exponentially correlated bias, from means and powers of simulated records."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

from gyrostab import diagnose
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.correlated_bias import CorrelatedBias, find_correlated_bias
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.identify.components import select_components
from gyrostab.diagnose.predict.condition import condition_on, refit_powers
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.noise import NORMAL_95
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}


def _make_model(noise: dict[str, float], rms: float = 0.0, time: float = 1.0) -> dict:
    bias = {"name": "gauss_markov", "axes": ["x"], "rms": rms, "correlation_time": time}
    return {"noise": {"x": noise, "y": NOISE}, "effect": [bias] if rms else []}


def _start_state(log: xr.Dataset) -> State:
    blocks = reduce_log(log)
    return initial_state(blocks, calibrate_noise(blocks))


def _find_on_x(model: dict, seed: int, duration: str = "1h") -> CorrelatedBias:
    log = simulate(model, duration=duration, rate=10.0, seed=seed).sel(axis=["x"])
    found = find_correlated_bias(_start_state(log), "x")
    assert found is not None
    return found


@pytest.mark.full
@pytest.mark.parametrize(
    "noise",
    [
        pytest.param({"N": 0.003}, id="white"),
        pytest.param({"N": 0.003, "B": 0.1, "K": 1.0, "Q": 0.3}, id="strong"),
        pytest.param({"N": 0.003, "K": 1000.0}, id="far above white noise"),
    ],
)
def test_noise_shows_no_bias(noise):
    """By Markov's inequality at most one record in 20 exceeds 3 nats."""
    nats = [_find_on_x(_make_model(noise), seed, "40min").nats for seed in range(3)]
    assert max(nats) < 3.0
    assert np.median(nats) < 0.0


@pytest.mark.full
@pytest.mark.parametrize(
    ("rms", "time", "count"),
    [(0.3, 20.0, 5), (0.1, 30.0, 40), (0.15, 100.0, 40)],
)
def test_bias_is_found_with_its_size_and_time(rms, time, count):
    """The logarithms of both are within 3.5 standard errors, and the errors are of the right size.

    The mean of n squared errors, in standard errors, is 1 with a standard deviation of sqrt(2 / n).
    """
    found = [_find_on_x(_make_model(NOISE, rms, time), seed) for seed in range(count)]
    errors = np.log([(bias.rms / rms, bias.time / time) for bias in found])
    z = errors / np.sqrt([np.diag(bias.covariance) for bias in found])
    assert np.abs(z).max() < 3.5
    square = np.mean(z**2, axis=0)
    assert (np.abs(square - 1.0) < 3.0 * np.sqrt(2.0 / count)).all()
    assert (square > 0.05).all()
    assert np.mean([bias.nats for bias in found]) > 3.0


def test_a_bias_in_the_model_is_no_evidence_of_another():
    model = _make_model({"N": 0.003}, 1.0, 20.0)
    blocks = reduce_log(simulate(model, duration="40min", rate=10.0, seed=6))
    found = find_correlated_bias(initial_state(blocks, baseline_from_model(blocks, model)), "x")
    assert found is not None
    assert found.nats < 3.0


@pytest.mark.full
def test_bands_of_lines_are_no_evidence_of_a_bias():
    """The lines are in the model, with powers of their own sizes; means alone have angle noise."""
    log = simulate(_make_model({"N": 0.003}), duration="40min", rate=10.0, seed=3).sel(axis=["x"])
    phase = 2.0 * np.pi * np.arange(log.sizes["time"]) / 10.0
    log["rate"] = log["rate"] + sum(3.0 * np.sin(f * phase) for f in (0.11, 0.17, 0.23))
    state = _start_state(log)
    assert state.baseline["angle_variance"].all()
    state = replace(state, baseline=state.baseline.assign(angle_variance=("axis", np.zeros(1))))
    bands = state.blocks.sizes["band"]
    where = np.flatnonzero(state.blocks["band_high"].values <= 0.3)
    columns = [
        np.broadcast_to(np.eye(bands)[band], state.expected_power.shape[1:]) for band in where
    ]
    in_model = refit_powers(state.with_columns("power", "x", columns))
    found = [find_correlated_bias(tried, "x") for tried in (in_model, state)]
    with_lines, without = (bias.nats for bias in found if bias is not None)
    assert with_lines < 3.0 < without


def test_a_bias_with_another_spectrum_is_found_once():
    """A second-order process has a steeper spectrum, which several of first order would follow."""
    log = simulate(_make_model(NOISE), duration="1h", rate=10.0, seed=4).sel(axis=["x"])
    rng = np.random.default_rng(5)
    decay = np.exp(-0.1 / 12.0)
    bias = lfilter([1.0], [1.0, -2.0 * decay, decay**2], rng.standard_normal(log.sizes["time"]))
    log["rate"] = log["rate"] + xr.DataArray(0.3 * bias / bias.std(), dims="time")
    state = _start_state(log)
    effects, _ = effect_candidates(state.blocks, state.baseline["coefficient"])
    (candidate,) = [
        candidate
        for candidate in effects
        if candidate.key == "gauss_markov" and candidate.statistic.name == "wandering_bias"
    ]
    (evidence,) = compute_evidence([candidate], state.blocks, state)
    assert evidence.evidence_nats[0, 0] > 10.0
    in_model = condition_on(state, select_components(evidence, DEFAULTS))
    (evidence,) = compute_evidence([candidate], state.blocks, in_model)
    assert evidence.evidence_nats[0, 0] < 0.0


@pytest.mark.slow
def test_bias_is_named_on_its_axis_and_may_be_a_telegraph():
    log = simulate(_make_model(NOISE, 0.2, 15.0), duration="30min", rate=10.0, seed=8)
    content = json.loads(diagnose(log, nulls=100).to_json())
    (effect,) = content["effects"]
    assert (effect["name"], effect["axes"]) == ("gauss_markov", ["x"])
    assert effect["alternatives"] == ["telegraph"]
    assert content["verdict"] == "explained"
    # no held-out data show its course: its evidence is that of the whole record
    gain = content["held_out"]["log_likelihood_gain"]
    assert gain == pytest.approx(effect["held_out_gain"]["nats"], abs=0.1)
    for name, truth in (("rms", 0.2), ("correlation_time", 15.0)):
        size = effect["parameters"][name]
        assert abs(np.log(size["value"] / truth)) < 1.5 * NORMAL_95 * size["stderr"] / size["value"]
        assert size["low"] < size["value"] < size["high"]
