"""The noise and effects of a model as the baseline."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.allan_surface import allan_surface
from gyrostab.diagnose.statistics.scores import cube_root_score
from gyrostab.errors import OptionError, SchemaError
from gyrostab.simulate import simulate
from tests.diagnose.baseline.test_calibrate import SHAKEN, WARM, log


def test_baseline_from_a_model_includes_its_effects():
    effects = [
        {"name": "vibration_noise", "white": 0.001, "axes": ["x"]},
        {"name": "temperature_bias", "sensitivity": 0.01, "axes": ["y"]},
        {"name": "telegraph", "step": 0.1},
    ]
    warm = WARM | {"points": [[0, 30], [3600, 60]]}
    model = {
        "noise": {"N": 0.003, "R": 0.1},
        "effect": effects,
        "environment": [SHAKEN, warm],
        "log": {"axes": ["x", "y"]},
    }
    made = simulate({**model, "effect": effects[:2]}, duration="1h", rate=10.0, seed=4).compute()
    blocks = reduce_log(made)
    baseline = baseline_from_model(blocks, model)
    ratio = blocks["power"] / baseline["spectrum"]
    shaken = (blocks["begin"].values > 1200) & (blocks["end"].values < 1500)
    assert float(ratio.isel(block=shaken).mean()) == pytest.approx(1.0, abs=0.1)
    assert float(ratio.isel(block=~shaken).mean()) == pytest.approx(1.0, abs=0.1)
    assert (
        float(
            baseline["spectrum"].sel(axis="x")[shaken].mean()
            / baseline["spectrum"].sel(axis="x")[~shaken].mean()
        )
        > 2.0
    )
    z = ((blocks["mean"] - baseline["known_mean"]) / np.sqrt(baseline["mean_variance"])).values
    assert np.abs(z - z.mean(axis=1, keepdims=True)).max() < 5.0
    assert baseline.attrs["shown_elsewhere"] == ["telegraph"]
    assert float(baseline["coefficient"].sel(axis="x", term="R")) == 0.1
    assert float(baseline["stderr"].max()) == 0.0
    nulls = next(null_records(blocks, baseline, count=3, rng=np.random.default_rng(1)))
    assert float((nulls["mean"] - baseline["known_mean"]).std()) < 2.0 * float(
        np.sqrt(baseline["mean_variance"].mean())
    )
    with pytest.raises(SchemaError, match="temperature"):
        baseline_from_model(blocks.drop_vars("channel_temperature"), model)
    with pytest.raises(OptionError, match="no noise"):
        baseline_from_model(blocks, {"noise": {"z": {"N": 1.0}}})


def test_a_ramp_of_a_model_counts_once():
    noise = {"N": 0.003, "R": 2.0}
    blocks = reduce_log(log(noise))
    surface = allan_surface(blocks, baseline_from_model(blocks, {"noise": noise}))
    score = cube_root_score(surface["observed"] / surface["expected"], surface["shape"])
    assert np.nanmax(np.abs(score[0, -1])) < 4.0  # the record as one window


def test_a_filter_of_a_model_is_expected_with_random_gaps():
    model = {
        "noise": {"N": 0.003},
        "effect": [{"name": "logger_filter", "cutoff": 1.5, "order": 2, "instrument": 1}],
        "log": {"axes": ["x"]},
    }
    blocks = reduce_log(log({"N": 0.003}, effects=model["effect"], lost=0.3))
    ratio = (blocks["power"] / baseline_from_model(blocks, model)["spectrum"]).mean("block")
    error = 1.0 / np.sqrt(blocks["shape"].sum("block"))
    assert float(np.abs((ratio - 1.0) / error).max()) < 4.5
