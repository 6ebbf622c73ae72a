"""Records simulated from a model are compared with the recording without any refit."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab import simulate
from gyrostab.blindtest.scoring.resimulation import check_model

RATE, SIZE = 10.0, 18_000
NOISE = {axis: {"N": 0.003, "B": 0.002} for axis in "xy"}
EFFECTS: list[dict[str, Any]] = [
    {"name": "temperature_bias", "sensitivity": 0.003},
    {"name": "temperature_noise", "linear": 0.02},
    {"name": "vibration_noise", "white": 0.002},
    {"name": "spectral_line", "frequency": 1.7, "amplitude": 0.3},
    {"name": "telegraph", "step": [0.5], "low": 40.0, "high": 60.0},
    {"name": "held_samples", "per_hour": 200.0},
    {"name": "dead_zone", "width": 0.05},
    {"name": "shared_source", "N": [0.002]},
    {"name": "feedback_reset", "kick": 60.0, "phase": "channel"},
]


@cache
def environment() -> xr.Dataset:
    """Half an hour with a temperature that rises, a shake in the middle, and a ramp."""
    log = simulate({"noise": NOISE}, duration=SIZE / RATE, rate=RATE, seed=9).compute()
    seconds = np.arange(SIZE) / RATE
    log["temperature"] = ("time", 25.0 + seconds / 60.0, {"units": "degree_Celsius"})
    shake = np.where(abs(seconds - 900.0) < 300.0, 1.0, 0.01)
    log["vibration"] = ("time", shake, {"units": "g"})
    log["ramp"] = ("time", np.mod(seconds * 0.417, 1.0), {"units": "1"})
    return log


def recording_of(*effects: dict[str, Any]) -> xr.Dataset:
    """Simulate a recording with effects; a sample of each minute is lost."""
    like = environment()
    model = {"noise": NOISE, "effect": list(effects)}
    log = simulate(model, like=like, seed=1234).compute()
    log = log.assign({name: like[name] for name in ("temperature", "vibration", "ramp")})
    log["rate"][:, ::600] = np.nan
    return log


@pytest.fixture(scope="module")
def noise_alone() -> xr.Dataset:
    return recording_of()


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect["name"])
def test_record_with_the_effect_is_nearer_only_if_the_recording_has_it(
    effect: dict[str, Any], noise_alone: xr.Dataset
):
    model = {"noise": NOISE, "effect": [effect]}
    present = check_model(recording_of(effect), model)
    assert present["runs"]
    assert present["nats"] > 5.0
    assert check_model(noise_alone, model)["nats"] < -5.0


def test_equal_models_are_equally_near(noise_alone: xr.Dataset):
    assert check_model(noise_alone, {"noise": NOISE, "effect": []})["nats"] == 0.0


def test_model_that_cannot_be_simulated_is_reported(noise_alone: xr.Dataset):
    model = {"noise": NOISE, "effect": [{"name": "light_power_noise", "thermal": 0.2}]}
    found = check_model(noise_alone, model)
    assert not found["runs"]
    assert "light_power" in found["reason"]
