"""Logger filters in models: expected in a recording, and simulated as identified."""

from __future__ import annotations

import numpy as np
import pytest

import gyrostab
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.evidence.spectral_lines import expected_lines, mean_line_power
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate
from tests.support.repetitions import first_of

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}


def made(axes: str = "xy", **filtering: float) -> dict[str, object]:
    oversampling = int(filtering.pop("oversampling", 1))
    effect = {"name": "logger_filter", **filtering}
    return {
        "noise": NOISE,
        "effect": [effect],
        "log": {"axes": list(axes), "oversampling": oversampling},
    }


@pytest.mark.parametrize(
    "filtering",
    [
        {"cutoff": 2.0},
        {"cutoff": 2.0, "oversampling": 4},
        {"length": 0.3},
        {"cutoff": 6.0, "order": 1.0, "pick": 1.0, "oversampling": 8},
    ],
    ids=str,
)
def test_a_model_expects_its_own_filter(filtering):
    model = made(**filtering)
    blocks = reduce_log(simulate(model, duration="1h", rate=10.0, seed=3).compute())
    baseline = baseline_from_model(blocks, model)
    ratio = (blocks["power"] / baseline["spectrum"]).mean(["axis", "block"]).values
    error = 1.0 / np.sqrt(blocks["shape"].sum(["axis", "block"]).values)
    assert np.abs((ratio - 1.0) / error).max() < 4.5
    powers, expected = [], expected_lines(baseline, blocks["line_frequency"].values)
    for axis in "xy":
        power, count = mean_line_power(blocks, axis)
        powers.append(power)
    ratio = (powers / expected).mean(axis=0)[2:]  # there the mean of the block is taken out
    assert np.abs(ratio - 1.0).max() < 5.0 / np.sqrt(2.0 * count)


@pytest.mark.full
@pytest.mark.parametrize("filtering", first_of({"cutoff": 2.0}, {"length": 0.5}), ids=str)
def test_a_recording_does_not_differ_from_its_own_filter(filtering):
    model = made(**filtering)
    log = simulate(model, duration="30min", rate=10.0, seed=4).compute()
    diagnosis = gyrostab.diagnose(log, simulation=model, nulls=100)
    assert diagnosis.verdict == "no mismatch"


@pytest.mark.full
def test_aliases_of_white_noise_are_not_taken_for_bias_instability():
    log = simulate(
        made("x", cutoff=58.0, order=1.0, pick=1.0, oversampling=16),
        duration="15min",
        rate=100.0,
        seed=5,
    ).compute()
    diagnosis = gyrostab.diagnose(log, nulls=100)
    (effect,) = diagnosis.effects
    assert effect["parameters"]["cutoff"]["value"] == pytest.approx(58.0, rel=0.05)
    noise = diagnosis.model["noise"]["x"]
    assert noise["N"] == pytest.approx(NOISE["N"], rel=0.1)
    assert noise["B"] < 4.0 * NOISE["B"]  # 14 times, without aliases


@pytest.mark.full
def test_a_named_filter_of_a_fast_instrument_simulates_the_recording():
    log = simulate(
        made("x", cutoff=6.0, order=4.0, oversampling=16), duration="30min", rate=10.0, seed=5
    ).compute()
    diagnosis = gyrostab.diagnose(log, nulls=100)
    (effect,) = diagnosis.effects
    assert effect["name"] == "logger_filter"
    assert diagnosis.model["log"] == {"oversampling": 16}
    second_log = simulate(
        diagnosis.model, like=log, seed=6
    ).compute()  # whose cutoff lies above half of the log's rate
    was, now = (reduce_log(recording) for recording in (log, second_log))
    ratio = (now["power"].mean(["axis", "block"]) / was["power"].mean(["axis", "block"])).values
    error = np.sqrt(2.0 / was["shape"].sum(["axis", "block"]).values)
    assert np.abs((ratio - 1.0) / error).max() < 4.0
