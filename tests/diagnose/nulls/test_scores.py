"""The law of the largest value of a null record is extrapolated by an exponential tail."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.nulls.scores import fit_best_evidence


@pytest.mark.parametrize("level", [0.1, 0.01, 0.001])
def test_level_and_probability_of_an_exponential_law(level: float) -> None:
    null = fit_best_evidence(np.random.default_rng(2).exponential(size=50_000))
    assert null.value_at(level) == pytest.approx(-np.log(level), rel=0.05)
    assert null.probability(null.value_at(level)) == pytest.approx(level, rel=1e-3)


def test_null_records_that_score_alike_have_a_tail() -> None:
    null = fit_best_evidence(np.ones(400))
    assert 1.0 < null.value_at(0.001) < 2.0
    assert 0.0 < null.probability(1.5) < 0.1
