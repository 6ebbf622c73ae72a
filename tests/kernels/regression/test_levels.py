"""Two levels by the forward-backward algorithm against the sum over all level sequences."""

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.kernels.regression.levels import level_tables, levels_smooth


def enumerated(
    like: np.ndarray, low: float, high: float
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Sum log likelihood, shares, their squares and steps up over all level sequences."""
    blocks, parts = like.shape[0], like.shape[1] - 1
    rate = 1.0 / low + 1.0 / high
    settled = np.array([low, high]) / (low + high)
    stay = np.exp(-rate / parts)
    move = stay * np.eye(2) + (1.0 - stay) * settled
    total, share, square, up = 0.0, np.zeros(blocks), np.zeros(blocks), 0.0
    for course in product((0, 1), repeat=1 + blocks * parts):
        chance = settled[course[0]] * np.prod([move[a, b] for a, b in pairwise(course)])
        counts = np.array(course[1:]).reshape(blocks, parts).sum(axis=1)
        weight = chance * np.prod(like[np.arange(blocks), counts])
        total += weight
        share += weight * counts / parts
        square += weight * (counts / parts) ** 2
        up += weight * sum(a < b for a, b in pairwise(course))
    return np.log(total), share / total, square / total, up / total


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_result_is_the_sum_over_all_level_sequences(parts: int) -> None:
    rng = np.random.default_rng(parts)
    like = rng.random((2, 4, parts + 1))
    like[1, 2] = 1.0  # a block that is missing
    low, high = np.array([0.7, 8.0]), np.array([3.0, 2.0])
    start = np.stack([low, high], axis=1) / (low + high)[:, None]
    log, share, square, up = levels_smooth(like, *level_tables(low, high, parts), start)
    for record in range(2):
        expected = enumerated(like[record], low[record], high[record])
        for computed, known in zip(
            (log[record], share[record], square[record], up[record]), expected, strict=True
        ):
            np.testing.assert_allclose(computed, known, rtol=1e-10)


@given(low=st.floats(0.3, 300.0), high=st.floats(0.3, 300.0), parts=st.integers(1, 8))
def test_tables_are_probabilities_with_the_given_switching_times(
    low: float, high: float, parts: int
) -> None:
    chance, rises = level_tables(np.array([low]), np.array([high]), parts)
    np.testing.assert_allclose(chance.sum(axis=(2, 3)), 1.0, rtol=1e-10)
    settled = np.array([low, high]) / (low + high)
    up = settled[0] * parts * (high / (low + high)) * -np.expm1(-(1.0 / low + 1.0 / high) / parts)
    np.testing.assert_allclose(np.einsum("a,abm->", settled, rises[0]), up, rtol=1e-9)
    share = np.einsum("a,abm,m->", settled, chance[0], np.arange(parts + 1)) / parts
    np.testing.assert_allclose(share, settled[1], rtol=1e-9)
