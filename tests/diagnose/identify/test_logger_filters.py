"""A filter of the logger is the same for all axes."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.signal import butter, lfilter, sosfilt

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.effect_candidates import effect_candidates
from gyrostab.diagnose.identify.identifiability import is_physical
from gyrostab.diagnose.identify.logger_filters import fit_filter_sizes, separate_axes_nats
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log
from tests.support.candidates import find_components


@pytest.mark.parametrize(
    ("late", "one_filter"),
    [
        ((0.1, 0.1, 0.1), True),
        ((0.1,), True),
        ((0.0, 0.0, 0.15), False),
        ((0.15, 0.15, 0.0), False),
    ],
)
def test_filter_must_fit_all_axes(late, one_filter):
    """Neighbouring samples are correlated: on all axes for a logger, or on one axis only."""
    share = np.array(late)[:, None]
    raw = np.random.default_rng(5).standard_normal((share.size, 18_001))
    blocks = reduce_log(
        make_log((1.0 - share) * raw[:, 1:] + share * raw[:, :-1], rate=10.0, unit="deg/h")
    )
    baseline = calibrate_noise(blocks)
    filters = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect == "logger_filter"
    ]
    state = initial_state(blocks, baseline)
    components = find_components(filters, state)["logger_filter"]
    assert sum_evidence(components) > 10.0
    assert (separate_axes_nats(components, state) == 0.0) == one_filter
    assert is_physical(components, state) == (components if one_filter else [])


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
