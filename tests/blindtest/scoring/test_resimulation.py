"""Records simulated from a model are compared with the recording without any refit."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest
import xarray as xr

from gyrostab import simulate
from gyrostab.blindtest.scoring.resimulation import (
    check_model,
    likelihood_ratio,
    measure_statistics,
    record_statistics,
    simulate_statistics,
)

RATE, SIZE = 10.0, 18_000
NOISE = {axis: {"N": 0.003, "B": 0.002} for axis in "xy"}
EFFECTS: list[dict[str, Any]] = [
    {"name": "temperature_bias", "sensitivity": 0.003},
    {"name": "temperature_noise", "linear": 0.02},
    {"name": "vibration_noise", "white": 0.002},
    {"name": "spectral_line", "frequency": 1.7, "amplitude": 0.3},
    {"name": "telegraph", "step": [0.5], "low": 40.0, "high": 60.0},
    {"name": "held_samples", "per_hour": 200.0},
    {"name": "held_samples", "per_hour": 12.0, "length": 3.0},
    {"name": "held_samples", "per_hour": 100.0, "length": 0.5, "fill": "frame"},
    {"name": "rate_quantization", "step": 0.5},
    {"name": "rotation_line", "amplitude": [0.05], "phase": [40.0]},
    {"name": "dead_zone", "width": 0.05},
    {"name": "shared_source", "N": [0.002]},
    {"name": "spikes", "kind": "outlier", "per_hour": 10.0, "size": 6.0},
    {"name": "feedback_reset", "kick": 60.0, "phase": "channel"},
]


@cache
def environment() -> xr.Dataset:
    """Half an hour: temperature rises, shake in the middle, ramp, rotation on its own stamps."""
    log = simulate({"noise": NOISE}, duration=SIZE / RATE, rate=RATE, seed=9).compute()
    seconds = np.arange(SIZE) / RATE
    log["temperature"] = ("time", 25.0 + seconds / 60.0, {"units": "degree_Celsius"})
    shake = np.where(abs(seconds - 900.0) < 300.0, 1.0, 0.01)
    log["vibration"] = ("time", shake, {"units": "g"})
    log["ramp"] = ("time", np.mod(seconds * 0.417, 1.0), {"units": "1"})
    log = log.assign_coords(time_rotation_rate=log["time"].values + np.timedelta64(20, "ms"))
    turning = np.where(abs(seconds - 900.0) < 600.0, 100.0, 0.0)
    log["rotation_rate"] = ("time_rotation_rate", turning, {"units": "degree s-1"})
    return log


def recording_of(*effects: dict[str, Any]) -> xr.Dataset:
    """Simulate a recording with effects; a sample of each minute is lost."""
    like = environment()
    model = {"noise": NOISE, "effect": list(effects)}
    log = simulate(model, like=like, seed=1234).compute()
    channels = ("temperature", "vibration", "ramp", "rotation_rate")
    log = log.assign({name: like[name] for name in channels})
    log["rate"][:, ::600] = np.nan
    return log


def nats_of(recording: xr.Dataset, *effects: dict[str, Any]) -> float:
    """Compute how much nearer the model with effects is, as `check_model` does.

    Records of one model are simulated once: all recordings have the same stamps, channels and lost
    samples.
    """
    lost = np.isnan(recording["rate"].values)
    assert lost[:, ::600].all()
    assert lost.sum() == lost[:, ::600].size
    return likelihood_ratio(
        measure_statistics(recording),
        _simulate_effects(json.dumps(effects)),
        _simulate_effects("[]"),
    )


@cache
def _simulate_effects(effects: str) -> list[dict[str, np.ndarray]]:
    return simulate_statistics(recording_of(), {"noise": NOISE, "effect": json.loads(effects)})


def recording_and_nats(effect: dict[str, Any]) -> tuple[xr.Dataset, float]:
    """Return a recording with an effect, and how much nearer the model with the effect is."""
    return _record_and_compare(json.dumps(effect))


@cache
def _record_and_compare(effect: str) -> tuple[xr.Dataset, float]:
    recording = recording_of(json.loads(effect))
    return recording, nats_of(recording, json.loads(effect))


def test_axes_that_the_model_does_not_name_are_compared_too():
    log = environment().isel(time=slice(0, 1000))
    statistics = simulate_statistics(log, {"noise": {"y": {"N": 0.003}}})[0]
    assert {*statistics} == {*measure_statistics(log)}
    assert np.isneginf(statistics["lines/0"]).all()
    assert np.isfinite(statistics["lines/1"]).all()


@pytest.fixture(scope="module")
def noise_alone() -> xr.Dataset:
    return recording_of()


@pytest.mark.full
@pytest.mark.parametrize(
    "effect", EFFECTS, ids=lambda effect: f"{effect['name']} {effect.get('fill', '')}".strip()
)
def test_record_with_the_effect_is_nearer_only_if_the_recording_has_it(
    effect: dict[str, Any], noise_alone: xr.Dataset
):
    assert recording_and_nats(effect)[1] > 5.0
    assert nats_of(noise_alone, effect) < -5.0


def test_model_is_compared_with_records_of_its_own(noise_alone: xr.Dataset):
    for recording in (noise_alone, recording_and_nats(EFFECTS[0])[0]):
        check = check_model(recording, {"noise": NOISE, "effect": EFFECTS[:1]}, NOISE)
        assert check == {"runs": True, "nats": nats_of(recording, EFFECTS[0])}


@pytest.mark.slow
def test_an_effect_that_replaces_noise_is_not_nearer_than_the_calibrated_noise(
    noise_alone: xr.Dataset,
):
    low = {axis: terms | {"N": 0.0015} for axis, terms in NOISE.items()}
    model = {"noise": low, "effect": [{"name": "temperature_noise", "linear": 0.1}]}
    assert check_model(noise_alone, model, low)["nats"] > 100.0
    assert check_model(noise_alone, model, NOISE)["nats"] < 0.0


def test_equal_models_are_equally_near(noise_alone: xr.Dataset):
    assert check_model(noise_alone, {"noise": NOISE, "effect": []}, NOISE)["nats"] == 0.0


def test_model_that_cannot_be_simulated_is_reported(noise_alone: xr.Dataset):
    model = {"noise": NOISE, "effect": [{"name": "light_power_noise", "thermal": 0.2}]}
    check = check_model(noise_alone, model, NOISE)
    assert not check["runs"]
    assert "light_power" in check["reason"]


JUMP = {"name": "bias_jump", "step": [0.2], "at": 600.0}
#: An effect of a recording, and what of it is wrong in a model.
WRONG_MODELS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    (EFFECTS[0], {"sensitivity": 0.0015}),
    (EFFECTS[1], {"linear": 0.01}),
    (EFFECTS[2], {"white": 0.001}),
    (EFFECTS[3], {"amplitude": 0.15}),
    (EFFECTS[3], {"frequency": 1.75}),
    (EFFECTS[5], {"per_hour": 100.0}),
    (EFFECTS[7], {"fill": "repeat"}),
    (EFFECTS[8], {"step": 0.25}),
    (EFFECTS[9], {"amplitude": [0.025]}),
    (JUMP, {"step": [0.1]}),
    (JUMP, {"at": 1200.0}),
    (EFFECTS[-1], {"kick": 30.0}),
    # twice the size and the other sign, which are easier to see than half the size
    *((EFFECTS[0], {"sensitivity": size}) for size in (0.006, -0.003)),
    *((EFFECTS[1], {"linear": size}) for size in (0.04, -0.02)),
    (EFFECTS[2], {"white": 0.004}),
    (EFFECTS[3], {"amplitude": 0.6}),
    (EFFECTS[5], {"per_hour": 400.0}),
    (EFFECTS[8], {"step": 1.0}),
    (EFFECTS[9], {"amplitude": [0.1]}),
    (EFFECTS[9], {"phase": [220.0]}),
    *((JUMP, {"step": size}) for size in ([0.4], [-0.2])),
    *((EFFECTS[-1], {"kick": size}) for size in (120.0, -60.0)),
]


@pytest.mark.full
@pytest.mark.parametrize(
    ("effect", "wrong"),
    WRONG_MODELS,
    ids=lambda value: " ".join(str(value) for value in value.values()),
)
def test_wrong_model_loses_against_the_right_one(effect: dict[str, Any], wrong: dict[str, Any]):
    """Half or twice the size, the wrong sign, another instant, frequency or replacement."""
    recording, right = recording_and_nats(effect)
    assert right > 5.0
    assert nats_of(recording, effect | wrong) < right - 3


def test_means_are_compared_across_gaps():
    """No difference is lost in a gap: what begins at a restart shows against the time before."""
    recording = recording_of()
    recording["rate"][:, 9000:9300] = np.nan
    statistics = record_statistics(recording["rate"].values, recording)
    means = {name: values for name, values in statistics.items() if name.startswith("means")}
    assert means
    assert all(np.isfinite(values).all() for values in means.values())


def test_amplitudes_locked_to_the_rotation_are_measured_where_the_tool_turns():
    """The channel has stamps of its own; at rest, all orders would show the mean."""
    recording = recording_of(EFFECTS[9])
    amplitudes = record_statistics(recording["rate"].values, recording)["order 1/0"].reshape(2, -1)
    assert np.isfinite(amplitudes).all(axis=0).sum() == pytest.approx(32 * 1200 / 1800, abs=2)
    assert 2.0 * abs(np.nanmean(amplitudes[0] + 1j * amplitudes[1])) == pytest.approx(
        0.05, abs=0.01
    )


def test_rare_large_values_do_not_widen_the_law_of_all():
    """Held stretches, at other places in each record: most means are those of noise alone."""
    rng = np.random.default_rng(3)
    draws = {rare: rng.standard_normal((9, 1000)) for rare in (False, True)}
    draws[True][rng.random((9, 1000)) < 0.005] += 30.0
    ensembles = [[{"means": values} for values in draws[rare][1:]] for rare in (True, False)]
    assert likelihood_ratio({"means": draws[True][0]}, *ensembles) > 10.0
    assert abs(likelihood_ratio({"means": draws[False][0]}, *ensembles)) < 5.0


def test_outliers_are_counted_that_noise_hardly_has():
    """Flipped bits of six standard deviations, on noise that wanders by many."""
    rng = np.random.default_rng(8)
    recording = recording_of()
    noise = rng.standard_normal(SIZE) + 0.05 * np.cumsum(rng.standard_normal(SIZE))
    flipped = noise.copy()
    flipped[rng.choice(SIZE, 20, replace=False)] += 6.0
    few, many = (
        float(record_statistics(rates[None], recording)["count outliers/0"][0] ** 2)
        for rates in (noise, flipped)
    )
    assert few < 5.0
    assert 15.0 <= many - few <= 22.0
