"""Tables of a diagnosis from its identifications."""

from __future__ import annotations

import pytest

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.tables import model_tables
from gyrostab.simulate import read_model, simulate


def test_ramp_of_a_given_model_is_no_part_of_the_bias_that_is_written():
    given = read_model({"noise": {"N": 0.003, "x": {"R": 300.0}}, "bias": {"x": 5.0}})
    blocks = reduce_log(simulate(given, duration="600s", rate=10.0, seed=2))
    tables = model_tables(baseline_from_model(blocks, given), [], given, blocks)
    assert tables["noise"]["x"]["R"] == 300.0
    assert tables["bias"] == pytest.approx({"x": 5.0, "y": 0.0, "z": 0.0}, abs=0.03)
