"""The first run compiles the kernels, later ones load them: the same numbers, bit for bit."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

#: A kernel of three functions.
TREND = """
import hashlib
import numpy as np
from gyrostab.kernels.regression.trend import window_trend

values = np.random.default_rng(1).standard_normal(600)
first = np.arange(60) * 7
found = window_trend(values, np.arange(600.0), first, first + 100)
assert np.isfinite(found).all()
print(hashlib.sha256(found.tobytes()).hexdigest())
"""
#: The largest kernel.
FIT = """
import hashlib
import numpy as np
from gyrostab.kernels.fit.least_squares import fit_windows
from gyrostab.kernels.fit.mixture import Curves
from gyrostab.kernels.fit.submodels import make_submodels

n, windows, rng = 24, 60, np.random.default_rng(1)
tau = np.geomspace(1.0, 1e3, n)
columns = np.stack([tau**power for power in (-2.0, -1.0, 0.0, 1.0, 2.0)], axis=1)
truth = columns @ np.array([1.0, 0.3, 0.01, 1e-4, 1e-8])
whole = np.ones((windows, n))
near = 0.6 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 20.0
pairs, ramps = np.tile(near, (4, 4, 1, 1)), np.tile(near / 2.0, (4, 1, 1))
avar = rng.gamma(8.0, truth / 8.0, (windows, n))
trend, diagonal = np.zeros((windows, 6)), np.full((n, 14), 0.05)
found = fit_windows(
    Curves(avar, whole, whole, whole, whole), trend, columns, np.ones(5), pairs, ramps, diagonal,
    np.full(n, 20.0), 31, 1.96, make_submodels(),
)
assert np.isfinite(found[0]).any()
print(hashlib.sha256(b"".join(part.tobytes() for part in found)).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "code", [TREND, pytest.param(FIT, marks=pytest.mark.full)], ids=["small", "large"]
)
def test_the_process_that_compiles_gets_the_same_bits_as_those_that_load(tmp_path, code) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    )
    assert any(tmp_path.rglob("*.nbi"))
    assert first == second


#: An account without a home that uses a package of another account.
NO_FOLDER = """
from numba.core import caching
name = "CacheImpl" if hasattr(caching, "CacheImpl") else "_CacheImpl"
getattr(caching, name)._locator_classes = []
"""


#: A kernel of a single loop.
TRACK = """
import numpy as np
from gyrostab.kernels.grid.stamps import track

count, piece = track(np.array([0, 10, 30]), 10.0, 0.1, 100.0)
assert count.tolist() == [0, 1, 3]
assert not track.stats.cache_path
"""


@pytest.mark.slow
def test_kernels_work_where_nothing_can_be_cached() -> None:
    subprocess.run([sys.executable, "-c", NO_FOLDER + TRACK], check=True)


@pytest.mark.parametrize("command", [["demo"], ["run", "log.csv", "-o", "product.nc"]])
def test_the_fit_is_compiled_from_before_the_libraries_are_imported(command, tmp_path):
    code = f"""
import os, sys
from gyrostab.kernels import compile_ahead

def start(module, kernel):
    print(module, kernel.__name__, {{"xarray", "dask"}} & set(sys.modules), flush=True)
    os._exit(0)

compile_ahead.start_compilation = start
sys.argv = ["gyrostab", *{command!r}]
from gyrostab.cli import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout == "gyrostab.allan.compile_fit fit_windows set()\n"


def test_the_second_process_imports_neither_xarray_nor_dask():
    code = "import sys, gyrostab.allan.compile_fit; print({'xarray', 'dask'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "set()\n"
