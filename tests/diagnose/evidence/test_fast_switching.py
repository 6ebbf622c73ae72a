"""A bias that switches within blocks: its course in sub-blocks, look-alikes, and its diagnosis."""

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

from gyrostab.diagnose.core import diagnose
from gyrostab.diagnose.evidence.fast_switching import (
    SwitchingEvidence,
    switching_evidence,
    switching_powers,
)
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log

BLOCKS, PIECES, STEP, WHITE = 60, 16, 20.0, 0.01
WALKS = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0])


def course_of(
    rng: np.random.Generator, low: float, high: float, seconds: float, rate: float
) -> np.ndarray:
    """Return the mean level of each sample, for given times of the switches."""
    level, at, area = int(rng.integers(2)), [0.0], [0.0]
    while at[-1] < seconds:
        stay = rng.exponential((low, high)[level])
        at.append(at[-1] + stay)
        area.append(area[-1] + stay * level)
        level = 1 - level
    return np.diff(np.interp(np.arange(round(seconds * rate) + 1) / rate, at, area)) * rate


def frame(pieces: np.ndarray) -> tuple[xr.Dataset, xr.Dataset]:
    """Return sub-block means (block, sub-block), and a baseline with any random walk."""
    begin = np.arange(BLOCKS) * STEP
    data = xr.Dataset(
        {
            "mean": (("axis", "block"), pieces.mean(axis=1)[None]),
            "samples": (("axis", "block"), np.full((1, BLOCKS), PIECES * 10)),
            "sub_block_mean": (("axis", "block", "sub_block"), pieces[None]),
            "sub_block_samples": (("axis", "block", "sub_block"), np.full((1, BLOCKS, PIECES), 10)),
            "begin": ("block", begin),
            "end": ("block", begin + STEP),
        },
        {"axis": ["x"]},
        {"block_s": STEP},
    )
    zero = np.zeros((1, WALKS.size))
    grid = {"K": WALKS[None], "B": zero, "prior": zero, "calibrated": zero}
    baseline = xr.Dataset(
        {
            "known_mean": (("axis", "block"), np.zeros((1, BLOCKS))),
            "mean_variance": (("axis", "block"), np.full((1, BLOCKS), WHITE / PIECES)),
            "angle_variance": (("axis",), np.zeros(1)),
            **{
                f"grid_{name}": (("axis", "grid"), grid_values)
                for name, grid_values in grid.items()
            },
        },
        {"axis": ["x"]},
    )
    return data, baseline


def found_in(course: np.ndarray, rng: np.random.Generator) -> SwitchingEvidence:
    noise = np.sqrt(WHITE) * rng.standard_normal((BLOCKS, PIECES))
    evidence = switching_evidence(*frame(course.reshape(BLOCKS, PIECES) + noise), axis="x")
    assert evidence is not None
    return evidence


@pytest.mark.parametrize(
    ("low", "high", "step"), [(4.0, 4.0, 2.0), (30.0, 3.0, 2.0), (8.0, 8.0, 0.5), (20.0, 3.0, 40.0)]
)
def test_finds_switching_within_blocks_and_its_parameters(
    low: float, high: float, step: float
) -> None:
    rng = np.random.default_rng(1)
    course = course_of(rng, low, high, BLOCKS * STEP, PIECES / STEP)
    evidence = found_in(step * course, rng)
    assert evidence.evidence_nats > 20.0
    np.testing.assert_allclose(evidence.times, [low, high], rtol=0.4)
    assert np.sqrt(np.mean((evidence.share.ravel() - course) ** 2)) < 0.15
    slope = np.polyfit(evidence.share.ravel(), step * course, 1)[0]
    assert slope == pytest.approx(step, rel=0.1)


