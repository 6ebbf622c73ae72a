"""Axes that move far beyond their noise are found, and left out of calibration and comparison."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from gyrostab import diagnose
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.unexplained_motion import find_unexplained_motion
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.windows import make_windows
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.reduce.moving_blocks import (
    find_moving_blocks,
    find_moving_blocks_of_axis,
    without_motion,
)
from gyrostab.diagnose.reduce.schema import read_as_measured
from gyrostab.diagnose.result.tables import motion_mismatches
from gyrostab.diagnose.settings import DEFAULTS
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.errors import SchemaError
from gyrostab.ingest.make_log import make_log
from gyrostab.simulate import simulate

N = 0.01
BEGIN, END = 2000, 4000  # samples in which z turns


@pytest.fixture(scope="module")
def at_rest() -> xr.Dataset:
    return simulate(
        {"log": {"axes": ["x", "y", "z"]}, "noise": {"N": N}}, duration="20min", rate=10.0, seed=5
    )


@pytest.fixture(scope="module")
def turning(at_rest) -> xr.Dataset:
    log = at_rest.copy(deep=True)
    bump = np.zeros(log.sizes["time"])
    bump[BEGIN:END] = 400.0 * np.sin(np.pi * np.linspace(0.0, 1.0, END - BEGIN)) ** 2
    rate = log["rate"].transpose("axis", "time").values
    rate[2] += bump
    rate[0] += 0.7e-3 * bump
    return log.assign(rate=(("axis", "time"), rate, log["rate"].attrs))


@pytest.fixture(scope="module")
def reduced(turning) -> tuple[xr.Dataset, xr.Dataset]:
    whole = reduce_log(turning)
    return whole, without_motion(turning, whole, find_moving_blocks(whole))


def test_noise_and_drift_are_not_motion(at_rest):
    assert not find_moving_blocks(reduce_log(at_rest)).any()
    ramp = np.linspace(0.0, 500.0, at_rest.sizes["time"])
    assert not find_moving_blocks(
        reduce_log(at_rest.assign(rate=at_rest["rate"] + xr.DataArray(ramp, dims="time")))
    ).any()


def test_moving_blocks_of_a_rotating_axis_are_found(reduced):
    whole, _ = reduced
    moving = find_moving_blocks(whole)
    length = whole.attrs["block_samples"]
    assert not moving[:2].any()
    inside = np.flatnonzero(moving[2])
    assert abs(inside[0] - BEGIN / length) <= 3
    assert abs(inside[-1] + 1 - END / length) <= 3
    assert np.diff(inside).max() == 1


@pytest.mark.parametrize("share", [0.0, 1e-3])
def test_motion_is_found_where_all_means_at_rest_are_equal(share):
    """Few samples a quantization step away from all others are no motion."""
    rng = np.random.default_rng(1)
    rate = (rng.random((1, 12_000)) < share).astype(float)
    assert not find_moving_blocks(reduce_log(make_log(rate, rate=10.0, unit="deg/h"))).any()
    rate[0, 4000:6000] += 500.0 + rng.standard_normal(2000)
    moving = find_moving_blocks(reduce_log(make_log(rate, rate=10.0, unit="deg/h")))[0]
    assert moving[32:46].all()
    assert not moving[:28].any()


@pytest.mark.parametrize(("rest", "found"), [(800, False), (3000, True)])
def test_axis_that_mostly_rotates_needs_a_stretch_at_rest(at_rest, rest, found):
    rate = at_rest["rate"].transpose("axis", "time").values.copy()
    rate[2, rest:] += 400.0 * np.arange(rate.shape[1] - rest) / 1000.0
    blocks = reduce_log(at_rest.assign(rate=(("axis", "time"), rate, at_rest["rate"].attrs)))
    moving, begin = find_moving_blocks(blocks), blocks["begin"].values
    assert not moving[:2].any()
    assert moving[2].any() == found
    if found:
        assert moving[2, begin > 340.0].all()
        assert not moving[2, begin < 250.0].any()


@pytest.mark.parametrize("blocks", [100, 4000])
def test_random_walk_is_not_motion(blocks):
    walks = np.random.default_rng(1).standard_normal((40, blocks)).cumsum(axis=1)
    assert not any(
        find_moving_blocks_of_axis(walk, float(np.ptp(walk)), DEFAULTS).any() for walk in walks
    )


def test_motion_is_left_out_on_its_axis_and_kept_as_measured(reduced):
    whole, rest = reduced
    moving = rest["moving"].values
    assert np.isnan(rest["mean"].values[moving]).all()
    assert np.isnan(rest["power"].values[moving]).all()
    np.testing.assert_array_equal(rest["mean"].values[:2], whole["mean"].values[:2])
    np.testing.assert_array_equal(read_as_measured(rest, "mean"), whole["mean"])
    np.testing.assert_array_equal(read_as_measured(rest, "cross"), whole["cross"])
    np.testing.assert_array_equal(make_windows(rest, {}).own["z"], whole["mean"].sel(axis="z"))
    assert rest.sizes["gap"] == whole.sizes["gap"]


def test_noise_is_calibrated_at_rest(reduced):
    _, rest = reduced
    baseline = calibrate_noise(rest)
    error = (baseline["coefficient"].sel(term="N") - N) / baseline["stderr"].sel(term="N")
    assert (np.abs(error) < 4.0).all()
    assert not baseline["quiet"].values[:, rest["moving"].values.any(axis=0)].any()
    assert (baseline["coefficient"].sel(term="K") < 1.0).all()


@pytest.fixture(scope="module")
def state(reduced) -> State:
    whole, rest = reduced
    return initial_state(whole, calibrate_noise(rest))


def identification(
    effect: str,
    statistic: str,
    *row: str,
    column: str = "z",
    course: np.ndarray | None = None,
    is_step: bool = False,
) -> SimpleNamespace:
    design = np.empty(0) if course is None else course[None, None]
    variant, candidate = (
        SimpleNamespace(columns=(column,), design=design),
        SimpleNamespace(effect=effect, statistic=find_statistic(statistic), reference=()),
    )
    return SimpleNamespace(
        effect=effect,
        components=(
            SimpleNamespace(
                candidate=candidate,
                statistic=candidate.statistic,
                row=row,
                variant=variant,
                is_step=is_step,
            ),
        ),
    )


def test_effect_explains_motion_if_it_leaves_almost_nothing(reduced, state):
    whole, _ = reduced
    moving = find_moving_blocks(whole)
    bump = np.nan_to_num(whole["mean"].values[2] - np.nanmedian(whole["mean"].values[2]))
    assert not find_unexplained_motion(
        whole, [identification("warm_up", "mean", "z", course=0.1 * np.abs(bump) ** 1.1)], state
    ).any()
    for other in (
        identification("rotation_line", "rotation_order", "z"),
        identification("dead_zone", "sample_counts", "z", column="stuck"),
    ):
        assert not find_unexplained_motion(whole, [other], state).any()
    step = np.where(np.arange(bump.size) < np.flatnonzero(moving[2]).mean(), 0.0, 1.0)
    for other in (
        identification("bias_jump", "mean", "z", course=step),
        identification("warm_up", "mean", "x", course=bump),
        identification("light_power_noise", "power", "z"),
        identification("vibration_random_walk", "random_process", "z"),
        identification("held_samples", "sample_counts", "z", column="repeats"),
    ):
        np.testing.assert_array_equal(find_unexplained_motion(whole, [other], state), moving)


def test_outliers_explain_motion_in_their_blocks_only(reduced, state):
    whole, _ = reduced
    moving = find_moving_blocks(whole)
    spikes = identification("spikes", "sample_counts", "z", column="outliers")
    for in_blocks in (moving[2], moving[2] & (np.arange(moving.shape[1]) % 2 == 0)):
        counts = whole["outliers"].copy()
        counts[2] = np.where(in_blocks, 5, 0)
        left = find_unexplained_motion(whole.assign(outliers=counts), [spikes], state)
        np.testing.assert_array_equal(left, moving & (in_blocks != moving[2]).any())


def test_several_steps_do_not_explain_a_slow_motion(reduced, state):
    """Enough of them leave next to nothing of it, but not an axis at rest."""
    whole, _ = reduced
    inside = np.flatnonzero(find_moving_blocks(whole)[2])
    steps = [
        identification(
            "bias_jump",
            "mean",
            "z",
            course=np.where(np.arange(whole.sizes["block"]) < at, 0.0, 1.0),
            is_step=True,
        )
        for at in inside[::2]
    ]
    left = find_unexplained_motion(whole, steps, state)
    np.testing.assert_array_equal(left, find_moving_blocks(whole))


def test_motion_ends_where_the_axis_is_at_rest_again(at_rest):
    """The slow tails of a motion belong to it."""
    hump = 40.0 * np.exp(-0.5 * ((np.arange(at_rest.sizes["time"]) - 6000) / 1000.0) ** 2)
    log = at_rest.copy(deep=True)
    log["rate"].loc[{"axis": "z"}] += xr.DataArray(hump, dims="time")
    whole = reduce_log(log)
    moving = find_moving_blocks(whole)[2]
    mean, length = whole["mean"].values[2], whole.attrs["block_samples"]
    scatter = float(np.std(reduce_log(at_rest)["mean"].values[2]))
    assert moving.any()
    assert np.abs(mean[~moving]).max() < 4.0 * scatter
    middle = hump[length // 2 :: length][: moving.size]
    assert np.abs(middle[~moving]).max() < 3.0 * scatter
    assert not moving[: int(1500 / length)].any()


@pytest.mark.parametrize("seen", [1.0, 0.5])
def test_channel_explains_motion_if_it_sees_almost_all_of_its_power(at_rest, seen):
    """A channel that sees only a part does not."""
    rng = np.random.default_rng(11)
    size = at_rest.sizes["time"]
    hump = 400.0 * np.exp(-0.5 * ((np.arange(size) - 6000) / 1000.0) ** 2)
    seen_motion, other_motion = hump * rng.standard_normal((2, size))
    log = at_rest.copy(deep=True)
    motion = hump + np.sqrt(seen) * seen_motion + np.sqrt(1.0 - seen) * other_motion
    log["rate"].loc[{"axis": "z"}] += xr.DataArray(motion, dims="time")
    log["seismometer"] = ("time", seen_motion, {"units": "m s-1"})
    whole = reduce_log(log)
    moving = find_moving_blocks(whole)
    baseline = calibrate_noise(without_motion(log, whole, moving))
    candidate = next(
        candidate
        for candidate in effect_candidates(whole, baseline["coefficient"])[0]
        if candidate.reference == ("seismometer",) and candidate.effect == "real_motion"
    )
    component = Component(candidate, candidate.variants[-1], ("z",), 100.0)
    named = [SimpleNamespace(effect="real_motion", components=(component,))]
    left = find_unexplained_motion(whole, named, initial_state(whole, baseline))
    np.testing.assert_array_equal(left, moving & (seen < 1.0))


def test_identified_jump_is_not_motion(at_rest, state):
    step = np.where(np.arange(at_rest.sizes["time"]) < 8000, 0.0, 300.0)
    whole = reduce_log(at_rest.assign(rate=at_rest["rate"] + xr.DataArray(step, dims="time")))
    assert find_moving_blocks(whole).any(axis=1).all()
    block_count = whole["begin"].values * 10.0 >= 8000
    named = [
        identification("bias_jump", "mean", axis, course=block_count.astype(float))
        for axis in "xyz"
    ]
    assert not find_unexplained_motion(whole, named, state).any()


def test_two_levels_explain_motion_only_if_they_leave_the_axis_at_rest(at_rest, state):
    time = np.arange(at_rest.sizes["time"])
    for rise in (1, 600):
        steps, hump = (
            400.0 * np.interp(time, [2000, 2000 + long, 8000, 8000 + long], [0.0, 1.0, 1.0, 0.0])
            for long in (1, rise)
        )
        whole, levels = (
            reduce_log(at_rest.assign(rate=at_rest["rate"] + xr.DataArray(added, dims="time")))
            for added in (hump, steps)
        )
        moving = find_moving_blocks(whole)
        assert moving.any(axis=1).all()
        named = [
            identification("telegraph", "telegraph", axis, course=levels["mean"].values[row])
            for row, axis in enumerate("xyz")
        ]
        left = find_unexplained_motion(whole, named, state)
        np.testing.assert_array_equal(left, moving & (rise > 1))


def test_rest_is_found_in_less_than_half_of_the_time(at_rest):
    log = at_rest.copy(deep=True)
    rate = log["rate"].transpose("axis", "time").values
    rate[2, 2000:9000] += 400.0 * np.sin(np.pi * np.linspace(0.0, 3.0, 7000)) ** 2
    whole = reduce_log(log.assign(rate=(("axis", "time"), rate, log["rate"].attrs)))
    moving = find_moving_blocks(whole)
    assert not moving[:2].any()
    seconds = whole["begin"].values
    turning = (seconds >= 205.0) & (seconds < 880.0)
    assert moving[2][turning].all()
    assert not moving[2][(seconds < 150.0) | (seconds > 960.0)].any()


def test_motion_is_one_mismatch_with_the_axes_that_sense_it(reduced):
    whole, rest = reduced
    assert motion_mismatches([], whole) == []
    (region,) = motion_mismatches([], rest)
    assert (region["axes"], region["explained_by"]) == (["z"], [])
    assert "scale-factor" in region["statement"]
    assert "40" in region["statement"] or "39" in region["statement"]
    (witnessed,) = motion_mismatches([identification("misalignment", "mean", "x")], rest)
    assert "Axis x senses part of it" in witnessed["statement"]
    assert "real rotation" in witnessed["statement"]


@pytest.fixture
def sparse_at_rest(turning) -> xr.Dataset:
    """The turning record with too few samples of z at rest for spectra."""
    lost = np.random.default_rng(3).random(turning.sizes["time"]) < 0.85
    lost[BEGIN:END] = False
    gone = xr.DataArray(lost, dims="time") & (turning["axis"] == "z")
    return turning.assign(rate=turning["rate"].where(~gone).transpose("axis", "time"))


def test_too_few_samples_at_rest_cannot_be_calibrated(sparse_at_rest):
    whole = reduce_log(sparse_at_rest)
    with pytest.raises(SchemaError, match="axis z"):
        calibrate_noise(without_motion(sparse_at_rest, whole, find_moving_blocks(whole)))


@pytest.mark.full
def test_diagnosis_includes_motion_when_the_rest_cannot_be_calibrated(sparse_at_rest):
    with pytest.warns(UserWarning, match="includes unexplained motion.*axis z"):
        diagnosis = diagnose(sparse_at_rest, nulls=100)
    assert diagnosis.verdict != "no mismatch"
