"""A simulated log as the baseline."""

from __future__ import annotations

import pytest

from gyrostab.diagnose.baseline.from_simulation import baseline_from_simulation
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from tests.diagnose.baseline.test_calibrate import SHAKEN, log


def test_baseline_from_a_simulation_keeps_its_level():
    effect = {"name": "vibration_noise", "white": 0.002}
    recording = reduce_log(log(effects=[effect], environment=[SHAKEN], seed=1))
    simulated = reduce_log(log(effects=[effect], environment=[SHAKEN], seed=2))
    baseline = baseline_from_simulation(recording, simulated)
    shaken = (recording["begin"].values > 1220) & (recording["end"].values < 1480)
    still = (recording["end"].values < 1000) | (recording["begin"].values > 1700)
    ratio = recording["power"] / baseline["spectrum"]
    assert float(ratio.isel(block=shaken).mean()) == pytest.approx(1.0, abs=0.2)
    assert float(ratio.isel(block=still).mean()) == pytest.approx(1.0, abs=0.05)
    assert baseline.attrs["source"] == "simulation"