@pytest.mark.slow
def test_noise_with_the_same_spectrum_does_not_switch() -> None:
    """Gauss-Markov noise with the variance and correlation time of a telegraph, and high noise."""
    rng = np.random.default_rng(2)
    for time, size in [
        (2.0, 1.0),
        (2.0, 20.0),
        (10.0, 0.5),
        (10.0, 20.0),
        (0.01, 0.1),
        (0.01, 1.0),
    ]:
        keep = np.exp(-STEP / PIECES / time)
        bias = (
            size
            * lfilter(
                [np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(BLOCKS * PIECES + 500)
            )[500:]
        )
        assert found_in(bias, rng).evidence_nats < 3.0


@pytest.mark.slow
def test_waves_and_steps_of_any_height_are_not_two_levels() -> None:
    rng = np.random.default_rng(3)
    time = (np.arange(BLOCKS * PIECES) + 0.5) * STEP / PIECES
    for period in (8.0, 20.0, 45.0):
        for size in (0.5, 10.0):
            assert found_in(size * np.sin(2.0 * np.pi * time / period), rng).evidence_nats < 3.0


def test_three_levels_in_turn_are_not_two_levels() -> None:
    rng = np.random.default_rng(4)
    for dwell in (4.0, 20.0):
        first, second = (
            course_of(rng, dwell, dwell, BLOCKS * STEP, PIECES / STEP) for _ in range(2)
        )
        assert found_in(2.0 * (first + second), rng).evidence_nats == -np.inf


@pytest.mark.parametrize("dwell", [2.0, 4.0, 10.0])
def test_three_random_levels_are_not_two_levels(dwell: float) -> None:
    """Fast two-level switching fits it too, but with equal shares in consecutive sub-blocks."""
    rng, fine = np.random.default_rng(1), 20
    course = np.empty(BLOCKS * PIECES * fine)
    at, level = 0, 1
    while at < course.size:
        stay = max(1, int(rng.exponential(dwell) * PIECES / STEP * fine))
        course[at : at + stay] = level
        at, level = at + stay, (level + int(rng.integers(1, 3))) % 3
    assert found_in(4.0 * course.reshape(-1, fine).mean(axis=1), rng).evidence_nats == -np.inf


def test_switching_powers_match_those_of_the_samples() -> None:
    rng = np.random.default_rng(5)
    course = course_of(rng, 15.0, 6.0, 1200.0, 10.0)
    log = make_log(course[None], rate=10.0, unit="deg/h")
    blocks = reduce_log(log, block="20s")
    size = int(blocks.attrs["block_samples"])
    recorded = blocks["power"].values[0]
    predicted = switching_powers(blocks["sub_block_mean"].values[0], 15.0, 6.0, size, 10.0)
    slow = blocks["frequency"].values < 0.3
    np.testing.assert_allclose(
        predicted[:, slow].mean(axis=0), recorded[:, slow].mean(axis=0), rtol=0.05
    )
    np.testing.assert_allclose(
        predicted.mean(axis=0), recorded.mean(axis=0), rtol=0.25
    )  # the number of switches is random
    assert np.corrcoef(np.log(predicted[:, 1] + 1e-3), np.log(recorded[:, 1] + 1e-3))[0, 1] > 0.99


@pytest.mark.full
@pytest.mark.parametrize(("low", "high", "deviations"), [(30.0, 3.0, 12.0), (4.0, 4.0, 3.0)])
def test_diagnosis_names_the_telegraph_with_its_parameters(
    low: float, high: float, deviations: float
) -> None:
    rng = np.random.default_rng(6)
    course = course_of(rng, low, high, 1800.0, 5.0)
    log = make_log(
        (0.5 * rng.standard_normal(course.size) + 0.5 * deviations * course)[None],
        rate=5.0,
        unit="deg/h",
    )
    diagnosis = diagnose(log, nulls=100, seed=1)
    assert [effect["name"] for effect in diagnosis.effects] == ["telegraph"]
    assert diagnosis.verdict in ("explained", "partly explained")
    numbers = diagnosis.effects[0]["parameters"]
    assert numbers["step"]["value"] == pytest.approx(0.5 * deviations, rel=0.1)
    for name, true in (("low", low), ("high", high)):
        assert abs(numbers[name]["value"] - true) < 3.0 * numbers[name]["stderr"]
    assert diagnosis.effects[0]["alternatives"] == []
