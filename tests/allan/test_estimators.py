"""The comparison of estimators: its likelihood and its bound, and a short form of its table."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dct
from scipy.linalg import toeplitz

from gyrostab.allan import window_fit
from gyrostab.kernels.spectra.expected import sample_covariance
from gyrostab.noise import LAWS, TERMS
from tests.support.scripts import load_script

RATE, SAMPLES = 10.0, 400


@pytest.fixture(scope="module")
def estimators():
    return load_script("benchmarks/estimators.py")


@pytest.fixture(scope="module")
def covariances():
    """Exact covariances of the cosine transform of unit Q, N, B and K, (4, n - 1, n - 1)."""
    basis = dct(np.eye(SAMPLES), norm="ortho", axis=0)[1:]
    rows = sample_covariance(SAMPLES, RATE)
    return np.stack(
        [
            LAWS[term].seconds_factor * basis @ toeplitz(row) @ basis.T
            for term, row in zip(TERMS, rows, strict=False)
        ]
    )


def test_expected_squares_of_the_cosine_transform_are_exact(estimators, covariances):
    columns = estimators.Cosines(SAMPLES, RATE).columns[: estimators.SINGLE]
    exact = np.einsum("aii->ia", covariances)[: estimators.SINGLE]
    np.testing.assert_allclose(columns, exact, rtol=1e-6)


@pytest.mark.parametrize("ramp", [False, True])
def test_the_bound_is_that_of_the_exact_likelihood(estimators, covariances, ramp):
    """Fisher information of a Gaussian record, with the ramp eliminated."""
    squares = np.array([1.0, 0.01, 1.0, 40.0]) ** 2
    inverse = np.linalg.inv(np.einsum("a,aij->ij", squares, covariances))
    if ramp:
        time = dct((np.arange(SAMPLES) - (SAMPLES - 1) / 2) / RATE / 3600, norm="ortho")[1:]
        whitened = inverse @ time
        inverse -= np.outer(whitened, whitened) / (time @ whitened)
    parts = [inverse @ covariance for covariance in covariances]
    exact = 0.5 * np.array([[np.sum(a * b.T) for b in parts] for a in parts])
    information, _ = estimators.Cosines(SAMPLES, RATE).information(squares, free_ramp=ramp)
    bounds = [np.sqrt(np.diag(np.linalg.inv(matrix))) for matrix in (information, exact)]
    np.testing.assert_allclose(*bounds, rtol=0.05)


def test_wavelet_variances_are_those_published_for_the_method_of_wavelet_moments():
    """Manual of the R package gmwm, processes to Haar wavelet variance, at scale 2 k."""
    ks = 2 ** np.arange(9)
    tables = window_fit.fit_tables(tuple(ks.tolist()), RATE, 2048)
    variances = tables.columns / 2 / tables.to_samples
    scale = 2.0 * ks
    np.testing.assert_allclose(variances[:, 0], 6 / scale**2, rtol=1e-9)
    np.testing.assert_allclose(variances[:, 1], 1 / scale, rtol=1e-9)
    np.testing.assert_allclose(variances[:, 4], scale**2 / 16, rtol=1e-9)
    # theirs is a walk in steps; samples that are means of it have less by white noise of 1 / 6
    np.testing.assert_allclose(variances[:, 3], (scale**2 + 2) / (12 * scale) - 1 / (6 * scale))


def test_short_form_of_the_table(estimators):
    rows = {term: row for _, term, _, row, _ in estimators.compare(40.0, 100.0, 40, ("Ks",))}
    assert set(rows) == {"N", "K"}
    for term, row in rows.items():
        error = {name: figures[1] for name, figures in row.items()}
        assert error["gyrostab"] < 1.25 * min(error.values()), (term, error)
        assert (
            max(error["relative NNLS"], error["log fit"], error["slopes"]) > 2 * error["gyrostab"]
        )
        assert row["gyrostab"][3] > 0.85
