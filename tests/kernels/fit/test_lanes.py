"""The fit where the vectors of eight cannot be built: one window at a time, in plain numba."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from gyrostab.kernels.allan.clusters import cluster_strides
from gyrostab.kernels.fit import lanes
from gyrostab.kernels.fit.covariance import product_tables
from gyrostab.kernels.fit.freedoms import combine_diagonal
from gyrostab.kernels.fit.least_squares import fit_windows
from gyrostab.kernels.fit.mixture import Curves
from gyrostab.kernels.fit.submodels import make_submodels
from gyrostab.noise import avar_columns, sample_squares

FIT = """
import sys
sys.modules["gyrostab.kernels.fit.eights"] = None
import numpy as np
from gyrostab.kernels.fit import lanes
from gyrostab.kernels.fit.least_squares import fit_windows
from gyrostab.kernels.fit.mixture import Curves
from gyrostab.kernels.fit.submodels import make_submodels
given = [np.load(sys.argv[1])[f"arr_{i}"] for i in range(12)]
found = fit_windows(Curves(*given[:5]), *given[5:], 31, 1.96, make_submodels())
np.savez(sys.argv[2], *found, places=lanes.PLACES)
"""


@pytest.mark.full  # compiles the fit
@pytest.mark.timeout(900)
def test_plain_numba_gives_the_fit_of_the_vectors(tmp_path):
    rng = np.random.default_rng(3)
    ks, rate, window = 2 ** np.arange(9), 100.0, 2000
    columns = avar_columns(ks / rate)
    freedom = np.maximum(window / ks, 2.0)
    avar = (columns @ [0.01, 1e-4, 0.0, 4.0, 0.0]) * rng.chisquare(freedom, (11, 9)) / freedom
    avar[2, 5:] = avar[4] = np.nan
    gaps = [rng.uniform(0.9, 1.1, avar.shape) for _ in range(4)]
    pairs, ramps = product_tables(window, ks)
    diagonal = combine_diagonal(
        np.einsum("abii->abi", pairs), np.einsum("aii->ai", ramps), cluster_strides(window, ks)
    )
    trend = rng.uniform(0.0, 1e-3, (11, 6))
    squares = sample_squares(rate)
    given = [avar, *gaps, trend, columns, squares, pairs, ramps, diagonal, freedom]
    np.savez(tmp_path / "given.npz", *given)
    subprocess.run(
        [sys.executable, "-c", FIT, tmp_path / "given.npz", tmp_path / "found.npz"],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        check=True,
    )
    plain = np.load(tmp_path / "found.npz")
    assert (lanes.PLACES, int(plain["places"])) == (8, 1)
    fits = fit_windows(Curves(*given[:5]), *given[5:], 31, 1.96, make_submodels())
    for number, expected in enumerate(fits):
        assert np.isfinite(expected).any()
        largest = np.nanmax(abs(expected), axis=0)
        np.testing.assert_allclose(
            plain[f"arr_{number}"], expected, rtol=1e-9, atol=1e-12 * largest.max()
        )
