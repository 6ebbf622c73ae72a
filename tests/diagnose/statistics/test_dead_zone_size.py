"""The width of a dead zone is that of the gap beside the values at which the loop sticks."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.arrays import Floats
from gyrostab.diagnose.evidence.sample_counts import CountEvidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.zero_bin import empty_zone
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics.sample_sizes import estimate_from_counts
from gyrostab.ingest.make_log import make_log
from tests.support.repetitions import first_of

SIZE = 24_000
WIDTH = 0.45


def sweep(seed: int) -> Floats:
    """Noise of 0.5 deg/h about a rate that swings through zero three times."""
    rng = np.random.default_rng(seed)
    turns = 2.0 * np.pi * 3.0 * np.arange(SIZE) / SIZE
    return 1.5 * np.sin(turns + seed) + 0.5 * rng.standard_normal(SIZE)


def estimate_width(values: Floats) -> tuple[float, ...]:
    log = make_log(values[None], rate=20.0, unit="deg/h", start="2026-01-01")
    return estimate_from_counts(
        "dead_zone", "stuck", "x", reduce_log(log), CountEvidence({}), DEFAULTS
    )["width"]


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
@pytest.mark.parametrize("inner", [0.0, 0.005, 0.03])
def test_width_of_a_zone_with_noise_inside_is_that_of_the_gap(seed: int, inner: float):
    rate = sweep(seed)
    stuck = inner * np.random.default_rng(seed + 9).standard_normal(SIZE)
    values = np.round(np.where(np.abs(rate) < WIDTH, stuck, rate), 4)
    width, _, low, high = estimate_width(values)
    assert width == pytest.approx(WIDTH, rel=0.01)
    assert low <= WIDTH <= high + 1e-4


@pytest.mark.parametrize(("bias", "sweep"), [(0.0, 0.0), (0.3, 0.0), (2.0, 0.0), (1.0, 5.0)])
@pytest.mark.parametrize("width", [0.1, 1.0, 3.0])
def test_width_of_a_zone_that_reduces_the_rate_beyond_is_that_of_the_zone(
    width: float, bias: float, sweep: float
):
    rate = bias + sweep * np.sin(6.0 * np.pi * np.arange(SIZE) / SIZE)
    rate += 2.0 * np.random.default_rng(4).standard_normal(SIZE)
    estimate, error, low, high = estimate_width(rate - np.clip(rate, -width, width))
    assert estimate == pytest.approx(width, rel=0.08)  # runs of zeros may be lost samples
    assert low < estimate < high
    assert error < 0.06 * width


def test_no_zone_is_empty_by_chance_nor_on_a_grid():
    for seed in range(20):
        rate = sweep(seed)
        for values in (rate, np.round(rate / 0.3) * 0.3, np.exp(3.0 * rate), np.cumsum(rate)):
            assert not np.isfinite(empty_zone(values)[0])
