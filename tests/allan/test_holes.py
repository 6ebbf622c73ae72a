"""Gaps in a record: clusters must be half full, and no term reaches across a gap."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.allan.davar import davar
from gyrostab.allan.fit import fit_noise
from gyrostab.allan.summary import describe_record
from gyrostab.ingest.make_log import make_log
from gyrostab.kernels.allan.biased_samples import EDGE_SAMPLES, gap_edge_ratio


@pytest.mark.parametrize(("present", "estimator"), [(4, 0), (6, 2)])
def test_a_cluster_must_be_half_full(present, estimator):
    """With four or six of every ten samples, no run is as long as two clusters of twenty."""
    rate = np.random.default_rng(1).standard_normal(4000)
    rate[np.arange(rate.size) % 10 >= present] = np.nan
    surface = davar(make_log(rate, rate=100.0, unit="deg/h"), window="2000samples", taus=[0.2])
    assert (surface.estimator == estimator).all()
    assert (surface.avar.notnull() == (estimator > 0)).all()


def test_step_inside_a_gap_does_not_enter_strict_terms():
    """The rate is constant before and after, so any term across the gap would contain the step."""
    rate = np.repeat([5.0, 9.0], 1000)
    rate[990:1010] = np.nan
    surface = davar(
        make_log(rate, rate=100.0, unit="deg/h"),
        window="2000samples",
        taus=[0.01, 0.1, 1.0],
        min_strict=0.0,
    )
    assert (surface.estimator == 1).all()
    assert float(surface.avar.max()) < 1e-20
    clusters = davar(
        make_log(rate, rate=100.0, unit="deg/h"), window="2000samples", taus=[1.0], min_strict=1.0
    )
    assert float(clusters.avar.max()) > 0.1


def noisy_spells(rng, *, lost_when_noisy: bool):
    """Two minutes at 100 Hz; every fourth second has three times the noise, or loses samples."""
    noisy = (np.arange(12_000) // 100) % 4 == 0
    x = rng.normal(size=12_000) * np.where(noisy, 3.0, 1.0)
    bursts = np.repeat(rng.random(1200) < 0.5, 10)
    x[bursts & (noisy if lost_when_noisy else np.roll(noisy, 137))] = np.nan
    return x


def test_losses_while_the_noise_is_high_are_noticed():
    rng = np.random.default_rng(3)
    options = {"window": "60s", "step": "20s", "taus": 12}
    informative = make_log(noisy_spells(rng, lost_when_noisy=True), rate=100.0, unit="deg/h")
    surface = davar(informative, **options)
    assert float(surface["gap_edge_ratio"].min()) > 1.8
    (line,) = [
        line for line in describe_record(fit_noise(surface)) if line.startswith("Noise next to")
    ]
    assert "Samples are lost while the noise is high" in line
    plain = np.where(np.repeat(rng.random(1200) < 0.1, 10), np.nan, rng.normal(size=12_000))
    product = fit_noise(davar(make_log(plain, rate=100.0, unit="deg/h"), **options))
    np.testing.assert_allclose(product["gap_edge_ratio"], 1.0, atol=0.15)
    assert not [line for line in describe_record(product) if line.startswith("Noise next to")]


def test_edge_ratio_equals_its_definition_and_ignores_gaps_outside_the_window():
    rng = np.random.default_rng(8)
    x = rng.normal(size=3000)
    x[::150] = x[1000:1040] = np.nan
    ratios = gap_edge_ratio(x[300:], window=2000, step=200, n_windows=2)
    for start, ratio in zip((300, 500), ratios, strict=True):
        part = x[start : start + 2000]
        near_gaps, elsewhere = [], []
        for i in range(EDGE_SAMPLES + 1, 2000 - EDGE_SAMPLES - 1):
            second = abs(part[i - 1] - 2 * part[i] + part[i + 1])
            around = part[i - 1 - EDGE_SAMPLES : i + 2 + EDGE_SAMPLES]
            if np.isfinite(second):
                (near_gaps if np.isnan(around).any() else elsewhere).append(second)
        assert ratio == pytest.approx(np.mean(near_gaps) / np.mean(elsewhere), rel=1e-12)
    x[400] = 1e30  # in the first window only
    assert gap_edge_ratio(x[300:], window=2000, step=200, n_windows=2)[1] == ratios[1]
    integers = gap_edge_ratio(np.arange(3000), window=3000, step=1, n_windows=1)
    assert np.isnan(integers).all()


def test_an_infinite_sample_is_a_missing_one():
    values = np.random.default_rng(3).standard_normal(6000) + 0.05 * np.arange(6000)
    values[2000:2100] = np.nan
    fitted = []
    for number in (np.nan, np.inf):
        values[3000] = number
        log = make_log(values, rate=10.0, unit="deg/h")
        fitted.append(fit_noise(davar(log, window="1min", step="1min")))
    xr.testing.assert_equal(*(product.drop_vars("outlier_count") for product in fitted))
