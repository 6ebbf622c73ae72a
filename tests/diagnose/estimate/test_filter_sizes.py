"""The cutoff of a filter is fitted with the interval that the record determines."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.signal import butter, lfilter, sosfilt

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.filter_sizes import fit_filter_sizes
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log


@pytest.mark.full
def test_undetermined_cutoff_has_a_wide_interval() -> None:
    """Samples with a little memory are a picked low-pass beyond half the rate; with free
    quantization noise, one at a low cutoff does the same."""
    share, rate = 0.05, 10.0
    raw = np.random.default_rng(2).standard_normal((2, 12_000))
    low, high = _cutoff_interval(
        make_log(lfilter([1.0 - share], [1.0, -share], raw, axis=1), rate=rate, unit="deg/h")
    )
    assert low <= -np.log(share) * rate / (2.0 * np.pi) <= high
    assert high > 3.0 * low


@pytest.mark.slow
def test_determined_cutoff_has_a_narrow_interval() -> None:
    raw = np.random.default_rng(3).standard_normal((2, 120_000))
    low, high = _cutoff_interval(
        make_log(
            sosfilt(butter(4, 2.0, fs=100.0, output="sos"), raw, axis=1)[:, ::10],
            rate=10.0,
            unit="deg/h",
        )
    )
    assert (low + high) / 2.0 == pytest.approx(2.0, rel=0.05)
    assert high < 1.2 * low


def _cutoff_interval(log: xr.Dataset) -> tuple[float, float]:
    """Return the 95 % interval of the cutoff of a filter on all axes."""
    blocks = reduce_log(log)
    baseline = calibrate_noise(blocks)
    candidate = next(
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect == "logger_filter"
    )
    variant = next(
        variant for variant in candidate.variants if candidate.statistic.is_filter(variant)
    )
    components = [
        Component(candidate, variant, (str(axis),), 50.0) for axis in blocks["axis"].values
    ]
    mean, error, *ends = fit_filter_sizes(components, initial_state(blocks, baseline))[0]["cutoff"]
    return (ends[0], ends[1]) if ends else (mean - 1.96 * error, mean + 1.96 * error)
