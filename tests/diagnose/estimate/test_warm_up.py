"""The model of a warm-up: its form, and its restarts after gaps."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab import diagnose
from gyrostab.simulate import simulate
from gyrostab.simulate.losses import power_cuts

AMPLITUDE, TIME = -0.7, 100.0


@pytest.fixture(scope="module")
def log() -> xr.Dataset:
    """A record whose two power cuts are gaps like any other."""
    model = {
        "log": {"axes": ["x", "y"]},
        "noise": {"N": 0.001, "B": 0.002, "K": 0.01},
        "effect": [{"name": "warm_up", "amplitude": AMPLITUDE, "time": TIME}],
    }
    cuts = power_cuts([[150, 175], [370, 390]], duration="10min")
    made = simulate(model, duration="10min", rate=20.0, seed=2, environment=cuts).compute()
    return made.assign(gap_cause=made["gap_cause"] * 0)


@pytest.mark.slow
def test_model_of_a_warm_up_restarts_after_the_gaps_of_the_record(log):
    diagnosis = diagnose(log, nulls=100)
    assert {effect["name"] for effect in diagnosis.effects} == {"warm_up"}
    terms = [table for table in diagnosis.model["effect"] if table["name"] == "warm_up"]
    assert {table["gap"] for table in terms} == {5.0}
    for table in terms:
        assert table.get("slow_amplitude", 0.0) == 0.0
        assert table["amplitude"] == pytest.approx(AMPLITUDE, rel=0.15)
        assert table["time"] == pytest.approx(TIME, rel=0.25)
    again = simulate(diagnosis.model, like=log, seed=1)
    measured, made = (
        record["rate"].coarsen(time=200).mean().values[:, :60] for record in (log, again)
    )
    difference = (measured - made) - np.nanmean(measured - made, axis=1, keepdims=True)
    assert np.nanstd(difference) < 0.25 * np.nanstd(measured)
