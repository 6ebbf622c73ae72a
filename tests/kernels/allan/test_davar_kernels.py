"""Single kernels of the dynamic Allan variance: integral, lags, reused memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.allan import plain_sums, vectors
from gyrostab.kernels.allan.integrate import integrate, present_runs
from gyrostab.kernels.allan.plain_sums import CONSECUTIVE_LAGS, LANES
from gyrostab.kernels.allan.surface import WorkUnit, surface_unit
from gyrostab.kernels.workspace import Workspace


class TestKernels:
    @pytest.mark.parametrize("module", [vectors, plain_sums])
    @given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.booleans(), st.integers(1, 200))
    def test_sums_of_several_lags_in_one_pass(self, module, seed, count, in_a_row, longest):
        rng = np.random.default_rng(seed)
        if in_a_row:
            count = CONSECUTIVE_LAGS if count > 2 else 4
        sizes = rng.integers(0, longest, count)
        first = int(rng.integers(0, 9))
        place = int(rng.integers(0, 3))
        lags = (
            rng.integers(1, 40) + np.arange(-2, count)
            if in_a_row
            else np.sort(rng.choice(40, count + 2, replace=False)) + 1
        )
        splits = rng.integers(0, sizes + 1)
        used = lags[2:]
        # elements that no term needs may have any value
        theta = np.full(first + longest + 2 * used.max() + 2 * LANES, np.nan)
        end = first + (sizes + 2 * used).max()
        theta[first:end] = rng.standard_normal(end - first)
        heads, tails = np.full((2, count + 4), 7.0)
        module.split_sums(theta, first, count, lags, 2, splits, sizes, heads, tails, place)
        for i, (k, split, size) in enumerate(zip(used, splits, sizes, strict=True)):
            m = first + np.arange(size)
            squares = (theta[m + 2 * k] - 2 * theta[m + k] + theta[m]) ** 2
            sums = [heads[place + i] - 7.0, tails[place + i] - 7.0]
            np.testing.assert_allclose(
                sums, [squares[:split].sum(), squares[split:].sum()], rtol=1e-12, atol=1e-13
            )
        others = np.r_[:place, place + count : count + 4]
        assert np.all(heads[others] == 7.0)
        assert np.all(tails[others] == 7.0)

    @given(
        st.integers(0, 2**32 - 1),
        st.integers(1, 9000),
        st.sampled_from([0.0, 0.001, 0.3, 0.99, 1.0]),
    )
    def test_integral(self, seed, n, missing):
        rng = np.random.default_rng(seed)
        x = rng.integers(-5, 6, n).astype(np.float64)
        x[rng.random(n) < missing] = np.nan
        starts, stops = present_runs(x)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], np.isfinite(x), [False]])))
        np.testing.assert_array_equal(starts, edges[::2])
        np.testing.assert_array_equal(stops, edges[1::2])
        angle = np.empty(n + 1)
        largest = integrate(x, 1.0, starts, stops, angle)
        theta = np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(x), x - 1.0, 0.0))])
        assert largest == np.abs(theta).max()
        np.testing.assert_array_equal(angle, theta)

    def test_reused_memory_does_not_change_results(self):
        rng, space = np.random.default_rng(4), Workspace()
        whole, broken = rng.standard_normal((2, 30_000))
        broken[rng.random(30_000) < 0.02] = np.nan
        broken[4000] = 1e9  # kept as two doubles
        for x, angle, apart, n_tau in [
            (whole, False, 1, 60),
            (broken, False, 8, 20),
            (broken, True, 1, 30),
            (whole, False, 8, 9),
        ]:
            ks = np.arange(1, n_tau + 1) * apart
            unit = WorkUnit(1000, 300, ks, angle, 0.01, 0.3, 0.1)
            cells, lines = surface_unit(x, unit)
            used_cells, used_lines = surface_unit(x, unit, space)
            for fresh, used in zip([*cells, lines], [*used_cells, used_lines], strict=True):
                np.testing.assert_array_equal(fresh, used)

    @pytest.mark.parametrize("angle", [False, True])
    @pytest.mark.parametrize("place", [0, 999])
    def test_damaged_sample_changes_only_its_windows(self, place, angle):
        x = 10.0 + np.random.default_rng(5).standard_normal(1000)
        x = np.cumsum(x) if angle else x
        damaged = x.copy()
        damaged[place] = 1e17
        unit = WorkUnit(100, 100, np.arange(1, 20), angle, 0.01, 0.3, 0.1)
        (cells, lines), (got_cells, got_lines) = (surface_unit(y, unit) for y in (x, damaged))
        others = slice(0, 8) if place else slice(1, 9)
        np.testing.assert_allclose(got_lines[:3, others], lines[:3, others], rtol=1e-9)
        np.testing.assert_allclose(got_cells.avar[others], cells.avar[others], rtol=1e-9)

    def test_blocks_use_the_plain_loop_where_the_vectors_cannot_be_imported(self):
        code = (
            "import sys\n"
            "sys.modules['gyrostab.kernels.allan.vectors'] = None\n"
            "from gyrostab.kernels.allan import blocks\n"
            "print(blocks.split_sums.py_func.__module__)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False
        )
        assert done.stdout.strip() == "gyrostab.kernels.allan.plain_sums", done.stderr
