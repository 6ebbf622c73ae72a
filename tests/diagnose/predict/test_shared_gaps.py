"""Common noise of axes with different or common gaps."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.predict.sizes import component_mixture
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from gyrostab.simulate import simulate
from tests.support.candidates import select_candidate


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
    is_present = xr.DataArray(np.broadcast_to(~lost, (2, lost.shape[1])), dims=("axis", "time"))
    rate = log["rate"].transpose("axis", "time")
    blocks = reduce_log(log.assign(rate=rate.where(is_present).assign_attrs(rate.attrs)))
    baseline = calibrate_noise(blocks)
    known, _ = effect_candidates(blocks, baseline["coefficient"])
    candidate = select_candidate(known, "shared_source", "cross_spectrum")
    variant = next(variant for variant in candidate.variants if variant.values["bandwidth"] == 0.5)
    mean, covariance = component_mixture(
        Component(candidate, variant, ("x", "y"), 1.0), initial_state(blocks, baseline)
    ).moments()
    error = float(np.sqrt(covariance[0, 0]))
    assert abs(mean[0] - 9e-6) < 3.0 * error
    assert error < 0.1 * mean[0]


@pytest.mark.parametrize("rows", [2, 1], ids=["each axis", "all axes"])
def test_gaps_do_not_make_noise_coherent_with_a_wave_of_a_channel(rows):
    """A channel without gaps waves slowly: gaps would spread its wave over all bands."""
    rng, size, rate = np.random.default_rng(4), 12_000, 10.0
    noise = 12.0 + 0.5 * rng.standard_normal((2, size))
    lost = np.repeat(rng.random((rows, size // 30)) < 0.3, 30, axis=1)
    noise[np.broadcast_to(lost, noise.shape)] = np.nan
    time = np.arange(size) / rate
    wave = 0.3 * np.sin(2.0 * np.pi * time / 17.0) + 0.002 * rng.standard_normal(size)
    log = make_log(noise, rate=rate, unit="deg/h", axis=["x", "y"]).assign(
        accel_x=("time", wave, {"units": "m s-2"})
    )
    blocks = reduce_log(log)
    power, shape = blocks["power"], blocks["shape"]
    cross = blocks["reference_cross"].sel(reference="accel_x")
    channel = blocks["reference_power"].sel(reference="accel_x")
    units = np.abs(cross) ** 2 * shape / (power * channel)  # 1 on average without coherence
    assert float(units.max()) < 30.0
    assert 0.5 < float(units.mean()) < 1.2
