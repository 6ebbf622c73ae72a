"""Trend of windows with gaps: its variance under each term, against sums over all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.kernels.allan.trend import window_trends

WINDOW, STEP, WINDOWS = 400, 150, 4
SIZE = WINDOW + STEP * (WINDOWS - 1)


def rate_covariances(size):
    """Covariances of the rates of Q, N, B and K in sample units, apart from what all share."""
    lags = np.abs(np.subtract.outer(np.arange(size + 1.0), np.arange(size + 1.0)))
    logarithm = np.log(np.maximum(lags, 1.0))
    angles = [lags == 0, -lags / 2, lags**2 * logarithm / (2 * np.pi), lags**3 / 12]
    return [np.diff(np.diff(angle.astype(float), axis=0), axis=1) for angle in angles]


def slope_variances(present):
    places = np.flatnonzero(present)
    weights = np.zeros(present.size)
    weights[places] = (places - places.mean()) / np.sum((places - places.mean()) ** 2)
    return np.array([weights @ spread @ weights for spread in rate_covariances(present.size)])


def masks():
    rng = np.random.default_rng(1)
    scattered = rng.random(SIZE) > 0.3
    blocks = np.repeat(rng.random(SIZE // 25 + 1) > 0.4, 25)[:SIZE]
    some = np.ones(SIZE, bool)
    some[WINDOW // 3 : WINDOW] = False
    hole = np.ones(SIZE, bool)
    hole[100:300] = False
    return {"scattered": scattered, "blocks": blocks, "first third": some, "hole": hole}


@pytest.mark.parametrize("kind", ["rate", "angle"])
@pytest.mark.parametrize("name", masks())
def test_variance_of_the_trend_through_gaps_is_the_sum_over_all_pairs(name, kind):
    """Exact for Q and N."""
    rng = np.random.default_rng(2)
    present = masks()[name]
    x = np.where(present, rng.standard_normal(SIZE), np.nan)
    if kind == "angle":
        x = np.append(x, 0.0)
        present = np.isfinite(x[1:]) & np.isfinite(x[:-1])
    got = window_trends(x, angle=kind == "angle", window=WINDOW, step=STEP, n_windows=WINDOWS)
    whole = slope_variances(np.ones(WINDOW, bool))
    for j in range(WINDOWS):
        expected = slope_variances(present[STEP * j :][:WINDOW]) / whole
        np.testing.assert_allclose(got[1:3, j], expected[:2], rtol=1e-9)
        np.testing.assert_allclose(got[3:, j], expected[2:], rtol=0.02)


def test_trend_of_a_window_without_gaps_has_the_variance_of_the_tables():
    x = np.random.default_rng(3).standard_normal(SIZE)
    x[WINDOW + 1] = np.nan
    got = window_trends(x, angle=False, window=WINDOW, step=STEP, n_windows=WINDOWS)
    assert (got[[1, 3, 4], 0] == 1.0).all()
    assert (got[1:, 1] != 1.0).all()
    nothing = window_trends(x * np.nan, angle=False, window=WINDOW, step=STEP, n_windows=WINDOWS)
    assert np.isnan(nothing).all()
    one = np.full(SIZE, np.nan)
    one[3] = 1.0
    alone = window_trends(one, angle=False, window=WINDOW, step=STEP, n_windows=WINDOWS)
    assert np.isnan(alone).all()
