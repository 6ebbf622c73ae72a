"""A recording against a simulated log: no mismatch if alike, else the effect that one lacks."""

from __future__ import annotations

import warnings
from functools import cache

import pytest

import gyrostab
from gyrostab.diagnose.task import read_simulation
from gyrostab.simulate import simulate
from tests.support.repetitions import first_of

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
SHAKE = {
    "profile": "vibration",
    "points": [[0, 0.02], [700, 0.02], [720, 6.0], [1000, 6.0], [1020, 0.02], [1500, 0.02]],
}


@cache
def simulate_log(seed: int, *sizes: float):
    effects = [{"name": "vibration_noise", "white": size} for size in sizes]
    model = {"noise": NOISE, "effect": effects, "environment": [SHAKE], "log": {"axes": ["x"]}}
    return simulate(model, duration="25min", rate=10.0, seed=seed).compute()


@pytest.mark.slow
def test_same_model_has_no_mismatch():
    diagnosis = gyrostab.diagnose(simulate_log(2), simulation=simulate_log(1), nulls=100)
    assert diagnosis.verdict == "no mismatch"
    assert diagnosis.effects == []
    assert diagnosis.content["baseline"]["source"] == "simulation"


@pytest.mark.slow
def test_effect_missing_in_the_simulation_is_identified():
    diagnosis = gyrostab.diagnose(simulate_log(2, 0.0006), simulation=simulate_log(1), nulls=100)
    assert diagnosis.verdict == "explained"
    (effect,) = diagnosis.effects
    assert effect["name"] == "vibration_noise"
    assert effect["parameters"]["white"]["low"] < 0.0006 < effect["parameters"]["white"]["high"]
    assert diagnosis.model["noise"]["x"]["N"] == pytest.approx(0.003, rel=0.1)


SHARED = {"name": "shared_source", "N": 0.0015, "axes": ["x", "y"]}
LINE = {"name": "spectral_line", "amplitude": 0.3, "frequency": 1.337, "axes": ["x"]}
BUMP = {"name": "spectral_line", "amplitude": 0.5, "frequency": 2.6, "quality": 8.0, "axes": ["y"]}


@cache
def simulate_axes(seed: int, *names: str):
    effects = {"shared_source": SHARED, "line": LINE, "bump": BUMP}
    model = {
        "noise": NOISE,
        "effect": [effects[name] for name in names],
        "log": {"axes": ["x", "y"]},
    }
    return simulate(model, duration="25min", rate=10.0, seed=seed).compute()


@pytest.mark.full
@pytest.mark.parametrize("seed", first_of(11, 12))
def test_steady_effects_of_the_simulation_are_not_mismatches(seed):
    names = ("shared_source", "line", "bump")
    diagnosis = gyrostab.diagnose(
        simulate_axes(seed, *names), simulation=simulate_axes(seed + 100, *names), nulls=100
    )
    assert diagnosis.verdict == "no mismatch"


@pytest.mark.slow
@pytest.mark.parametrize("lacking", first_of("line", "shared_source"))
def test_effect_in_addition_to_the_simulation_is_identified(lacking):
    names = ("shared_source", "line", "bump")
    simulation = simulate_axes(111, *(name for name in names if name != lacking))
    diagnosis = gyrostab.diagnose(simulate_axes(11, *names), simulation=simulation, nulls=100)
    assert [effect["name"] for effect in diagnosis.effects] == [
        {"line": "spectral_line"}.get(lacking, lacking)
    ]


def test_effects_on_the_rate_of_a_simulated_log_are_noted():
    warm = {"profile": "steps", "channel": "temperature", "unit": "degC", "points": [[0, 35]]}
    noise = {"noise": {"N": 0.01}}
    effect = {"name": "temperature_bias", "sensitivity": 0.1}
    biased = simulate(
        noise | {"effect": [effect], "environment": [warm]}, duration="1min", rate=10.0
    )
    with pytest.warns(UserWarning, match=r"effects on the rate: temperature_bias; .* their model"):
        read_simulation(biased, biased)
    plain = simulate(noise, duration="1min", rate=10.0)
    foreign = plain.assign_attrs(simulation_model="[[effect")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_simulation(plain, plain)
        read_simulation(plain, foreign)
