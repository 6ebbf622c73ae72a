"""The assembled baseline: its grid of slow noise."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from tests.diagnose.baseline.test_calibrate import log


def test_the_grid_contains_calibrated_and_much_slower_noise():
    baseline = calibrate_noise(reduce_log(log({"N": 0.003, "K": 0.3})))
    K, weight = baseline["grid_K"].values[0], np.exp(baseline["grid_calibrated"].values[0])
    assert weight.sum() == pytest.approx(1.0)
    assert weight[(K > 0.1) & (K < 0.9)].sum() > 0.9
    assert K.max() > 5.0 * 0.3
    assert K.min() == 0.0
    assert np.exp(baseline["grid_prior"].values[0]).sum() == pytest.approx(1.0)


@pytest.mark.filterwarnings("ignore:the time given with --quiet")
def test_the_grid_contains_all_noise_that_little_quiescent_time_allows():
    blocks = reduce_log(log({"N": 0.003}, duration="3h", rate=10.0))
    baseline = calibrate_noise(blocks, quiet=(0.0, 120.0))
    draws = np.sqrt(np.quantile(baseline["posterior_slow"].values[0], 0.999, axis=0))
    for column, term in enumerate("BK"):
        assert baseline[f"grid_{term}"].values.max() > draws[column] / 10.0**0.25
