"""The script of docs/temperature.md takes the bias that a diagnosis names out of a log."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import gyrostab
from gyrostab.io.datasets import to_netcdf
from gyrostab.simulate import simulate

PAGE = Path(__file__).resolve().parents[2] / "docs" / "temperature.md"


@pytest.mark.parametrize(
    "parameters", [{"sensitivity": {"value": 0.02}}, {"sensitivity.x": {"value": 0.02}}]
)
def test_the_script_takes_the_bias_out(tmp_path, monkeypatch, parameters):
    heat = {
        "profile": "ramps", "channel": "temperature", "unit": "degC",
        "points": [[0, 20], [1500, 60]],
    }  # fmt: skip
    model = {
        "noise": {"N": 1e-4},
        "log": {"axes": ["x"]},
        "environment": [heat],
        "effect": [{"name": "temperature_bias", "sensitivity": 0.02}],
    }
    to_netcdf(simulate(model, duration="1500s", rate=10.0, seed=1), tmp_path / "run7.nc")
    named = {"name": "temperature_bias", "axes": ["x"], "parameters": parameters}
    diagnosis = SimpleNamespace(effects=[{"name": "shupe"}, named])
    monkeypatch.setattr(gyrostab, "open_diagnosis", lambda folder: diagnosis)
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    exec(re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[1], scope)
    assert np.isfinite(scope["rate"]).all()
    means = scope["product"]["window_mean"].values
    assert np.ptp(means) < 0.01 * np.ptp(scope["log"]["rate"].values)
