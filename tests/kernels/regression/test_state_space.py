"""Whitening of block means against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.regression.state_space import flicker_states, products_on_grid, whiten


def walk_covariance(edges: np.ndarray) -> np.ndarray:
    """Covariance of block means of a Brownian motion from the first edge: integral of min(s, t)."""
    begin, end = edges[:-1] - edges[0], edges[1:] - edges[0]
    covariance = np.minimum.outer((begin + end) / 2.0, (begin + end) / 2.0)
    covariance[np.diag_indices(begin.size)] = begin + (end - begin) / 3.0
    return covariance


def relaxation_covariance(edges: np.ndarray, time: float) -> np.ndarray:
    """Covariance of block means of an Ornstein-Uhlenbeck process: integral of exp(-|s - t| / T)."""
    begin, end = edges[:-1], edges[1:]
    step = end - begin
    fall = -np.expm1(-step / time) * time / step
    apart = np.maximum(begin[:, None] - end[None, :], begin[None, :] - end[:, None])
    covariance = np.exp(-apart / time) * np.outer(fall, fall)
    a = step / time
    covariance[np.diag_indices(step.size)] = 2.0 * (a + np.expm1(-a)) / a**2
    return covariance


def dense(columns, variance, step, present, K2, ou_variance, ou_time, angle=0.0):
    edges = np.concatenate([[0.0], np.cumsum(step)])
    # it walks by its own clock
    V = np.diag(variance) + walk_covariance(np.concatenate([[0.0], np.cumsum(K2 * step)]))
    for v, time in zip(ou_variance, ou_time, strict=True):
        V = V + v * relaxation_covariance(edges, time)
    differences = (np.eye(step.size, step.size + 1, 1) - np.eye(step.size, step.size + 1)).T / step
    V = V + angle * differences.T @ differences
    V, X, constant = V[np.ix_(present, present)], columns[present], np.ones(present.sum())
    L = np.linalg.cholesky(V)
    A, u = np.linalg.solve(L, X), np.linalg.solve(L, constant)
    products = A.T @ A - np.outer(A.T @ u, A.T @ u) / (u @ u)
    return products, 2.0 * np.log(np.diag(L)).sum() + np.log(u @ u)


@given(
    seed=st.integers(0, 10**6),
    missing=st.floats(0.0, 0.8),
    K=st.sampled_from([0.0, 0.01, 1.0]),
    processes=st.integers(0, 5),
    angle=st.sampled_from([0.0, 30.0, 1e4]),
)
def test_products_and_determinant_equal_those_of_the_dense_covariance(
    seed, missing, K, processes, angle
):
    rng = np.random.default_rng(seed)
    n = 60
    step = np.full(n, 20.0) if seed % 2 else rng.uniform(1.0, 30.0, n)
    present = rng.random(n) >= missing
    present[rng.choice(n, 3, replace=False)] = True
    columns = rng.standard_normal((n, 4)) + 5.0
    variance = rng.uniform(0.5, 2.0, n)
    K2 = K**2 * (rng.uniform(0.1, 3.0, n) if seed % 3 else np.ones(n))
    case = (
        columns,
        variance,
        step,
        present,
        K2,
        rng.uniform(0.1, 3.0, processes),
        10.0 ** rng.uniform(0.0, 5.0, processes),
        angle,
    )
    whitened, log_determinant = whiten(*case)
    products, expected = dense(*case)
    np.testing.assert_allclose(whitened.T @ whitened, products, rtol=1e-8, atol=1e-8)
    assert log_determinant == pytest.approx(expected, rel=1e-8, abs=1e-8)
    assert not whitened[~present].any()


def test_only_a_constant_is_removed():
    rng = np.random.default_rng(3)
    n = 50
    case = (
        np.ones(n),
        np.full(n, 20.0),
        rng.random(n) > 0.3,
        np.full(n, 1e-3),
        np.array([0.2]),
        np.array([100.0]),
    )
    columns = rng.standard_normal((n, 2))
    plain, _ = whiten(columns, *case)
    moved, _ = whiten(columns + np.array([1e6, 0.0]), *case)
    np.testing.assert_allclose(moved, plain, atol=1e-8)
    constant, _ = whiten(np.ones((n, 1)), *case)
    assert np.abs(constant).max() < 1e-12


def test_white_noise_alone_leaves_deviations_from_the_mean():
    values = np.array([[1.0], [2.0], [4.0]])
    whitened, log_determinant = whiten(
        values, np.full(3, 0.5), np.ones(3), np.ones(3, bool), np.zeros(3), np.empty(0), np.empty(0)
    )
    assert (whitened**2).sum() == pytest.approx(((values - values.mean()) ** 2).sum() / 0.5)
    assert log_determinant == pytest.approx(3 * np.log(0.5) + np.log(3 / 0.5))


def test_no_block_present_gives_zeros():
    case = (np.ones(5), np.ones(5), np.zeros(5, bool), np.ones(5), np.ones(1), np.ones(1))
    whitened, log_determinant = whiten(np.ones((5, 2)), *case)
    assert not whitened.any()
    assert log_determinant == 0.0


def test_slow_and_fast_processes_keep_precision():
    rng = np.random.default_rng(5)
    n = 40
    slow_and_fast = np.ones(3), np.array([999.0, 1e6, 1e-2])
    case = (
        rng.standard_normal((n, 2)),
        np.full(n, 1e-3),
        np.full(n, 1.0),
        np.ones(n, bool),
        np.zeros(n),
        *slow_and_fast,
    )
    whitened, log_determinant = whiten(*case)
    products, expected = dense(*case)
    np.testing.assert_allclose(whitened.T @ whitened, products, rtol=1e-7)
    assert log_determinant == pytest.approx(expected, rel=1e-8)


def flicker_variogram(lag: np.ndarray) -> np.ndarray:
    """Variance of the difference of two block means of flicker noise, B = 1."""

    def integral(x):
        return np.where(x > 0, -(x**2) / 2.0 * np.log(np.maximum(x, 1e-300)) + 0.75 * x**2, 0.0)

    covariance = (
        integral(lag + 1.0) - 2.0 * integral(lag * 1.0) + integral(np.abs(lag - 1.0))
    ) / np.pi
    return 2.0 * (2.0 * integral(np.array(1.0)) / np.pi - covariance)


def test_sum_of_processes_approximates_flicker_noise():
    step, n = 20.0, 180
    variance, time, white = flicker_states(step, step * n)
    edges = np.arange(n + 1) * step
    covariance = sum(
        v * relaxation_covariance(edges, t)[0] for v, t in zip(variance, time, strict=True)
    )
    lag = np.arange(1, n)
    variogram = 2.0 * (covariance[0] + white - covariance[1:])
    np.testing.assert_allclose(variogram, flicker_variogram(lag), rtol=0.05)


@given(seed=st.integers(0, 10**6), angle=st.sampled_from([0.0, 30.0]))
def test_products_on_a_grid_are_those_of_each_point(seed, angle):
    rng = np.random.default_rng(seed)
    n, step = 40, 20.0
    columns, present = rng.standard_normal((n, 3)), rng.random(n) > 0.2
    variance, walk = rng.uniform(0.5, 2.0, n), rng.uniform(0.0, 0.01, n)
    K2, B2 = np.array([0.0, 0.02, 1.0]), np.array([3.0, 0.0, 0.1])
    flicker = share, time, white = flicker_states(step, n * step)
    other = np.array([0.7]), np.array([55.0])
    steps = np.full(n, step)
    products, determinant = products_on_grid(
        columns, variance, steps, present, walk, K2, B2, flicker, *other, angle
    )
    for g, (k, b) in enumerate(zip(K2, B2, strict=True)):
        squares = np.append(share * b, other[0]) if b else other[0]
        times = np.append(time, other[1]) if b else other[1]
        expected, log_determinant = dense(
            columns, variance + b * white, steps, present, walk + k, squares, times, angle
        )
        np.testing.assert_allclose(products[g], expected, rtol=1e-6, atol=1e-8)
        assert determinant[g] == pytest.approx(log_determinant, rel=1e-9, abs=1e-7)
