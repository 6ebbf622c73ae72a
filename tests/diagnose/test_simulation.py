"""A recording against a simulated log, the whole way: nothing where they are alike, the effect where it is in one only."""

from __future__ import annotations

from functools import cache

import pytest

import gyrostab
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
SHAKE = {
    "profile": "vibration",
    "points": [[0, 0.02], [700, 0.02], [720, 6.0], [1000, 6.0], [1020, 0.02], [1500, 0.02]],
}


@cache
def log_of(seed: int, *sizes: float):
    effects = [{"name": "vibration_noise", "white": size} for size in sizes]
    model = {"noise": NOISE, "effect": effects, "environment": [SHAKE], "log": {"axes": ["x"]}}
    return simulate(model, duration="25min", rate=10.0, seed=seed).compute()


def test_a_simulation_of_the_same_model_is_no_mismatch():
    found = gyrostab.diagnose(log_of(2), simulation=log_of(1), nulls=100)
    assert found.verdict == "no mismatch"
    assert found.effects == []
    assert found.content["baseline"]["source"] == "simulation"


def test_what_the_simulation_lacks_is_named():
    found = gyrostab.diagnose(log_of(2, 0.0006), simulation=log_of(1), nulls=100)
    assert found.verdict == "explained"
    (effect,) = found.effects
    assert effect["name"] == "vibration_noise"
    assert effect["parameters"]["white"]["low"] < 0.0006 < effect["parameters"]["white"]["high"]
    assert found.model["noise"]["x"]["N"] == pytest.approx(0.003, rel=0.1)


SHARED = {"name": "shared_source", "N": 0.0015, "axes": ["x", "y"]}
LINE = {"name": "spectral_line", "amplitude": 0.3, "frequency": 1.337, "axes": ["x"]}
BUMP = {"name": "spectral_line", "amplitude": 0.5, "frequency": 2.6, "quality": 8.0, "axes": ["y"]}


@cache
def axes_log(seed: int, *names: str):
    effects = {"shared_source": SHARED, "line": LINE, "bump": BUMP}
    model = {
        "noise": NOISE,
        "effect": [effects[name] for name in names],
        "log": {"axes": ["x", "y"]},
    }
    return simulate(model, duration="25min", rate=10.0, seed=seed).compute()


@pytest.mark.parametrize("seed", [11, 12])
def test_what_a_simulation_shows_all_the_time_is_no_mismatch(seed):
    names = ("shared_source", "line", "bump")
    found = gyrostab.diagnose(
        axes_log(seed, *names), simulation=axes_log(seed + 100, *names), nulls=100
    )
    assert found.verdict == "no mismatch"


@pytest.mark.parametrize("lacking", ["shared_source", "line"])
def test_what_a_simulation_lacks_beside_what_it_shows_is_named(lacking):
    names = ("shared_source", "line", "bump")
    simulation = axes_log(111, *(name for name in names if name != lacking))
    found = gyrostab.diagnose(axes_log(11, *names), simulation=simulation, nulls=100)
    assert [effect["name"] for effect in found.effects] == [
        {"line": "spectral_line"}.get(lacking, lacking)
    ]
