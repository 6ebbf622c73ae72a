"""Levels that a bias does not return to: evidence, and what it does to the name of a telegraph."""

import numpy as np
import pytest

from gyrostab.diagnose.evidence.telegraph import telegraph_evidence
from gyrostab.diagnose.evidence.visits import compare_visits, visit_columns
from gyrostab.diagnose.identify.identifiability import keep_physical
from tests.diagnose.evidence.test_telegraph import (
    BLOCKS,
    STEP,
    component,
    frame,
    state_of,
    telegraph_share,
    white,
)

EQUAL = (1.0, 1.0, 1.0, 1.0)
UNEQUAL = (1.0, 0.5, 0.8, 0.3)
BEGINS, LENGTH = (8, 30, 50, 75), 10


def bursts(heights: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return events of these heights by block, and whether there is one."""
    share, course = np.zeros((2, BLOCKS))
    for begin, height in zip(BEGINS, heights, strict=False):
        share[begin : begin + LENGTH] = 1.0
        course[begin : begin + LENGTH] = height
    return course, share


def nats(mean: np.ndarray, share: np.ndarray) -> float:
    _, baseline = frame(mean[None])
    return compare_visits(mean, baseline, share, axis="x", block_s=STEP).unequal_nats


def test_equal_and_unequal_visits_are_told_apart() -> None:
    rng = np.random.default_rng(1)
    for sign in (1.0, -1.0):
        equal, share = bursts(EQUAL)
        unequal, _ = bursts(UNEQUAL)
        noise = white(rng, 1)[0]
        assert nats(sign * equal + noise, share) < -3.0
        assert nats(sign * unequal + noise, share) > 10.0
        assert nats(sign * unequal + noise, 1.0 - share) > 10.0


def test_evidence_of_unequal_visits_is_a_bayes_factor() -> None:
    """Over records of equal visits, the mean Bayes factor of unequal ones is one at most."""
    rng = np.random.default_rng(2)
    course, share = bursts(EQUAL)
    gains = [nats(course + noise, share) for noise in white(rng, 200)]
    assert np.exp(gains).mean() < 1.2
    assert max(gains) < 5.0


def test_parts_of_blocks_belong_to_the_nearest_visit() -> None:
    share = np.array([0.0, 0.3, 1.0, 0.4, 0.4, 1.0, 0.2])
    columns = visit_columns(share)
    np.testing.assert_array_equal(columns.sum(axis=0), share)
    assert [np.flatnonzero(row).tolist() for row in columns] == [[1, 2, 3], [4, 5, 6]]
    assert visit_columns(np.full(5, 0.4)).shape == (0, 5)


def test_switches_within_blocks_are_counted_by_parts() -> None:
    share = np.tile([0.0, 0.0, 1.0, 1.0], (BLOCKS, 1))
    _, baseline = frame(np.zeros((1, BLOCKS)))
    comparison = compare_visits(np.zeros(BLOCKS), baseline, share, axis="x", block_s=STEP)
    assert comparison.switch_count == 2 * BLOCKS - 1
    assert np.isneginf(comparison.unequal_nats)


@pytest.mark.parametrize(
    ("heights", "named"), [(EQUAL, True), (UNEQUAL, False), (EQUAL[:2], False)]
)
def test_two_levels_are_named_only_if_the_bias_returns_to_them(
    heights: tuple[float, ...], named: bool
) -> None:
    """With four switches, or levels that differ, it may follow something not recorded."""
    course, share = bursts(heights)
    state = state_of(course + white(np.random.default_rng(3), 1)[0])
    shown = component(state, share)
    assert bool(keep_physical([shown], state)[0]) is named
    if not named:
        assert keep_physical([shown], state)[1][0] == "levels that differ"


def test_equal_visits_on_several_axes_count_once() -> None:
    """A single axis must show that the levels are equal; three weak ones do not add up to it."""
    rng = np.random.default_rng(4)
    share = bursts(EQUAL[:3])[1]
    state = state_of(0.18 * share + white(rng, 1)[0])
    shown = component(state, share)
    assert -3.0 < nats(state.blocks["mean"].values[0], share) < -1.0
    assert not keep_physical([shown] * 3, state)[0]


def test_the_course_of_a_telegraph_has_equal_visits() -> None:
    rng = np.random.default_rng(5)
    course = np.stack([telegraph_share(rng, 120.0, 160.0) for _ in range(20)])
    mean = 0.8 * course + white(rng, 20)
    _, telegraph = telegraph_evidence(*frame(mean), axis="x")
    assert (np.array([nats(*pair) for pair in zip(mean, telegraph.share, strict=True)]) < -3).all()
