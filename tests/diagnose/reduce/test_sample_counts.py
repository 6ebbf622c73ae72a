"""Sample counts of blocks: outliers, held samples, range ends, zeros; and the quantization step."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.outliers import quantization_step
from gyrostab.ingest.make_log import make_log

RATE = 100.0


def log_of(values: np.ndarray) -> xr.Dataset:
    return make_log(np.atleast_2d(values), rate=RATE, unit="deg/h")


def test_anomalous_samples_are_counted_in_their_blocks():
    rng = np.random.default_rng(9)
    x = rng.standard_normal(60 * 1000)
    clean = reduce_log(log_of(x), block="10s")
    assert int(clean.outliers.sum()) == 0
    assert int(clean.repeats.sum() + clean.zeros.sum()) == 0
    assert int(clean.extremes.sum()) == 2
    assert clean.quantization_step.values == 0.0
    assert np.abs(clean.kurtosis.values).max() < 0.6
    y = x.copy()
    y[5_500] += 40.0
    y[10_200:10_220] = y[10_199]
    y[20_100:20_105] = 0.0
    y[30_000:31_000] = np.clip(y[30_000:31_000], -1.0, 50.0)
    y[40_000:50_000] *= 30.0  # noisier, but without outliers
    marked = reduce_log(log_of(y), block="10s")
    assert marked.outliers.values[0, 5] == 3
    assert int(marked.outliers.sum()) - 3 <= 3  # at most the edges of the noisy interval
    assert marked.repeats.values[0, 10] == 20
    assert marked.repeats.values[0, 20] == 0  # zeros are counted elsewhere
    assert marked.zeros.values[0, 20] == marked.filled.values[0, 20] == 5
    assert marked.kurtosis.values[0, 5] > 10.0
    assert marked.kurtosis.values[0, 30] < -0.3
    clipped = reduce_log(log_of(np.clip(x, -2.0, 2.0)), block="10s")
    assert int(clipped.extremes.sum()) == int((np.abs(x) >= 2.0).sum())
    assert int(clipped.repeats.sum()) == 0  # at the ends


@pytest.mark.parametrize("step", [0.0, 0.02, 0.3])
def test_samples_at_one_rate_are_stuck_and_held_ones_are_not(step):
    rng = np.random.default_rng(11)
    x = 5.0 + rng.standard_normal((2, 60 * 1000))
    inside = np.abs(x[0] - 5.4) < 0.4
    x[0, inside] = 5.4
    for first in rng.integers(1, 60 * 998, 12):
        x[1, first : first + 30] = x[1, first - 1]
    x = np.rint(x / step) * step if step else x
    blocks = reduce_log(log_of(x), block="10s")
    assert blocks.zone_centre.values[0] == pytest.approx(5.4)
    assert np.isnan(blocks.zone_centre.values[1])
    assert int(blocks.stuck[0].sum()) == pytest.approx(inside.sum(), rel=0.1)
    assert int(blocks.stuck[1].sum()) == 0


@pytest.mark.parametrize(
    ("step", "length"), [(0.0, 3), (1e-6, 3), (1e-3, 8), (0.01, 8), (0.03, 20), (0.1, 20)]
)
def test_frames_sent_twice_are_counted_unless_chance_repeats_as_many(step: float, length: int):
    x = np.random.default_rng(10).standard_normal((2, 60_000))
    if step:
        x = step * (np.floor(x / step) + 0.5)  # never zero
    assert int(reduce_log(log_of(x), block="10s").resent.sum()) == 0
    starts = np.arange(500, 60_000, 1000)
    for start in starts:
        x[:, start : start + length] = x[:, start - length : start]
    marked = reduce_log(log_of(x), block="10s")
    # a value that occurs in between by chance may hide the beginning of a frame
    np.testing.assert_allclose(marked.resent.sum("block"), starts.size * length, rtol=0.1)


@pytest.mark.parametrize("step", [0.3, 1.0, 3.0])
def test_coarse_values_are_no_frames_sent_twice(step: float):
    x = np.random.default_rng(11).standard_normal((1, 60_000))
    assert int(reduce_log(log_of(step * (np.floor(x / step) + 0.5)), block="10s").resent.sum()) == 0


def test_zeros_of_one_axis_are_stuck_and_common_zeros_are_filled():
    rng = np.random.default_rng(10)
    x = rng.standard_normal((3, 60 * 1000))
    x[1, np.abs(x[1]) < 0.02] = 0.0
    lost = np.zeros(x.shape[1], bool)
    for first in rng.integers(0, 60 * 998, 12):
        lost[first : first + 30] = True
    at = (x[1] == 0.0).sum(), lost.sum(), (lost & (x[1] == 0.0)).sum()
    x[:, lost] = 0.0
    blocks = reduce_log(log_of(x), block="10s")
    np.testing.assert_array_equal(blocks.filled.sum("block"), [at[1]] * 3)
    np.testing.assert_array_equal(blocks.stuck.sum("block"), [0, at[0] - at[2], 0])
    np.testing.assert_array_equal(blocks.zeros.sum("block"), (x == 0.0).sum(axis=1))
    assert int(blocks.repeats.sum()) == 0


@pytest.mark.parametrize("axes", [1, 3])
def test_wide_dead_zones_are_stuck_and_not_filled(axes: int):
    """A third of the samples stick: some coincide in time or on two axes by chance."""
    x = np.random.default_rng(11).standard_normal((axes, 60 * 1000)) + 0.1
    x[np.abs(x) < 0.43] = 0.0
    blocks = reduce_log(log_of(x), block="10s")
    zeros = (x == 0.0).sum()
    assert 0.3 < zeros / x.size < 0.36
    assert blocks.stuck.sum() > 0.96 * zeros


def test_zeros_at_the_end_of_a_range_are_not_stuck():
    x = np.maximum(np.random.default_rng(12).standard_normal((2, 60 * 1000)), 0.0)
    blocks = reduce_log(log_of(x), block="10s")
    assert int(blocks.stuck.sum()) == 0
    np.testing.assert_array_equal(blocks.extremes.sum("block"), (x == 0.0).sum(axis=1) + 1)


@pytest.mark.parametrize("frame", [3, 25, 400])
def test_frames_that_are_sent_twice_are_repeats(frame: int):
    x = np.random.default_rng(3).standard_normal(60 * 1000)
    x[5_500 : 5_500 + frame] = x[5_500 - frame : 5_500]
    x[9_100:9_110] = x[9_099]
    blocks = reduce_log(log_of(x), block="10s")
    assert blocks.repeats.values[0, [5, 9]].tolist() == [frame, 10]
    assert blocks.repeat_runs.values[0, [5, 9]].tolist() == [1, 1]
    assert int(blocks.repeats.sum()) == frame + 10


@pytest.mark.parametrize("values", ["single precision", "quantized", "too short"])
def test_chance_is_no_frame_that_was_sent_twice(values: str):
    x = np.random.default_rng(3).standard_normal(60 * 1000)
    if values == "too short":
        x[5_500:5_502] = x[5_490:5_492]
    else:
        x = x.astype(np.float32) if values == "single precision" else np.round(x, 1)
    blocks = reduce_log(log_of(x), block="10s")
    assert (int(blocks.repeats.sum()) == 0) == (values != "quantized")
    within = x.reshape(60, 1000)
    is_repeat = (np.diff(within) == 0.0) & (within[:, 1:] != 0.0)
    assert int(blocks.repeats.sum()) == int(is_repeat.sum())


def test_held_samples_do_not_make_outliers_of_the_others():
    rng = np.random.default_rng(9)
    x = rng.standard_normal(60 * 1000)
    x[20_000:24_500] = x[20_000]
    assert int(reduce_log(log_of(x), block="10s").outliers.sum()) == 0


@given(
    seed=st.integers(0, 2**31),
    step=st.floats(0.01, 3.0),
    offset=st.floats(-5e4, 5e4),
    single=st.booleans(),
)
def test_the_quantization_step_is_found_with_any_offset(
    seed: int, step: float, offset: float, single: bool
):
    noise = np.random.default_rng(seed).standard_normal(8000)
    values = np.round(noise / step) * step + offset
    values = values.astype(np.float32).astype(np.float64) if single else values
    finest = 1.01 * (64 * 8 * 2.0**-23 if single else 2.0**-20) * np.abs(values).max()
    if step > finest:
        assert quantization_step(values) == pytest.approx(step, rel=1e-3)
    smooth = noise * step + offset
    assert quantization_step(smooth) == 0.0


def test_the_quantization_step_is_found_among_spikes():
    rng = np.random.default_rng(9)
    values = np.round(rng.standard_normal(4000) / 0.1) * 0.1
    off = np.concatenate([values[:12] + 7.03, np.full(8, 6.777)])
    assert quantization_step(np.concatenate([values, off])) == pytest.approx(0.1, rel=1e-9)
    half = np.where(
        np.arange(4000) < 2000, values, rng.standard_normal(4000)
    )  # half of the values are not on a grid
    assert quantization_step(half) == 0.0
