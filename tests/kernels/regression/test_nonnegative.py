"""Least squares with sizes that cannot be negative, compared with scipy."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear, nnls

from gyrostab.kernels.regression.nonnegative import solve_bounded, solve_nonnegative


def test_nonnegative_solution_is_optimal():
    rng = np.random.default_rng(14)
    for _ in range(50):
        design = rng.standard_normal((12, 5)) * 10.0 ** rng.integers(-6, 6, 5)
        data = rng.standard_normal(12)
        solution = solve_nonnegative(design.T @ design, design.T @ data)
        expected, residual = nnls(design, data)
        assert np.linalg.norm(design @ solution - data) <= residual * (1 + 1e-6)
        np.testing.assert_allclose(design @ solution, design @ expected, atol=1e-5)


def test_many_systems_have_the_solutions_of_each():
    """Some inside the range, and some at its edge."""
    rng = np.random.default_rng(17)
    design = np.abs(rng.standard_normal((40, 12, 4)))
    data = rng.standard_normal((40, 12)) + 2.0
    normal = np.swapaxes(design, 1, 2) @ design
    right = (np.swapaxes(design, 1, 2) @ data[..., None])[..., 0]
    solutions = solve_nonnegative(normal, right)
    at_zero = (solutions == 0.0).any(axis=1)
    assert 0 < at_zero.sum() < 40
    for solution, one_design, one_data in zip(solutions, design, data, strict=True):
        np.testing.assert_allclose(solution, nnls(one_design, one_data)[0], atol=1e-8)


def test_some_sizes_are_bounded():
    rng = np.random.default_rng(15)
    at_bound = 0
    for _ in range(100):
        design = rng.standard_normal((20, 7)) * 10.0 ** rng.integers(-4, 4, 7)
        data, scale = rng.standard_normal(20), np.linalg.norm(design, axis=0)
        low = np.where(rng.random(7) < 0.6, -0.5 * rng.integers(0, 2, 7), -np.inf)
        solution = scale * solve_bounded(design.T @ design, design.T @ data, low / scale)
        assert (solution >= low).all()
        expected = lsq_linear(design / scale, data, (low, np.inf), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(solution, expected, atol=1e-8)
        at_bound += int((solution == low).any())
    assert 40 < at_bound < 100


def test_size_that_free_sizes_make_superfluous_stays_at_its_bound():
    rng = np.random.default_rng(16)
    free = rng.standard_normal((30, 3))
    design = np.column_stack([free, free @ [1.0, -2.0, 0.5], rng.standard_normal(30)])
    data = design @ [1.0, 1.0, 1.0, -3.0, -2.0] + 0.1 * rng.standard_normal(30)
    normal = design.T @ design * (1.0 + 1e-12 * np.eye(5))
    low = np.array([-np.inf, -np.inf, -np.inf, 0.0, 0.0])
    solution = solve_bounded(normal, design.T @ data, low)
    expected = np.append(np.linalg.lstsq(free, data, rcond=None)[0], [0.0, 0.0])
    np.testing.assert_allclose(solution, expected, atol=1e-6)
