"""Smoothing removes white noise and keeps slow changes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.regression.smooth import smooth_curve


@given(st.integers(8, 300), st.floats(-50.0, 50.0), st.floats(-1.0, 1.0))
def test_straight_lines_are_unchanged(n, level, slope):
    line = level + slope * np.arange(n)
    np.testing.assert_allclose(smooth_curve(line, longest=8.0), line, atol=1e-8)


def test_curves_without_noise_are_almost_unchanged():
    curve = np.sin(np.arange(500) / 10.0)
    assert np.abs(smooth_curve(curve, longest=20.0) - curve).max() < 0.005


@pytest.mark.parametrize("noise", [0.03, 0.3])
def test_noise_is_reduced(noise):
    rng = np.random.default_rng(7)
    true = 5.0 * np.sin(np.arange(2000) / 60.0)
    curve = smooth_curve(true + noise * rng.standard_normal(true.size), longest=40.0)
    assert np.std(curve - true) < 0.5 * noise


def test_penalty_is_the_sum_of_squared_differences():
    """Compare with the normal equations at a single length."""
    values = np.random.default_rng(2).standard_normal(30)
    D = np.diff(np.eye(30), 2, axis=0)
    expected = np.linalg.solve(np.eye(30) + 0.7**4 * D.T @ D, values)
    np.testing.assert_allclose(smooth_curve(values, longest=0.7), expected, atol=1e-10)


def test_the_rate_of_change_is_never_much_noisier_than_usual():
    """Smoothing too little now and then would spoil the rate of change first."""
    t = np.arange(0.0, 1000.0, 5.0)
    since = np.clip(t - 300.0, 0.0, None)
    true = (since - 60.0 * -np.expm1(-since / 60.0)) / 60.0  # a ramp that begins with a lag
    errors = []
    for seed in range(60):
        noisy = true + 0.016 * np.random.default_rng(seed).standard_normal(t.size)
        errors.append(np.std(np.diff(smooth_curve(noisy, longest=8.0) - true)) / 0.016)
    assert max(errors) < 1.5 * np.median(errors)
