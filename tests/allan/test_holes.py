"""Holes in a record: no cluster that is mostly hole is compared, and nothing is carried across."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.allan.davar import davar
from gyrostab.ingest.make_log import make_log


@pytest.mark.parametrize(("present", "estimator"), [(4, 0), (6, 2)])
def test_a_cluster_must_be_half_full(present, estimator):
    """Four, or six, of every ten samples: no run is as long as two clusters of twenty."""
    rate = np.random.default_rng(1).standard_normal(4000)
    rate[np.arange(rate.size) % 10 >= present] = np.nan
    surface = davar(make_log(rate, rate=100.0, unit="deg/h"), window="2000samples", taus=[0.2])
    assert (surface.estimator == estimator).all()
    assert (surface.avar.notnull() == (estimator > 0)).all()


def test_a_step_inside_of_a_hole_is_in_no_strict_term():
    """The rate is constant before and after: any term that reaches across the hole would see the step."""
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
