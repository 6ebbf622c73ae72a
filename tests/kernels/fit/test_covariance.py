"""Covariance of variances of third differences between averaging times that are far apart."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.kernels.fit.covariance import product_tables


@pytest.mark.parametrize("variance", ["hadamard", "modified"])
def test_averaging_times_far_apart_are_hardly_correlated(variance):
    """Third differences of t^5 at single samples cancel to the last digit."""
    ks = np.array([1, 200_000])
    pairs, _ = product_tables(1_000_000, ks, variance=variance)
    for term in range(1, 4):
        covariance = pairs[term, term]
        correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
        assert 0.0 <= correlation < 0.01, term
