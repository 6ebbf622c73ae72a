"""Tables of a diagnosis from its identifications."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.tables import model_tables
from gyrostab.physics.registry import make_effect
from gyrostab.simulate import read_model, simulate


def test_filters_of_a_given_model_stay_those_that_they_are_at_a_higher_oversampling():
    old = {"name": "logger_filter", "length": 0.3, "axes": ["x"]}
    new = {"name": "logger_filter", "cutoff": 6.0, "instrument": 0.0, "axes": ["y"]}
    given = read_model({"noise": {"N": 0.003}, "effect": [old]})
    log = simulate(given, duration="600s", rate=10.0, seed=2)
    blocks = reduce_log(log)
    added = [SimpleNamespace(effect=make_effect(new), components=())]
    tables = model_tables(baseline_from_model(blocks, given), added, given, blocks)
    assert tables["log"] == {"oversampling": 16}
    filtered, plain = (
        simulate(tables | {"effect": effects}, duration="600s", rate=10.0, seed=2)["rate"][0]
        for effects in (tables["effect"], [])
    )
    expected = (plain + plain.shift(time=1) + plain.shift(time=2)) / 3.0
    np.testing.assert_allclose(filtered[2:], expected[2:], rtol=0, atol=1e-9)


def test_ramp_of_a_given_model_is_no_part_of_the_bias_that_is_written():
    given = read_model({"noise": {"N": 0.003, "x": {"R": 300.0}}, "bias": {"x": 5.0}})
    blocks = reduce_log(simulate(given, duration="600s", rate=10.0, seed=2))
    tables = model_tables(baseline_from_model(blocks, given), [], given, blocks)
    assert tables["noise"]["x"]["R"] == 300.0
    assert tables["bias"] == pytest.approx({"x": 5.0, "y": 0.0, "z": 0.0}, abs=0.03)
