"""Gaps in a record: clusters must be half full, and no term reaches across a gap."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log


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
