"""Largest sums along paths through spectra equal sums over their cells, one by one."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.spectra.line_paths import largest_path_sums

SECTIONS = 3


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from([0.5, 2.0, np.inf]))
def test_largest_sums_equal_those_of_all_paths(seed: int, step: int, limit: float) -> None:
    rng = np.random.default_rng(seed)
    parts, lines = int(rng.integers(1, 6)), int(rng.integers(8, 40))
    cells = rng.standard_normal((2, parts, lines))
    move = rng.integers(-(lines - 2), lines - 1, 5)
    corners = np.rint(np.linspace(0.0, 1.0, parts + 1)[None] * move[:, None]).astype(int)
    low = np.minimum(corners[:, :-1], corners[:, 1:])
    high = np.maximum(corners[:, :-1], corners[:, 1:]) + 1
    first, stop = np.maximum(0, -move), lines - np.maximum(0, move)
    largest = largest_path_sums(
        cells, low, high, first, stop, np.full(5, step), move, SECTIONS, limit
    )
    expected = np.full((2, SECTIONS**2), -np.inf)
    for series in range(2):
        for shape in range(5):
            for begin in range(first[shape], stop[shape], step):
                covered = [
                    cells[series, part, begin + low[shape, part] : begin + high[shape, part]]
                    for part in range(parts)
                ]
                total = sum(min(inside.sum() / np.sqrt(inside.size), limit) for inside in covered)
                begins, ends = (place * SECTIONS // lines for place in (begin, begin + move[shape]))
                column = begins * SECTIONS + ends
                expected[series, column] = max(expected[series, column], total)
    np.testing.assert_allclose(largest, expected, rtol=1e-9, atol=1e-9)
