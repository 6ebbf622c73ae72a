"""Repeats and zeros that a quantization grid alone produces, and real ones on the same grid."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.stats import multivariate_normal

import gyrostab
from gyrostab.arrays import Floats
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.evidence.sample_counts import hidden_by_grid
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.outliers import quantization_step
from gyrostab.diagnose.statistics.sample_counts import _chance_in_bin
from gyrostab.ingest.make_log import make_log
from tests.support.repetitions import first_of

SIZE = 24_000
COUNTS = ("repeats", "zeros", "stuck", "filled")


def noise(kind: str, *, seed: int = 3, size: int = SIZE) -> Floats:
    """White noise, low-passed noise, differences of an angle, or noise of two levels."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal(size)
    values = {
        "white": white,
        "low-passed": np.convolve(rng.standard_normal(size + 3), np.ones(4) / 2.0, "valid"),
        "angle": np.diff(rng.standard_normal(size + 1)) + 0.3 * white,
        "two levels": white * np.where(np.arange(size) // (size // 4) % 2, 3.0, 1.0),
    }[kind]
    return np.asarray(values / values.std() + 0.13)


def log_of(values: Floats) -> xr.Dataset:
    return make_log(values[None], rate=50.0, unit="deg/h", start="2026-01-01")


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.05, pytest.param(0.2, marks=pytest.mark.full), 0.5, 1.0])
@pytest.mark.parametrize("kind", ["white", "low-passed", "angle", "two levels"])
def test_null_records_have_the_counts_of_the_grid(kind: str, step: float):
    blocks = reduce_log(log_of(np.round(noise(kind) / step) * step))
    records = null_records(
        blocks, calibrate_noise(blocks), count=60, rng=np.random.default_rng(1), chunk=60
    )
    drawn = next(iter(records))
    for name in COUNTS:
        count = int(blocks[name].sum())
        expected = drawn[name].sum(["axis", "block"]).values
        assert abs(count - expected.mean()) < 4.5 * np.hypot(expected.std(), 1.0), name


@pytest.mark.parametrize("correlation", [-0.6, 0.0, 0.5, 0.95])
@pytest.mark.parametrize(("middle", "half"), [(0.0, 0.25), (0.7, 0.5), (-1.5, 1.0)])
def test_chance_of_a_pair_in_a_bin_is_that_of_the_bivariate_normal(
    correlation: float, middle: float, half: float
):
    law = multivariate_normal([0.0, 0.0], [[1.0, correlation], [correlation, 1.0]])
    low, high = middle - half, middle + half
    expected = law.cdf([high, high], lower_limit=[low, low])
    chance = _chance_in_bin(np.array([middle]), half, np.ones(1), np.array([correlation]))[1]
    assert chance[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("step", [1e-1, 1e-3, 1e-4])
def test_fine_step_is_found_in_a_short_record(step: float):
    values = np.round(1.8 * noise("white", size=2_000) / step) * step
    assert quantization_step(values) == pytest.approx(step, rel=1e-6)
    assert quantization_step(3600.0 * values + 0.7) == pytest.approx(3600.0 * step, rel=1e-6)


def turning(seed: int, *, size: int = SIZE) -> Floats:
    """Noise of an axis that turns at up to 30 deg/s, on a grid of 1e-6 deg/s [degree hour-1]."""
    rng = np.random.default_rng(seed)
    stops = np.repeat(rng.choice([-30.0, -10.0, 0.0, 10.0, 30.0], size // 2000), 2000)
    sway = np.convolve(rng.standard_normal(size + 199), np.full(200, 0.05), "valid")
    return 3600.0 * np.round(stops + sway + 3e-4 * rng.standard_normal(size), 6)


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
def test_null_records_have_the_repeats_of_an_axis_that_turns(seed: int):
    values = np.stack([3600.0 * np.round(3e-4 * noise("white", seed=seed), 6), turning(seed)])
    blocks = reduce_log(make_log(values, rate=50.0, unit="deg/h", start="2026-01-01"))
    assert blocks["quantization_step"].values == pytest.approx([0.0036, 0.0036], rel=1e-6)
    records = null_records(
        blocks, calibrate_noise(blocks), count=60, rng=np.random.default_rng(1), chunk=60
    )
    drawn = next(iter(records))["repeats"].sum("block")
    for axis in (0, 1):
        count, expected = int(blocks["repeats"][axis].sum()), drawn[:, axis].values
        assert abs(count - expected.mean()) < 4.5 * np.hypot(expected.std(), 1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_without_a_grid_have_no_step(dtype: type):
    for seed in range(30):
        white = noise("white", seed=seed, size=2_000)
        for values in (white, np.cumsum(white)):
            assert quantization_step(3.6 * values.astype(dtype).astype(np.float64)) == 0.0


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_grid_hides_repeats_only_where_noise_is_not_normal():
    normal = reduce_log(log_of(np.round(noise("white") / 0.5) * 0.5))
    bursts = noise("white") * (0.3 + 3.0 * (np.arange(SIZE) // 50 % 8 == 0))
    uneven = reduce_log(log_of(np.round(bursts / 0.5) * 0.5))
    for name in COUNTS:
        assert not hidden_by_grid(normal, name).any()
        assert hidden_by_grid(uneven, name).all()
    assert hidden_by_grid(normal, "kurtosis").all()
    coarse = reduce_log(log_of(np.round(noise("white") / 2.0) * 2.0))
    assert hidden_by_grid(coarse, "repeats").all()
    unknown = normal.assign(kurtosis=np.nan * normal["kurtosis"])
    assert hidden_by_grid(unknown, "repeats").all()
    swings = noise("white") * (0.5 + (np.arange(SIZE) // 50 % 8 == 0))
    few = reduce_log(log_of(np.round(swings / 0.5) * 0.5))
    left_out = xr.DataArray(np.arange(few.sizes["block"]) % 3 > 0, dims="block")
    few["kurtosis"], few["samples"] = few["kurtosis"].where(~left_out), few["samples"] * ~left_out
    assert hidden_by_grid(few, "repeats").all()


@pytest.mark.slow
@pytest.mark.parametrize("step", first_of(0.5, 1e-4))
def test_grid_alone_is_no_effect(step: float):
    diagnosis = gyrostab.diagnose(log_of(np.round(noise("white") / step) * step), nulls=100)
    assert not {"held_samples", "dead_zone", "clipping"} & {
        effect["name"] for effect in diagnosis.effects
    }
    assert diagnosis.verdict == "no mismatch"


@pytest.mark.slow
def test_held_samples_are_named_on_a_coarse_grid():
    values = np.round(noise("white") / 0.5) * 0.5
    held = np.flatnonzero(np.random.default_rng(1).random(SIZE - 1) < 0.06) + 1
    values[held] = values[held - 1]
    diagnosis = gyrostab.diagnose(log_of(values), nulls=100)
    assert [effect["name"] for effect in diagnosis.effects] == ["held_samples"]


@pytest.mark.slow
def test_dead_zone_is_named_on_a_coarse_grid():
    values = noise("white")
    values = np.round(np.where(np.abs(values) < 0.5, 0.0, values) / 0.3) * 0.3
    diagnosis = gyrostab.diagnose(log_of(values), nulls=100)
    assert "dead_zone" in {effect["name"] for effect in diagnosis.effects}
