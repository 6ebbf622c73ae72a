"""A bias that wanders or switches: its powers, and a record against its own model."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import xarray as xr

from gyrostab import diagnose
from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.evidence.wandering import process_allan_variance
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.kernels.spectra.expected import correlated_powers
from gyrostab.kernels.spectra.periodogram import ordinates, taper
from gyrostab.simulate import simulate
from gyrostab.simulate.model import read_model
from tests.support.repetitions import first_of

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
WANDER_30_S = {"name": "gauss_markov", "rms": [1.0], "correlation_time": 30.0}
WANDER_300_S = {"name": "gauss_markov", "rms": [1.0], "correlation_time": 300.0}
SLOW_HOPS = {"name": "telegraph", "step": [1.0], "low": 200.0, "high": 200.0}
FAST_HOPS = {"name": "telegraph", "step": [1.0], "low": 30.0, "high": 60.0}


def _simulate_effect(effect: dict, seed: int, duration: str = "30min") -> tuple[dict, xr.Dataset]:
    model = {"noise": NOISE, "effect": [effect]}
    log = simulate({**model, "log": {"axes": ["x"]}}, duration=duration, rate=10.0, seed=seed)
    return model, log.compute()


@pytest.mark.parametrize("time", [1.0, 20.0, 1e4])
@pytest.mark.parametrize("size", [25, 100])
def test_powers_are_the_quadratic_form_of_the_covariance(size, time):
    weights, rate, i = taper(size), 10.0, np.arange(size)
    step = 1.0 / (rate * time)
    means = {0: 2.0 * (step + np.expm1(-step)) / step**2}
    of_lag = [
        means.get(lag, (np.expm1(-step) / step) ** 2 * np.exp(-(lag - 1) * step)) for lag in i
    ]
    covariance = np.array(of_lag)[np.abs(i[:, None] - i)]
    expected = []
    for k in range(1, ordinates(size) + 1):
        row = weights * np.exp(-2j * np.pi * k * i / size)
        row -= row.mean()
        expected.append((row @ covariance @ row.conj()).real / (rate * (np.abs(row) ** 2).sum()))
    made = correlated_powers(weights, rate, ordinates(size), time)
    np.testing.assert_allclose(made, expected, rtol=1e-4)


def test_allan_variance_is_that_of_ieee_std_952():
    tau, time = 3.0, np.array([0.2, 3.0, 50.0])
    ratio = time / tau
    law = ratio * (2.0 - ratio * (3.0 - 4.0 * np.exp(-1.0 / ratio) + np.exp(-2.0 / ratio)))
    np.testing.assert_allclose(process_allan_variance(tau, time), law, rtol=1e-9)


@pytest.mark.parametrize("effect", [WANDER_30_S, WANDER_300_S], ids=["30 s", "300 s"])
def test_powers_of_a_simulation_are_the_expected_ones(effect):
    model, log = _simulate_effect(effect, 3, "8h")
    blocks = reduce_log(log, block="20s")
    expected = baseline_from_model(blocks, read_model(model))["spectrum"].values[0]
    ratio = np.nanmean(blocks["power"].values[0] / expected, axis=0)
    error = 1.0 / np.sqrt(np.nansum(blocks["shape"].values[0], axis=0))
    assert (np.abs(ratio - 1.0) < 0.01 + 5.0 * error).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", first_of(7, 8))
@pytest.mark.parametrize(
    "effect",
    [
        pytest.param(WANDER_30_S, id="wander, 30 s"),
        pytest.param(WANDER_300_S, id="wander, 300 s", marks=pytest.mark.full),
        pytest.param(SLOW_HOPS, id="hops, 200 s", marks=pytest.mark.full),
        pytest.param(FAST_HOPS, id="hops, 45 s", marks=pytest.mark.full),
    ],
)
def test_no_mismatch_against_its_own_model(effect, seed):
    model, log = _simulate_effect(effect, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        diagnosis = diagnose(log, simulation=model, nulls=100)
    assert (diagnosis.verdict, diagnosis.content["mismatches"]) == ("no mismatch", [])
    found = {item["name"] for item in diagnosis.content["baseline"].get("expected", [])}
    assert found == ({"telegraph"} if effect["name"] == "telegraph" else set())
