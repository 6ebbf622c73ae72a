"""Detection limits: closed forms, simulated likelihoods, and what fitted noise absorbs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from gyrostab.blindtest.generator.catalogue import CATALOGUE
from gyrostab.blindtest.generator.detection_limits import (
    NATS,
    amplitude_for,
    learned_filter_nats,
    learned_nats,
    learned_random_nats,
    mean_size,
    shared_size,
    variance_nats,
    variance_size,
)
from gyrostab.blindtest.generator.noise import BANDS
from gyrostab.blindtest.generator.scenario import AXES, draw_scenario, stream
from gyrostab.blindtest.generator.shapes import fit_lagged_driver
from gyrostab.blindtest.generator.wander import course_nats, wander_size
from tests.support.blind_cases import white_scenario


def test_limit_of_a_mean_matches_closed_form():
    scenario = white_scenario()
    mean = np.zeros((3, scenario.size))
    mean[1, 5000:8000] = 1.0  # 300 s of 2000 s
    effective = 300 * (1 - 300 / 2000)
    smallest = 60 * 0.004 * math.sqrt(2 * NATS / effective)
    assert mean_size(scenario, mean * smallest) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(("size", "time"), [(0.3, 80.0), (-0.05, 15.0), (2.0, 0.0)])
def test_lagged_driver_fit_recovers_static_sensitivity_and_lag(size, time):
    scenario = replace(white_scenario(), missing=np.arange(20_000) % 7 < 2)
    step = np.where(np.arange(scenario.temperature.size) >= 600, 1.5, 0.0)
    since = np.maximum(np.arange(scenario.size) / scenario.rate - 600.0, 0.0)
    mean = (
        1.5 * size * (1.0 - np.exp(-since / time))
        if time
        else 1.5 * size * np.interp(since, [0, 1e-9], [0, 1])
    )
    fitted = fit_lagged_driver(scenario, np.asarray(mean), step, axis=0)
    assert fitted[0] == pytest.approx(size, rel=0.01)
    assert fitted[1] == pytest.approx(time, abs=1.5)  # the driver has one value a second


def test_true_parameters_of_a_slow_supply_bias_explain_it():
    """An instantaneous response would leave a tenth or more unexplained."""
    scenario = white_scenario()
    slow = [
        e
        for s in range(12)
        if (
            e := CATALOGUE["supply_bias"].make(scenario, stream(s, "slow"), strength=4.0)
        ).form_differs
    ]
    volt = np.repeat(scenario.supply, 10)[: scenario.size]
    assert len(slow) >= 4
    for effect in slow:
        for axis in effect.axes:
            mean = effect.mean[AXES.index(axis)]
            size, late = (effect.parameters[name]["values"][axis] for name in ("voltage", "lag"))
            decay = math.exp(-0.1 / late)
            followed = volt[0] + lfilter([1 - decay], [1, -decay], volt - volt[0])
            assert np.var(mean - size * followed) < 0.05 * np.var(mean)


def test_latitude_follows_from_the_cross_axis_earth_rate():
    scenario = draw_scenario(np.random.default_rng(3), rate=10.0, seconds=900.0)
    turning = np.arange(scenario.rotation.size) * 0.1 < 300.0  # at rest longer than turning
    scenario = replace(scenario, rotation=np.where(turning, 60.0, 0.0))
    for seed in range(4):
        effect = CATALOGUE["earth_rate"].make(scenario, stream(seed, "rest"), strength=4.0)
        across = np.median(np.hypot(effect.mean[0], effect.mean[1]))
        assert math.cos(
            math.radians(effect.parameters["latitude"]["value"])
        ) * 15.041 == pytest.approx(across, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "term"),
    [
        ("temperature_bias", "quadratic"),
        ("vibration_rectification", "quartic"),
        ("scale_factor", "cubic"),
    ],
)
def test_nonlinear_response_is_not_compared_with_a_single_term(name, term):
    scenario = draw_scenario(np.random.default_rng(3), rate=10.0, seconds=900.0)
    scenario = replace(
        scenario, rotation=np.maximum(scenario.rotation, 1e-3 * np.arange(scenario.rotation.size))
    )
    made = [CATALOGUE[name].make(scenario, stream(s, "bend"), strength=4.0) for s in range(12)]
    marks = {
        effect.form_differs: [entry.get("unless", ()) for entry in effect.parameters.values()]
        for effect in made
    }
    assert any(term in names for names in marks[True])
    assert not any(marks[False])


@pytest.mark.parametrize(
    ("frequency", "least", "most"), [(0.5, 0.8, 1.0), (1 / 4000, 0.0, 0.2)], ids=["fast", "slow"]
)
def test_fitted_noise_absorbs_a_slow_mean_only(frequency, least, most):
    scenario = white_scenario()
    mean = np.zeros((3, scenario.size))
    mean[1] = np.cos(2 * math.pi * frequency * np.arange(scenario.size) / scenario.rate)
    mean *= 8.0 / mean_size(scenario, mean)
    share = learned_nats(scenario, mean) / (NATS * 64.0)
    assert least <= share <= most
    assert learned_nats(scenario, np.zeros_like(mean)) == 0.0


def test_fitted_noise_absorbs_random_walk_and_not_a_fast_random_bias():
    scenario = white_scenario()
    shares = np.array([1.0, 0.0, 0.0])
    assert learned_random_nats(scenario, shares, lambda f: 1e-5 / f**2) < 0.01
    assert learned_random_nats(scenario, shares, lambda f: 1e-3 / f) < 0.01
    shares_left = []
    for time in (0.2, 20.0):
        rms = amplitude_for(
            lambda rms, time=time: wander_size(scenario, shares, time=time, rms=rms)[0], 8.0
        )
        known = wander_size(scenario, shares, time=time, rms=rms)[1]
        shares_left.append(
            learned_random_nats(
                scenario,
                shares,
                lambda f, time=time, rms=rms: (
                    2 * rms**2 * time / (1 + (2 * math.pi * f * time) ** 2)
                ),
            )
            / known
        )
    fast, slow = shares_left
    assert 0.0 < slow < 0.1 < fast < 1.0


def draw_course(rng: np.random.Generator, size: int, dwell: np.ndarray) -> np.ndarray:
    level = np.empty(size)
    level[0] = rng.random() < dwell[1] / dwell.sum()
    leave = -np.expm1(-1.0 / dwell)
    for at in range(1, size):
        switches = rng.random() < leave[int(level[at - 1])]
        level[at] = 1 - level[at - 1] if switches else level[at - 1]
    return level


def test_a_course_of_independent_levels_costs_what_a_binary_channel_tells():
    """Mutual information of a fair bit and a normal reading of it, for every second."""
    scenario, dwell = white_scenario(), np.full(2, 1.0 / math.log(2.0))
    course = draw_course(np.random.default_rng(1), scenario.temperature.size, dwell)
    step = 0.3  # deg/h between the levels; a mean over a second scatters by 60 N
    information = (step / (60 * 0.004)) ** 2
    odds = np.linspace(-12, 12, 4001) * math.sqrt(information) + information / 2
    density = np.exp(-((odds - information / 2) ** 2) / 2 / information)
    density /= density.sum()
    bit = math.log(2.0) - float(density @ np.log1p(np.exp(-odds)))
    cost = course_nats(
        scenario, np.array([0.0, step, 0.0]), course, dwell, np.random.default_rng(2)
    )
    assert cost == pytest.approx(bit * course.size, rel=0.05)


def test_a_course_that_is_seen_clearly_costs_its_own_surprise():
    scenario, dwell = white_scenario(), np.array([40.0, 90.0])
    course = draw_course(np.random.default_rng(3), scenario.temperature.size, dwell)
    leave = -np.expm1(-1.0 / dwell)
    before, after = course[:-1].astype(int), course[1:].astype(int)
    chance = np.where(before == after, 1.0 - leave[before], leave[before])
    start = dwell[int(course[0])] / dwell.sum()
    surprise = -float(np.log(chance).sum()) - math.log(start)
    rng = np.random.default_rng(4)
    clear, hidden = (
        course_nats(scenario, np.array([size, 0.0, size]), course, dwell, rng)
        for size in (30.0, 1e-4)
    )
    assert clear == pytest.approx(surprise, abs=0.05)  # the first level is drawn by mean times
    assert hidden == pytest.approx(0.0, abs=0.05)


def test_the_turn_that_a_misaligned_axis_sees_is_no_evidence_in_fitted_noise():
    scenario = white_scenario()
    effect = CATALOGUE["misalignment"].make(scenario, stream(1, "turn"), strength=8.0)
    assert effect.mean is not None
    assert effect.learned_nats is not None
    leak = effect.mean * (np.arange(3) != 2)[:, None]
    assert effect.learned_nats == pytest.approx(learned_nats(scenario, leak))
    assert effect.learned_nats < 0.5 * effect.nats < learned_nats(scenario, effect.mean)


@pytest.mark.parametrize(
    ("quantization", "least", "most"), [(0.0, 0.98, 1.0), (0.02, 0.3, 0.9), (0.2, 0.0, 0.01)]
)
def test_less_quantization_noise_looks_like_a_filter_of_two_neighbours(quantization, least, most):
    """`quantization` is 1.5 times the share of Q in the variance of a sample."""
    white = white_scenario()
    step = math.sqrt(quantization / 3.0) * 60.0 / math.sqrt(white.rate)
    urad = math.degrees(1e-6) * 3600.0
    scenario = replace(
        white,
        noise=tuple(noise | {"Q": step * noise["N"] / urad} for noise in white.noise),
    )
    effect = CATALOGUE["logger_filter"].make(scenario, stream(1, "filter"), strength=4.0)
    assert effect.learned_nats is not None
    assert least <= effect.learned_nats / effect.nats <= most
    assert learned_filter_nats(scenario, np.ones(200)) < 1e-6


def test_limit_of_a_mean_matches_simulated_likelihoods():
    scenario = replace(
        white_scenario(), noise=tuple({"N": 0.003, "B": 0.002, "K": 0.02, "Q": 0.0} for _ in AXES)
    )
    t = np.arange(scenario.size) / scenario.rate
    mean = np.zeros((3, scenario.size))
    mean[0] = np.cos(2 * math.pi * t / 700)
    mean *= 2.0 / mean_size(scenario, mean)
    white_size = mean_size(scenario, mean, white=True)
    assert white_size > 2.05  # random walk hides a slow mean: equal size needs more amplitude
    from scipy import fft

    from gyrostab.blindtest.generator.noise import floor_psd
    from gyrostab.blindtest.generator.record import draw_base_noise

    f = np.arange(1, scenario.size) * scenario.rate / 2 / scenario.size
    density = floor_psd(f, noise=scenario.noise[0], rate=scenario.rate) * scenario.rate
    lines = fft.dct(mean[0], norm="ortho")[1:]
    ratios = []
    for seed in range(100):
        noise = draw_base_noise(scenario, np.random.default_rng(seed))[0]
        ratios.append(
            float((lines * (fft.dct(noise, norm="ortho")[1:] + lines / 2) / density).sum())
        )
    nats = NATS * 4.0
    assert np.mean(ratios) == pytest.approx(nats, abs=4 * math.sqrt(2 * nats / 100))
    assert np.var(ratios) == pytest.approx(2 * nats, rel=0.5)


def test_limits_of_noise_effects_match_closed_forms():
    scenario = white_scenario()
    n = scenario.size
    step = np.ones((3, scenario.temperature.size))
    step[0, :1000] = math.exp(
        2 * math.sqrt(NATS / n) * 2
    )  # for half of the time T_eff is a quarter of T
    assert variance_size(scenario, step) == pytest.approx(1.0, rel=0.01)
    always = np.full((3, 1, 10), 1.0)
    always[1] = math.exp(2 * math.sqrt(NATS / n))
    assert variance_size(scenario, always) == pytest.approx(1.0, rel=1e-6)
    assert variance_nats(scenario, always) == pytest.approx(NATS, rel=0.05)
    shares = np.array([1.0, 1.0, 0.0]) * (2 * NATS / n) ** 0.25
    assert shared_size(scenario, shares, np.ones(BANDS)) == pytest.approx(1.0, rel=0.01)
    assert amplitude_for(lambda a: a**1.5, 8.0) == pytest.approx(4.0, rel=1e-3)
