"""Outliers: detected from five deviations, but not in nonstationary or coarse noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.diagnose.reduce.outliers import (
    EXPECTED_FALSE_OUTLIERS,
    count_histogram_outliers,
    find_peaks,
    quantization_step,
)
from gyrostab.kernels.samples.outliers import HISTOGRAM, departures

SIZE, BLOCK, RATE = 18_000, 180, 10.0  # half an hour


def counted(x: np.ndarray, block: int = BLOCK) -> tuple[np.ndarray, np.ndarray]:
    """Return number and weighted number of outliers by block, of one axis."""
    values = np.ascontiguousarray(x[: x.size // block * block].reshape(-1, block))
    histogram = np.zeros((1, len(values), HISTOGRAM), np.uint32)
    number, outliers = count_histogram_outliers(histogram, [[find_peaks(values, histogram[0])]])
    return number[0], outliers[0]


def total(make, records: int = 20) -> int:
    return sum(
        int(counted(make(np.random.default_rng([7, seed])))[0].sum()) for seed in range(records)
    )


def slow(rng: np.random.Generator) -> np.ndarray:
    """White noise with a random walk."""
    return rng.standard_normal(SIZE) + np.cumsum(0.002 * rng.standard_normal(SIZE))


def spiked(rng: np.random.Generator, size: float, number: int) -> np.ndarray:
    x = slow(rng)
    x[rng.choice(SIZE, number, replace=False)] += size * rng.choice([-1.0, 1.0], number)
    return x


# --------------------------------------------------------------------------------
# departures


@given(seed=st.integers(0, 2**31), lost=st.sampled_from([0.0, 0.2, 0.4]))
def test_departures_are_from_the_median_of_surrounding_pairs(seed: int, lost: float):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, 60))
    x[rng.random(x.shape) < lost] = np.nan
    away, histogram = np.empty_like(x), np.zeros((2, HISTOGRAM), np.uint32)
    departures(x, away, histogram)
    smaller = {
        1: 0.5,
        2: 0.2982,
        3: 0.2147,
        4: 0.1682,
    }  # variance of the median of that many pairs of normal numbers
    checked = 0
    for b, i in np.ndindex(*x.shape):
        pairs = [(x[b, i - k], x[b, i + k]) for k in range(1, 5) if i - k >= 0 and i + k < 60]
        complete = [pair for pair in pairs if not np.isnan(pair).any()]
        if np.isnan(x[b, i]):
            assert np.isnan(away[b, i])
        elif len(complete) > 1:
            share = np.sqrt((1.0 + smaller[4]) / (1.0 + smaller[len(complete)]))
            assert away[b, i] == pytest.approx((x[b, i] - np.median(complete)) * share, abs=1e-12)
            checked += 1
    assert checked > 5
    assert histogram.sum() == np.isfinite(away).sum()


def test_departures_of_white_noise_do_not_depend_on_gaps():
    rng = np.random.default_rng(1)
    for lost in (0.0, 0.3, 0.6):
        x = rng.standard_normal((200, 1000))
        x[rng.random(x.shape) < lost] = np.nan
        away = np.empty_like(x)
        departures(x, away, np.zeros((200, HISTOGRAM), np.uint32))
        assert np.nanstd(away) == pytest.approx(np.sqrt(1.168), rel=0.02)


def test_departures_ignore_slopes_and_show_spikes():
    x = np.tile(3.0 * np.arange(100.0), (2, 1))
    x[1, [0, 50, 99]] += 1000.0
    away = np.empty_like(x)
    departures(x, away, np.zeros((2, HISTOGRAM), np.uint32))
    np.testing.assert_allclose(away[0], 0.0, atol=1e-9)
    np.testing.assert_array_equal(
        np.flatnonzero(np.abs(away[1]) > 20.0), [0, 50, 99]
    )  # next to it, medians are off by some steps


# --------------------------------------------------------------------------------
# counts


def test_gaussian_noise_has_the_expected_false_outliers():
    assert total(
        lambda rng: rng.standard_normal(SIZE), 40
    ) <= 40 * EXPECTED_FALSE_OUTLIERS + 3.0 * np.sqrt(40 * EXPECTED_FALSE_OUTLIERS)


@pytest.mark.parametrize(("size", "least"), [(5.0, 0.2), (6.0, 0.5), (8.0, 0.9)])
def test_spikes_are_detected_from_five_deviations(size, least):
    detected = total(lambda rng: spiked(rng, size, 15), 10)
    assert least * 150 <= detected <= 150


def test_a_large_outlier_counts_three_times_anywhere_in_a_block():
    for place in (0, 1, 90, 179):
        x = np.random.default_rng(2).standard_normal(SIZE)
        x[20 * BLOCK + place] += 30.0
        number, outliers = counted(x)
        assert (number[20], outliers[20], outliers.sum()) == (1, 3, 3)


TIME = np.arange(SIZE) / RATE
LIVELY = {
    "twice the noise for a while": lambda rng: slow(rng) * np.where(TIME % 300.0 < 70.0, 2.0, 1.0),
    "five times the noise, from within a block": lambda rng: (
        slow(rng) * np.where(TIME % 300.0 < 77.3, 5.0, 1.0)
    ),
    "swelling within seconds": lambda rng: (
        slow(rng) * np.exp(0.4 * np.sin(2.0 * np.pi * TIME / 3.1))
    ),
    "swelling at random": lambda rng: (
        slow(rng)
        * np.exp(0.2 * np.convolve(rng.standard_normal(SIZE + 9), np.ones(10) / 10**0.5, "valid"))
    ),
    "a line that beats": lambda rng: (
        slow(rng) + 3.0 * np.sin(13.2 * TIME) * (1.0 + 0.5 * np.sin(0.9 * TIME))
    ),
    "steps": lambda rng: (
        slow(rng)
        + 20.0 * np.cumsum((rng.random(SIZE) < 20.0 / SIZE) * rng.choice([-1.0, 1.0], SIZE))
    ),
    "few levels": lambda rng: np.round(slow(rng) / 3.0) * 3.0,
    "angles in counts": lambda rng: (
        np.diff(np.round(np.cumsum(np.append(0.0, slow(rng))) / 3.0)) * 3.0
    ),
    "a moving mean": lambda rng: np.convolve(slow(rng), np.ones(3) / 3.0, "same"),
    "single samples lost": lambda rng: np.where(rng.random(SIZE) < 0.3, np.nan, slow(rng)),
    "held": lambda rng: np.where(
        np.arange(SIZE) % 97 < 5, slow(rng)[np.arange(SIZE) // 97 * 97], slow(rng)
    ),
}


@pytest.mark.parametrize("kind", LIVELY)
def test_nonstationary_noise_has_few_false_outliers(kind):
    assert total(LIVELY[kind], 12) <= 4  # in six hours


@pytest.mark.parametrize(("samples", "louder"), [(20, 3.0), (20, 10.0), (50, 5.0)])
def test_bursts_of_noise_are_not_spikes(samples, louder):
    def make(rng):
        loud = np.ones(SIZE)
        for first in rng.integers(0, SIZE - samples, 15):
            loud[first : first + samples] = louder
        return slow(rng) * loud

    jumping = [
        int((np.abs(x) > 5.0).sum())
        for x in (make(np.random.default_rng([7, seed])) for seed in range(8))
    ]
    assert total(make, 8) < max(12, 0.02 * sum(jumping))


def test_bit_errors_in_bursts_are_not_noise():
    x = np.random.default_rng(3).standard_normal(SIZE)
    x[40 * BLOCK + 30 : 40 * BLOCK + 72 : 3] += 2.0 ** np.random.default_rng(4).integers(4, 8, 14)
    number, _ = counted(x)
    assert number[40] >= 11
    assert number.sum() <= 14


@pytest.mark.parametrize("jump", [1e4, 1e6, 1e9])
@pytest.mark.parametrize("step", [0.0, 0.01])
def test_a_large_jump_is_not_the_quantization_step(jump, step):
    noise = 0.6 * np.random.default_rng(1).standard_normal(5000)
    values = np.round(noise / step) * step if step else noise
    values[2000:] += jump
    assert quantization_step(values) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("spread", [0.3, 10.0])
def test_step_of_differences_of_angles_is_found(spread):
    """The differences of equal angles are equal but for rounding."""
    angle = np.round(np.cumsum(spread * np.random.default_rng(1).standard_normal(5000) + 0.37))
    assert quantization_step(np.diff(angle * 1e-3)) == pytest.approx(1e-3)
