"""Common noise of axes with different or common gaps."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.identify.effect_candidates import effect_candidates
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.simulate import simulate


@pytest.fixture(scope="module")
def log():
    model = {
        "log": {"axes": ["x", "y"]},
        "noise": {"N": 0.003},
        "effect": [{"name": "shared_source", "N": 0.003, "bandwidth": 0.5}],
    }
    return simulate(model, duration="30min", rate=10.0, seed=5).compute()


@pytest.mark.parametrize("rows", [1, 2])
def test_random_gaps_do_not_bias_a_shared_band(log, rows):
    lost = np.random.default_rng(3).random((rows, log.sizes["time"])) < 0.4
    there = xr.DataArray(np.broadcast_to(~lost, (2, lost.shape[1])), dims=("axis", "time"))
    rate = log["rate"].transpose("axis", "time")
    blocks = reduce_log(log.assign(rate=rate.where(there).assign_attrs(rate.attrs)))
    baseline = calibrate_noise(blocks)
    known, _ = effect_candidates(blocks, baseline["coefficient"])
    one = next(
        one
        for one in known
        if one.effect == "shared_source" and one.statistic.name == "cross_spectrum"
    )
    variant = next(each for each in one.variants if each.values["bandwidth"] == 0.5)
    mean, covariance = component_mixture(
        Component(one, variant, ("x", "y"), 1.0), initial_state(blocks, baseline)
    ).moments()
    error = float(np.sqrt(covariance[0, 0]))
    assert abs(mean[0] - 9e-6) < 3.0 * error
    assert error < 0.1 * mean[0]
