"""Temporary and fluctuating noise must not become ageing, jumps, leaks or rotation lines."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

from gyrostab.diagnose.baseline.from_model import baseline_from_model
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.identifiability import keep_physical, passes_time_shift_test
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.predict.candidates import Candidate, Component
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.predict.search import compute_evidence
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics import find_statistic
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.diagnose.statistics.power import burst_intervals
from gyrostab.ingest.make_log import make_log
from tests.support.candidates import find_components
from tests.support.named import name_effects, nulls
from tests.support.repetitions import first_of

BLOCKS, LENGTH, RATE = 120, 200, 10.0
WHITE = 0.003 * 60.0 * np.sqrt(RATE)
SECOND = np.arange(BLOCKS * LENGTH) / RATE
MODEL = {"noise": {"N": 0.003, "B": 0.004, "K": 0.02}}


def reduce_rates(rate: np.ndarray) -> xr.Dataset:
    """Reduce rates (axis, time) [deg/h] to blocks of 20 s."""
    return reduce_log(make_log(rate, rate=RATE, unit="deg/h"), block="20s")


def noise_with_levels(factor: np.ndarray) -> np.ndarray:
    """White noise on one axis, its standard deviation times a factor for each block."""
    return np.asarray(
        np.random.default_rng(1).standard_normal((1, BLOCKS * LENGTH)) * np.repeat(factor, LENGTH)
    )


def state_of_rates(rate: np.ndarray) -> State:
    blocks = reduce_rates(rate)
    return initial_state(
        blocks,
        baseline_from_model(
            blocks, {**MODEL, "log": {"axes": [str(axis) for axis in blocks["axis"].values]}}
        ),
    )


def candidate(state: State, effect: str, statistic: str) -> Candidate:
    known, _ = effect_candidates(state.blocks, state.baseline["coefficient"])
    return next(
        tried for tried in known if (tried.effect, tried.statistic.name) == (effect, statistic)
    )


def components_of(state: State, tried: Candidate) -> list[Component]:
    return find_components([tried], state)[tried.key]


@pytest.mark.full
@pytest.mark.parametrize("inside", first_of(slice(0, 3), slice(-4, None)))
def test_temporary_noise_is_not_ageing(inside: slice) -> None:
    factor = np.ones(BLOCKS)
    factor[inside] = 3.0
    blocks = reduce_rates(noise_with_levels(factor))
    identifications = name_effects(blocks, *nulls(blocks, 40))
    assert not identifications.identified
    first = identifications.unidentified[0]
    assert first.effect == "~burst"
    begin, end = (first.components[0].variant.values[name] / 20.0 for name in ("begin", "end"))
    assert abs(begin - range(BLOCKS)[inside][0]) <= 1
    assert abs(end - range(BLOCKS)[inside][-1] - 1) <= 1


@pytest.mark.full
@pytest.mark.parametrize(("first", "last", "named"), [(1.3, 1.0, []), (1.0, 1.3, ["ageing_noise"])])
def test_ageing_noise_only_grows(first: float, last: float, named: list[str]) -> None:
    blocks = reduce_rates(noise_with_levels(np.sqrt(np.linspace(first**2, last**2, BLOCKS))))
    identifications = name_effects(blocks, *nulls(blocks, 40))
    assert [identification.effect for identification in identifications.identified] == named
    assert bool(identifications.unidentified) == (not named)


def test_stretches_of_all_lengths_reach_both_ends() -> None:
    for block_count in (5, 92, 540, 4320):
        tried = {tuple(interval) for interval in burst_intervals(block_count).tolist()}
        assert len(tried) <= 240
        assert {
            (0, 1),
            (block_count - 1, block_count),
            (0, 2),
            (block_count - 2, block_count),
        } <= tried
        assert max(stop for _, stop in tried) == block_count


@pytest.mark.parametrize(("size", "jump"), [(8.0, True), (0.0, False)])
def test_waves_slower_than_a_block_are_not_jumps(size: float, jump: bool) -> None:
    """From half an hour on, means scatter by twenty of their errors; a lasting level is still found
    among them."""
    waves = (
        np.repeat(np.random.default_rng(3).standard_normal(BLOCKS), LENGTH)
        * 20.0
        * WHITE
        / np.sqrt(LENGTH)
    )
    waves[SECOND < 1800.0] = 0.0
    state = state_of_rates(
        WHITE * np.random.default_rng(4).standard_normal((1, SECOND.size))
        + waves
        + size * (SECOND >= 1000.0)
    )
    components = components_of(state, candidate(state, "bias_jump", "mean"))
    assert sum_evidence(components) > 20.0
    assert bool(keep_physical(components, state)[0]) == jump


@pytest.mark.parametrize(("back", "jump"), [(2.0, False), (1.2, True)])
def test_return_to_the_old_level_is_not_a_jump(back: float, jump: bool) -> None:
    course = 2.0 * (SECOND >= 1000.0) - back * (SECOND >= 1160.0)
    state = state_of_rates(
        WHITE * np.random.default_rng(4).standard_normal((1, SECOND.size)) + course
    )
    components = components_of(state, candidate(state, "bias_jump", "mean"))
    assert sum_evidence(components) > 8.0
    assert bool(keep_physical(components, state)[0]) == jump


@pytest.mark.slow
@pytest.mark.parametrize(("back", "jump"), [(1.0, False), (0.0, True)])
def test_long_weak_event_is_not_a_jump(back: float, jump: bool) -> None:
    """Two errors of a mean, for a twelfth of two hours: too little for noisier means."""
    second = np.arange(360 * LENGTH) / RATE
    course = 0.12 * ((second >= 3000.0) - back * (second >= 3640.0))
    state = state_of_rates(
        WHITE * np.random.default_rng(5).standard_normal((1, second.size)) + course
    )
    components = components_of(state, candidate(state, "bias_jump", "mean"))
    assert sum_evidence(components) > 8.0
    assert bool(keep_physical(components, state)[0]) == jump


@pytest.mark.parametrize("moves", [False, True])
def test_only_motion_is_a_misalignment(moves: bool) -> None:
    """Noise and a line in common, with and without an intermittent sway of y that leaks into x."""
    rng = np.random.default_rng(6)
    shared = WHITE * rng.standard_normal(SECOND.size) + WHITE * np.sin(2.0 * np.pi * 1.7 * SECOND)
    rate = WHITE * rng.standard_normal((2, SECOND.size)) + 0.5 * shared
    sway = lfilter([1.0], [1.0, -1.8, 0.9], rng.standard_normal(SECOND.size)) * (
        SECOND % 800.0 < 300.0
    )
    rate += 30.0 * WHITE * np.array([[0.015], [1.0]]) * sway * moves
    state = state_of_rates(rate)
    leaks = [
        leak
        for leak in effect_candidates(state.blocks, state.baseline["coefficient"])[0]
        if leak.key == "misalignment(y)"
    ]
    (evidence,) = compute_evidence(leaks, state.blocks, state)
    assert (float(evidence.evidence_nats[0, 0]) > 20.0) == moves
    assert moves or float(evidence.evidence_nats.max()) < 3.0


@pytest.mark.parametrize("leak", [0.0, 0.003])
def test_leak_must_exceed_time_shifted_surrogates(leak: float) -> None:
    rng = np.random.default_rng(8)
    turning = np.interp(SECOND, np.linspace(0.0, SECOND[-1], 25), 200.0 * rng.standard_normal(25))
    state = state_of_rates(
        WHITE * rng.standard_normal((2, SECOND.size)) + np.array([[leak], [1.0]]) * turning
    )
    misalignment = candidate(state, "misalignment", "mean")
    variant = next(choice for choice in misalignment.variants if choice.columns == ("y",))
    beats, p_value, _ = passes_time_shift_test(
        [Component(misalignment, variant, ("x",), 20.0)], state
    )
    assert np.isfinite(p_value)
    assert beats == bool(leak)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "named"),
    [(0.7, []), pytest.param(0.0, ["vibration_rectification"], marks=pytest.mark.full)],
)
def test_channel_that_fails_the_time_shift_test_is_not_named(late: float, named: list[str]) -> None:
    """A bias follows the squared vibration, or leads it by a ninth of a period: then half of all
    shifts explain as much."""
    phase = 2.0 * np.pi * SECOND / 200.0
    rate = WHITE * np.random.default_rng(9).standard_normal((1, SECOND.size)) + 0.3 * np.sin(phase)
    shaking = np.sqrt(2.0 + np.sin(phase - late))
    blocks = reduce_log(
        make_log(rate, rate=RATE, unit="deg/h", channels={"vibration": (shaking, "g")}), block="20s"
    )
    identifications = name_effects(blocks, *nulls(blocks, 40))
    assert [identification.effect for identification in identifications.identified] == named


def make_swell(size: float) -> State:
    """Swell about 0.3 Hz in groups, twenty times above the noise; a tool that rotates as fast, with
    its line."""
    rng = np.random.default_rng(5)
    swell = lfilter(
        [1.0],
        [1.0, -2.0 * 0.97 * np.cos(2.0 * np.pi * 0.03), 0.97**2],
        rng.standard_normal(SECOND.size),
    )
    swell *= np.where(SECOND % 900.0 < 350.0, 4.0, 0.2) * WHITE
    turns = 0.3 * SECOND + 0.3 * np.sin(2.0 * np.pi * SECOND / 400.0)
    rate = (
        WHITE * rng.standard_normal((1, SECOND.size)) + swell + size * np.sin(2.0 * np.pi * turns)
    )
    return state_of_rotation(rate, turns)


def state_of_rotation(rate: np.ndarray, turns: np.ndarray) -> State:
    """Rates (axis, time) [deg/h] with the channel of a tool that has made so many turns."""
    log = make_log(rate, rate=RATE, unit="deg/h")
    turning = 360.0 * np.gradient(turns, SECOND)
    blocks = reduce_log(
        log.assign(rotation_rate=("time", turning, {"units": "degree s-1"})), block="20s"
    )
    return initial_state(blocks, baseline_from_model(blocks, {**MODEL, "log": {"axes": ["x"]}}))


@pytest.mark.parametrize("size", [0.0, 6.0])
def test_waves_not_locked_to_the_rotation_are_not_rotation_lines(size: float) -> None:
    state = make_swell(size)
    components = components_of(state, candidate(state, "rotation_line", "rotation_order"))
    assert (sum_evidence(components) > 15.0) == (size > 0.0)


def test_rotation_lines_do_not_change_the_noise_around_them() -> None:
    """Three harmonics, a hundred times the noise: white noise of 0.003 deg/sqrt(h) about each."""
    rng = np.random.default_rng(2)
    turns = 0.21 * SECOND + 0.2 * np.sin(2.0 * np.pi * SECOND / 300.0)
    rate = WHITE * rng.standard_normal(SECOND.size)
    quiet = rate.copy()
    rate = rate + sum(
        size * np.sin(2.0 * np.pi * k * turns) for k, size in ((1, 3.0), (2, 5.0), (3, 2.0))
    )
    level = [
        state_of_rotation(values[None], turns).blocks["order_level"].values[0]
        for values in (rate, quiet)
    ]
    usual = 3600.0 * 0.003**2
    assert np.nanmean(level[1]) == pytest.approx(usual, rel=0.08)
    assert np.nanmedian(level[0]) < 3.0 * usual


def test_scores_at_orders_scatter_like_null_records() -> None:
    state = make_swell(0.0)
    (drawn,) = null_records(
        state.blocks, state.baseline, count=40, rng=np.random.default_rng(1), chunk=40
    )
    real, noise = (
        find_statistic("ramp_phase").score(blocks, state.baseline)
        for blocks in (state.blocks, drawn)
    )
    assert real is not None
    assert noise is not None
    largest = noise["z"].max([dim for dim in noise["z"].dims if dim != "record"])
    assert float(real["z"].max()) < 2.0 * float(largest.max())


@pytest.mark.full
def test_line_of_another_axis_is_named_beside_resets_of_the_ramp():
    """The resets explain lines near multiples of the ramp frequency on their own axis only."""
    phase = np.mod(0.72 * SECOND, 1.0)
    rate = WHITE * np.random.default_rng(3).standard_normal((2, SECOND.size))
    rate[0] += WHITE * (phase - 0.5)
    rate[1] += 0.4 * WHITE * np.sin(2.0 * np.pi * 0.66 * SECOND)
    log = make_log(rate, rate=RATE, unit="deg/h").assign(ramp=("time", phase, {"units": "1"}))
    blocks = reduce_log(log, block="20s")
    baseline, records = nulls(blocks, 40)
    identified = name_effects(blocks, baseline, records).identified
    first, second = map(str, blocks["axis"].values)
    assert {(effect.effect, effect.axes) for effect in identified} == {
        ("feedback_reset", (first,)),
        ("spectral_line", (second,)),
    }
