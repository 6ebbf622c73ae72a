"""Means and slopes of a channel over windows, against extended precision."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.kernels.regression.trend import window_trend


def plain(values, seconds):
    """Mean and least-squares slope of finite values, in extended precision."""
    present = np.isfinite(values)
    y, t = values[present].astype(np.longdouble), seconds[present].astype(np.longdouble)
    mean, centre = y.sum() / y.size, t.sum() / t.size
    return float(mean), float(((t - centre) * (y - mean)).sum() / ((t - centre) ** 2).sum())


@pytest.mark.parametrize("offset", [0.0, 25.0, 1e6])
def test_means_and_slopes_agree_with_extended_precision(offset):
    rng = np.random.default_rng(1)
    seconds = 3600.0 + np.sort(rng.uniform(0.0, 1000.0, 3000))
    values = offset + 0.002 * (seconds - 4000.0) + rng.standard_normal(3000)
    values[rng.random(3000) < 0.2] = np.nan
    values[[700, 2000]] = np.inf, -np.inf
    first = np.sort(rng.integers(0, 2990, 200))
    last = np.minimum(first + rng.integers(8, 900, 200), 3000)
    got = window_trend(values, seconds, first, last)
    expected = np.array(
        [plain(values[a:b], seconds[a:b]) for a, b in zip(first, last, strict=True)]
    ).T
    np.testing.assert_allclose(got[0], expected[0], rtol=1e-14, atol=1e-14 * (1.0 + offset))
    np.testing.assert_allclose(got[1], expected[1], rtol=1e-10, atol=1e-14 * (1.0 + offset))


def test_windows_without_mean_or_slope():
    values = np.array([np.nan, np.inf, 3.0, np.nan, 5.0])
    seconds = np.array([0.0, 1.0, 2.0, 3.0, 2.0])
    first, last = np.array([0, 1, 2, 3, 4]), np.array([2, 3, 5, 3, 5])
    got = window_trend(values, seconds, first, last)
    np.testing.assert_array_equal(got, [[np.nan, 3.0, 4.0, np.nan, 5.0], [np.nan] * 5])
