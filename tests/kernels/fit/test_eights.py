"""Eight problems at once against numpy and scipy, one at a time."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from scipy.optimize import nnls

from gyrostab.kernels.compiled import KERNEL
from gyrostab.kernels.fit.eight_solvers import back_substitute, eliminate, solve_nonnegative_eights
from gyrostab.kernels.fit.eights import eights, put, root, take, where_above

COMPILED = {**KERNEL, "cache": False}


@njit(**COMPILED)
def every_operation(a, b):
    out = eights(8)
    for place in range(8):
        out[6, place], out[7, place] = a[place], b[place]
    x, y = take(out, 6), take(out, 7)
    put(out, 0, x + y)
    put(out, 1, 2.0 - x)
    put(out, 2, x * y)
    put(out, 3, 1.0 / y)
    put(out, 4, root(y))
    put(out, 5, where_above(x, y, 1.0, x))
    return out, out.ctypes.data


def test_operations_equal_those_of_numpy():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=8), rng.uniform(0.1, 1.0, 8)
    a[2] = np.nan
    got, address = every_operation(a, b)
    np.testing.assert_array_equal(
        got[:6], [a + b, 2.0 - a, a * b, 1.0 / b, np.sqrt(b), np.where(a > b, 1.0, a)]
    )
    assert address % 64 == 0


@njit(**COMPILED)
def solve_eight(matrices, columns):
    n, width = matrices.shape[1], matrices.shape[1] + columns.shape[2]
    system, ok = eights(n * width), eights(1)
    for place in range(8):
        for i in range(n):
            for j in range(n):
                system[width * i + j, place] = matrices[place, i, j]
            for c in range(columns.shape[2]):
                system[width * i + n + c, place] = columns[place, i, c]
    eliminate(system, n, width, ok)
    whitened = system.copy()
    back_substitute(system, n, width)
    return whitened, system, ok


@pytest.mark.parametrize("n", [4, 12, 40])
def test_elimination_of_positive_definite_matrices_equals_numpy(n):
    rng = np.random.default_rng(n)
    half = rng.normal(size=(8, n, n + 3))
    matrices, columns = half @ half.transpose(0, 2, 1), rng.normal(size=(8, n, 6))
    matrices[5, n // 2, n // 2] = -1.0
    whitened, solved, ok = solve_eight(matrices, columns)
    assert ok[0].tolist() == [1, 1, 1, 1, 1, 0, 1, 1]
    for place in np.flatnonzero(ok[0]):
        factor = np.linalg.cholesky(matrices[place])
        first, second = (system.reshape(n, n + 6, 8)[:, :, place] for system in (whitened, solved))
        np.testing.assert_allclose(np.triu(first[:, :n]), factor.T, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            first[:, n:], np.linalg.solve(factor, columns[place]), rtol=1e-7, atol=1e-8
        )
        np.testing.assert_allclose(
            second[:, n : n + 5],
            np.linalg.solve(matrices[place], columns[place, :, :5]),
            rtol=1e-6,
            atol=1e-7,
        )


@njit(**COMPILED)
def nonnegative_eight(normal, right, allowed):
    equations, data, terms, squares = eights(25), eights(5), eights(5), eights(5)
    for place in range(8):
        for i in range(5):
            data[i, place] = right[place, i]
            for j in range(5):
                equations[5 * i + j, place] = normal[place, i, j]
    solve_nonnegative_eights(equations, data, allowed, terms, squares, eights(75))
    return squares, terms


@pytest.mark.parametrize("allowed", [31, 0b01011])
def test_nonnegative_solutions_equal_scipy(allowed):
    rng = np.random.default_rng(allowed)
    members = [i for i in range(5) if allowed >> i & 1]
    sizes = set()
    for _ in range(40):
        design = rng.standard_normal((8, 12, 5)) * 10.0 ** rng.integers(-6, 6, (8, 1, 5))
        data = rng.standard_normal((8, 12))
        if rng.random() < 0.5:  # a minimiser with all terms
            data = data / 10 + (design / abs(design).max(axis=1, keepdims=True)) @ rng.uniform(
                0.5, 1.0, 5
            )
        normal = np.einsum("pni,pnj->pij", design, design)
        right = np.einsum("pni,pn->pi", design, data)
        squares, terms = nonnegative_eight(normal, right, allowed)
        for place in range(8):
            scale = np.linalg.norm(design[place], axis=0)
            expected = np.zeros(5)
            expected[members] = nnls(design[place][:, members] / scale[members], data[place])[0]
            np.testing.assert_allclose(squares[:, place] * scale, expected, atol=1e-7)
            np.testing.assert_array_equal(terms[:, place], expected > 0)
            sizes.add(int(terms[:, place].sum()))
    assert sizes >= set(range(1, len(members) + 1))
