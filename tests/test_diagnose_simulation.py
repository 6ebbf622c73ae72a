"""A recording against a simulated log, the whole way: nothing where they are alike, the effect where it is in one only."""

from __future__ import annotations

from functools import cache

import pytest

import gyrostab
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
SHAKE = {"profile": "vibration", "points": [[0, 0.02], [700, 0.02], [720, 6.0], [1000, 6.0], [1020, 0.02], [1500, 0.02]]}


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
