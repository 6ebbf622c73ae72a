"""The covariance of Allan variances, also less their trend, against sums over all pairs."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from gyrostab.kernels.fit.covariance import product_tables
from gyrostab.kernels.fit.trend import detrend_tables

WINDOW, KS = 90, np.array([1, 3, 8, 20])


def weights_of(k):
    """Second differences of the angle for the averaging factor k, as weights of the rates."""
    return np.array(
        [
            np.concatenate([np.zeros(m), -np.ones(k), np.ones(k), np.zeros(WINDOW - m - 2 * k)])
            for m in range(WINDOW - 2 * k + 1)
        ]
    )


def covariance_of(term):
    """Covariance of the samples of one term in sample units."""
    if term == 0:
        edges = np.diff(np.eye(WINDOW + 1), axis=0)
        return edges @ edges.T
    if term == 1:
        return np.eye(WINDOW)
    ends = np.tril(np.ones((WINDOW, WINDOW))) - 0.5 * np.eye(WINDOW)
    return ends @ ends.T + np.eye(WINDOW) / 12


def test_table_of_products_is_the_sum_over_all_pairs_of_terms():
    """Compare with covariances from the weights of the second differences."""
    got, _ = product_tables(WINDOW, KS)
    differences = [weights_of(k) / (np.sqrt(2.0) * k) for k in KS]
    for i, first in enumerate(differences):
        for j, second in enumerate(differences):
            parts = {term: first @ covariance_of(term) @ second.T for term in (0, 1, 3)}
            for a, one in parts.items():
                for b, other in parts.items():
                    expected = 2 * np.mean(one * other)
                    assert got[a, b, i, j] == pytest.approx(expected, rel=1e-9), (a, b)


@pytest.mark.parametrize("term", [0, 1, 3])
def test_tables_are_those_of_the_quadratic_forms(term):
    """z is the quadratic form of the mean square less the square of the slope times k^2 / 2."""
    line = np.arange(WINDOW) - (WINDOW - 1) / 2
    slope = line / np.sum(line**2)
    forms = []
    for k in KS:
        rows = weights_of(k)
        forms.append(rows.T @ rows / len(rows) / (2 * k**2) - 0.5 * k**2 * np.outer(slope, slope))
    spread = covariance_of(term)
    tables = detrend_tables(WINDOW, KS, *product_tables(WINDOW, KS))
    assert tables.variance[term] == pytest.approx(slope @ spread @ slope, rel=1e-9)
    for i, first in enumerate(forms):
        for j, second in enumerate(forms):
            expected = 2 * np.trace(first @ spread @ second @ spread)
            assert tables.pairs[term, term, i, j] == pytest.approx(expected, rel=1e-6), (i, j)
            through = 4 * (first @ line) @ spread @ (second @ line)
            assert tables.ramps[term, i, j] == pytest.approx(
                through,
                rel=1e-3,
                abs=1e-3 * np.sqrt(tables.ramps[term, i, i] * tables.ramps[term, j, j]),
            ), (i, j)


def test_tables_of_a_long_window_need_less_than_100_bytes_a_sample():
    ks = np.array([1, 100, 2**16])
    calls = {
        "pairs": lambda window: product_tables(window, ks, diagonal=True),
        "third": lambda window: product_tables(window, ks, variance="modified", diagonal=True),
        "trend": lambda window: detrend_tables(
            window, ks, np.ones((4, 4, ks.size, ks.size)), np.ones((4, ks.size, ks.size))
        ),
    }
    for name, call in calls.items():
        call(int(3 * ks[-1]))  # compiles
        tracemalloc.start()
        call(2**18)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100 * 2**18, (name, peak / 2**18)
