"""The plain loop of the Allan variance against the vectors of eight, and its use without them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.allan import plain_sums, vectors
from gyrostab.kernels.allan.plain_sums import CONSECUTIVE_LAGS, LANES


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 3, 4, 8]), st.integers(1, 300))
def test_plain_loop_and_vectors_give_the_same_sums(seed, count, longest):
    rng = np.random.default_rng(seed)
    if count == CONSECUTIVE_LAGS:
        lags = rng.integers(1, 40) + np.arange(count)
    else:
        lags = np.sort(rng.choice(60, count, replace=False)) + 1
    sizes = rng.integers(0, longest, count)
    splits = rng.integers(0, sizes + 1)
    theta = np.cumsum(rng.standard_normal(longest + 2 * lags.max() + 2 * LANES))
    sums = []
    for module in (plain_sums, vectors):
        heads, tails = np.zeros((2, count + 2))
        module.split_sums(theta, 0, count, lags, 0, splits, sizes, heads, tails, 1)
        sums.append(np.concatenate([heads, tails]))
    np.testing.assert_allclose(sums[0], sums[1], rtol=1e-12, atol=1e-12)


def test_blocks_use_the_plain_loop_where_the_vectors_cannot_be_imported():
    code = (
        "import sys\n"
        "sys.modules['gyrostab.kernels.allan.vectors'] = None\n"
        "from gyrostab.kernels.allan import blocks\n"
        "print(blocks.split_sums.py_func.__module__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "gyrostab.kernels.allan.plain_sums", done.stderr
