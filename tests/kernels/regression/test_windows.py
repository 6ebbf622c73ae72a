"""Covariance of means over overlapping windows, against simulation and a sum over the windows."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.kernels.regression.coupling import (
    average_windows,
    slow_covariance,
    white_covariance,
)


def test_covariance_in_white_noise_is_that_of_simulated_windows():
    cells = np.random.default_rng(4).normal(size=(20000, 14))
    windows = 0.5 * (cells[:, 1:] + cells[:, :-1])[:, :12]
    mean = average_windows(np.repeat(np.arange(3), 4))
    white = white_covariance(mean, np.arange(12) * 30.0, 60.0, np.ones(12))
    blocks = windows @ mean.toarray().T
    # a full window of two cells has variance 1/2
    np.testing.assert_allclose(np.cov(blocks.T) * 2, white, atol=0.02)


@pytest.mark.parametrize("memory", [15.0, 100.0, 5000.0])
def test_covariance_in_slow_noise_is_the_mean_over_the_windows(memory):
    """Compare with the double integral of the autocovariance over each pair of windows."""
    rng = np.random.default_rng(0)
    time = np.sort(rng.choice(60, 40, replace=False)) * 7.0
    length = 30.0
    inside = (np.arange(600) + 0.5) / 600 * length
    apart = np.unique(np.abs(np.subtract.outer(time, time)))
    averaged = [np.exp(-np.abs(d + inside[:, None] - inside) / memory).mean() for d in apart]
    pairs = np.interp(np.abs(np.subtract.outer(time, time)), apart, averaged)
    mean = average_windows(np.unique((time // 45).astype(int), return_inverse=True)[1])
    np.testing.assert_allclose(
        slow_covariance(mean, time, length, memory), mean @ pairs @ mean.T, atol=2e-6
    )


def test_increments_of_an_averaged_walk_have_two_thirds_of_its_variance():
    """A walk is the limit of a long memory: Var(increment) = 2 (C(0) - C(L)), L / T small."""
    memory = 1e6
    mean = average_windows(np.arange(3))
    covariance = slow_covariance(mean, np.arange(3) * 60.0, 60.0, memory)
    increment = 2 * (covariance[0, 0] - covariance[0, 1])
    assert increment == pytest.approx(2 / 3 * 2 * 60.0 / memory, rel=1e-4)
