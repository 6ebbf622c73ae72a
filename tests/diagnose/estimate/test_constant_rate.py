"""Constant rates of a model, and noise that truncated values lack."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.estimate.constant_rate import constant_rates, undo_noise_loss
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import simulate
from gyrostab.units import HOUR

WARM = {
    "profile": "ramps",
    "channel": "temperature",
    "unit": "degC",
    "points": [[0, 35], [900, 55]],
}
BIAS = {"x": -3.0, "y": 0.4}


def reduce_simulation(*effects, noise=0.003):
    tables = {"noise": {"N": noise}, "bias": BIAS, "effect": list(effects), "environment": [WARM]}
    return reduce_log(simulate(tables, duration="900s", rate=10.0, seed=2))


def test_constant_rate_is_the_mean_without_the_effects():
    effects = [
        {"name": "temperature_bias", "sensitivity": 0.05, "axes": ["x"]},
        {"name": "misalignment", "x": 20.0, "axes": ["z"], "motion": "recorded"},
    ]
    blocks = reduce_simulation(effects[0])
    rates = constant_rates(blocks, [make_effect(table) for table in effects])
    leak = 0.02 * float(blocks["mean"].sel(axis="x").mean())
    assert rates == pytest.approx({"x": -3.0, "y": 0.4, "z": -leak}, abs=0.03)


@pytest.mark.parametrize(("mode", "noise"), [("zero", 0.003), ("zero", 0.01), ("round", 0.003)])
def test_rounded_values_have_the_constant_rate_and_noise_of_those_before(mode, noise):
    rounding = {"name": "rate_quantization", "step": 1.0, "mode": mode}
    blocks = reduce_simulation(rounding, noise=noise)
    effects = [make_effect(rounding)]
    scatter = noise * np.sqrt(HOUR * 10.0)
    error = 5.0 * scatter / np.sqrt(9000.0)
    assert constant_rates(blocks, effects)["x"] == pytest.approx(-3.0, abs=error)
    assert constant_rates(blocks, effects)["y"] == pytest.approx(0.4, abs=error)
    after = float(blocks["variance"].sel(axis="y").mean()) - 1.0 / 12.0
    recorded = {"y": {"N": math.sqrt(after / (HOUR * 10.0)), "B": 0.0, "K": 0.0}}
    undone = undo_noise_loss(recorded, blocks.sel(axis=["y"]), effects)
    if mode == "round":
        assert undone == recorded
        return
    assert after < 0.97 * scatter**2
    assert undone["y"]["N"] == pytest.approx(noise, rel=0.04)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize(
    "table",
    [
        {"name": "clipping", "limit": 0.5, "centre": 0.4},
        {"name": "clipping", "limit": 0.8},
        {"name": "dead_zone", "width": 0.4, "centre": 0.4},
        {"name": "dead_zone", "width": 0.4, "centre": 0.7},
        {"name": "dead_zone", "width": 0.6, "edge": "jump"},
    ],
    ids=lambda table: "-".join(map(str, table.values())),
)
def test_noise_and_rate_are_those_before_a_limit_or_a_dead_zone(table, lost):
    blocks = reduce_simulation(table | {"axes": ["y"]}).sel(axis=["y"])
    if lost:  # every fourth block
        is_lost = xr.DataArray(np.arange(blocks.sizes["block"]) % 4 == 0, dims="block")
        blocks = blocks.assign(
            mean=blocks["mean"].where(~is_lost),
            variance=blocks["variance"].where(~is_lost),
            samples=blocks["samples"].where(~is_lost, 0),
        )
    after = float(blocks["variance"].mean())
    recorded = {"y": {"N": math.sqrt(after / (HOUR * 10.0)), "B": 0.01, "K": 0.0}}
    effect = make_effect(table)
    undone = undo_noise_loss(recorded, blocks, [effect])["y"]
    assert recorded["y"]["N"] < 0.93 * 0.003 or table.get("edge") == "jump"
    assert undone["N"] == pytest.approx(0.003, rel=0.03)
    assert undone["B"] > 0.0105
    assert constant_rates(blocks, [effect])["y"] == pytest.approx(0.4, abs=0.05)
