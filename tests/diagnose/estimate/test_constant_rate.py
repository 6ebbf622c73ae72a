"""Constant rates of a model, and noise that truncated values lack."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.estimate.constant_rate import constant_rates, noise_lost_by_truncation
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
    lost = noise_lost_by_truncation(blocks, effects)
    if mode == "round":
        assert not lost
        return
    variance = float(blocks["variance"].sel(axis="y").mean())
    assert variance - 1.0 / 12.0 < 0.97 * scatter**2
    assert variance - 1.0 / 12.0 + lost["y"] == pytest.approx(scatter**2, rel=0.08)
