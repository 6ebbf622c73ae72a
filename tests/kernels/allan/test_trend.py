"""Trend of windows with gaps: its variance under each term, against sums over all pairs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gyrostab.kernels.allan.trend import window_lines

WINDOW, STEP, WINDOWS = 400, 150, 4
SIZE = WINDOW + STEP * (WINDOWS - 1)


def rate_covariances(size):
    """Covariances of the rates of Q, N, B and K in sample units, apart from what all share."""
    lags = np.abs(np.subtract.outer(np.arange(size + 1.0), np.arange(size + 1.0)))
    logarithm = np.log(np.maximum(lags, 1.0))
    angles = [lags == 0, -lags / 2, lags**2 * logarithm / (2 * np.pi), lags**3 / 12]
    return [np.diff(np.diff(angle.astype(float), axis=0), axis=1) for angle in angles]


def slope_weights(places):
    """Weights of the rates from their places, NaN where missing."""
    line = np.nan_to_num(places - np.nanmean(places))
    return line / np.sum(line**2)


def rate_places(finite, kind):
    """Places of the rates; those between two angles are at their middle."""
    places = np.where(finite, np.arange(finite.size, dtype=float), np.nan)
    if kind == "angle":
        held = np.flatnonzero(finite)
        places = np.full(finite.size - 1, np.nan)
        for first, last in pairwise(held):
            places[first:last] = 0.5 * (first + last - 1)
    return places


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
def test_trend_through_gaps_and_its_variance_are_the_sums_over_all_rates(name, kind):
    """Exact for Q and N. Angles outside a window do not count."""
    x = 3.0 + np.random.default_rng(2).standard_normal(SIZE)
    x = np.where(masks()[name], x if kind == "rate" else np.cumsum(x), np.nan)
    x = np.append(x, 7.0) if kind == "angle" else x
    lines, _ = window_lines(x, angle=kind == "angle", window=WINDOW, step=STEP, n_windows=WINDOWS)
    got = lines[2:]
    spreads = rate_covariances(WINDOW)
    whole = slope_weights(np.arange(WINDOW))
    for j in range(WINDOWS):
        part = x[STEP * j :][: WINDOW + (kind == "angle")]
        held = np.flatnonzero(np.isfinite(part))
        if kind == "angle":
            rates = np.diff(np.interp(np.arange(part.size), held, part[held]))
        else:
            rates = np.nan_to_num(part)
        weights = slope_weights(rate_places(np.isfinite(part), kind))
        assert got[0, j] == pytest.approx(weights @ rates, rel=1e-9, abs=1e-12)
        ratios = [weights @ spread @ weights / (whole @ spread @ whole) for spread in spreads]
        np.testing.assert_allclose(got[1:3, j], ratios[:2], rtol=1e-9)
        np.testing.assert_allclose(got[3:, j], ratios[2:], rtol=0.02)


def test_trend_of_a_window_without_gaps_has_the_variance_of_the_tables():
    x = np.random.default_rng(3).standard_normal(SIZE)
    x[WINDOW + 1] = np.nan
    options = {"angle": False, "window": WINDOW, "step": STEP, "n_windows": WINDOWS}
    got = window_lines(x, **options)[0][2:]
    assert (got[[1, 3, 4], 0] == 1.0).all()
    assert (got[1:, 1] != 1.0).all()
    nothing, mean = window_lines(x * np.nan, **options)
    assert np.isnan([mean, *nothing[0], *nothing[2:].ravel()]).all()
    assert (nothing[1] == 0.0).all()
    one = np.full(SIZE, np.nan)
    one[3] = 1.0
    alone, mean = window_lines(one, **options)
    assert mean == alone[0, 0] == 1.0
    assert alone[1, 0] == 1.0 / WINDOW
    assert np.isnan(alone[2:]).all()
